"""What to ask a segmentation network about a clip, made from its motion masks instead
of mouse clicks: which things move, the frame in which each shows best, and there points
on it, points beside it and a box around it. A file of points corrects or adds to that.

Points are pixels of the scene's frames, x right and y down, centers at +0.5; label 1
lies on the object, 0 beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json

SHORTEST = 3  # frames that a thing must move in to be one (or all there are)
SMALLEST = 0.0008  # share of the frame below which a connected part of a mask is no thing
INSIDE, BESIDE = 3, 4  # points on a thing, and beside it, at most
BOX_MARGIN = 0.05  # of its size that the box is larger on each side
MOST = 8  # things asked about; of more, the largest


@dataclass(frozen=True)
class Prompt:
    """One frame in which an object is pointed at."""

    frame: int
    points: np.ndarray  # (N, 2) pixels
    labels: np.ndarray  # (N,) 1 on the object, 0 beside it
    box: np.ndarray | None = None  # (4,) left, top, right, bottom in pixels


@dataclass(frozen=True)
class Mover:
    """One thing that moves, and what to ask about it."""

    number: int
    prompts: tuple[Prompt, ...]
    # frame -> (H, W) bool, its part of the motion mask; empty for the user's own
    seen: dict[int, np.ndarray] = field(default_factory=dict)

    def among(self, frames: Sequence[int], others: Sequence[int]) -> Mover:
        """The same in a clip of the frames `others`, which hold this one's `frames`."""
        place = {f: k for k, f in enumerate(others)}
        prompts = tuple(replace(p, frame=place[frames[p.frame]]) for p in self.prompts)
        return replace(
            self, prompts=prompts, seen={place[frames[k]]: mask for k, mask in self.seen.items()}
        )


@dataclass(frozen=True)
class Part:
    """A connected part of one frame's motion mask."""

    frame: int
    mask: np.ndarray  # (H, W) bool
    area: int
    center: np.ndarray  # (2,) pixels


def movers(moving: np.ndarray, first: int = 1) -> list[Mover]:
    """The things that move in `moving` (T, H, W) bool, largest (summed over frames)
    first and numbered from `first`, each with one prompt.
    """
    frames = [parts(mask, t) for t, mask in enumerate(moving)]
    least = min(SHORTEST, len(moving))
    tracks = [t for t in link(frames) if len(t) >= least]
    tracks.sort(key=lambda track: -sum(p.area for p in track))
    found = []
    for number, track in enumerate(tracks[:MOST], first):
        best = clearest(track)
        found.append(
            Mover(number, (prompt(best, moving[best.frame]),), {p.frame: p.mask for p in track})
        )
    return found


def parts(mask: np.ndarray, frame: int) -> list[Part]:
    """The connected parts of `mask` (H, W) bool that are not tiny."""
    _, labels, stats, centers = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA]
    return [
        Part(frame, labels == k, int(areas[k]), centers[k] + 0.5)
        for k in range(1, len(areas))
        if areas[k] >= SMALLEST * mask.size
    ]


def link(frames: list[list[Part]]) -> list[list[Part]]:
    """The same thing's parts in consecutive frames: those that are each other's best
    match in place and size.
    """
    tracks = [[p] for p in frames[0]]
    open_tracks = list(tracks)
    for new in frames[1:]:
        score = np.array([[likeness(t[-1], p) for p in new] for t in open_tracks]).reshape(
            len(open_tracks), len(new)
        )
        following = {}
        for a in range(len(open_tracks)) if len(new) else ():
            b = int(np.argmax(score[a]))
            if score[a, b] > 0 and int(np.argmax(score[:, b])) == a:
                following[b] = open_tracks[a]
        for b, p in enumerate(new):
            if b in following:
                following[b].append(p)
            else:
                tracks.append(following.setdefault(b, [p]))
        open_tracks = [following[b] for b in range(len(new))]
    return tracks


