"""How far away moving objects are, from one moving camera.

Two frames cannot tell: any distance fits some motion. But a camera in a hand shakes,
objects do not shake with it: of all distances, the true one gives the object the
smoothest path through the world (trajectory triangulation after Park et al., "3D
reconstruction of a moving point from a series of 2D projections", ECCV 2010; we
penalize third differences). A prior holds where that says little: an object is nearer
than the static scene behind it, and about as far as what it stands on. Every connected
moving region is one patch of constant disparity per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from hdr_nsff.scene.posed_video import PosedVideo

LEAST_AREA = 1e-3  # of the frame: smaller moving regions are no objects of their own
# pixels per step by which two objects in one region must move apart to be told apart
DIFFERENT = 1.0
LEAST_FLOW = 0.4  # share of a region's core whose flow must be valid for its motion to count
NEARER = 1.1  # an object's expected disparity relative to the nearest static surface behind it
PRIOR_SIGMA = 0.25  # of the logarithm of that
MOST = 8.0  # times the surface behind it: no path is believed that brings an object nearer
# how much an object's distance is expected to change, as a share of it, per polynomial
# order
CHANGE_SIGMA = 0.1
ORDER = 3  # differences: constant acceleration is free
SAME_SIZE = 1.25  # how much an object may grow or shrink in a step whose motion is unknown
LEAST_ROWS = 6  # third differences a path must have before it can speak
TRUSTED = 0.5  # confidence of a mover whose distance is known to KNOWN or better ...
KNOWN = 0.05
LEAST_CONFIDENCE = 0.1  # ... and of one known from the prior alone


@dataclass
class Track:
    """One moving region through time."""

    frames: list[int] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)  # of the region in each frame
    # (2,) px to the next frame of the track, None = unknown
    motions: list[np.ndarray | None] = field(default_factory=list)


def regions(moving: np.ndarray) -> np.ndarray:
    """Connected moving regions of each frame: labels (T, H, W), 0 = static or too
    small.
    """
    labels = np.zeros(moving.shape, np.int32)
    for frame, result in zip(moving, labels, strict=True):
        _, found, stats, _ = cv2.connectedComponentsWithStats(
            frame.astype(np.uint8), connectivity=8
        )
        large = stats[:, cv2.CC_STAT_AREA] >= LEAST_AREA * frame.size
        large[0] = False
        result[:] = (np.cumsum(large) * large)[found]
    return labels


@dataclass(frozen=True)
class Step:
    """Flow from frame `start` to frame `end` and back."""

    start: int
    end: int
    flow: np.ndarray  # (H, W, 2) px
    valid: np.ndarray  # (H, W) bool
    back: np.ndarray
    back_valid: np.ndarray

    def reversed(self) -> Step:
        """The same the other way round."""
        return Step(self.end, self.start, self.back, self.back_valid, self.flow, self.valid)


def steps_in_time(
    times: np.ndarray, flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray
) -> list[Step]:
    """From each frame to the nearest later one there is flow to, and back, in order of
    time.
    """
    index = {(int(i), int(j)): k for k, (i, j) in enumerate(pairs)}
    after: dict[int, int] = {}
    for i, j in index:
        if (
            times[j] > times[i]
            and (j, i) in index
            and (i not in after or times[j] < times[after[i]])
        ):
            after[i] = j
    both = [
        (i, j, index[i, j], index[j, i])
        for i, j in sorted(after.items(), key=lambda pair: times[pair[0]])
    ]
    return [Step(i, j, flow[k], valid[k], flow[b], valid[b]) for i, j, k, b in both]


def landed(region: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Where the pixels of a `region` (H, W) come to lie in the other frame (H, W) bool."""
    y, x = np.nonzero(region)
    px, py = np.rint(x + flow[y, x, 0]).astype(int), np.rint(y + flow[y, x, 1]).astype(int)
    inside = (px >= 0) & (py >= 0) & (px < region.shape[1]) & (py < region.shape[0])
    result = np.zeros_like(region)
    result[py[inside], px[inside]] = True
    return result


def landing(region: np.ndarray, flow: np.ndarray, other_labels: np.ndarray) -> int:
    """The region of the other frame on which most of `region` (H, W) lands, or 0 where
    that is less than a third of it.
    """
    votes = np.bincount(other_labels[landed(region, flow)], minlength=1)
    votes[0] = 0
    best = int(votes.argmax())
    return best if votes[best] * 3 > region.sum() else 0


