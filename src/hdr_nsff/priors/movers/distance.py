"""The distance of moving objects from one moving camera.

Two frames do not determine it: any distance fits some motion. But a hand-held camera
shakes and objects do not shake with it. Of all distances, the true one gives the object
the smoothest path through the world (trajectory triangulation after Park et al., "3D
reconstruction of a moving point from a series of 2D projections", ECCV 2010; we
penalize third differences). Where the path does not determine it, priors hold: an
object is nearer than the static scene behind it, and about as far as what it stands on;
its size hardly changes, so its distance changes as it shrinks in the picture.

Every connected moving region is one patch of constant disparity per frame.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.core.stack import ArrayStack, Stack, with_pixels
from hdr_nsff.geometry import pinhole
from hdr_nsff.maths.differences import differences
from hdr_nsff.priors.movers.regions import (
    RegionTrack,
    flow_steps,
    label_regions,
    link_regions,
    split_regions,
)
from hdr_nsff.priors.movers.tuning import MOVER_DISTANCE_TUNING, MoverDistanceTuning
from hdr_nsff.scene.posed_video import PosedVideo

ORDER = 3  # of the differences that are penalized: constant acceleration is free


def mover_depth(
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    behind: ArrayStack,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> tuple[ArrayStack, ArrayStack]:
    """Disparity and confidence (T, H, W) of moving pixels, `behind` and 0 elsewhere.

    `behind` (T, H, W) is the static scene's disparity, also under the masks, in 1 /
    scene units. `flow` (P, H, W, 2) px and `valid` (P, H, W) are of `pairs` (P, 2) of
    frames.
    """
    moving = clip.moving
    disparity = [behind[f][mask] for f, mask in enumerate(moving)]
    confidence = [np.full(len(d), tuning.min_confidence, np.float32) for d in disparity]
    labels = label_regions(clip.moving, tuning)
    steps = flow_steps(clip.times, flow, valid, pairs)
    split_regions(labels, steps, tuning)
    split_regions(labels, [step.reversed() for step in steps[::-1]], tuning)
    for track in link_regions(labels, clip.times, steps, tuning):
        masks = [labels[f] == label for f, label in zip(track.frames, track.labels, strict=True)]
        surface = np.array(
            [
                np.percentile(behind[f][mask], tuning.surface_percentile)
                for f, mask in zip(track.frames, masks, strict=True)
            ]
        )
        depth, sigma = track_depth(clip, track, labels, surface, tuning)
        track_disparity = 1 / np.maximum(depth, 1e-9)
        track_confidence = depth_confidence(sigma, tuning)
        for k, (f, mask) in enumerate(zip(track.frames, masks, strict=True)):
            lowest = np.median(behind[f][mask])
            highest = tuning.max_disparity_ratio * surface[k]
            own = mask[moving[f]]
            disparity[f][own] = np.clip(track_disparity[k], lowest, highest)
            confidence[f][own] = track_confidence[k]
    nowhere = Stack(lambda f: np.zeros(clip.size, np.float32), moving.shape)
    return with_pixels(behind, moving, disparity), with_pixels(nowhere, moving, confidence)


def depth_confidence(
    sigma: np.ndarray, tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING
) -> np.ndarray:
    """Confidence (n,) of a depth by its relative standard deviation `sigma` (n,)."""
    full = tuning.full_confidence_sigma
    confidence = tuning.max_confidence * full / np.maximum(sigma, full)
    return np.clip(confidence, tuning.min_confidence, tuning.max_confidence)


def track_depth(
    clip: PosedVideo,
    track: RegionTrack,
    labels: np.ndarray,
    surface: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """z-depth (n,) of a region in each of its frames, and its relative sigma (n,).

    `surface` (n,) is the disparity of the nearest static surface behind it.
    """
    frames = np.array(track.frames)
    pixels = region_centers(track, labels, clip.times, tuning)
    eyes = clip.c2w[frames, :, 3]
    rays = pinhole.world_rays(pixels, clip.K[frames], clip.c2w[frames])
    known = np.array([motion is not None for motion in track.motions[:-1]], bool)
    prior = 1 / (tuning.disparity_ratio * np.maximum(surface, np.median(surface)))
    axes = clip.c2w[frames, :, 2]
    size = apparent_size(track)
    return smoothest_path(eyes, axes, rays, clip.times[frames], known, prior, size, tuning)


def apparent_size(track: RegionTrack) -> np.ndarray:
    """Size in the picture, relative to its mean over each run of known growths, and
    the run of each frame: (2, n).
    """
    growths = track.growths[:-1]
    steps = [0.0 if growth is None else growth for growth in growths]
    run = np.cumsum([0, *(growth is None for growth in growths)])
    log_size = np.concatenate([[0.0], np.cumsum(steps)])
    for r in np.unique(run):
        log_size[run == r] -= log_size[run == r].mean()
    return np.stack([np.exp(log_size), run])


def region_centers(
    track: RegionTrack,
    labels: np.ndarray,
    times: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> np.ndarray:
    """The position (n, 2) px of a region in each frame of its track.

    Fast changes come from its flow, slow ones from its centroid. Each run of known
    motions has a polynomial that ties the integrated flow to the centroids.
    """
    centroids = np.array(
        [
            np.argwhere(labels[f] == label).mean(0)[::-1] + 0.5
            for f, label in zip(track.frames, track.labels, strict=True)
        ]
    )
    steps = [np.zeros(2) if motion is None else motion for motion in track.motions[:-1]]
    integrated = np.cumsum(np.array(steps).reshape(-1, 2), 0)
    path = np.concatenate([np.zeros((1, 2)), integrated])
    run = np.cumsum([0, *(motion is None for motion in track.motions[:-1])])
    for r in np.unique(run):
        own = run == r
        own_times = times[track.frames][own]
        own_times = own_times - own_times.mean()
        degree = int(own.sum()) // tuning.frames_per_drift_degree
        degree = min(tuning.max_drift_degree, degree)
        offsets = (centroids - path)[own]
        drift = np.polynomial.polynomial.polyfit(own_times, offsets, degree)
        path[own] += np.polynomial.polynomial.polyval(own_times, drift).T
    return path


def smoothest_path(
    eyes: np.ndarray,
    axes: np.ndarray,
    rays: np.ndarray,
    times: np.ndarray,
    known: np.ndarray,
    prior: np.ndarray,
    size: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """z-depth (n,) of the smoothest path, and its relative standard deviation (n,).

    The path is along `rays` (n, 3), one unit of z-depth long, from `eyes` (n, 3); its
    steps are `known` (n - 1,) or not. z-depth is a low polynomial in time plus what the
    camera itself moves along its optical `axes` (n, 3). `prior` (n,) is the expected
    z-depth, which counts as one observation in all. `size` (2, n) is that of
    `apparent_size`: z-depth times size is constant in each run, up to a tolerance.
    Where the rest of the path's third differences is not much smaller than the camera's
    own shake, the path determines nothing and the priors remain.
    """
    num = len(times)
    third = differences(times, known, ORDER)
    degree = max(len(third), num // 2) // tuning.rows_per_depth_degree
    count = 1 + min(tuning.max_depth_degree, degree)
    scaled_times = 2 * (times - times[0]) / max(times[-1] - times[0], 1e-9) - 1
    basis = np.polynomial.legendre.legvander(scaled_times, count - 1)  # (n, count)
    camera_depth = -((eyes - eyes.mean(0)) * axes).sum(-1)

    prior_rows = basis / (tuning.prior_sigma * prior[:, None] * np.sqrt(num))
    prior_target = (1 - camera_depth / prior) / (tuning.prior_sigma * np.sqrt(num))
    change_rows = np.eye(count)[1:] / (tuning.change_sigma * np.median(prior))
    rows = [prior_rows, change_rows]
    targets = [prior_target, np.zeros(count - 1)]
    if len(third) >= tuning.min_path_rows:
        path_rows = np.einsum("rn,nk,nc->rck", third, basis, rays).reshape(-1, count)
        fixed_points = eyes + camera_depth[:, None] * rays
        path_target = -(third @ fixed_points).reshape(-1)
        weight, noise = huber_weights(path_rows, path_target, tuning)
        signal = max(float((path_target**2).mean()), 1e-30)
        reliability = max(0.0, 1 - tuning.signal_to_noise * noise**2 / signal)
        weight *= np.sqrt(reliability) / noise
        rows.append(path_rows * weight[:, None])
        targets.append(path_target * weight)

    depth = prior
    for _ in range(tuning.size_rounds):
        size_rows, size_target = size_constraints(size, depth, basis, camera_depth, tuning)
        system = np.concatenate([*rows, size_rows])
        target = np.concatenate([*targets, size_target])
        depth = basis @ np.linalg.lstsq(system, target, rcond=None)[0] + camera_depth
    covariance = np.linalg.pinv(system.T @ system)
    sigma = np.sqrt(np.einsum("nk,kl,nl->n", basis, covariance, basis))
    return depth, sigma / np.maximum(np.abs(depth), 1e-9)


def size_constraints(
    size: np.ndarray,
    depth: np.ndarray,
    basis: np.ndarray,
    camera_depth: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n, k) and targets (n,) by which z-depth falls as size grows, in each run.

    z-depth is `basis` (n, k) @ coefficients + `camera_depth` (n,); `depth` (n,) is an
    estimate, from which its mean is taken.
    """
    scale, run = size
    same_run = run[:, None] == run[None]
    mean = same_run / same_run.sum(1, keepdims=True)  # (n, n): over the run of each frame
    reference = np.maximum(mean @ depth, 1e-9)
    expected = reference * ((1 / scale) / (mean @ (1 / scale)) - 1)  # z-depth less its mean
    centering = np.eye(len(scale)) - mean
    weight = 1 / (tuning.size_sigma * reference * np.sqrt(len(scale)))
    rows = weight[:, None] * (centering @ basis)
    return rows, weight * (expected - centering @ camera_depth)


def huber_weights(
    rows: np.ndarray, target: np.ndarray, tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING
) -> tuple[np.ndarray, float]:
    """Huber weights (3 R,) of `rows` (3 R, k) @ coefficients = `target` (3 R,).

    Three rows, x, y and z of one difference, share a weight. Also returns the standard
    deviation of the weighted residuals.
    """
    weight = np.ones(len(target))
    for _ in range(tuning.huber_rounds):
        solution = np.linalg.lstsq(rows * weight[:, None], target * weight, rcond=None)
        residual = target - rows @ solution[0]
        length = np.linalg.norm(residual.reshape(-1, 3), axis=1)
        threshold = tuning.huber_medians * np.median(length) + 1e-12
        weight = np.repeat(np.sqrt(1 / np.maximum(1, length / threshold)), 3)
    weighted = residual * weight
    freedom = max(len(target) - rows.shape[1], 1)
    return weight, float(np.sqrt(weighted @ weighted / freedom)) + 1e-9
