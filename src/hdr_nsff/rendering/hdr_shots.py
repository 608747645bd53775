"""HDR videos of a shot, made from its EXR files.

Diffuse white is 203 nits and the peak 1000 (`maths.hdr_signal`). One exposure holds for
the whole shot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry.hdr_footage import write_radiance_video
from hdr_nsff.rendering.exr_header import WhiteBalance, balance, unbalance
from hdr_nsff.training.run_folder import Run

TRANSFERS: tuple[Transfer, ...] = ("hlg", "pq")
CODECS: tuple[Codec, ...] = ("hevc", "av1", "prores")
ENDINGS = {"hevc": ".mp4", "av1": "_av1.mp4", "prores": "_prores.mov"}


def hdr_path(out: Path, name: str, transfer: Transfer, codec: Codec) -> Path:
    """`NAME_hlg.mp4` or `NAME_pq.mp4`; of other codecs `NAME_hlg_av1.mp4` and so on."""
    return out / f"{name}_{transfer}{ENDINGS[codec]}"


def hdr_paths(
    out: Path,
    name: str,
    transfers: Sequence[Transfer] = TRANSFERS,
    codecs: Sequence[Codec] = CODECS,
) -> list[Path]:
    """All the HDR videos that a shot may have, or those of the given kinds."""
    return [hdr_path(out, name, transfer, codec) for transfer in transfers for codec in codecs]


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