def split(labels: np.ndarray, steps: list[Step]) -> None:
    """Cut, in place, regions of `labels` (T, H, W) that two differently moving regions
    flow into, along `steps` in the order of going: objects that pass in front of each
    other stay two. A part counts where it also flows back to where it came from.
    """
    least = LEAST_AREA * labels[0].size
    for step in steps:
        here, there = labels[step.start], labels[step.end]
        arriving: dict[
            int, list[tuple[int, np.ndarray, np.ndarray]]
        ] = {}  # region there -> label, motion, landed pixels
        for n in range(1, here.max() + 1):
            sure = (here == n) & step.valid
            target = landing(here == n, step.flow, there) if sure.sum() >= least else 0
            if target:
                arriving.setdefault(target, []).append(
                    (n, np.median(step.flow[sure], axis=0), landed(sure, step.flow))
                )
        for target, parts in arriving.items():
            parts.sort(key=lambda part: -int(part[2].sum()))
            parts = [parts[0]] + [
                p for p in parts[1:] if np.linalg.norm(p[1] - parts[0][1]) > DIFFERENT
            ]
            distance = [
                cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, 3)
                for _, _, pixels in parts
            ]
            owner = np.argmin(distance, axis=0)
            for k, (n, _, _) in enumerate(parts[1:], start=1):
                own = (there == target) & (owner == k)
                if own.sum() >= least and landing(own, step.back, here) == n:
                    there[own] = there.max() + 1


def core(region: np.ndarray) -> np.ndarray:
    """The inner half of a region (H, W): masks are generous, and their rim shows the
    background.
    """
    depth = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    return region & (depth >= 0.5 * depth.max())


def motion(step: Step, here: np.ndarray, there: np.ndarray) -> np.ndarray | None:
    """Motion (2,) px of a region (masks `here`, `there`): the median of its flow and
    its reversed backward flow; None if few know.
    """
    here, there = core(here), core(there)
    samples = np.concatenate([step.flow[here & step.valid], -step.back[there & step.back_valid]])
    return (
        np.median(samples, axis=0)
        if len(samples) >= LEAST_FLOW * (here.sum() + there.sum())
        else None
    )


def link(labels: np.ndarray, times: np.ndarray, steps: list[Step]) -> list[Track]:
    """Regions followed through time by flow that leads there and back; where two flow
    into one, the larger goes on, the other ends.
    """
    after = {step.start: step for step in steps}
    tracks: list[Track] = []
    current: dict[tuple[int, int], Track] = {}
    for i in (int(f) for f in np.argsort(times, kind="stable")):
        sizes = np.bincount(labels[i].reshape(-1))
        for n in sorted(np.nonzero(sizes[1:])[0] + 1, key=lambda n: -int(sizes[n])):
            track = current.get((i, int(n)))
            if track is None:
                track = Track()
                tracks.append(track)
            track.frames.append(i)
            track.labels.append(int(n))
            track.motions.append(None)
            if i not in after:
                continue
            step, here, there = after[i], labels[i] == n, labels[after[i].end]
            target = landing(here, step.flow, there)
            if (
                target
                and (step.end, target) not in current
                and landing(there == target, step.back, labels[i]) == n
            ):
                track.motions[-1] = motion(step, here, there == target)
                growth = (there == target).sum() / here.sum()
                if (
                    track.motions[-1] is not None or 1 / SAME_SIZE < growth < SAME_SIZE
                ):  # else it may be another object
                    current[step.end, target] = track
    return tracks


