"""Depth and disparity maps that other programs estimated, read from files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_codes, read_image
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.geometry.fill import fill

# what a map holds: z-depth in scene units, 1 / z-depth, or disparity up to scale and
# shift
DepthKind = Literal["metric", "disparity", "relative"]

ARRAYS = (".npy", ".exr")  # other files are pictures
MILLIMETERS = 1000.0  # in a scene unit: what metric pictures hold
# what to write where a map knows nothing
UNKNOWN: dict[DepthKind, str] = {
    "metric": "write 0 where depth is unknown",
    "disparity": "write -1 where disparity is unknown",
    "relative": "write a number everywhere",
}
MIN_DEPTH = 1e-6  # of metric maps: what is nearer is no measurement, and has no disparity


def read_depth_files(
    files: list[Path], kind: DepthKind, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (T, H, W) of depth maps of `size` (H, W), one file per
    frame, see `read_depth`.
    """
    disparity = np.zeros((len(files), *size), np.float32)
    confidence = np.ones((len(files), *size), np.float32)
    for k, path in enumerate(files):
        disparity[k], confidence[k] = read_depth(path, kind, size)
    return disparity, confidence


def read_depth(path: Path, kind: DepthKind, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (H, W) of a depth map: .npy, EXR or PNG of `size` (H,
    W), see `read_map`.

    Where a metric map holds 0 or less, or one of disparity less than 0, nothing was
    measured: confidence is 0, and disparity that of the pixels around. Elsewhere
    confidence is 1. InputError for another size, NaN, or an empty map.
    """
    values = read_map(path, kind == "metric")
    if values.shape != size:
        raise InputError(
            f"{path}: a depth map of shape {values.shape}, the frames need {size}; "
            "make it at the size of the frames"
        )
    if not np.isfinite(values).all():
        raise InputError(f"{path}: the depth map holds NaN or Inf; {UNKNOWN[kind]}")
    least = MIN_DEPTH if kind == "metric" else 0
    if kind != "relative" and not (values > least).any():
        raise InputError(f"{path}: no depth above 0 in this map; check that its kind is {kind!r}")
    if kind == "relative":
        return values, np.ones(size, np.float32)
    if kind == "disparity":
        known = values >= 0  # at 0 it is far away
        return fill(values, known), known.astype(np.float32)
    known = values > MIN_DEPTH
    return fill(1 / np.where(known, values, 1), known), known.astype(np.float32)


def read_map(path: Path, is_metric: bool) -> np.ndarray:
    """One map (H, W) float32 of metric depth, or of anything else.

    From a .npy, from channel Z of an EXR (or its only one), or from a PNG: millimeters
    in 16 bits for metric depth, which become scene units, else shares of white.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return np.squeeze(read_array(path))
    if suffix not in ARRAYS:
        return read_millimeters(path) if is_metric else read_image(path)[..., 0]
    channels = read_exr(path)
    if not channels:
        raise InputError(f"{path}: an EXR without channels; write depth as channel Z")
    values = channels["Z"] if "Z" in channels else next(iter(channels.values()))
    return values if values.ndim == 2 else values[..., 0]


def read_millimeters(path: Path) -> np.ndarray:
    """Metric depth (H, W) float32, scene units, of a picture in millimeters.

    InputError for one of 8 bits, which end at 255.
    """
    codes = read_codes(path)[..., 0]
    if codes.dtype != np.uint16:
        raise InputError(
            f"{path}: 8 bits hold no metric depth; write millimeters in 16 bits, .npy or EXR, or "
            "give disparity by --depth with --depth-kind disparity or relative"
        )
    return codes.astype(np.float32) / np.float32(MILLIMETERS)
