"""Depth of every frame by Depth Anything V2 (Yang et al. 2024), aligned to the static
points of structure from motion.

The network sees each frame by itself, equalized in exposure. Relative variants predict
disparity up to an unknown scale and shift, metric ones depth in meters up to a scale.
So each frame gets the scale (and shift) of its points, robustly, since points err and
so does the network. A frame with few points is aligned together with its neighbors in
time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.priors.depth.geometric import depth_range, lower_confidence_at_edges
from hdr_nsff.priors.depth.parallax import triangulate
from hdr_nsff.priors.pretrained import IMAGENET_MEAN, IMAGENET_STD
from hdr_nsff.scene.posed_video import PosedVideo

Kind = Literal["relative", "metric"]
MIN_METRIC_DEPTH = 1e-3  # meters: what a metric network predicts below is raised to this
MAD_TO_SIGMA = 1.48  # standard deviation of a normal distribution per median |deviation|


@dataclass(frozen=True)
class DepthAnythingTuning:
    """The robust alignment of predictions to points.

    Hand-chosen on rendered scenes; half or twice changes little.
    """

    min_points: int = 30  # a frame with fewer is drawn to its neighbors in time
    num_hypotheses: int = 200  # pairs of points tried for a first scale and shift (RANSAC)
    max_judges: int = 10_000  # points, drawn at random, that these are compared at
    num_iterations: int = 10  # of reweighting
    # standard deviations from which on points have little weight (Geman-McClure)
    outlier_scale: float = 2.4
    # relative error of disparity at the points that halves the confidence
    half_confidence_error: float = 0.1
    # no pixel's disparity is below this share of the lowest disparity of the points,
    # not counting the lowest percent of them
    min_disparity_share: float = 0.25
    min_disparity_percentile: float = 1.0


def network_disparity(network: Any, video: ArrayStack) -> tuple[np.ndarray, Kind]:
    """What the network predicts for `video` (T, H, W, 3), equalized rgb in [0, 1].

    Disparity (T, H, W) up to a scale and shift per frame ("relative"), or up to a scale
    ("metric"). `network`: transformers' DepthAnythingForDepthEstimation.
    """
    kind: Kind = network.config.depth_estimation_type
    size = video.shape[1:3]
    disparity = np.empty(video.shape[:3], np.float32)
    for t in track(range(len(video)), "depth: network"):
        with torch.inference_mode():
            output = network(pixel_values=network_input(network, video[t]))
            predicted = output.predicted_depth[:, None].float()
            resized = functional.interpolate(predicted, size, mode="bilinear", align_corners=False)
        values = resized[0, 0].cpu().numpy()
        disparity[t] = 1 / np.maximum(values, MIN_METRIC_DEPTH) if kind == "metric" else values
    return disparity, kind


def network_input(network: Any, rgb: np.ndarray) -> Tensor:
    """A frame (H, W, 3) in [0, 1] as the network's input (1, 3, h, w), normalized.

    The shorter side is that of the training images, both are multiples of the patch.
    """
    patch = network.config.patch_size
    short, shorter_side = network.config.backbone_config.image_size, min(rgb.shape[:2])
    size = tuple(
        max(1, round(side * short / shorter_side / patch)) * patch for side in rgb.shape[:2]
    )
    values = torch.from_numpy(np.ascontiguousarray(rgb, np.float32)).permute(2, 0, 1)[None]
    resized = functional.interpolate(values, size, mode="bicubic", antialias=True).clamp(0, 1)
    return ((resized - IMAGENET_MEAN) / IMAGENET_STD).to(network.device)


def anchored_depth(
    predicted: np.ndarray,
    kind: Kind,
    clip: PosedVideo,
    points: np.ndarray,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    tuning: DepthAnythingTuning = DepthAnythingTuning(),
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Disparity (T, H, W) in 1 / scene units, confidence (T, H, W) in [0, 1], near and
    far z-depth, from the disparity (T, H, W) that the network `predicted`.

    `points` (N, 3) static; where there are too few, more are triangulated from `flow`
    (P, H, W, 2) px, `valid` (P, H, W) of `pairs` (P, 2). InputError where there still
    are too few.
    """
    count = len(predicted)
    samples = [sample_at_points(clip, t, points, predicted[t]) for t in range(count)]
    if sum(map(len, samples)) < tuning.min_points * count:
        from_flow = triangulate(clip, flow, valid, pairs)
        points = np.concatenate([np.asarray(points).reshape(-1, 3), from_flow])
        samples = [sample_at_points(clip, t, points, predicted[t]) for t in range(count)]
    num_samples = sum(map(len, samples))
    if num_samples < tuning.min_points:
        raise InputError(
            f"--depth depth-anything: {num_samples} static points are too few to align the "
            "network's depth to; use --depth geometric, or give depth maps (--depth FOLDER)"
        )
    lines, errors = align(samples, kind == "relative", tuning)
    scale, shift = lines[:, 0, None, None], lines[:, 1, None, None]
    known = np.concatenate(samples)[:, 1]
    lowest = tuning.min_disparity_share * float(
        np.percentile(known, tuning.min_disparity_percentile)
    )
    disparity = np.maximum(scale * predicted + shift, lowest).astype(np.float32)
    frame_confidence = 1 / (1 + (errors / tuning.half_confidence_error) ** 2)  # (T,)
    confidence = np.stack(
        [
            lower_confidence_at_edges(d, np.full(d.shape, c, np.float32))
            for d, c in zip(disparity, frame_confidence, strict=True)
        ]
    )
    confidence[disparity <= lowest] = 0
    report(kind, samples, errors, tuning.min_points)
    return disparity, confidence, *depth_range(disparity, confidence)