def centers(track: Track, labels: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Where the region is in each frame of the track, (n, 2) px: fast changes from its
    flow, slow ones from its centroid.
    """
    centroid = np.array(
        [
            np.argwhere(labels[f] == n).mean(0)[::-1] + 0.5
            for f, n in zip(track.frames, track.labels, strict=True)
        ]
    )
    steps = np.array([np.zeros(2) if m is None else m for m in track.motions[:-1]]).reshape(-1, 2)
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])
    piece = np.cumsum([0, *(m is None for m in track.motions[:-1])])
    for p in np.unique(piece):
        own = piece == p
        t = times[track.frames][own] - times[track.frames][own].mean()
        degree = min(3, int(own.sum()) // 4)
        drift = np.polynomial.polynomial.polyfit(t, (centroid - path)[own], degree)
        path[own] += np.polynomial.polynomial.polyval(t, drift).T
    return path


def differences(times: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Matrix (rows, n) of third differences over every run of four frames whose three
    steps are `known` (n - 1,).

    Divided differences, scaled so that even steps give (-1, 3, -3, 1).
    """
    rows = []
    for start in range(len(times) - ORDER):
        if known[start : start + ORDER].all():
            t = times[start : start + ORDER + 1]
            gaps = t[:, None] - t[None] + np.eye(ORDER + 1)
            row = np.zeros(len(times))
            row[start : start + ORDER + 1] = 6 * ((t[-1] - t[0]) / ORDER) ** ORDER / gaps.prod(1)
            rows.append(row)
    return np.array(rows).reshape(-1, len(times))


def smoothest_path(
    eyes: np.ndarray,
    axes: np.ndarray,
    rays: np.ndarray,
    times: np.ndarray,
    known: np.ndarray,
    prior: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """z-depth (n,) along `rays` (n, 3) from `eyes` (n, 3) that gives the smoothest
    path, and its relative standard deviation (n,).

    z-depth is a low polynomial in time plus what the camera itself moves along its
    optical `axes` (n, 3). `prior` (n,) is the expected z-depth, known to `PRIOR_SIGMA`,
    as one observation in all. Where what is left of the path's third differences is not
    much smaller than the camera's own shake, the path says nothing and the prior
    remains.
    """
    n = len(times)
    D = differences(times, known)
    count = 1 + min(4, max(len(D), n // 2) // 7)
    scaled = 2 * (times - times[0]) / max(times[-1] - times[0], 1e-9) - 1
    basis = np.polynomial.legendre.legvander(scaled, count - 1)  # (n, count)
    nearing = -((eyes - eyes.mean(0)) * axes).sum(-1)
    system = [
        basis / (PRIOR_SIGMA * prior[:, None] * np.sqrt(n)),
        np.eye(count)[1:] / (CHANGE_SIGMA * np.median(prior)),
    ]
    target = [(1 - nearing / prior) / (PRIOR_SIGMA * np.sqrt(n)), np.zeros(count - 1)]
    if len(D) >= LEAST_ROWS:
        A = np.einsum("rn,nk,nc->rck", D, basis, rays).reshape(-1, count)
        y = -(D @ (eyes + nearing[:, None] * rays)).reshape(-1)
        weight, noise = robust_weights(A, y)
        worth = max(0.0, 1 - 2 * noise**2 / max(float((y**2).mean()), 1e-30))
        weight *= np.sqrt(worth) / noise
        system.append(A * weight[:, None])
        target.append(y * weight)
    full = np.concatenate(system)
    z = basis @ np.linalg.lstsq(full, np.concatenate(target), rcond=None)[0] + nearing
    covariance = np.linalg.pinv(full.T @ full)
    return z, np.sqrt(np.einsum("nk,kl,nl->n", basis, covariance, basis)) / np.maximum(
        np.abs(z), 1e-9
    )


def robust_weights(A: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights (3 R,) of the rows of `A c = y` (three per difference) that let outliers
    go (Huber), and the noise that is left.
    """
    weight = np.ones(len(y))
    for _ in range(10):
        c = np.linalg.lstsq(A * weight[:, None], y * weight, rcond=None)[0]
        length = np.linalg.norm((y - A @ c).reshape(-1, 3), axis=1)
        weight = np.repeat(
            np.sqrt(1 / np.maximum(1, length / (1.5 * np.median(length) + 1e-12))), 3
        )
    left = (y - A @ c) * weight
    return weight, float(np.sqrt(left @ left / max(len(y) - A.shape[1], 1))) + 1e-9


def mover_depth(
    clip: PosedVideo, flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray, behind: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity and confidence (T, H, W) inside the moving masks (elsewhere `behind`
    and 0).

    `behind` (T, H, W): the static scene's disparity, also under the masks; `flow` (P,
    H, W, 2) px of `pairs` (P, 2).
    """
    disparity, confidence = (
        behind.copy(),
        np.where(clip.moving, np.float32(LEAST_CONFIDENCE), np.float32(0)),
    )
    labels = regions(clip.moving)
    steps = steps_in_time(clip.times, flow, valid, pairs)
    split(labels, steps)
    split(labels, [step.reversed() for step in steps[::-1]])
    for track in link(labels, clip.times, steps):
        frames = np.array(track.frames)
        inside = [labels[f] == n for f, n in zip(frames, track.labels, strict=True)]
        wall = np.array(
            [np.percentile(behind[f][m], 95) for f, m in zip(frames, inside, strict=True)]
        )
        pixels = centers(track, labels, clip.times)
        rays = np.stack(
            [
                clip.unproject(f, p[None], np.ones(1))[0] - clip.c2w[f, :, 3]
                for f, p in zip(frames, pixels, strict=True)
            ]
        )
        known = np.array([m is not None for m in track.motions[:-1]], bool)
        prior = 1 / (NEARER * np.maximum(wall, np.median(wall)))
        pose = clip.c2w[frames]
        z, sigma = smoothest_path(
            pose[..., 3], pose[..., 2], rays, clip.times[frames], known, prior
        )
        for f, m, d, s, w in zip(frames, inside, 1 / np.maximum(z, 1e-9), sigma, wall, strict=True):
            disparity[f][m] = np.clip(d, np.median(behind[f][m]), MOST * w)
            confidence[f][m] = np.clip(TRUSTED * KNOWN / max(s, KNOWN), LEAST_CONFIDENCE, TRUSTED)
    return disparity, confidence
