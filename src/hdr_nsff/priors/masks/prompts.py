"""Prompts for a segmentation network, from motion masks instead of mouse clicks.

The masks give the moving objects, the frame in which each is clearest, and in that
frame points on the object, points beside it and a box around it. Points are pixels of
the scene's frames, x right and y down, with centers at +0.5; label 1 is on the object,
label 0 beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

ON, BESIDE = 1, 0  # labels of points


@dataclass(frozen=True)
class PromptTuning:
    """Tuning constants of prompts, hand-chosen on rendered scenes."""

    min_frames: int = 3
    """Frames that an object must move in, or all frames of shorter clips."""
    min_area_share: float = 0.0008
    """Share of the frame below which a connected part of a mask is no object."""
    max_objects: int = 8
    """Of more objects, the largest are prompted."""
    points_on: int = 3
    """Points on an object, at most."""
    points_beside: int = 4
    """Points beside an object, at most, one per direction."""
    box_margin: float = 0.05
    """Share of the object's size by which the box is larger on each side."""
    min_depth_share: float = 0.5
    """A point on an object is this share as far from the outline as the first one."""
    spacing: float = 1.5
    """Least distance between points on an object, in depths of the first one."""
    beside_distance: float = 0.5
    """Best distance of points beside an object from its outline, in its radii."""
    max_beside_distance: float = 2.0
    """Largest distance of points beside an object from its outline, in its radii."""
    mask_margin_px: int = 2
    """Distance of points beside an object from all moving pixels."""
    lone_stability: float = 0.1
    """Added to the stability of a part's outline, so that area counts without it."""


PROMPT_TUNING = PromptTuning()


@dataclass(frozen=True)
class Prompt:
    """Points and a box for one object in one frame."""

    frame: int
    points: np.ndarray
    """(N, 2) pixels."""
    labels: np.ndarray
    """(N,) ON or BESIDE the object."""
    box: np.ndarray | None = None
    """(4,) left, top, right, bottom in pixels."""


@dataclass(frozen=True)
class PromptedObject:
    """A moving object with its prompts."""

    number: int
    prompts: tuple[Prompt, ...]
    masks: dict[int, np.ndarray] = field(default_factory=dict)
    """Its part (H, W) bool of the motion mask, by frame; none for a user's objects."""

    def remap_frames(self, frames: Sequence[int], others: Sequence[int]) -> PromptedObject:
        """The same object in another clip, one that includes this one.

        `frames` are the frames of this clip, `others` those of the other; prompts and
        masks count frames within their own clip.
        """
        position = {frame: k for k, frame in enumerate(others)}
        prompts = tuple(replace(p, frame=position[frames[p.frame]]) for p in self.prompts)
        masks = {position[frames[k]]: mask for k, mask in self.masks.items()}
        return replace(self, prompts=prompts, masks=masks)


@dataclass(frozen=True)
class Part:
    """A connected part of one frame's motion mask."""

    frame: int
    mask: np.ndarray
    """(H, W) bool."""
    area: int
    """Pixels."""
    center: np.ndarray
    """(2,) pixels."""


def find_objects(
    moving: np.ndarray, first_number: int = 1, tuning: PromptTuning = PROMPT_TUNING
) -> list[PromptedObject]:
    """The objects that move in `moving` (T, H, W) bool, each with one prompt.

    The largest comes first, by area summed over frames. They are numbered
    from `first_number`.
    """
    frames = [connected_parts(mask, t, tuning) for t, mask in enumerate(moving)]
    min_frames = min(tuning.min_frames, len(moving))
    tracks = [track for track in link_parts(frames) if len(track) >= min_frames]
    tracks.sort(key=lambda track: -sum(part.area for part in track))
    objects = []
    for number, track in enumerate(tracks[: tuning.max_objects], first_number):
        part = clearest_part(track, tuning)
        prompt = make_prompt(part, moving[part.frame], tuning)
        masks = {part.frame: part.mask for part in track}
        objects.append(PromptedObject(number, (prompt,), masks))
    return objects


def connected_parts(mask: np.ndarray, frame: int, tuning: PromptTuning) -> list[Part]:
    """The connected parts of `mask` (H, W) bool that are not tiny."""
    _, labels, stats, centers = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA]
    return [
        Part(frame, labels == k, int(areas[k]), centers[k] + 0.5)
        for k in range(1, len(areas))
        if areas[k] >= tuning.min_area_share * mask.size
    ]


def link_parts(frames: list[list[Part]]) -> list[list[Part]]:
    """The parts of one object in consecutive frames, as tracks.

    Two parts are linked that are each other's best match in place and size.
    """
    tracks = [[part] for part in frames[0]]
    open_tracks = list(tracks)
    for parts in frames[1:]:
        matched = match_parts([track[-1] for track in open_tracks], parts)
        following = []
        for b, part in enumerate(parts):
            if b in matched:
                track = open_tracks[matched[b]]
                track.append(part)
            else:
                track = [part]
                tracks.append(track)
            following.append(track)
        open_tracks = following
    return tracks


