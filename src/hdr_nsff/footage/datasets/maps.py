"""Maps that a data set gives (masks, flow, depth) at the size of the frames as used,
depth in units of the poses.

A map of the same size passes untouched; another one of the same shape is resampled:
masks and depth by the nearest pixel, flow by area with its vectors scaled. Depth of a
network's own units is brought to those of the poses by static points: metric depth by
one scale for all pictures, disparity by a scale and a shift per picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_mask
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.footage.datasets.capture import Capture, Picture, Sighting
from hdr_nsff.footage.depth_files import read_map
from hdr_nsff.footage.flow_files import read_npz
from hdr_nsff.geometry.fill import fill

AREA = cv2.INTER_AREA
SHAPE = 0.02  # by how much the proportions of a map may differ from the frames'
ENOUGH = 20  # points from which a scale and shift are fitted
FARTHEST = 3.0  # times the far bound: what fitted disparity is clamped to


def fitted(path: Path, array: np.ndarray, size: tuple[int, int], interpolation: int) -> np.ndarray:
    """`array` (h, w, ...) at `size` (H, W); InputError for one of another shape."""
    h, w = array.shape[:2]
    if (h, w) == size:
        return array
    if abs(w / h / (size[1] / size[0]) - 1) > SHAPE:
        raise InputError(
            f"{path}: {w}x{h} for frames of {size[1]}x{size[0]}, another shape; make it the shape of the frames"
        )
    return cv2.resize(array, size[::-1], interpolation=interpolation)


def moving_mask(path: Path, size: tuple[int, int], white_moves: bool) -> np.ndarray:
    """A moving mask (H, W) bool."""
    mask = fitted(path, read_mask(path).astype(np.uint8), size, cv2.INTER_NEAREST) > 0
    return mask if white_moves else ~mask


def flow_map(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px and where it is valid (H, W), from .npz (`flow`, `mask`) or
    .npy with `_valid.png`.
    """
    if path.suffix == ".npz":
        flow, valid = read_npz(path)
    else:
        flow, valid = read_array(path), read_mask(path.with_name(f"{path.stem}_valid.png"))
    if flow.ndim != 3 or flow.shape[2] != 2 or valid.shape != flow.shape[:2]:
        raise InputError(
            f"{path}: expected flow (H, W, 2) with a mask (H, W), found {flow.shape} and {valid.shape}; copy it again"
        )
    if not np.isfinite(flow).all():
        raise InputError(
            f"{path}: the flow holds NaN or Inf; write 0 there and mask those pixels out"
        )
    scale = np.array([size[1] / flow.shape[1], size[0] / flow.shape[0]], np.float32)
    valid = fitted(path, valid.astype(np.uint8), size, cv2.INTER_NEAREST) > 0
    return fitted(path, flow, size, cv2.INTER_AREA) * scale, valid


def depth_map(path: Path, size: tuple[int, int]) -> np.ndarray:
    """A depth or disparity map (H, W) float32 as stored."""
    values = read_map(path)
    if values.ndim != 2:
        raise InputError(
            f"{path}: a depth map of shape {values.shape}; it must be (H, W), copy it again"
        )
    if not np.isfinite(values).all():
        raise InputError(f"{path}: the depth map holds NaN or Inf; write 0 where depth is unknown")
    return fitted(path, values, size, cv2.INTER_NEAREST)


def disparities(
    capture: Capture, chosen: Sequence[Picture], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, str]:
    """Disparity and confidence (T, H, W) of the `chosen` pictures, and how they were
    brought to scene units, in words.
    """
    paths = [p.depth for p in chosen if p.depth is not None]
    maps = np.stack([depth_map(path, size) for path in paths])
    kind = capture.depth_kind
    if kind == "metric":
        whole = [
            65535.0 if path.suffix.lower() == ".png" else 1.0 for path in paths
        ]  # pictures are read as shares of white
        maps *= np.array(whole, np.float32)[:, None, None] * np.float32(capture.depth_scale)
    for path, values in zip(paths, maps, strict=True):
        if kind != "relative" and not (values > 0).any():
            raise InputError(f"{path}: nothing above 0 in this depth map; copy it again")
    seen = [capture.sightings.get(p.source) for p in chosen]
    note = ""
    if capture.depth_units == "own" and kind == "metric":
        scale, note = metric_scale(maps, seen)
        maps *= np.float32(scale)
    known = maps > 0
    if kind == "metric":
        disparity = np.stack(
            [fill(1 / np.where(k, m, 1), k) for m, k in zip(maps, known, strict=True)]
        )
        return disparity, known.astype(np.float32), note
    if capture.depth_units == "own":
        maps, note = shifted(maps, seen)
    return maps, trust(chosen, size), note


