"""A splat run as one HTML file that plays in a browser, or as a bare scene file.

The page opens from a folder, without a network. docs/formats.md, section "Scene file",
specifies what it holds.
"""

from __future__ import annotations

from pathlib import Path

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic, write_text
from hdr_nsff.core.progress import say
from hdr_nsff.rendering.export_gaussians import NOT_OURS, ColorTransform, exposure_of
from hdr_nsff.training.run_folder import Run
from hdr_nsff.viewer.field_scene import scene_of
from hdr_nsff.viewer.page_file import MARK, Link, PageSettings, make_page
from hdr_nsff.viewer.scene_file import KEY, SceneFile, to_bytes

PAGE, BARE = ".html", ".hdr4d"  # endings of the two kinds of files
HEAD_BYTES = 4096  # of a file, in which its mark is
# videos of `render` that a page without a GPU offers, if they are beside it
VIDEOS = {"training": "Video", "bullet": "Bullet time", "slowmo": "Slow motion"}


def export_page(run: Run, path: Path) -> Path:
    """Write the run's scene to `path`, as a page or bare, by its ending; `path`."""
    check_place(path)
    scene = run_scene(run)
    if not scene.groups:
        problem = "its field is not made of Gaussians, so no page can play it"
        raise InputError(f"{run.folder}: {problem}; use `hdr-nsff view`, or train `splat`")
    data = to_bytes(scene)
    if path.suffix.lower() == PAGE:
        settings = PageSettings(videos=find_videos(run, path.parent))
        write_text(path, make_page(scene.title, data, settings))
    else:
        with atomic(path) as temporary:
            temporary.write_bytes(data)
    size = path.stat().st_size / 1e6
    say(f"{path}: {scene.count()} Gaussians over {len(scene.times)} times, {size:.1f} MB")
    return path


def check_place(path: Path) -> None:
    """InputError where writing a page to `path` would destroy something else."""
    if path.exists() and not is_ours(path):
        raise InputError(f"{path}: {NOT_OURS}; choose another name")


def run_scene(run: Run) -> SceneFile:
    """The scene of a run; without Gaussians where its field has none."""
    exposure = exposure_of(run, ColorTransform())
    return scene_of(run.field, run.tonemapper, run.scene, run_title(run.folder), exposure)


def run_title(folder: Path) -> str:
    """A name for a run folder: that of the folder around it where it is just `run`."""
    place = folder.resolve()
    return place.parent.name if place.name == "run" else place.name


def find_videos(run: Run, folder: Path) -> list[Link]:
    """Videos of `render` that lie below `folder`, as links from it."""
    links = []
    for name, text in VIDEOS.items():
        for place in (folder / "render", run.folder / "render"):
            video = (place / f"{name}.mp4").resolve()
            if video.is_file() and video.is_relative_to(folder.resolve()):
                links.append(Link(video.relative_to(folder.resolve()).as_posix(), text))
                break
    return links


def is_ours(path: Path) -> bool:
    """Whether `export` wrote the file, so that it may be replaced."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    return MARK.encode() in head or f'{{"__metadata__":{{"{KEY}"'.encode() in head
