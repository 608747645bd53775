"""Matches between the cameras of a rig in turn, from all of their visits.

A camera of such a rig has one pose for all of its frames. Keypoints of its frames that
fall on the same pixel are one keypoint, and a match of two frames is one of their
cameras: noise, clipping and movers that hide a point in one frame hardly hide it in
all. The static pictures of the cameras count as one more frame each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.images import encode
from hdr_nsff.core.stack import ArrayStack, Stack
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.lightglue import LightGlueTuning, Matcher, match_images, upsample
from hdr_nsff.priors.poses.matching import (
    MatchingTuning,
    keypoint_mask,
    sift_image,
    upsampling_factor,
)
from hdr_nsff.priors.poses.view_matches import Pairs, ViewMatches


@dataclass(frozen=True)
class VisitTuning:
    """How many frames of each camera are matched (hand-chosen on rendered rigs)."""

    max_visits: int = 4  # frames per camera, besides its static picture
    max_pairs: int = 1600  # of frames, about; more cameras give fewer frames each
    cell_px: float = 1.0  # keypoints in one cell of this size are one; image pixels


@dataclass(frozen=True)
class VisitImages:
    """Frames of a rig that are matched, with its static pictures; F images."""

    images: ArrayStack  # (F, H, W, 3) equalized rgb in [0, 1]
    ignore: np.ndarray  # (F, H, W) bool
    camera: np.ndarray  # (F,) the camera of each

    def pairs(self) -> Pairs:
        """All pairs of images of different cameras."""
        count = len(self.camera)
        first, second = np.triu_indices(count, 1)
        apart = self.camera[first] != self.camera[second]
        return list(zip(first[apart].tolist(), second[apart].tolist(), strict=True))


def choose_visits(
    video: ArrayStack,
    ignore: np.ndarray,
    pictures: np.ndarray,
    hidden: np.ndarray,
    places: Sequence[int],
    tuning: VisitTuning = VisitTuning(),
) -> VisitImages:
    """The images of a rig to match: static `pictures` (N, H, W, 3), `hidden` (N, H, W)
    where unknown, and some frames of each camera from `video` (T, H, W, 3), of which
    `ignore` (T, H, W) is left out; `places` (T,): the camera of each frame.
    """
    count = len(pictures)
    camera_pairs = max(1, count * (count - 1) // 2)
    per_camera = int(np.sqrt(tuning.max_pairs / camera_pairs)) - 1
    per_camera = int(np.clip(per_camera, 1, tuning.max_visits))
    frames: list[int] = []
    for camera in range(count):
        own = np.flatnonzero(np.asarray(places) == camera)
        chosen = np.linspace(0, len(own) - 1, min(per_camera, len(own))).round().astype(int)
        frames += own[chosen].tolist()

    def image(k: int) -> np.ndarray:
        return pictures[k] if k < count else video[frames[k - count]]

    return VisitImages(
        images=Stack(image, (count + len(frames), *pictures.shape[1:])),
        ignore=np.concatenate([hidden, ignore[frames]]),
        camera=np.concatenate([np.arange(count), np.asarray(places)[frames]]),
    )


def match_visits(
    job: sfm.Job,
    visits: VisitImages,
    level_contrast: bool,
    matcher: Matcher,
    device: torch.device,
    matching: MatchingTuning,
    lightglue: LightGlueTuning,
    tuning: VisitTuning,
) -> ViewMatches:
    """Keypoints and matches of the cameras of a rig, found in the images of their
    visits, which are written into the folder of the `job`.
    """
    scale = upsampling_factor(visits.images.shape[1:3], matching)
    pairs = visits.pairs()
    masks = [keypoint_mask(ignore, scale, matching.mask_margin_px) for ignore in visits.ignore]
    if matcher == "sift":
        folder = Path(job.folder)
        names = [f"visit{k:05d}.png" for k in range(len(visits.images))]
        for name, image in zip(names, visits.images, strict=True):
            gray = sift_image(image, scale, level_contrast, matching)
            encode(folder / "images" / name, gray)
        named_pairs = [(names[a], names[b]) for a, b in pairs]
        sfm.run_worker(replace(job, groups=[names], pairs=named_pairs, keyframes=[]))
        keypoints, matches = sfm.read_matches(folder, names, named_pairs)
    else:
        images = [upsample(image, scale) for image in visits.images]
        keypoints, matches = match_images(images, masks, pairs, matcher, lightglue, device)
    static = ViewMatches(keypoints, pairs, matches).outside(masks)
    return merge_visits(static, visits.camera, tuning)


def merge_visits(
    found: ViewMatches, camera: np.ndarray, tuning: VisitTuning = VisitTuning()
) -> ViewMatches:
    """Keypoints and matches of cameras from those `found` in images of them; `camera`
    (F,): that of each image, from 0 without gaps.
    """
    count = int(camera.max()) + 1
    keypoints: list[np.ndarray] = []
    new_rows: list[np.ndarray] = [np.zeros(0, int)] * len(camera)
    for k in range(count):
        images = np.flatnonzero(camera == k)
        points = np.concatenate([found.keypoints[v] for v in images])
        merged, row_of = merge_points(points, tuning.cell_px)
        keypoints.append(merged)
        ends = np.cumsum([len(found.keypoints[v]) for v in images])
        for v, rows in zip(images, np.split(row_of, ends[:-1]), strict=True):
            new_rows[v] = rows
    gathered: dict[tuple[int, int], list[np.ndarray]] = {}
    for (a, b), rows in zip(found.pairs, found.matches, strict=True):
        match = np.stack([new_rows[a][rows[:, 0]], new_rows[b][rows[:, 1]]], 1)
        first, second = int(camera[a]), int(camera[b])
        if first > second:
            first, second, match = second, first, match[:, ::-1]
        gathered.setdefault((first, second), []).append(match)
    pairs = sorted(gathered)
    matches = [most_frequent(np.concatenate(gathered[pair])) for pair in pairs]
    return ViewMatches(keypoints, pairs, matches)


def merge_points(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """The means (M, 2) of the `points` (P, 2) that share a cell, and the row (P,) that
    each point goes to.
    """
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0, int)
    cells = np.floor(points / cell).astype(int)
    _, row_of, size = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    row_of = row_of.reshape(-1)
    sums = np.stack([np.bincount(row_of, points[:, axis]) for axis in (0, 1)], 1)
    return sums / size[:, None], row_of


def most_frequent(matches: np.ndarray) -> np.ndarray:
    """The matches (M, 2) that are the most frequent ones of both of their keypoints, of
    all `matches` (P, 2) between two cameras.
    """
    unique, votes = np.unique(matches.reshape(-1, 2), axis=0, return_counts=True)
    used: tuple[set[int], set[int]] = (set(), set())
    kept = []
    for k in np.argsort(-votes, kind="stable"):
        a, b = unique[k].tolist()
        if a not in used[0] and b not in used[1]:
            used[0].add(a)
            used[1].add(b)
            kept.append((a, b))
    return np.array(kept, int).reshape(-1, 2)
