"""A run as the viewer's server shows it: its page and scene, and frames on request.

While the run is still training, its newest checkpoint is opened again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from hdr_nsff.core.checkpoints import checkpoint_files
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.fields.recording_field import RecordingField
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.export_page import HDR_CLIP, VIDEOS, find_hdr_clips, run_scene
from hdr_nsff.rendering.output import render_folders
from hdr_nsff.rendering.row_bands import render_in_bands
from hdr_nsff.rendering.served_picture import served_picture
from hdr_nsff.rendering.shot_views import check_views
from hdr_nsff.rendering.stills import Still
from hdr_nsff.training.run_folder import Run
from hdr_nsff.viewer.display import png
from hdr_nsff.viewer.field_scene import jpeg
from hdr_nsff.viewer.page_file import Link, PageSettings, make_page
from hdr_nsff.viewer.scene_file import to_bytes
from hdr_nsff.viewer.server import FrameRequest

BITS = {"png8": 8, "png16": 16}


class ServedRun:
    """The source of a `ViewerServer`. One thread at a time opens, reads or renders."""

    def __init__(self, folder: Path, device: str) -> None:
        self.folder, self.device = folder, device
        self.lock = threading.Lock()
        self.open()

    def open(self) -> None:
        """Open the newest checkpoint."""
        newest = newest_checkpoint(self.folder)
        self.run = Run.open(self.folder, self.device)
        self.opened = newest
        self.kept: tuple[bytes, Still] | None = None  # the last rendered view, by its key
        scene = run_scene(self.run)
        self.title, self.data = scene.title, to_bytes(scene)

    def page(self) -> str:
        names = {path.name: address.removeprefix("/") for address, path in self.videos().items()}
        videos = [
            Link(names[f"{name}.mp4"], text)
            for name, text in VIDEOS.items()
            if f"{name}.mp4" in names
        ]
        clips = [Link(names[clip.name], HDR_CLIP) for clip in self.hdr_clips()]
        records = isinstance(self.run.field, RecordingField)
        settings = PageSettings(videos, clips, server=True, records=records)
        return make_page(self.title, None, settings)

    def places(self) -> list[Path]:
        """Folders where the run's videos may be."""
        return render_folders(self.folder)

    def hdr_clips(self) -> list[Path]:
        return find_hdr_clips(self.run, self.places()[-1].parent)

    def videos(self) -> dict[str, Path]:
        found = [place / f"{name}.mp4" for name in VIDEOS for place in reversed(self.places())]
        found += self.hdr_clips()
        return {f"/video/{file.name}": file for file in found if file.is_file()}

    def scene(self) -> bytes:
        with self.lock:
            return self.data

    def version(self) -> str:
        with self.lock:
            if newest_checkpoint(self.folder) != self.opened:
                try:
                    self.open()
                except InputError as error:  # replaced while it was read: look again later
                    say(f"{self.folder}: {error}")
            return self.opened

    def frame(self, request: FrameRequest, awaited: Callable[[], bool]) -> bytes | None:
        with self.lock:
            view = self.view_of(request)
            check_views(self.run, "frame", [view])
            still = self.still_of(view, request.show == "flow", awaited)
            if still is None:
                return None
            rgb = served_picture(self.run, request, view, still)
        return jpeg(rgb) if request.kind == "jpeg" else png(rgb, BITS[request.kind])

    def still_of(self, view: PathView, motion: bool, awaited: Callable[[], bool]) -> Still | None:
        """The rendered view. The last one is kept, to be developed in other ways."""
        key = view_key(view, motion)
        if self.kept is None or self.kept[0] != key:
            still = render_in_bands(self.run, view, motion, awaited)
            if still is None:
                return None
            self.kept = key, still
        return self.kept[1]

    def view_of(self, request: FrameRequest) -> PathView:
        """The view that a request asks for."""
        like = self.run.scene.train[0].camera
        K = torch.from_numpy(request.K).to(like.K)
        c2w = torch.from_numpy(request.c2w).to(like.c2w)
        return PathView(Camera(K, c2w, request.width, request.height), request.time)


def view_key(view: PathView, motion: bool) -> bytes:
    """What a rendering of a view depends on."""
    camera = view.camera
    numbers = [view.time, float(motion), camera.width, camera.height]
    parts = [torch.tensor(numbers, dtype=torch.float64), camera.K, camera.c2w]
    return b"".join(part.cpu().numpy().tobytes() for part in parts)


def newest_checkpoint(folder: Path) -> str:
    """The name of the newest checkpoint; empty without one."""
    files = checkpoint_files(folder)
    return files[0].name if files else ""
