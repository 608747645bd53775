"""A run as the viewer's server shows it: its page and scene, and frames on request.

While the run is still training, its newest checkpoint is opened again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.checkpoints import checkpoint_files
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import colorize
from hdr_nsff.core.progress import say
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.maths import color
from hdr_nsff.rendering.develop import develop_view
from hdr_nsff.rendering.export_page import HDR_CLIP, VIDEOS, find_hdr_clip, run_scene
from hdr_nsff.rendering.output import render_folders
from hdr_nsff.rendering.row_bands import render_in_bands
from hdr_nsff.rendering.shot_views import check_views
from hdr_nsff.rendering.stills import Still
from hdr_nsff.training.run_folder import Run
from hdr_nsff.viewer.field_scene import jpeg
from hdr_nsff.viewer.page_file import Link, PageSettings, make_page
from hdr_nsff.viewer.scene_file import to_bytes
from hdr_nsff.viewer.server import FrameRequest

MOTION_COLOR = (1.0, 0.62, 0.15)  # of moving content, as on the page
STILL_COLOR = 0.07


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
        scene = run_scene(self.run)
        self.title, self.data = scene.title, to_bytes(scene)

    def page(self) -> str:
        names = {path.name: address.removeprefix("/") for address, path in self.videos().items()}
        videos = [
            Link(names[f"{name}.mp4"], text)
            for name, text in VIDEOS.items()
            if f"{name}.mp4" in names
        ]
        clip = self.hdr_clip()
        link = None if clip is None else Link(names[clip.name], HDR_CLIP)
        return make_page(self.title, None, PageSettings(videos, link, server=True))

    def places(self) -> list[Path]:
        """Folders where the run's videos may be."""
        return render_folders(self.folder)

    def hdr_clip(self) -> Path | None:
        return find_hdr_clip(self.run, self.places()[-1].parent)

    def videos(self) -> dict[str, Path]:
        found = [place / f"{name}.mp4" for name in VIDEOS for place in reversed(self.places())]
        clip = self.hdr_clip()
        found += [] if clip is None else [clip]
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
            still = render_in_bands(self.run, view, False, awaited)
            return None if still is None else jpeg(self.picture(request, view, still))

    def view_of(self, request: FrameRequest) -> PathView:
        """The view that a request asks for."""
        like = self.run.scene.train[0].camera
        K = torch.from_numpy(request.K).to(like.K)
        c2w = torch.from_numpy(request.c2w).to(like.c2w)
        return PathView(Camera(K, c2w, request.width, request.height), request.time)

    def picture(self, request: FrameRequest, view: PathView, still: Still) -> np.ndarray:
        """What a request shows of a rendered view: rgb (H, W, 3) in [0, 1]."""
        near, far = self.run.scene.near, self.run.scene.far
        match request.show:
            case "depth":
                disparity = 1 / np.clip(still.depth, near, far)
                return colorize(disparity, 1 / far, 1 / near)
            case "motion":
                share = still.motion[..., None].clip(0, 1)
                return STILL_COLOR + share * (np.array(MOTION_COLOR) - STILL_COLOR)
        return self.develop(request, view, still.radiance)

    def develop(self, request: FrameRequest, view: PathView, radiance: np.ndarray) -> np.ndarray:
        """Radiance (H, W, 3) of a view through the curve of a request."""
        camera_id, exposure = request.camera_id, 2.0**request.ev
        if not 0 <= camera_id < self.run.tonemapper.num_cameras:
            raise InputError(f"frame: camera {camera_id} is not known")
        match request.curve:
            case "camera":
                return develop_view(self.run, view, radiance, request.ev, camera_id, 1.0)
            case "clip":
                neutral = self.run.tonemapper.neutral(camera_id).detach().cpu().numpy()
                return color.srgb_encode(radiance * neutral * exposure)
        return develop_view(self.run, view, radiance, None, camera_id, exposure)


def newest_checkpoint(folder: Path) -> str:
    """The name of the newest checkpoint; empty without one."""
    files = checkpoint_files(folder)
    return files[0].name if files else ""