def match_parts(before: list[Part], after: list[Part]) -> dict[int, int]:
    """The index of the part `before` for each part `after` that has one, by index."""
    if not before or not after:
        return {}
    score = np.array([[similarity(a, b) for b in after] for a in before])
    matched = {}
    for a in range(len(before)):
        b = int(np.argmax(score[a]))
        if score[a, b] > 0 and int(np.argmax(score[:, b])) == a:
            matched[b] = a
    return matched


def similarity(a: Part, b: Part) -> float:
    """How well two parts agree in place and size, in [0, 1].

    It is 0 where their centers are farther apart than the larger one is wide.
    """
    distance = float(np.linalg.norm(a.center - b.center)) / np.sqrt(max(a.area, b.area))
    return max(0.0, 1 - distance) * min(a.area, b.area) / max(a.area, b.area)


def clearest_part(track: list[Part], tuning: PromptTuning) -> Part:
    """The part that is largest and most certain.

    A part is certain whose neighbors in time have the same outline, moved.
    """

    def clearness(part: Part) -> float:
        neighbors = [other for other in track if abs(part.frame - other.frame) == 1]
        overlaps = [centered_iou(part, other) for other in neighbors] or [0]
        return part.area * (tuning.lone_stability + float(np.mean(overlaps)))

    return max(track, key=clearness)


def centered_iou(a: Part, b: Part) -> float:
    """Intersection over union of two outlines, with the centers aligned."""
    shift = (a.center - b.center).astype(np.float32)
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(b.mask.astype(np.uint8), matrix, b.mask.shape[::-1])
    return iou(a.mask, moved > 0)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks; 0 of two empty ones."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def make_prompt(part: Part, moving: np.ndarray, tuning: PromptTuning) -> Prompt:
    """Points on and beside a part, and its box.

    `moving` (H, W) bool is the whole motion mask: no point beside the part is in it.
    """
    on = points_on(part.mask, tuning)
    beside = points_beside(part, moving, tuning)
    labels = np.array([ON] * len(on) + [BESIDE] * len(beside))
    return Prompt(part.frame, np.concatenate([on, beside]), labels, bounding_box(part.mask, tuning))


def bounding_box(mask: np.ndarray, tuning: PromptTuning) -> np.ndarray:
    """The box (4,) around `mask` (H, W) bool, a little enlarged, inside the frame."""
    rows = np.flatnonzero(mask.any(1))
    columns = np.flatnonzero(mask.any(0))
    low = np.array([columns[0], rows[0]])
    high = np.array([columns[-1], rows[-1]]) + 1
    margin = tuning.box_margin * (high - low)
    low = np.maximum(low - margin, 0)
    high = np.minimum(high + margin, mask.shape[::-1])
    return np.concatenate([low, high])


def points_on(mask: np.ndarray, tuning: PromptTuning) -> np.ndarray:
    """Points (N, 2) inside `mask` (H, W), each as far from the outline as possible."""
    padded = np.pad(mask.astype(np.uint8), 1)  # the frame's edge counts as outline
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.indices(mask.shape)
    deepest = float(depth.max())
    points: list[tuple[float, float]] = []
    while len(points) < tuning.points_on and depth.max() >= tuning.min_depth_share * deepest:
        row, column = np.unravel_index(np.argmax(depth), depth.shape)
        points.append((column + 0.5, row + 0.5))
        near = np.hypot(x - column, y - row) < tuning.spacing * deepest
        depth = np.where(near, 0, depth)
    return np.array(points)


def points_beside(part: Part, moving: np.ndarray, tuning: PromptTuning) -> np.ndarray:
    """Points (N, 2) around a part, one per direction, outside of all moving pixels.

    The best point lies in the middle of its sector, at `beside_distance`.
    """
    radius = np.sqrt(part.area / np.pi)
    distance = cv2.distanceTransform(1 - part.mask.astype(np.uint8), cv2.DIST_L2, 5)
    max_distance = tuning.max_beside_distance * radius
    margin = np.ones((2 * tuning.mask_margin_px + 1,) * 2, np.uint8)
    free = cv2.dilate(moving.astype(np.uint8), margin) == 0
    y, x = np.indices(part.mask.shape) + 0.5
    angle = np.arctan2(y - part.center[1], x - part.center[0])
    sectors = tuning.points_beside
    points: list[tuple[float, float]] = []
    for direction in np.arange(sectors) * 2 * np.pi / sectors:
        turn = np.abs(np.angle(np.exp(1j * (angle - direction))))
        allowed = free & (turn < np.pi / sectors) & (distance < max_distance)
        cost = turn + np.abs(distance / radius - tuning.beside_distance)
        cost = np.where(allowed, cost, np.inf)
        row, column = np.unravel_index(np.argmin(cost), cost.shape)
        if np.isfinite(cost[row, column]):
            points.append((column + 0.5, row + 0.5))
    return np.array(points).reshape(-1, 2)
