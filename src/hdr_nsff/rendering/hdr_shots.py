"""HDR videos and stills of a shot, made from its EXR files.

Diffuse white is 203 nits and the peak 1000 (`maths.hdr_signal`). One exposure holds for
the whole shot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.core.images import read_image
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry.hdr_footage import hdr_path, write_radiance_video
from hdr_nsff.radiometry.hdr_stills import still_path, write_hdr_still
from hdr_nsff.rendering.exr_header import WhiteBalance, balance, unbalance
from hdr_nsff.rendering.output import Output, Shot, ev_of
from hdr_nsff.training.run_folder import Run

TRANSFERS: tuple[Transfer, ...] = ("hlg", "pq")
CODECS: tuple[Codec, ...] = ("hevc", "av1", "prores")


def hdr_paths(
    out: Path,
    name: str,
    transfers: Sequence[Transfer] = TRANSFERS,
    codecs: Sequence[Codec] = CODECS,
) -> list[Path]:
    """All the HDR videos that a shot may have, or those of the given kinds."""
    return [hdr_path(out, name, transfer, codec) for transfer in transfers for codec in codecs]


def hdr_files(out: Path, name: str, output: Output) -> list[Path]:
    """The HDR videos that `output` asks for."""
    return hdr_paths(out, name, output.hdr_video, [output.hdr_codec])


def write_hdr_videos(
    run: Run,
    shot: Shot,
    pictures: Sequence[Path],
    out: Path,
    output: Output,
    display_exposure: float,
) -> None:
    """The HDR videos of a shot, from the EXR files beside its `pictures`.

    Exposed at the EV that was asked for, else as for a display.
    """
    files = [picture.with_suffix(".exr") for picture in pictures]
    exposure = display_exposure if output.ev is None else 2.0**output.ev
    balanced = output.white_balance, output.camera_id
    for transfer in output.hdr_video:
        path = hdr_path(out, shot.name, transfer, output.hdr_codec)
        codec = output.hdr_codec
        write_hdr_shot(run, files, path, transfer, codec, shot.fps, exposure, *balanced)


def write_hdr_stills(
    run: Run, shot: Shot, pictures: Sequence[Path], output: Output, display_exposure: float
) -> None:
    """The HDR stills that are missing, from the EXR files beside the `pictures`."""
    balanced = output.white_balance, output.camera_id
    for picture, view in zip(pictures, shot.views, strict=True):
        ev = ev_of(view, output)
        exposure = display_exposure if ev is None else 2.0**ev
        missing = [kind for kind in output.hdr_still if not still_path(picture, kind).exists()]
        if missing:
            radiance = next(neutral_radiance(run, [picture.with_suffix(".exr")], *balanced))
            sdr = read_image(picture)
            for kind in missing:
                write_hdr_still(still_path(picture, kind), kind, radiance, exposure, sdr)


def neutral_radiance(
    run: Run, files: Sequence[Path], choice: WhiteBalance, camera_id: int
) -> Iterator[np.ndarray]:
    """Radiance (H, W, 3) of EXR files with gray neutral, cut to even sizes."""
    for file in files:
        stored = read_exr(file)["RGB"]
        height = stored.shape[0] // 2 * 2
        width = stored.shape[1] // 2 * 2
        learned = unbalance(run, stored[:height, :width], choice, camera_id)
        yield balance(run, learned, "neutral", camera_id)


def write_hdr_shot(
    run: Run,
    files: Sequence[Path],
    path: Path,
    transfer: Transfer,
    codec: Codec,
    fps: float,
    exposure: float,
    choice: WhiteBalance,
    camera_id: int,
) -> None:
    """Write the video of a shot's EXR `files`, whose white balance is `choice`.

    `exposure` is the factor that brings diffuse white to radiance 1.
    """

    def frames() -> Iterator[np.ndarray]:
        return neutral_radiance(run, files, choice, camera_id)

    write_radiance_video(path, frames, transfer, codec, fps, exposure)
