"""HDR video of linear radiance: diffuse white is 203 nits, the peak 1000.

One exposure holds for the whole video; what a screen shows of radiance is in
`maths.hdr_signal`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from hdr_nsff.core.hdr_video import (
    Codec,
    LightLevels,
    Planes,
    has_full_chroma,
    write_hdr_video,
)
from hdr_nsff.maths.hdr_signal import PEAK_NITS, Transfer, display_light, encode, ycbcr_planes

ENDINGS = {"hevc": ".mp4", "av1": "_av1.mp4", "prores": "_prores.mov"}


def hdr_path(out: Path, name: str, transfer: Transfer, codec: Codec) -> Path:
    """`NAME_hlg.mp4` or `NAME_pq.mp4`; of other codecs `NAME_hlg_av1.mp4` and so on."""
    return out / f"{name}_{transfer}{ENDINGS[codec]}"


def write_radiance_video(
    path: Path,
    frames: Callable[[], Iterable[np.ndarray]],
    transfer: Transfer,
    codec: Codec,
    fps: float,
    exposure: float,
) -> None:
    """Write frames of linear Rec. 709 radiance (H, W, 3), gray neutral, as HDR video.

    `frames` is called twice for PQ, whose light levels are measured first. `exposure`
    is the factor that brings diffuse white to 1. Sides are cut to even numbers.
    """

    def light() -> Iterator[np.ndarray]:
        for radiance in frames():
            height, width = radiance.shape[0] // 2 * 2, radiance.shape[1] // 2 * 2
            yield display_light(radiance[:height, :width], exposure, transfer)

    def planes() -> Iterator[Planes]:
        for nits in light():
            yield ycbcr_planes(encode(nits, transfer), has_full_chroma(codec))

    levels = None  # HLG has none: its signal is relative to the display's peak
    if transfer == "pq":
        levels = measure_light(light())
    write_hdr_video(path, planes(), fps, transfer, codec, levels, PEAK_NITS)


def measure_light(frames: Iterable[np.ndarray]) -> LightLevels:
    """MaxCLL and MaxFALL of frames of display light (H, W, 3) in nits."""
    max_cll = 0.0
    max_fall = 0.0
    for nits in frames:
        largest = nits.max(-1)
        max_cll = max(max_cll, float(largest.max()))
        max_fall = max(max_fall, float(largest.mean()))
    return LightLevels(max_cll, max_fall)
