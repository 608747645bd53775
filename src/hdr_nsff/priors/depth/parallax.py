"""What known poses reveal of depth before any pixel is compared: how far apart two
views are for the points of the scene, which views determine each other's depth best,
which disparities occur, and points triangulated from flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry import pinhole
from hdr_nsff.scene.posed_video import PosedVideo

MIN_SCORE = 1e-6  # of a view that is used at all
AT_INFINITY = 1e6  # times as far away as the point


@dataclass(frozen=True)
class ParallaxTuning:
    """The choice of views and candidate disparities, hand-chosen on rendered scenes."""

    # image widths: parallax of the middle of the scene between two frames that match
    # best
    best_parallax: float = 0.05
    # frames: all within the first distance are candidates, every so manyth of those
    # within the last
    near_gap: int = 48
    far_gap_step: int = 6
    max_gap: int = 144
    time_decay: float = 0.02  # of a view's score per frame of distance in time ...
    min_time_weight: float = 0.3  # ... down to this
    # the candidates reach from and to these percentiles of the points' disparities,
    # times these factors
    near_percentile: float = 99.0
    far_percentile: float = 1.0
    near_factor: float = 1.4
    far_factor: float = 0.6
    num_points: int = 3000  # triangulated from flow where structure from motion gave too few
    max_reprojection_px: float = 1.0  # of such a point
    min_parallax_px: float = 0.5  # of such a point


def disparity_range(
    clip: PosedVideo, points: np.ndarray, tuning: ParallaxTuning = ParallaxTuning()
) -> tuple[float, float]:
    """Lowest and highest disparity to try: those of static `points` (P, 3) in all
    frames, with room for what the points miss.
    """
    disparities = []
    for i in range(len(clip.c2w)):
        _, depth, inside = clip.project(i, points)
        disparities.append(1 / depth[inside])
    percentiles = [tuning.far_percentile, tuning.near_percentile]
    low, high = np.percentile(np.concatenate(disparities), percentiles)
    return tuning.far_factor * float(low), tuning.near_factor * float(high)


def parallax(clip: PosedVideo, i: int, j: int, points: np.ndarray) -> tuple[float, float]:
    """Median parallax of `points` (P, 3) between frames `i` and `j`, and the share of
    the points that `j` sees.

    Parallax: pixels of frame `j` between a point and the same direction from `i`
    infinitely far away.
    """
    pixels, _, inside = clip.project(j, points)
    if not inside.any():
        return 0.0, 0.0
    eye = clip.c2w[i, :, 3]
    at_infinity, _, _ = clip.project(j, eye + (points - eye) * AT_INFINITY)
    displacement = np.linalg.norm(pixels - at_infinity, axis=-1)
    return float(np.median(displacement[inside])), float(inside.mean())


def choose_views(
    clip: PosedVideo,
    points: np.ndarray,
    max_views: int,
    tuning: ParallaxTuning = ParallaxTuning(),
    same_time: bool = False,
) -> tuple[list[list[int]], float]:
    """For each frame the up to `max_views` frames that determine its depth best, best
    first; and the largest parallax of all pairs, in pixels.

    Good views share most of the picture, are about `best_parallax` apart, and are near
    in time, since light changes. `points` (P, 3): static. `same_time`: only what other
    cameras see at the instant of the frame.
    """
    count, width = len(clip.c2w), clip.size[1]
    chosen, largest = [], 0.0
    for i in range(count):
        visible = points[clip.project(i, points)[2]]
        scores = np.zeros(count)
        others = candidates(clip.times, i, tuning, same_time) if len(visible) else []
        for j in others:
            moved, share = parallax(clip, i, j, visible)
            ratio = max(moved / (tuning.best_parallax * width), 1e-9)
            parallax_weight = min(ratio, ratio**-0.5)
            gap = abs(clip.times[i] - clip.times[j])
            time_weight = max(tuning.min_time_weight, 1 - tuning.time_decay * gap)
            scores[j] = share * parallax_weight * time_weight
            largest = max(largest, moved)
        best = np.argsort(-scores, kind="stable")[:max_views]
        chosen.append([int(j) for j in best if scores[j] > MIN_SCORE])
    return chosen, largest


def candidates(
    times: np.ndarray,
    i: int,
    tuning: ParallaxTuning = ParallaxTuning(),
    same_time: bool = False,
) -> list[int]:
    """The frames that may determine the depth of frame `i`, whose `times` are (T,): all
    of a short clip; of a long one those of the nearest times, and of every few of those
    farther away. `same_time`: those of its own time only.
    """
    _, rank = np.unique(times, return_inverse=True)
    gap = np.abs(rank - rank[i])
    if same_time:
        used = gap == 0
    else:
        far = (gap % tuning.far_gap_step == 0) & (gap <= tuning.max_gap)
        used = (gap <= tuning.near_gap) | far
    return [int(j) for j in np.flatnonzero(used) if j != i]


def triangulate(
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    tuning: ParallaxTuning = ParallaxTuning(),
) -> np.ndarray:
    """Static world points (P, 3) from flow (N, H, W, 2) px of `pairs` (N, 2).

    Every point is the least-squares disparity of one of a grid of pixels. It is kept
    where the flow is `valid` (N, H, W), and where the point lies in front, has parallax
    and reprojects onto the flow's target.
    """
    height, width = clip.size
    stride = max(1, int(np.sqrt(height * width * len(pairs) / tuning.num_points)))
    grid = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    y, x = grid.reshape(2, -1)
    pixels = np.stack([x, y], -1) + 0.5
    points = []
    for k, (i, j) in enumerate(pairs):
        target = pixels + flow[k, y, x]
        disparity, error, parallax_px = disparity_of_flow(clip, i, j, pixels, target)
        usable = valid[k, y, x] & ~clip.moving[i, y, x]
        in_front = disparity > 1e-6
        precise = error < tuning.max_reprojection_px
        kept = usable & in_front & precise & (parallax_px > tuning.min_parallax_px)
        points.append(clip.unproject(i, pixels[kept], disparity[kept]))
    return np.concatenate(points) if points else np.zeros((0, 3))


def disparity_of_flow(
    clip: PosedVideo, i: int, j: int, pixels: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disparity (P,) in frame `i` of `pixels` (P, 2) that frame `j` sees at `target`
    (P, 2), by least squares; its reprojection error (P,) and parallax (P,), in pixels.

    With the homogeneous image `start + d shift` of a pixel at disparity d, both
    coordinates of `(start_xy + d shift_xy) - target (start_z + d shift_z) = 0` are
    linear in d.
    """
    rotation, shift = clip.transfer(i, j)
    start = pinhole.homogeneous(pixels) @ rotation.T  # (P, 3)
    offset = start[:, :2] - target * start[:, 2:]
    slope = shift[:2] - target * shift[2]
    disparity = -(offset * slope).sum(-1) / np.maximum((slope**2).sum(-1), 1e-12)
    image = start + disparity[:, None] * shift
    depth_ratio = np.where(np.abs(image[:, 2:]) < 1e-9, 1e-9, image[:, 2:])
    error = np.linalg.norm(image[:, :2] / depth_ratio - target, axis=-1)
    displacement = np.abs(disparity) * np.linalg.norm(slope, axis=-1)
    return disparity, error, displacement / np.maximum(np.abs(start[:, 2]), 1e-9)
