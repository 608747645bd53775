"""Maps that a data set gives (masks, flow, depth) at the size of the frames as used,
depth in units of the poses.

A map of the same size passes untouched; another one of the same shape is resampled:
masks and depth by the nearest pixel, flow by the area of its valid pixels, with its
vectors scaled. Depth of a network's own units is brought to those of the poses by
static points: metric depth by one scale for all pictures, disparity by a scale and a
shift per picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.footage.datasets.capture import Capture, Picture, SparseDepth
from hdr_nsff.footage.depth_files import ARRAYS, read_map
from hdr_nsff.footage.flow_files import check_flow, read_npz
from hdr_nsff.geometry.fill import fill

NEAREST = cv2.INTER_NEAREST_EXACT  # by the centers of pixels; the other one shifts maps
MAX_ASPECT_ERROR = 0.02  # by which the shape of a map may differ from the frames'
MIN_POINTS = 20  # from which a scale and shift are fitted (hand-chosen)
MAX_FAR = 3.0  # times the far bound: fitted disparity is clamped there (hand-chosen)
FIT_ROUNDS = 5  # fits of a line, each without the worst of the last
MIN_SHARE = 1e-6  # of valid pixels in a resampled one, that is divided by
FIT_SHARE = 0.75  # of the points, that the next round keeps (hand-chosen)


# One map at the size of the frames


def fit_size(
    path: Path, array: np.ndarray, size: tuple[int, int], interpolation: int
) -> np.ndarray:
    """`array` (h, w, ...) at `size` (H, W); InputError for one of another shape."""
    h, w = array.shape[:2]
    height, width = size
    if (h, w) == size:
        return array
    if not h or abs(w / h / (width / height) - 1) > MAX_ASPECT_ERROR:
        raise InputError(
            f"{path}: {w}x{h} for frames of {width}x{height}, another shape; "
            "make it the shape of the frames"
        )
    return cv2.resize(array, (width, height), interpolation=interpolation)


def fit_mask(path: Path, mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask (h, w) bool at `size` (H, W), by the nearest pixel."""
    return fit_size(path, mask.astype(np.uint8), size, NEAREST) > 0


def moving_mask(path: Path, size: tuple[int, int], white_moves: bool) -> np.ndarray:
    """A moving mask (H, W) bool."""
    mask = fit_mask(path, read_mask(path), size)
    return mask if white_moves else ~mask


