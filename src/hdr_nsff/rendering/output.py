"""What is asked for: a shot, which files are written of its views, and how pictures are
developed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry.hdr_stills import HdrStill
from hdr_nsff.rendering.exr_header import WhiteBalance
from hdr_nsff.rendering.interpolate import Mode
from hdr_nsff.rendering.stills import Vectors


@dataclass(frozen=True)
class Shot:
    """A named list of views and its speed."""

    name: str
    views: list[PathView]
    fps: float


@dataclass(frozen=True)
class Output:
    """Which files are written for every view, and how pictures are developed."""

    exr: Literal["half", "float", "none"] = "half"
    """EXR: radiance, alpha, depth Z, motion, motion vectors, mattes of the movers."""
    exr_vectors: Vectors = "nuke"
    """Names and signs of motion on the screen: forward.u, ... for Nuke, Vector.X, ...
    for Blender.
    """
    png: bool = True
    """8-bit PNG."""
    video: bool = True
    """8-bit H.264 MP4."""
    hdr_video: tuple[Transfer, ...] = ()
    """10-bit HDR video: hlg, pq (HDR10) or both. Diffuse white is 203 nits, the peak
    1000.
    """
    hdr_codec: Codec = "hevc"
    """Of HDR videos: hevc plays on more screens, av1 is royalty-free, prores (4444,
    MOV) is for editing programs.
    """
    hdr_still: tuple[HdrStill, ...] = ()
    """HDR picture of every view: ultrahdr (JPEG with a gain map, for phones and
    browsers), avif (PQ, 10 bits), png16 (PQ, 16 bits).
    """
    ev: float | None = None
    """Develop at this exposure, relative to the reference; default: tone-map for a
    display.
    """
    ocio: str | None = None
    """Develop PNG and video by OpenColorIO instead: studio-config-latest,
    cg-config-latest, or a file NAME.ocio. White is as for HDR: --ev, else the
    display's exposure.
    """
    view: str | None = None
    """With --ocio: a view, like 'ACES 2.0 - SDR 100 nits (Rec.709)'; default: the
    display's first.
    """
    display: str | None = None
    """With --ocio: a display, like 'sRGB - Display'; default: the first."""
    camera_id: int = 0
    """Whose learned response and white balance develop the picture (with --ev), and
    whose neutral --white-balance takes.
    """
    white_balance: WhiteBalance = "camera"
    """Radiance in EXR files. camera: in the run's unit of each channel; neutral: times
    the gains that make gray neutral. The header has these gains either way. PNG and
    video are neutral anyhow.
    """
    lens: Literal["pinhole", "original"] = "pinhole"
    """original: with the distortion of the clip's lens (of --camera-id), where
    `prepare` has removed one.
    """
    between: Mode = "auto"
    """Times between frames: splat along the scene flow, or ask the field directly; auto
    splats where the field can.
    """


def render_folders(run: Path) -> list[Path]:
    """Where shots of a run folder may be: by `render`, then by the verb `run`."""
    whole = run.resolve()
    by_run = [whole.parent / "render"] if whole.name == "run" else []
    return [run / "render", *by_run]


def picture_settings(output: Output) -> dict[str, Any]:
    """The settings that the pictures and EXR files of a shot depend on."""
    later = {"hdr_video", "hdr_codec", "hdr_still"}  # made from them
    if output.lens == "pinhole":
        later.add("lens")  # as before there was a choice
    return {name: value for name, value in vars(output).items() if name not in later}


def ev_of(view: PathView, output: Output) -> float | None:
    """The EV at which a view is developed; None: tone-mapped for a display."""
    return output.ev if view.ev is None else view.ev