def report(kind: Kind, samples: list[np.ndarray], errors: np.ndarray, min_points: int) -> None:
    """Print how many points the predictions were aligned to, and how well they fit."""
    num_few = sum(len(s) < min_points for s in samples)
    sentence = (
        f"depth: {kind} predictions aligned to {np.mean([len(s) for s in samples]):.0f} points "
        f"per frame, with a median error of {np.median(errors):.1%} of their disparity"
    )
    if num_few:
        sentence += f"; {num_few} frames with few points follow their neighbors"
    say(sentence)


def sample_at_points(
    clip: PosedVideo, t: int, points: np.ndarray, predicted: np.ndarray
) -> np.ndarray:
    """What the network `predicted` (H, W) for frame `t` where static `points` (P, 3)
    are seen, and their disparity: (N, 2). Points behind moving pixels are left out.
    """
    pixels, depth, inside = clip.project(t, np.asarray(points, np.float64).reshape(-1, 3))
    height, width = predicted.shape
    x, y = pixels[inside].T
    column = np.clip(x.astype(int), 0, width - 1)
    row = np.clip(y.astype(int), 0, height - 1)
    static = ~clip.moving[t, row, column]
    values = map_coordinates(predicted, (y - 0.5, x - 0.5), order=1, mode="nearest")
    return np.stack([values, 1 / depth[inside]], 1)[static].astype(np.float64)


def align(
    samples: list[np.ndarray],
    with_shift: bool,
    tuning: DepthAnythingTuning = DepthAnythingTuning(),
) -> tuple[np.ndarray, np.ndarray]:
    """Per frame the scale and shift (T, 2) from predictions to disparities, and the
    median error (T,) as a share of the disparity.

    `samples`: per frame (N, 2) predictions and disparities; without `with_shift` the
    shift is 0. Frames without points get the median error of all. InputError where the
    predictions of the whole clip do not rise with the disparities.

    Each frame's line starts from the best of many through two of its points (RANSAC)
    and is refined by reweighting. All frames are solved together: those that lack
    points to `min_points` are drawn to their neighbors as strongly as the lacking
    points would.
    """
    every_sample = np.concatenate([s for s in samples if len(s)])
    common = ransac_line(every_sample, with_shift, tuning)
    if common is None:
        raise InputError(
            "--depth depth-anything: what the network predicts does not rise where static points "
            "are nearer; use other --depth-weights, or --depth geometric"
        )
    lines = np.zeros((len(samples), 2))
    for t, s in enumerate(samples):
        own = ransac_line(s, with_shift, tuning)
        lines[t] = common if own is None else own
    deviations = [
        float(np.median(np.abs(residuals(s, line))))
        for s, line in zip(samples, lines, strict=True)
        if len(s)
    ]
    noise = max(np.median(deviations) * MAD_TO_SIGMA, 1e-9)
    for _ in range(tuning.num_iterations):
        lines = solve_lines(samples, lines, noise, with_shift, every_sample[:, 0], tuning)
    errors = np.full(len(samples), np.nan)
    for t, s in enumerate(samples):
        if len(s) >= tuning.min_points:
            errors[t] = np.median(np.abs(residuals(s, lines[t])) / s[:, 1])
    known = np.isfinite(errors)
    typical = np.median(errors[known]) if known.any() else 1.0
    return lines, np.where(known, errors, typical)


