"""A splat run as one HTML file that plays in a browser, or as a bare scene file.

The page opens from a folder, without a network. docs/formats.md, section "Scene file",
specifies what it holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.core.io import atomic, write_text
from hdr_nsff.core.progress import say
from hdr_nsff.radiometry.hdr_footage import hdr_path
from hdr_nsff.rendering.export_gaussians import NOT_OURS, ColorTransform, exposure_of
from hdr_nsff.rendering.hdr_shots import TRANSFERS
from hdr_nsff.rendering.output import render_folders
from hdr_nsff.training.run_folder import Run
from hdr_nsff.viewer.field_scene import scene_of
from hdr_nsff.viewer.page_file import MARK, Link, PageSettings, make_page
from hdr_nsff.viewer.scene_file import KEY, SceneFile, to_bytes

PAGE, BARE = ".html", ".hdr4d"  # endings of the two kinds of files
HEAD_BYTES = 4096  # of a file, in which its mark is
HDR_CLIP = "HDR clip"
MAX_CLIP_BYTES = 4_000_000  # of HDR videos inside a page (hand-chosen: easily sent)
MAX_VIDEO_BYTES = 4_000_000  # of the 8-bit video inside a page (hand-chosen likewise)
# in this order by browsers: hevc in HDR by more of them, av1 by more of them at all
PLAYED_CODECS: tuple[Codec, ...] = ("hevc", "av1")
# videos of `render` that a page offers: the first inside it, the others beside it
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
        write_text(path, single_page(run, path.parent, scene.title, data))
    else:
        with atomic(path) as temporary:
            temporary.write_bytes(data)
    size = path.stat().st_size / 1e6
    say(f"{path}: {scene.count()} Gaussians over {len(scene.times)} times, {size:.1f} MB")
    return path


def single_page(run: Run, folder: Path, title: str, data: bytes) -> str:
    """The page with the scene `data` inside, to be written into `folder`."""
    clips = find_hdr_clips(run, folder)
    held = clips_that_fit(clips)
    links = [Link(clip.name, HDR_CLIP) for clip in held]
    if clips and not held:
        beside = link_below(clips[-1], folder, HDR_CLIP)
        links = [] if beside is None else [beside]
    videos = find_videos(run, folder)
    filmed = find_filmed(run, folder)
    if filmed is not None:
        own = Link(filmed.name, VIDEOS["training"])
        videos = [own, *(link for link in videos if link.text != own.text)]
        held.append(filmed)
    inside = {video.name: video.read_bytes() for video in held}
    return make_page(title, data, PageSettings(videos, links), inside)


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


def places(run: Run, folder: Path) -> tuple[Path, ...]:
    """Where videos of a page in `folder` may be: of the run, then beside the page."""
    return (*render_folders(run.folder), folder / "render")


def find_filmed(run: Run, folder: Path) -> Path | None:
    """The 8-bit video as filmed, if there is one that is small enough for a page."""
    for place in places(run, folder):
        video = place / "training.mp4"
        if video.is_file():
            return video if video.stat().st_size <= MAX_VIDEO_BYTES else None
    return None


def find_videos(run: Run, folder: Path) -> list[Link]:
    """Videos of `render` that lie below `folder`, as links from it."""
    links = []
    for name, text in VIDEOS.items():
        for place in places(run, folder):
            link = link_below(place / f"{name}.mp4", folder, text)
            if link is not None:
                links.append(link)
                break
    return links


def link_below(video: Path, folder: Path, text: str) -> Link | None:
    """A link from `folder` to a video, if that exists and lies below it."""
    target, base = video.resolve(), folder.resolve()
    if not (target.is_file() and target.is_relative_to(base)):
        return None
    return Link(quote(target.relative_to(base).as_posix()), text)


def find_hdr_clips(run: Run, folder: Path) -> list[Path]:
    """The HDR video as filmed that `render` or `run` has made: one file per codec, in
    the order of `PLAYED_CODECS`; empty without any.
    """
    for transfer in TRANSFERS:
        clips = []
        for codec in PLAYED_CODECS:
            paths = [hdr_path(place, "training", transfer, codec) for place in places(run, folder)]
            clips += [path for path in paths if path.is_file()][:1]
        if clips:
            return clips
    return []


def clips_that_fit(clips: Sequence[Path]) -> list[Path]:
    """Those of `clips` that fit into a page together; the last one is chosen first."""
    chosen: list[Path] = []
    left = MAX_CLIP_BYTES
    for clip in reversed(clips):
        size = clip.stat().st_size
        if size <= left:
            chosen.insert(0, clip)
            left -= size
    return chosen


def is_ours(path: Path) -> bool:
    """Whether `export` wrote the file, so that it may be replaced."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    return MARK.encode() in head or f'{{"__metadata__":{{"{KEY}"'.encode() in head
