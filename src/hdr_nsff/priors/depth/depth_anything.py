"""Depth of every frame by Depth Anything V2 (Yang et al. 2024), laid onto the static
points of structure from motion.

The network answers each frame by itself: relative variants with disparity up to an
unknown scale and shift, metric ones with depth in meters of its own making. So each
frame gets the scale (and shift) that its points ask for, robustly, since points err and
so does the network; where a frame has few points its neighbors in time decide along
with it. It sees exposure-equalized frames.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say, track
from hdr_nsff.priors.depth.geometric import LEAST_POINTS, depth_range, doubt_edges
from hdr_nsff.priors.depth.parallax import triangulate
from hdr_nsff.priors.pretrained import IMAGENET_MEAN, IMAGENET_STD
from hdr_nsff.scene.posed_video import PosedVideo

Kind = Literal["relative", "metric"]
TRIALS = 200  # pairs of points tried for a first scale and shift
ROUNDS = 10  # of reweighting
FEW = 30  # points below which a frame listens to its neighbors in time
QUIET = 0.005  # least noise of disparity, as a share of it: no network is better
HALF = 0.1  # relative error of disparity at the points that halves the confidence
FLOOR = 0.25  # of the smallest disparity of the points (all but 1 %): nothing is farther


def network_disparity(network: Any, video: np.ndarray) -> tuple[np.ndarray, Kind]:
    """What the network says of `video` (T, H, W, 3), equalized rgb in [0, 1]: disparity
    (T, H, W), up to scale and shift per frame ("relative") or up to scale ("metric").
    `network`: transformers' DepthAnythingForDepthEstimation.
    """
    kind: Kind = network.config.depth_estimation_type
    found = np.empty(video.shape[:3], np.float32)
    for t in track(range(len(video)), "depth: network"):
        with torch.inference_mode():
            answer = (
                network(pixel_values=picture(network, video[t])).predicted_depth[:, None].float()
            )
            values = (
                functional.interpolate(
                    answer, video.shape[1:3], mode="bilinear", align_corners=False
                )[0, 0]
                .cpu()
                .numpy()
            )
        found[t] = 1 / np.maximum(values, 1e-3) if kind == "metric" else values
    return found, kind


def picture(network: Any, rgb: np.ndarray) -> Tensor:
    """A frame (H, W, 3) as the network wants it: (1, 3, h, w), normalized, the shorter
    side what it was trained with, both multiples of its patches.
    """
    patch, short = network.config.patch_size, network.config.backbone_config.image_size
    height, width = (
        max(1, round(n * short / min(rgb.shape[:2]) / patch)) * patch for n in rgb.shape[:2]
    )
    values = torch.from_numpy(np.ascontiguousarray(rgb, np.float32)).permute(2, 0, 1)[None]
    values = functional.interpolate(values, (height, width), mode="bicubic", antialias=True).clamp(
        0, 1
    )
    return ((values - IMAGENET_MEAN) / IMAGENET_STD).to(network.device)


def anchored_depth(
    answered: np.ndarray,
    kind: Kind,
    clip: PosedVideo,
    points: np.ndarray,
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Disparity (T, H, W) in 1 / scene units, confidence (T, H, W) in [0, 1], near and
    far z-depth, as `geometric_depth` gives them, from disparity (T, H, W) that the
    network `answered`.

    `points` (N, 3) static; where there are too few, more are triangulated from `flow`
    (P, H, W, 2) px, `valid` (P, H, W) of `pairs` (P, 2). InputError where there still
    are too few.
    """
    count = len(answered)
    seen = [sample(clip, t, points, answered[t]) for t in range(count)]
    if sum(len(s) for s in seen) < LEAST_POINTS * count:
        points = np.concatenate(
            [np.asarray(points).reshape(-1, 3), triangulate(clip, flow, valid, pairs)]
        )
        seen = [sample(clip, t, points, answered[t]) for t in range(count)]
    if sum(len(s) for s in seen) < LEAST_POINTS:
        raise InputError(
            f"--depth depth-anything: only {sum(len(s) for s in seen)} static points to bring the network's depth to scale; use --depth geometric, "
            "or give depth maps (--depth FOLDER)"
        )
    lines, errors = align(seen, shift=kind == "relative")
    least = FLOOR * float(np.percentile(np.concatenate(seen)[:, 1], 1))
    disparity = np.maximum(
        lines[:, 0, None, None] * answered + lines[:, 1, None, None], least
    ).astype(np.float32)
    trust = 1 / (1 + (errors / HALF) ** 2)
    confidence = np.stack(
        [
            doubt_edges(d, np.full(d.shape, c, np.float32))
            for d, c in zip(disparity, trust, strict=True)
        ]
    )
    confidence[disparity <= least] = 0
    few = sum(len(s) < FEW for s in seen)
    say(
        f"depth: {kind} answers laid onto {np.mean([len(s) for s in seen]):.0f} points a frame, off by {np.median(errors):.1%} of the disparity there"
        + (f"; {few} frames with few points follow their neighbors" if few else "")
    )
    return disparity, confidence, *depth_range(disparity, confidence)


