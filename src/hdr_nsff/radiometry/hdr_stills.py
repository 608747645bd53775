"""HDR stills of linear radiance: diffuse white is 203 nits, the peak 1000.

They show the light of the HDR videos (`maths.hdr_signal`). An Ultra HDR JPEG shows an
8-bit picture on other screens.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.exr import REC709
from hdr_nsff.core.hdr_still import write_avif, write_pq_png
from hdr_nsff.core.ultra_hdr import write_ultra_hdr
from hdr_nsff.maths.color import srgb_decode
from hdr_nsff.maths.gain_map import GainMap, make_gain_map
from hdr_nsff.maths.hdr_signal import (
    PEAK_NITS,
    REC2020,
    WHITE_NITS,
    display_light,
    encode,
    rgb_to_xyz,
    ycbcr_planes,
)
from hdr_nsff.radiometry.hdr_footage import measure_light

HdrStill = Literal["ultrahdr", "avif", "png16"]

SUFFIXES: dict[HdrStill, str] = {
    "ultrahdr": "_ultrahdr.jpg",
    "avif": "_pq.avif",
    "png16": "_pq.png",
}
HEADROOM = float(np.log2(PEAK_NITS / WHITE_NITS))  # stops of the peak above diffuse white


def still_path(picture: Path, kind: HdrStill) -> Path:
    """The HDR still beside the picture `NNNNN.png`."""
    return picture.with_name(picture.stem + SUFFIXES[kind])


def still_paths(pictures: Sequence[Path], kinds: Sequence[HdrStill]) -> list[Path]:
    """The HDR stills of a shot."""
    return [still_path(picture, kind) for picture in pictures for kind in kinds]


def write_hdr_still(
    path: Path, kind: HdrStill, radiance: np.ndarray, exposure: float, sdr: np.ndarray
) -> None:
    """Write radiance (H, W, 3), in linear Rec. 709 with gray neutral, as an HDR still.

    `exposure` brings diffuse white to 1; `sdr` (H, W, 3) in [0, 1] is the same picture
    in sRGB, for screens without HDR.
    """
    light = display_light(radiance, exposure, "pq")
    match kind:
        case "avif":
            write_avif(path, ycbcr_planes(encode(light, "pq")))
        case "png16":
            write_pq_png(path, encode(light, "pq"), measure_light(iter([light])))
        case "ultrahdr":
            height, width = light.shape[:2]
            hdr = rec2020_to_rec709(light) / WHITE_NITS

            def gains_of(sdr: np.ndarray) -> GainMap:
                return make_gain_map(srgb_decode(sdr), hdr, HEADROOM)

            write_ultra_hdr(path, sdr[:height, :width], gains_of)


def rec2020_to_rec709(rgb: np.ndarray) -> np.ndarray:
    """Linear rgb (..., 3) of BT.2020 in Rec. 709 primaries (BT.2087)."""
    matrix = np.linalg.solve(rgb_to_xyz(REC709), rgb_to_xyz(REC2020))
    return rgb @ matrix.T
