"""Tracks of moving pixels: chains of optical flow, lifted to points by depth.

Tracks start on a grid of moving pixels (`starts.py`) and follow the flow forward and
backward in time. A track ends where flow is not valid, leaves the moving pixels, or
lies between two motions. The depth may be wrong; later steps correct it. Pixels are
(x, y) with centers at +0.5.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import track
from hdr_nsff.geometry.round_trip import flow_at
from hdr_nsff.priors.movers.starts import (
    middle_times,
    missed_regions,
    spread_times,
    start_spacing,
    starting_pixels,
)
from hdr_nsff.priors.movers.tuning import TRACK_TUNING, TrackTuning


class PixelValues(Protocol):
    """An array over the pixels of a frame, or what reads one where it is indexed."""

    def __getitem__(self, index: Any, /) -> np.ndarray:
        """The values of pixels: rows and columns, or a mask."""
        ...


@dataclass(frozen=True)
class MovingView:
    """What one training time shows of its moving pixels."""

    moving: np.ndarray  # (H, W) bool
    points: PixelValues  # (H, W, 3) every pixel at its depth, scene units
    trust: PixelValues  # (H, W) in the depth, in [0, 1]
    flow: Mapping[int, np.ndarray]  # {+-1: (H, W, 2)} px to the neighboring times
    valid: Mapping[int, np.ndarray]  # {+-1: (H, W) bool}


@dataclass(frozen=True)
class Tracks:
    """`N` chains of flow over `T` times."""

    pixels: np.ndarray  # (N, T, 2) xy, NaN where not visible
    points: np.ndarray  # (N, T, 3) scene units, NaN where not visible
    trust: np.ndarray  # (N, T) in the depth, 0 where not visible
    patch: np.ndarray  # (N, T) connected patch of moving pixels, 0 where not visible
    age: np.ndarray  # (N, T) steps of flow since the start: errors accumulate
    times: np.ndarray  # (T,) in frames of the clip, rising
    spacing: float = TRACK_TUNING.stride_px  # px from one start to the next

    def at(self, times: np.ndarray) -> Tracks:
        """The same tracks at the `times` (S,)."""
        return Tracks(
            self.pixels[:, times],
            self.points[:, times],
            self.trust[:, times],
            self.patch[:, times],
            self.age[:, times],
            self.times[times],
            self.spacing,
        )


def follow_moving_pixels(
    views: Sequence[MovingView], times: np.ndarray, tuning: TrackTuning = TRACK_TUNING
) -> Tracks:
    """Tracks through the moving pixels of consecutive `times` (T,), in frames."""
    num = len(views)
    moving = [view.moving for view in views]
    spread = spread_times(num, tuning)
    spacing = start_spacing([moving[t] for t in spread], tuning)
    pixels, age = follow(views, {t: starting_pixels(moving[t], spacing) for t in spread}, tuning)
    tried = set(spread)
    for _ in range(tuning.further_rounds):
        missed = missed_regions(moving, pixels, tuning)
        starts = {t: starting_pixels(missed[t], spacing) for t in middle_times(missed, tried)}
        if not starts:
            break
        tried |= starts.keys()
        more, more_age = follow(views, starts, tuning)
        pixels, age = np.concatenate([pixels, more]), np.concatenate([age, more_age])

    points = np.full((*pixels.shape[:2], 3), np.nan)
    trust = np.zeros(pixels.shape[:2])
    patch = np.zeros(pixels.shape[:2], int)
    for t, view in enumerate(views):
        visible = np.isfinite(pixels[:, t, 0])
        x, y = pixels[visible, t].astype(int).T
        patches, _ = ndimage.label(view.moving)
        points[visible, t] = view.points[y, x]
        trust[visible, t] = view.trust[y, x] + tuning.min_trust
        patch[visible, t] = patches[y, x]
    return Tracks(pixels, points, trust, patch, age, np.asarray(times, float), spacing)


def follow(
    views: Sequence[MovingView],
    starts: Mapping[int, np.ndarray],
    tuning: TrackTuning = TRACK_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, T, 2) of the tracks that start at pixels (S, 2) of some times, NaN
    where not visible, and steps (N, T) since their start; short ones are left out.
    """
    num = len(views)
    start_of = np.repeat(list(starts), [len(own) for own in starts.values()])
    pixels = np.full((len(start_of), num, 2), np.nan)
    pixels[np.arange(len(start_of)), start_of] = np.concatenate(list(starts.values()))
    forward = [(t, 1) for t in range(num - 1)]
    backward = [(t, -1) for t in range(num - 1, 0, -1)]
    for t, step in track(forward + backward, "movers: tracks"):
        own = ((t - start_of) * step >= 0) & np.isfinite(pixels[:, t, 0])
        if step not in views[t].flow or not own.any():
            continue
        view = smoothed(views[t], step, tuning)
        pixels[own, t + step] = advance(view, views[t + step], step, pixels[own, t], tuning)
    age = np.abs(np.arange(num) - start_of[:, None])
    kept = np.isfinite(pixels[..., 0]).sum(1) >= min(tuning.min_frames, num)
    return pixels[kept], age[kept]


