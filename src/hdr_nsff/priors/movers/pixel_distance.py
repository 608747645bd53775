"""The distance of every moving pixel before a rig whose cameras take turns.

For a few frames, a point moves smoothly. Seen by cameras that do not, only one distance
puts it where flow leads: at any other one the point would jump with the cameras
(trajectory triangulation after Park et al., "3D reconstruction of a moving point from a
series of 2D projections", ECCV 2010). Cameras that take turns jump at every frame, and
show this in every pixel, cloth and limbs included. One that moves on shows too little:
there, distances of pixels are no better than those of whole regions (`distance.py`).

A pixel (x, y, 1) of frame i at disparity d falls, tau frames later, on the homogeneous
A (x, y, 1) + d b + M (v tau + a tau^2 / 2 + c tau^3 / 6) of frame j: A and b are those
of `pinhole.transfer`, M turns the axes of camera i into the picture of j, and velocity
v, acceleration a and jerk c are in pixels at the pixel's distance. That this is the end
of its flow is linear in the relative error of d and in v, a and c.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import ArrayStack, with_pixels
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.round_trip import flow_at
from hdr_nsff.priors.movers.regions import FlowStep, flow_steps
from hdr_nsff.priors.movers.tuning import PIXEL_DISTANCE_TUNING, PixelDistanceTuning
from hdr_nsff.scene.movers import NO_MOVER, Mover, nearest_mover
from hdr_nsff.scene.posed_video import PosedVideo

ORDER = 3  # of the motion: velocity, acceleration and jerk
MIN_FREEDOM = 0.5  # residuals beyond the unknowns: where there are fewer, others tell
UNKNOWNS = 1 + 3 * ORDER  # of a pixel: the relative error of its disparity, and its motion


@dataclass(frozen=True)
class FlowEnds:
    """Where P pixels of a frame are in another one."""

    frame: int
    pixels: np.ndarray  # (P, 2)
    valid: np.ndarray  # (P,) bool
    links: int  # of flow from there to here


def pixel_distances(
    clip: PosedVideo,
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    disparity: ArrayStack,
    confidence: ArrayStack,
    tuning: PixelDistanceTuning = PIXEL_DISTANCE_TUNING,
) -> tuple[ArrayStack, list[np.ndarray]]:
    """`disparity` (T, H, W) with that of moving pixels corrected as far as the cameras
    show it; and the relative standard deviation (M,) of it in each frame's moving
    pixels.

    `disparity` is in 1 / scene units, roughly right there; where `confidence` (T, H, W)
    in it is high, it stays. `flow` (P, H, W, 2) px and `valid` (P, H, W) are of `pairs`
    (P, 2) of frames.
    """
    steps = flow_steps(clip.times, flow, valid, pairs)
    measured = [
        measure_errors(clip, steps, i, disparity[i], tuning)
        for i in track(range(len(clip.moving)), "movers: pixels")
    ]
    variance = usual_variance(measured)
    corrected, sigmas = [], []
    for i, (wide, near) in enumerate(measured):
        information, pull, misfit, freedom = near
        # flow that no smooth motion explains errs by more than its noise
        excess = (misfit + MIN_FREEDOM * variance) / (freedom + MIN_FREEDOM)
        independent = tuning.independent_pixels / np.maximum(excess, 1)
        prior = 1 / tuning.prior_sigma**2
        around = independent * wide[1] / (independent * wide[0] + prior)
        relief = 1 / tuning.relief_sigma**2
        error = (independent * pull + relief * around) / (independent * information + relief)
        error = error.clip(-tuning.max_change, tuning.max_change)
        mask = clip.moving[i]
        stays = confidence[i][mask] >= tuning.confidence
        corrected.append(disparity[i][mask] * np.where(stays, 1, 1 + error))
        sigmas.append(1 / np.sqrt(independent * information + prior))
    return with_pixels(disparity, clip.moving, corrected), sigmas


def believe_well_placed(
    confidence: ArrayStack,
    clip: PosedVideo,
    sigmas: list[np.ndarray],
    movers: Sequence[Mover],
    tuning: PixelDistanceTuning = PIXEL_DISTANCE_TUNING,
) -> ArrayStack:
    """`confidence` (T, H, W), higher in pixels of `movers` that are well placed.

    `clip` and `sigmas`, (M,) of each frame, are those of `pixel_distances`; the frames
    of `movers` are positions among them.
    """
    if not movers:
        return confidence
    owners = [np.full(len(sigma), NO_MOVER) for sigma in sigmas]
    for t, i in enumerate(movers[0].frames.tolist()):
        pixels = np.argwhere(clip.moving[i])[:, ::-1] + 0.5
        owners[i] = nearest_mover(movers, t, pixels, (clip.K[i], clip.c2w[i]))
    placed = well_placed(movers, np.concatenate(owners), np.concatenate(sigmas), tuning)
    raised = []
    for i, mask in enumerate(clip.moving):
        trust = confidence[i][mask]
        own = np.isin(owners[i], placed)
        raised.append(np.where(own, np.maximum(trust, tuning.confidence), trust))
    return with_pixels(confidence, clip.moving, raised)


def well_placed(
    movers: Sequence[Mover], owner: np.ndarray, sigma: np.ndarray, tuning: PixelDistanceTuning
) -> list[int]:
    """The movers that are not rigid and half of whose pixels have a relative `sigma`
    (M,) of distance that is small enough; `owner` (M,) is the mover of each pixel.
    """
    placed = []
    for k, mover in enumerate(movers):
        own = sigma[owner == k]
        if not mover.rigid and len(own) and np.median(own) < tuning.max_median_sigma:
            placed.append(k)
    return placed


def measure_errors(
    clip: PosedVideo, steps: list[FlowStep], i: int, disparity: np.ndarray, t: PixelDistanceTuning
) -> np.ndarray:
    """What the pixels around say of the relative error of `disparity` (H, W) in each
    moving pixel of frame `i`: the averages of `pixel_errors` over the wide window and
    over the narrow one, (2, 4, M).
    """
    moving = clip.moving[i]
    y, x = np.nonzero(moving)
    stride = max(t.min_stride_px, math.ceil(math.sqrt(len(y) / t.max_pixels)))
    on_grid = (x % stride == 0) & (y % stride == 0)
    y, x = y[on_grid], x[on_grid]
    maps = np.zeros((4, *moving.shape), np.float32)
    if len(y):
        pixels = np.stack([x, y], -1) + 0.5
        ends = list(chain(steps, i, pixels, t))
        if ends:
            system = equations(clip, i, pixels, disparity[y, x], ends, t)
            maps[:, y, x] = pixel_errors(*system, t)
    windows = (t.wide_window_px, t.window_px)
    smooth = [[ndimage.gaussian_filter(m, w)[moving] for m in maps] for w in windows]
    return stride**2 * np.array(smooth)


def usual_variance(measured: list[np.ndarray]) -> float:
    """The median of squared residuals, in squared sigmas, where there are enough."""
    misfit, freedom = np.concatenate(measured, -1)[1, 2:]
    enough = freedom > MIN_FREEDOM
    return float(np.median(misfit[enough] / freedom[enough])) if enough.any() else 1.0


def chain(
    steps: list[FlowStep], i: int, pixels: np.ndarray, t: PixelDistanceTuning
) -> Iterator[FlowEnds]:
    """Where `pixels` (P, 2) of frame `i` are in the frames around."""
    later = {step.start: step for step in steps}
    earlier = {step.end: step.reversed() for step in steps}
    for links in (later, earlier):
        frame, place, valid = i, pixels, np.ones(len(pixels), bool)
        for count in range(1, t.reach_frames + 1):
            if frame not in links:
                break
            step = links[frame]
            y, x = (place[:, ::-1] - 0.5).T
            sure = ndimage.map_coordinates(step.valid.astype(np.float32), (y, x), order=1)
            place = place + flow_at(step.flow, place)
            valid = valid & (sure > t.min_valid) & np.isfinite(place).all(-1)
            place = np.where(valid[:, None], place, pixels)  # of no weight any more
            frame = step.end
            yield FlowEnds(frame, place, valid, count)


def pixel_errors(
    slopes: np.ndarray, offsets: np.ndarray, weights: np.ndarray, t: PixelDistanceTuning
) -> np.ndarray:
    """What each pixel alone says of the relative error of its disparity, (4, P), by its
    `equations`: information (1 / variance), information times error, the sum of squared
    residuals in sigmas, and how many residuals there are beyond the number of unknowns.
    """
    sigmas = (t.velocity_sigma_px, t.acceleration_sigma_px, t.jerk_sigma_px)
    prior = np.diag([0, *np.repeat(np.power(sigmas, -2.0), 3)])
    start = np.zeros((UNKNOWNS, UNKNOWNS))
    start[0, 0] = 1 / t.prior_sigma**2
    robust = np.ones_like(weights)
    for _ in range(t.robust_rounds):
        weighted = slopes * (robust * weights)[..., None, None]
        normal = np.einsum("pcek,pcel->pkl", weighted, slopes) + prior
        target = -np.einsum("pcek,pce->pk", weighted, offsets)
        solution = np.linalg.solve(normal + start, target[..., None])[..., 0]
        residual = offsets + np.einsum("pcek,pk->pce", slopes, solution)
        robust = 1 / (1 + weights * (residual**2).sum(-1) / t.robust_sigmas**2)
    # what remains of the error once motion is eliminated (Schur complement)
    coupling = normal[:, 0, 1:]
    both = np.stack([coupling, target[:, 1:]], -1)
    explained = np.einsum("pk,pkr->rp", coupling, np.linalg.solve(normal[:, 1:, 1:], both))
    information = np.maximum(normal[:, 0, 0] - explained[0], 0)
    freedom = np.maximum(2 * (weights > 0).sum(1) - UNKNOWNS, 0)
    misfit = (weights * (residual**2).sum(-1)).sum(1) * (freedom > 0)
    return np.stack([information, target[:, 0] - explained[1], misfit, freedom])


def equations(
    clip: PosedVideo,
    i: int,
    pixels: np.ndarray,
    rho: np.ndarray,
    ends: list[FlowEnds],
    t: PixelDistanceTuning,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals in pixels of `pixels` (P, 2) of frame `i` at disparity `rho` (P,), at C
    ends of their flow: `slopes` (P, C, 2, UNKNOWNS) @ unknowns + `offsets` (P, C, 2),
    and their weights (P, C), 1 / variance.
    """
    K, c2w, times = clip.K, clip.c2w, clip.times
    homogeneous = pinhole.homogeneous(pixels)
    slopes = np.empty((len(pixels), len(ends), 2, UNKNOWNS))
    offsets = np.empty((len(pixels), len(ends), 2))
    weights = np.empty((len(pixels), len(ends)))
    for c, end in enumerate(ends):
        j = end.frame

        def in_picture(point: np.ndarray, place: np.ndarray = end.pixels) -> np.ndarray:
            """How far homogeneous points (..., 3) are from their places, px times z."""
            return point[..., :2] - place * point[..., 2:]

        rotation, shift = pinhole.transfer(K[i], c2w[i], K[j], c2w[j])
        turn = K[j] @ c2w[j, :, :3].T @ c2w[i, :, :3] / K[i, 0, 0]
        moved_by_rho = rho[:, None].astype(np.float64) * shift
        offsets[:, c] = in_picture(homogeneous @ rotation.T + moved_by_rho)
        slopes[:, c, :, 0] = in_picture(moved_by_rho)
        by_motion = np.stack([in_picture(axis) for axis in turn.T], -1)  # (P, 2, 3)
        for order in range(1, ORDER + 1):
            share = (times[j] - times[i]) ** order / math.factorial(order)
            slopes[:, c, :, 3 * order - 2 : 3 * order + 1] = share * by_motion
        weights[:, c] = end.valid / (t.noise_px**2 * end.links)
    return slopes, offsets, weights
