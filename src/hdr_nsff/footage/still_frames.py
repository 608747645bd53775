"""One frame from its file: recorded rgb of PNG, JPEG and TIFF, linear light of EXR and
DNG.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.core.picture_size import check_size


def read_frame(path: Path, over: float | None = None) -> np.ndarray:
    """One frame file as float32 (H, W, 3): recorded rgb, or linear for EXR and DNG.

    `over` is the gray that shows through transparent pixels.
    """
    suffix = path.suffix.lower()
    if suffix == ".dng":
        return read_dng(path)
    if suffix == ".exr":
        return read_linear_exr(path)
    return read_image(path, over)


def read_linear_exr(path: Path) -> np.ndarray:
    """Linear radiance (H, W, 3) of an EXR, gray or rgb; InputError below zero."""
    channels = read_exr(path, ("RGB", "Y"))
    light = channels.get("RGB", channels.get("Y"))
    if light is None:
        found = shorten(", ".join(channels))
        raise InputError(f"{path}: no R, G, B channels (found {found}); write the picture as RGB")
    if light.min() < 0:
        raise InputError(
            f"{path}: negative radiance; clip at zero or subtract the black level before "
            "writing the EXR"
        )
    return light if light.ndim == 3 else np.repeat(light[..., None], 3, -1)


def read_dng(path: Path) -> np.ndarray:
    """A raw photograph as linear rgb (H, W, 3), 1 where the sensor saturates.

    Daylight white balance, the same for every frame.
    """
    try:
        import rawpy
    except ImportError as error:
        raise InputError(
            f"{path}: DNG frames need rawpy; install it with `pip install rawpy`"
        ) from error
    try:
        with rawpy.imread(str(path)) as raw:
            check_size(path, raw.sizes.width, raw.sizes.height)
            image = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                output_bps=16,
                adjust_maximum_thr=0.0,  # white is the sensor's, not the frame's brightest
                user_wb=daylight_gains(raw.daylight_whitebalance),
            )
    except rawpy.LibRawError as error:
        raise InputError(f"{path}: not a readable DNG ({error!s}); copy it again") from error
    return image.astype(np.float32) / np.float32(65535)


def daylight_gains(gains: list[float]) -> list[float]:
    """LibRaw's gains of red, green, blue and the second green, none of them 0. It gives
    0 where it knows none, and for a second green that is as the first.
    """
    red, green, blue, second = gains
    green = green or 1.0
    return [red or 1.0, green, blue or 1.0, second or green]
