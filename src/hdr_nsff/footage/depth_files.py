"""Depth and disparity maps that other programs estimated, read from files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.geometry.fill import fill

# what a map holds: z-depth in scene units, 1 / z-depth, or disparity up to scale and
# shift
DepthKind = Literal["metric", "disparity", "relative"]

MIN_DEPTH = 1e-6  # of metric maps: what is nearer is no measurement, and has no disparity


def read_depth_files(
    files: list[Path], kind: DepthKind, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (T, H, W) of depth maps, one file per frame.

    Files are .npy, EXR or 16-bit PNG of `size` (H, W). Confidence is 1, and 0 where a
    metric map holds 0 or less (no measurement). InputError for another size, NaN, or an
    empty map.
    """
    disparity = np.zeros((len(files), *size), np.float32)
    confidence = np.ones((len(files), *size), np.float32)
    maps = [read_map(path) for path in files]
    for k, (path, values) in enumerate(zip(files, maps, strict=True)):
        if values.shape != size:
            raise InputError(
                f"{path}: a depth map of shape {values.shape}, the frames need {size}; "
                "make it at the size of the frames"
            )
        if not np.isfinite(values).all():
            raise InputError(
                f"{path}: the depth map holds NaN or Inf; write 0 where depth is unknown"
            )
        least = MIN_DEPTH if kind == "metric" else 0
        known = values > least
        if kind != "relative" and not known.any():
            raise InputError(
                f"{path}: no depth above 0 in this map; check that its kind is {kind!r}"
            )
        if kind == "metric":
            disparity[k] = fill(1 / np.where(known, values, 1), known)
            confidence[k] = known
        else:
            disparity[k] = values
    return disparity, confidence


def read_map(path: Path) -> np.ndarray:
    """One depth or disparity map (H, W) float32.

    From a .npy, from channel Z of an EXR (or its only one), or from a PNG as shares of
    white.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return np.squeeze(read_array(path))
    if suffix != ".exr":
        return read_image(path)[..., 0]
    channels = read_exr(path)
    if not channels:
        raise InputError(f"{path}: an EXR without channels; write depth as channel Z")
    values = channels["Z"] if "Z" in channels else next(iter(channels.values()))
    return values if values.ndim == 2 else values[..., 0]