def likeness(a: Part, b: Part) -> float:
    """How well two parts fit in place and size, 1 at best; 0 where they lie farther
    apart than the larger one is wide.
    """
    apart = float(np.linalg.norm(a.center - b.center)) / np.sqrt(max(a.area, b.area))
    return max(0.0, 1 - apart) * min(a.area, b.area) / max(a.area, b.area)


def clearest(track: list[Part]) -> Part:
    """The part that is largest and most certain: certain where its neighbors in time
    have the same outline, moved.
    """
    return max(
        track,
        key=lambda p: (
            p.area
            * (
                0.1
                + np.mean([agreement(p, q) for q in track if abs(p.frame - q.frame) == 1] or [0])
            )
        ),
    )


def agreement(a: Part, b: Part) -> float:
    """Intersection over union of two outlines, center laid on center."""
    shift = (a.center - b.center).astype(np.float32)
    moved = cv2.warpAffine(
        b.mask.astype(np.uint8),
        np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32),
        b.mask.shape[::-1],
    )
    return iou(a.mask, moved > 0)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks; 0 of two empty ones."""
    return float((a & b).sum() / max((a | b).sum(), 1))


def prompt(part: Part, moving: np.ndarray) -> Prompt:
    """Points on and beside a part, and its box; `moving` (H, W) bool is the whole
    motion mask: nothing in it is called beside.
    """
    inside, beside = on_it(part.mask), beside_it(part, moving)
    rows, columns = np.flatnonzero(part.mask.any(1)), np.flatnonzero(part.mask.any(0))
    low, high = np.array([columns[0], rows[0]]), np.array([columns[-1], rows[-1]]) + 1
    margin = BOX_MARGIN * (high - low)
    box = np.concatenate(
        [np.maximum(low - margin, 0), np.minimum(high + margin, part.mask.shape[::-1])]
    )
    labels = np.array([1] * len(inside) + [0] * len(beside))
    return Prompt(part.frame, np.concatenate([inside, beside]), labels, box)


def on_it(mask: np.ndarray) -> np.ndarray:
    """Up to `INSIDE` points (N, 2) deep inside `mask` (H, W): where the distance to its
    outline is largest, then likewise farther off.
    """
    padded = np.pad(mask.astype(np.uint8), 1)  # the frame's edge counts as outline
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    y, x = np.indices(mask.shape)
    deepest = float(depth.max())
    points: list[tuple[float, float]] = []
    while len(points) < INSIDE and depth.max() >= 0.5 * deepest:
        v, u = np.unravel_index(np.argmax(depth), depth.shape)
        points.append((u + 0.5, v + 0.5))
        depth = np.where(np.hypot(x - u, y - v) < 1.5 * deepest, 0, depth)
    return np.array(points)


def beside_it(part: Part, moving: np.ndarray) -> np.ndarray:
    """Up to `BESIDE` points (N, 2) around a part, one per side, about half its radius
    from its outline and outside all that moves.
    """
    radius = np.sqrt(part.area / np.pi)
    away = cv2.distanceTransform(1 - part.mask.astype(np.uint8), cv2.DIST_L2, 5)
    free = cv2.dilate(moving.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    y, x = np.indices(part.mask.shape) + 0.5
    angle = np.arctan2(y - part.center[1], x - part.center[0])
    points: list[tuple[float, float]] = []
    for direction in np.arange(BESIDE) * 2 * np.pi / BESIDE:
        turn = np.abs(np.angle(np.exp(1j * (angle - direction))))
        cost = np.where(
            free & (turn < np.pi / BESIDE) & (away < 2 * radius),
            turn + np.abs(away / radius - 0.5),
            np.inf,
        )
        v, u = np.unravel_index(np.argmin(cost), cost.shape)
        if np.isfinite(cost[v, u]):
            points.append((u + 0.5, v + 0.5))
    return np.array(points).reshape(-1, 2)


class Entry(BaseModel):
    """Which object, in which frame."""

    model_config = ConfigDict(extra="forbid", strict=True)

    frame: int = Field(ge=0)
    object: int = Field(ge=1)


class PointEntry(Entry):
    """One point of a points file, in pixels."""

    x: FiniteFloat
    y: FiniteFloat
    label: int = Field(ge=0, le=1)


class BoxEntry(Entry):
    """One box of a points file, in pixels."""

    left: FiniteFloat
    top: FiniteFloat
    right: FiniteFloat
    bottom: FiniteFloat


class PointsFile(BaseModel):
    """What a points file holds, and what `prepare` writes of its own prompts."""

    model_config = ConfigDict(extra="forbid", strict=True)

    points: list[PointEntry] = []
    boxes: list[BoxEntry] = []


def read_points(path: Path, count: int, size: tuple[int, int]) -> PointsFile:
    """The points of a file for a clip of `count` frames of `size` (height, width);
    InputError where it is none or points outside.
    """
    try:
        found = PointsFile.model_validate(read_json(path))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); mend the path of --mask-points"
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(v) for v in first["loc"]) or "the file"
        raise InputError(
            f"{path}: {where}: {first['msg']}; docs/formats.md says what a points file holds"
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path}: not a JSON file ({error}); docs/formats.md says what a points file holds"
        ) from error
    height, width = size
    for p in found.points:
        if p.frame >= count or not (0 <= p.x <= width and 0 <= p.y <= height):
            raise InputError(
                f"{path}: point ({p.x:g}, {p.y:g}) of frame {p.frame}: the clip has {count} frames of {width}x{height} pixels; mend it"
            )
    for b in found.boxes:
        if b.frame >= count or not (b.left < b.right and b.top < b.bottom):
            raise InputError(
                f"{path}: the box of object {b.object} in frame {b.frame} is empty, or of none of the clip's {count} frames; mend it"
            )
    return found


def corrected(found: Sequence[Mover], given: PointsFile, frames: Sequence[int]) -> list[Mover]:
    """`found` with the user's points and boxes: those of an object's number are added
    to its prompts (a box replaces that frame's), those of other numbers make objects of
    their own. `frames` names the clip's frames as the file numbers them; entries of
    others are left out.
    """
    place = {f: k for k, f in enumerate(frames)}
    objects = {m.number: m for m in found}
    entries: list[PointEntry | BoxEntry] = [*given.points, *given.boxes]
    for entry in (e for e in entries if e.frame in place):
        mover = objects.get(entry.object, Mover(entry.object, ()))
        by_frame = {p.frame: p for p in mover.prompts}
        frame = place[entry.frame]
        old = by_frame.get(frame, Prompt(frame, np.zeros((0, 2)), np.zeros(0, int)))
        if isinstance(entry, BoxEntry):
            new = replace(old, box=np.array([entry.left, entry.top, entry.right, entry.bottom]))
        else:
            new = replace(
                old,
                points=np.vstack([old.points, [entry.x, entry.y]]),
                labels=np.append(old.labels, entry.label),
            )
        by_frame[frame] = new
        objects[entry.object] = replace(mover, prompts=tuple(by_frame[f] for f in sorted(by_frame)))
    return [objects[n] for n in sorted(objects)]


def as_file(asked: Sequence[Mover], frames: Sequence[int]) -> dict[str, Any]:
    """The prompts of a clip as a points file holds them; `frames` are the numbers of
    the clip's frames.
    """
    points = [
        PointEntry(
            frame=frames[p.frame],
            object=m.number,
            x=round(float(x), 2),
            y=round(float(y), 2),
            label=int(label),
        )
        for m in asked
        for p in m.prompts
        for (x, y), label in zip(p.points, p.labels, strict=True)
    ]
    boxes = [
        BoxEntry(
            frame=frames[p.frame], object=m.number, left=left, top=top, right=right, bottom=bottom
        )
        for m in asked
        for p in m.prompts
        if p.box is not None
        for left, top, right, bottom in [p.box.round(2).tolist()]
    ]
    return PointsFile(points=points, boxes=boxes).model_dump()