def trust(chosen: Sequence[Picture], size: tuple[int, int]) -> np.ndarray:
    """The confidence (T, H, W) that the set gives of its disparity; 1 where it gives
    none.
    """
    one = np.ones(size, np.float32)
    return np.stack(
        [
            one if p.confidence is None else np.array(depth_map(p.confidence, size), np.float32)
            for p in chosen
        ]
    )


def sampled(values: np.ndarray, seen: Sighting) -> np.ndarray:
    """A map (H, W) at the static points of a picture (n,)."""
    h, w = values.shape
    x, y = (np.clip((seen.xy * [w, h]).astype(int), 0, [w - 1, h - 1])).T
    return values[y, x]


def metric_scale(maps: np.ndarray, seen: Sequence[Sighting | None]) -> tuple[float, str]:
    """Scene units per unit of metric depth (T, H, W), one for all pictures: the median
    over what they see of the static points.
    """
    ratios = []
    for values, s in zip(maps, seen, strict=True):
        if s is not None and len(s.depth):
            there = sampled(values, s)
            ratios.append(s.depth[there > 0] / there[there > 0])
    if ratios and len(every := np.concatenate(ratios)) >= ENOUGH:
        scale = float(np.median(every))
        spread = float(np.median(np.abs(np.log(every / scale))))
        return (
            scale,
            f"1 unit of it is {scale:.4g} scene units, by {len(every)} static points (median deviation {spread:.0%})",
        )
    bounds = [
        np.sqrt(np.prod(s.bounds) / np.prod(np.percentile(v[v > 0], [5, 95])))
        for v, s in zip(maps, seen, strict=True)
        if s is not None and min(s.bounds) > 0 and (v > 0).any()
    ]
    if not bounds:
        return 1.0, "taken to be in scene units: nothing tells otherwise"
    scale = float(np.median(bounds))
    return (
        scale,
        f"1 unit of it is {scale:.4g} scene units, by the near and far bounds of the pictures alone",
    )


def shifted(maps: np.ndarray, seen: Sequence[Sighting | None]) -> tuple[np.ndarray, str]:
    """Disparity (T, H, W) up to scale and shift -> in 1 / scene units: by the static
    points of each picture, else by its bounds.
    """
    result, by_points = np.empty_like(maps), 0
    for k, (values, s) in enumerate(zip(maps, seen, strict=True)):
        line = None
        if s is not None and len(s.depth) >= ENOUGH:
            line = robust_line(sampled(values, s), 1 / s.depth)
            by_points += line is not None
        if line is None and s is not None and min(s.bounds) > 0:
            low, high = np.percentile(values, [5, 95])
            scale = (1 / s.bounds[0] - 1 / s.bounds[1]) / max(float(high - low), 1e-12)
            line = scale, 1 / s.bounds[1] - scale * float(low)
        scale, shift = line or (1.0, 0.0)
        least = 1 / (FARTHEST * s.bounds[1]) if s is not None and s.bounds[1] > 0 else 0.0
        result[k] = np.maximum(scale * values + shift, least)
    return (
        result,
        f"scale and shift of {by_points} of {len(maps)} maps by static points, the others by their near and far bounds",
    )


def robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Scale and shift of `y` (n,) over `x` (n,), refitted without the worst quarter;
    None where it does not rise.
    """
    keep = np.ones(len(x), bool)
    for _ in range(5):
        if np.ptp(x[keep]) < 1e-9:
            return None
        scale, shift = np.polyfit(x[keep], y[keep], 1)
        error = np.abs(scale * x + shift - y)
        keep = error <= np.quantile(error, 0.75)
    return (float(scale), float(shift)) if scale > 0 else None
