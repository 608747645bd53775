"""The radiance of a clip as HDR references beside it: videos and stills."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core.hdr_video import Codec, check_encoder, check_rate, check_side
from hdr_nsff.core.progress import say, track
from hdr_nsff.maths import color
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry.hdr_footage import hdr_path, write_radiance_video
from hdr_nsff.radiometry.hdr_stills import HdrStill, still_path, write_hdr_still

FOLDER = "reference"  # of the stills, in the output folder


@dataclass(frozen=True)
class ReferenceKinds:
    """Which references are wanted."""

    videos: tuple[Transfer, ...]
    codec: Codec  # of the videos
    stills: tuple[HdrStill, ...]


def check_references(
    footage: Path, size: tuple[int, int], fps: float, kinds: ReferenceKinds
) -> None:
    """InputError where frames of `size` (width, height) cannot be written so."""
    if kinds.videos:
        check_encoder(kinds.codec)
        check_rate(footage, kinds.codec, fps)
    if "avif" in kinds.stills:
        check_encoder("av1")
    if kinds.videos or "avif" in kinds.stills:
        check_side(footage, *size)


def write_references(
    out: Path,
    frames: Callable[[], Iterator[np.ndarray]],
    num_frames: int,
    fps: float,
    exposure: float,
    kinds: ReferenceKinds,
) -> None:
    """Write what is asked for of `frames()`, linear Rec. 709 radiance (H, W, 3).

    `exposure` brings diffuse white to 1. Stills that are there are kept.
    """
    for transfer in kinds.videos:
        path = hdr_path(out, "reference", transfer, kinds.codec)
        write_radiance_video(path, frames, transfer, kinds.codec, fps, exposure)
        say(f"{path}: the radiance of the clip")
    if not kinds.stills:
        return
    for k, radiance in enumerate(track(frames(), "HDR stills", num_frames)):
        write_stills(out / FOLDER / f"{k:05d}.png", radiance, exposure, kinds.stills)
    say(f"{out / FOLDER}: the radiance of the clip")


def write_stills(
    picture: Path, radiance: np.ndarray, exposure: float, kinds: tuple[HdrStill, ...]
) -> None:
    """Write the HDR stills that are missing beside where `picture` would be."""
    missing = [kind for kind in kinds if not still_path(picture, kind).is_file()]
    if missing:
        sdr = color.display(radiance, exposure)
        for kind in missing:
            write_hdr_still(still_path(picture, kind), kind, radiance, exposure, sdr)