def residuals(samples: np.ndarray, line: np.ndarray) -> np.ndarray:
    """How far (N,) the `samples` (N, 2) are from a line (scale, shift)."""
    return samples[:, 1] - line[0] * samples[:, 0] - line[1]


def ransac_line(
    samples: np.ndarray,
    with_shift: bool,
    tuning: DepthAnythingTuning = DepthAnythingTuning(),
) -> np.ndarray | None:
    """The scale and shift (2,) with the least median distance to `samples` (N, 2), or
    some of them, of many through two of them (through one of them and zero without
    `with_shift`).

    None for fewer than `min_points`, or where no scale is above 0: what is nearer for
    the network is nearer.
    """
    count = len(samples)
    if count < tuning.min_points:
        return None
    rng = np.random.default_rng(0)
    first = samples[rng.integers(count, size=tuning.num_hypotheses)]
    second = samples[rng.integers(count, size=tuning.num_hypotheses)]
    if not with_shift:
        second = np.zeros_like(first)
    run, rise = (first - second).T
    scale = rise / np.where(np.abs(run) < 1e-12, np.inf, run)
    shift = first[:, 1] - scale * first[:, 0] if with_shift else np.zeros_like(scale)
    judges = samples
    if count > tuning.max_judges:
        judges = samples[rng.choice(count, tuning.max_judges, replace=False)]
    lines = scale[:, None] * judges[:, 0] + shift[:, None]
    distance = np.median(np.abs(judges[:, 1] - lines), 1)
    best = int(np.argmin(np.where(scale > 0, distance, np.inf)))
    return np.array([scale[best], shift[best]]) if scale[best] > 0 else None


def solve_lines(
    samples: list[np.ndarray],
    lines: np.ndarray,
    noise: float,
    with_shift: bool,
    predictions: np.ndarray,
    tuning: DepthAnythingTuning = DepthAnythingTuning(),
) -> np.ndarray:
    """One round of reweighted least squares: the lines (T, 2) that fit all samples, and
    in frames with few of them the neighbors' lines.

    Each sample is weighted by how well it fits `lines` now (Geman-McClure: plainly
    wrong points have almost no weight; `noise` is the standard deviation of the
    others). Two lines differ by their difference at the clip's `predictions` (N,).
    """
    count, size = len(samples), 2 if with_shift else 1
    matrix, right = np.zeros((count, size, count, size)), np.zeros((count, size))
    for t, s in enumerate(samples):
        weight = 1 / (1 + (residuals(s, lines[t]) / (tuning.outlier_scale * noise)) ** 2) ** 2
        columns = line_columns(s[:, 0], size)
        matrix[t, :, t] += columns.T @ (weight[:, None] * columns)
        right[t] += columns.T @ (weight * s[:, 1])
    columns = line_columns(predictions, size)
    difference = columns.T @ columns / len(predictions)
    for t, s in enumerate(samples):
        neighbors = [n for n in (t - 1, t + 1) if 0 <= n < count]
        num_lacking = max(tuning.min_points - len(s), 0)
        pull = num_lacking * difference / max(len(neighbors), 1)
        for n in neighbors:  # in this frame's own equations alone: it pulls no other frame
            matrix[t, :, t] += pull
            matrix[t, :, n] -= pull
    flat = matrix.reshape(count * size, -1)
    solution = np.linalg.lstsq(flat, right.reshape(-1), rcond=1e-12)[0].reshape(count, size)
    return solution if with_shift else np.concatenate([solution, np.zeros((count, 1))], 1)


def line_columns(values: np.ndarray, size: int) -> np.ndarray:
    """The design (N, size) of a scale, and a shift if `size` is 2, at `values` (N,)."""
    return np.stack([values, np.ones(len(values))], 1)[:, :size]