def flow_map(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px and where it is valid (H, W).

    From a .npz with `flow` and `mask`, or a .npy with `_valid.png`.
    """
    if path.suffix == ".npz":
        flow, valid = read_npz(path)
    else:
        flow = read_array(path)
        valid = read_mask(path.with_name(f"{path.stem}_valid.png"))
    if flow.ndim != 3 or flow.shape[2] != 2 or valid.shape != flow.shape[:2]:
        raise InputError(
            f"{path}: expected flow (H, W, 2) with a mask (H, W), found {flow.shape} and "
            f"{valid.shape}; copy it again"
        )
    check_flow(path, flow)
    height, width = size
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    resized = fit_size(path, flow, size, cv2.INTER_AREA)
    # sets hold 0 where flow is not valid: only valid pixels count where there are some
    share = fit_size(path, valid.astype(np.float32), size, cv2.INTER_AREA)[..., None]
    total = fit_size(path, flow * valid[..., None], size, cv2.INTER_AREA)
    resized = np.where(share > 0, total / np.maximum(share, MIN_SHARE), resized)
    return resized * scale, fit_mask(path, valid, size)


def depth_map(path: Path, size: tuple[int, int], is_metric: bool) -> np.ndarray:
    """A map (H, W) float32 of metric depth, or of disparity or its confidence."""
    values = read_map(path, is_metric)
    if values.ndim != 2:
        raise InputError(
            f"{path}: a depth map of shape {values.shape}; it must be (H, W), copy it again"
        )
    if not np.isfinite(values).all():
        raise InputError(f"{path}: the depth map holds NaN or Inf; write 0 where depth is unknown")
    return fit_size(path, values, size, NEAREST)


# Depth of all pictures in units of the poses


def disparities(
    capture: Capture, chosen: Sequence[Picture], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, str]:
    """Disparity and confidence (T, H, W) of the `chosen` pictures, and a note.

    The note is a sentence on how they were brought to scene units.
    """
    paths = [p.depth for p in chosen if p.depth is not None]
    is_metric = capture.depth_kind == "metric"
    maps = np.stack([depth_map(path, size, is_metric) for path in paths])
    sparse = [capture.sparse_depth.get(p.source) for p in chosen]
    for path, values in zip(paths, maps, strict=True):
        if capture.depth_kind != "relative" and not (values > 0).any():
            raise InputError(f"{path}: nothing above 0 in this depth map; copy it again")
    if is_metric:
        maps *= unit_scales(paths, capture.depth_scale)[:, None, None]
        return disparity_of_metric(maps, sparse, capture.depth_units == "own")
    note = ""
    if capture.depth_units == "own":
        maps, note = align_disparity(maps, sparse)
    return maps, read_confidence(chosen, size), note


def unit_scales(paths: Sequence[Path], depth_scale: float) -> np.ndarray:
    """Scene units per unit of each metric map (T,) as read.

    Pictures are read in scene units, arrays in those of the set.
    """
    scales = [depth_scale if path.suffix.lower() in ARRAYS else 1.0 for path in paths]
    return np.array(scales, np.float32)


def disparity_of_metric(
    maps: np.ndarray, sparse: Sequence[SparseDepth | None], own_units: bool
) -> tuple[np.ndarray, np.ndarray, str]:
    """Disparity and confidence (T, H, W) of metric depth `maps` (T, H, W), and a note.

    `own_units`: in units of the network, which are scaled to those of the poses.
    """
    note = ""
    if own_units:
        scale, note = metric_scale(maps, sparse)
        maps = maps * np.float32(scale)
    known = maps > 0
    disparity = [fill(1 / np.where(k, m, 1), k) for m, k in zip(maps, known, strict=True)]
    return np.stack(disparity), known.astype(np.float32), note


def read_confidence(chosen: Sequence[Picture], size: tuple[int, int]) -> np.ndarray:
    """The confidence (T, H, W) of the disparity; 1 where the set gives none."""
    confidence = np.ones((len(chosen), *size), np.float32)
    for k, picture in enumerate(chosen):
        if picture.confidence is not None:
            confidence[k] = depth_map(picture.confidence, size, is_metric=False)
    return confidence


def sample(values: np.ndarray, sparse: SparseDepth) -> np.ndarray:
    """A map (H, W) at the static points of a picture (n,)."""
    h, w = values.shape
    pixels = (sparse.xy * [w, h]).astype(int)
    x, y = np.clip(pixels, 0, [w - 1, h - 1]).T
    return values[y, x]


def metric_scale(maps: np.ndarray, sparse: Sequence[SparseDepth | None]) -> tuple[float, str]:
    """Scene units per unit of metric depth (T, H, W), one for all pictures, and a note.

    The median over the static points that they see, else from their bounds.
    """
    ratios = [np.zeros(0)]
    for values, points in zip(maps, sparse, strict=True):
        if points is not None and len(points.depth):
            found = sample(values, points)
            ratios.append(points.depth[found > 0] / found[found > 0])
    every = np.concatenate(ratios)
    if len(every) >= MIN_POINTS:
        scale = float(np.median(every))
        spread = float(np.median(np.abs(np.log(every / scale))))
        return scale, (
            f"1 unit of it is {scale:.4g} scene units, by {len(every)} static points "
            f"(median deviation {spread:.0%})"
        )
    bounds = []
    for values, points in zip(maps, sparse, strict=True):
        if points is not None and min(points.bounds) > 0 and (values > 0).any():
            near_far = np.percentile(values[values > 0], [5, 95])
            bounds.append(np.sqrt(np.prod(points.bounds) / np.prod(near_far)))
    if not bounds:
        return 1.0, "taken to be in scene units: nothing shows otherwise"
    scale = float(np.median(bounds))
    return scale, (
        f"1 unit of it is {scale:.4g} scene units, by the near and far bounds of the pictures alone"
    )


def align_disparity(
    maps: np.ndarray, sparse: Sequence[SparseDepth | None]
) -> tuple[np.ndarray, str]:
    """Disparity (T, H, W) up to scale and shift -> in 1 / scene units, and a note.

    By the static points of each picture, else by its bounds.
    """
    result = np.empty_like(maps)
    by_points = 0
    for k, (values, points) in enumerate(zip(maps, sparse, strict=True)):
        line = None
        if points is not None and len(points.depth) >= MIN_POINTS:
            line = robust_line(sample(values, points), 1 / points.depth)
        if line is not None:
            by_points += 1
        elif points is not None and min(points.bounds) > 0:
            line = line_of_bounds(values, points.bounds)
        scale, shift = line or (1.0, 0.0)
        least = 0.0
        if points is not None and points.bounds[1] > 0:
            least = 1 / (MAX_FAR * points.bounds[1])
        result[k] = np.maximum(scale * values + shift, least)
    return result, (
        f"scale and shift of {by_points} of {len(maps)} maps by static points, "
        "the others by their near and far bounds"
    )


def line_of_bounds(values: np.ndarray, bounds: tuple[float, float]) -> tuple[float, float]:
    """Scale and shift that bring disparity (H, W) to depth bounds (near, far)."""
    near, far = bounds
    low, high = np.percentile(values, [5, 95])
    scale = (1 / near - 1 / far) / max(float(high - low), 1e-12)
    return scale, 1 / far - scale * float(low)


def robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Scale and shift of `y` (n,) over `x` (n,), refitted without the worst quarter.

    None where the line does not rise.
    """
    keep = np.ones(len(x), bool)
    for _ in range(FIT_ROUNDS):
        if np.ptp(x[keep]) < 1e-9:
            return None
        scale, shift = np.polyfit(x[keep], y[keep], 1)
        error = np.abs(scale * x + shift - y)
        keep = error <= np.quantile(error, FIT_SHARE)
    return (float(scale), float(shift)) if scale > 0 else None