def sample(clip: PosedVideo, t: int, points: np.ndarray, answered: np.ndarray) -> np.ndarray:
    """What the network `answered` (H, W) for frame `t` where static `points` are seen,
    and their disparity: (N, 2). Points behind something that moves are left out.
    """
    pixels, z, inside = clip.project(t, np.asarray(points, np.float64).reshape(-1, 3))
    height, width = answered.shape
    at = pixels[inside]
    x, y = np.clip(at[:, 0].astype(int), 0, width - 1), np.clip(at[:, 1].astype(int), 0, height - 1)
    still = ~clip.moving[t, y, x]
    there = map_coordinates(answered, (at[:, 1] - 0.5, at[:, 0] - 0.5), order=1, mode="nearest")
    return np.stack([there, 1 / z[inside]], 1)[still].astype(np.float64)


def align(seen: list[np.ndarray], shift: bool) -> tuple[np.ndarray, np.ndarray]:
    """Per frame the scale and shift (T, 2) that take answers to disparities (`seen`:
    per frame (N, 2) of both; without `shift` it is 0), and how far the points are from
    it, (T,), as a share of their disparity (median; of frames without points that of
    all).

    Each frame's line starts from the best of many through two of its points (RANSAC)
    and is refined by reweighting; then all frames are solved together, those that lack
    points to `FEW` drawn to their neighbors as strongly as the lacking points would.
    """
    own = [first_line(s, shift) for s in seen]
    everything = np.concatenate([s for s in seen if len(s)])
    middle = first_line(everything, shift)
    starts = np.array([middle if line is None else line for line in own])
    spread = max(
        np.median(
            [
                float(np.median(np.abs(misses(s, line))))
                for s, line in zip(seen, starts, strict=True)
                if len(s)
            ]
        )
        * 1.48,
        1e-9,
    )
    lines = starts
    for _ in range(ROUNDS):
        lines = solve(seen, lines, spread, shift, everything[:, 0])
    off = [
        float(np.median(np.abs(misses(s, line)) / s[:, 1])) if len(s) >= FEW else np.nan
        for s, line in zip(seen, lines, strict=True)
    ]
    known = np.nanmedian(off) if np.isfinite(off).any() else 1.0
    return lines, np.where(np.isfinite(off), off, known)


def misses(s: np.ndarray, line: np.ndarray) -> np.ndarray:
    """How far (N,) the points `s` (N, 2) are from a line (scale, shift)."""
    return s[:, 1] - line[0] * s[:, 0] - line[1]


def first_line(s: np.ndarray, shift: bool) -> np.ndarray | None:
    """The scale and shift, of many through two points of `s` (N, 2) (through one and
    zero without `shift`), with the least median distance to all; None for fewer than
    `FEW` points. Scale is above 0: what is nearer for the network is nearer.
    """
    if len(s) < FEW:
        return None
    rng = np.random.default_rng(0)
    a, b = s[rng.integers(len(s), size=TRIALS)], s[rng.integers(len(s), size=TRIALS)]
    run = a[:, 0] - (b[:, 0] if shift else 0)
    scale = (a[:, 1] - (b[:, 1] if shift else 0)) / np.where(np.abs(run) < 1e-12, np.inf, run)
    offset = a[:, 1] - scale * a[:, 0] if shift else np.zeros(TRIALS)
    off = np.median(np.abs(s[:, 1] - scale[:, None] * s[:, 0] - offset[:, None]), 1)
    best = int(np.argmin(np.where(scale > 0, off, np.inf)))
    return np.array([scale[best], offset[best]]) if scale[best] > 0 else None


def solve(
    seen: list[np.ndarray], lines: np.ndarray, spread: float, shift: bool, answers: np.ndarray
) -> np.ndarray:
    """One round: the lines (T, 2) that fit all points, each weighted by how well it
    fits now (Geman-McClure: plainly wrong points have no say), and in frames with few
    points the neighbors' lines. Two lines differ by what they differ by at the clip's
    `answers`.
    """
    count, size = len(seen), 2 if shift else 1
    matrix, vector = np.zeros((count, size, count, size)), np.zeros((count, size))
    for t, s in enumerate(seen):
        weight = 1 / (1 + (misses(s, lines[t]) / (2.4 * spread)) ** 2) ** 2
        columns = np.stack([s[:, 0], np.ones(len(s))], 1)[:, :size]
        matrix[t, :, t] += columns.T @ (weight[:, None] * columns)
        vector[t] += columns.T @ (weight * s[:, 1])
    columns = np.stack([answers, np.ones(len(answers))], 1)[:, :size]
    tie = columns.T @ columns / len(answers)
    for t, s in enumerate(seen):
        beside = [n for n in (t - 1, t + 1) if 0 <= n < count]
        lacking = max(FEW - len(s), 0) * tie / max(len(beside), 1)
        for n in beside:  # into this frame's own equations alone: it pulls nothing
            matrix[t, :, t] += lacking
            matrix[t, :, n] -= lacking
    found = np.linalg.lstsq(matrix.reshape(count * size, -1), vector.reshape(-1), rcond=1e-12)[
        0
    ].reshape(count, size)
    return found if shift else np.concatenate([found, np.zeros((count, 1))], 1)