def smoothed(view: MovingView, step: int, tuning: TrackTuning = TRACK_TUNING) -> MovingView:
    """The view with one flow, averaged over valid moving pixels, NaN elsewhere."""
    known = view.valid[step] & view.moving
    return replace(view, flow={step: smooth_flow(view.flow[step], known, tuning)})


def smooth_flow(
    flow: np.ndarray, known: np.ndarray, tuning: TrackTuning = TRACK_TUNING
) -> np.ndarray:
    """`flow` (H, W, 2) px averaged over `known` (H, W) pixels around of similar flow.

    It is NaN where a pixel itself is not known.
    """
    result = np.full(flow.shape, np.nan, np.float32)
    rows, columns = np.nonzero(known.any(1))[0], np.nonzero(known.any(0))[0]
    if not len(rows):
        return result
    around = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    radius = tuning.smoothing_radius_px
    margin = (radius, radius)
    flow = np.where(known[around][..., None], flow[around], 0).astype(np.float32)
    flow = np.pad(flow, (margin, margin, (0, 0)))
    weight = np.pad(known[around].astype(np.float32), (margin, margin))
    offsets = range(-radius, radius + 1)
    total_weight = np.zeros_like(weight)
    total_flow = np.zeros_like(flow)
    for offset in itertools.product(offsets, offsets):
        other = np.roll(flow, offset, (0, 1))
        difference = np.abs(other - flow)
        similar = np.maximum(*np.moveaxis(difference, -1, 0)) < tuning.max_flow_difference_px
        other_weight = np.roll(weight, offset, (0, 1)) * weight * similar
        total_weight += other_weight
        total_flow += other * other_weight[..., None]
    mean = total_flow / np.maximum(total_weight, 1)[..., None]
    mean = np.where((total_weight > 0)[..., None], mean, np.nan)
    height, width = known[around].shape
    result[around] = mean[radius : radius + height, radius : radius + width]
    return result


def advance(
    view: MovingView,
    next_view: MovingView,
    step: int,
    pixels: np.ndarray,
    tuning: TrackTuning = TRACK_TUNING,
) -> np.ndarray:
    """`pixels` (N, 2) of `view` in `next_view`, NaN where a track ends or had ended."""
    height, width = view.moving.shape
    flow = view.flow[step]
    visible = np.isfinite(pixels[:, 0])
    x = np.where(visible, pixels[:, 0], 0).astype(int)
    y = np.where(visible, pixels[:, 1], 0).astype(int)
    motion = flow_at(flow, pixels)
    # a pixel between two motions: interpolation mixes them
    mixed = np.abs(motion - flow[y, x]).max(-1) > 0.5 * tuning.max_flow_difference_px
    moved = np.where(mixed[:, None], np.nan, pixels + motion)

    next_x = np.nan_to_num(moved[:, 0], nan=-1)
    next_y = np.nan_to_num(moved[:, 1], nan=-1)
    inside = (next_x >= 0) & (next_y >= 0) & (next_x < width) & (next_y < height)
    column = next_x.clip(0, width - 1).astype(int)
    row = next_y.clip(0, height - 1).astype(int)
    continues = visible & view.valid[step][y, x] & inside & next_view.moving[row, column]
    return np.where(continues[:, None], moved, np.nan)
