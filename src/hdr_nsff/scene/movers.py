"""What `prepare` knows of the moving objects of a clip: tracks, rigid motion, shape.

One `Mover` per object, all over the same times. A canonical point X of a mover is at
`R(t) (X - center) + center + translation(t)` at time t. Depth maps, the contact sheet
and the start of a field read movers; only `prepare` estimates them. They lie in the
scene folder as `movers.npz`, plain arrays that a user may read, change or drop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic
from hdr_nsff.geometry import pinhole

VERSION = 2  # of movers.npz
NUM_NEAREST_TRACKS = 4  # tracks that a pixel's depth is interpolated from
MAX_TRACK_DISTANCE_PX = 8.0  # pixels from the nearest track; half or twice was not measured
# pixels between starts of tracks, from which on limits of distance grow with them: the
# limits were chosen for up to as many
DENSE_SPACING_PX = 6.0
OPTIONAL_ARRAYS = ("spacing",)  # that files written before do not have
TRACK_CONFIDENCE = 0.5  # at a track: its distance as a whole rests on priors
NO_MOVER = -1  # owner of a pixel that moves, but with none of the movers
MAX_DEPTH_RATIO = 2.0  # a pixel's depth changes by less than this factor

PinholeCamera = tuple[np.ndarray, np.ndarray]  # K (3, 3), c2w (3, 4)


@dataclass(frozen=True)
class Mover:
    """One moving object over T times."""

    frames: np.ndarray  # (T,) int: index of the frame at each time
    pixels: np.ndarray  # (N, T, 2) xy px of its tracks, NaN where unseen
    trust: np.ndarray  # (N, T) of a track's depth, 0 where unseen
    points: np.ndarray  # (N, 3) canonical, scene units, NaN where unknown: the shape
    rotations: np.ndarray  # (T, 3, 3) world from canonical
    translations: np.ndarray  # (T, 3) scene units
    center: np.ndarray  # (3,) canonical, scene units
    known: np.ndarray  # (T,) bool: enough of it was seen; motion between is interpolated
    error: float  # median reprojection error of the shape, in its sigmas; inf: no shape
    # median distance in pixels between believed flow and what its motion explains, and
    # the same of the static scene: the uncertainty of flow; 0 where there is no flow
    flow_residual: float = 0.0
    flow_uncertainty: float = 0.0
    rigid: bool = True  # its motion explains its flow, within that uncertainty
    spacing: float = 3.0  # pixels from the start of one track to the next

    @property
    def sparseness(self) -> float:
        """The factor on limits of distance in pixels; 1 where tracks are dense."""
        return max(1.0, self.spacing / DENSE_SPACING_PX)

    @property
    def reach_px(self) -> float:
        """The distance from its nearest track up to which a pixel is on the mover."""
        return MAX_TRACK_DISTANCE_PX * self.sparseness

    @property
    def has_shape(self) -> bool:
        """Whether its tracks determined a shape."""
        return bool(np.isfinite(self.error))

    def at(self, t: int) -> np.ndarray:
        """World points (N, 3) of its tracks at the t-th time."""
        return self.world(self.points, t)

    def world(self, points: np.ndarray, t: int) -> np.ndarray:
        """World points (P, 3) at the t-th time of canonical `points` (P, 3)."""
        turned = (points - self.center) @ self.rotations[t].T
        return turned + self.center + self.translations[t]

    def canonical(self, points: np.ndarray, t: int) -> np.ndarray:
        """Canonical points (P, 3) of world `points` (P, 3) of the t-th time."""
        return (points - self.center - self.translations[t]) @ self.rotations[t] + self.center


def fill_mover_depth(
    movers: Sequence[Mover],
    t: int,
    moving: np.ndarray,
    c2w: np.ndarray,
    disparity: np.ndarray,
    confidence: np.ndarray,
    rigid_only: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """`disparity` and `confidence` (H, W) with the shapes of movers at the t-th time.

    A pixel that is `moving` (H, W) takes the depth of the nearest tracks of one mover,
    as the camera at `c2w` (3, 4) sees them. Pixels far from any track stay as they are.
    So do those of a mover that is not rigid: all with `rigid_only`, else those whose
    own depth is known better.
    """
    disparity, confidence = disparity.copy(), confidence.copy()
    pixels, inverse_depths, owners = track_depths(movers, t, c2w)
    y, x = np.nonzero(moving)
    if not len(pixels) or not len(y):
        return disparity, confidence
    num_nearest = min(NUM_NEAREST_TRACKS, len(pixels))
    distance, nearest = cKDTree(pixels).query(np.stack([x, y], -1) + 0.5, num_nearest)
    distance, nearest = distance.reshape(len(y), -1), nearest.reshape(len(y), -1)
    same_mover = owners[nearest] == owners[nearest[:, :1]]
    weight = same_mover / (distance + 0.5) ** 2
    found = (weight * inverse_depths[nearest]).sum(1) / weight.sum(1)
    change = np.abs(np.log(found / np.maximum(disparity[y, x], 1e-9)))
    reach = np.array([mover.reach_px for mover in movers])[owners[nearest[:, 0]]]
    near = (distance[:, 0] < reach) & (change < np.log(MAX_DEPTH_RATIO))
    rigid = np.array([mover.rigid for mover in movers])[owners[nearest[:, 0]]]
    near &= rigid | ((confidence[y, x] <= TRACK_CONFIDENCE) & (not rigid_only))
    y, x = y[near], x[near]
    disparity[y, x] = found[near]
    falloff = np.exp(-((distance[near, 0] / reach[near]) ** 2))
    confidence[y, x] = np.maximum(confidence[y, x], TRACK_CONFIDENCE * falloff)
    return disparity, confidence


def track_depths(
    movers: Sequence[Mover], t: int, c2w: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (P, 2), inverse z-depths (P,) and movers (P,) of all tracks of known shape
    that are seen at the t-th time.
    """
    pixels, inverse_depths, owners = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros(0, int)]
    for k, mover in enumerate(movers):
        if not mover.has_shape:
            continue
        depth = (mover.at(t) - c2w[:, 3]) @ c2w[:, 2]
        seen = np.isfinite(mover.pixels[:, t, 0]) & np.isfinite(depth) & (depth > 1e-6)
        pixels.append(mover.pixels[seen, t])
        inverse_depths.append(1 / depth[seen])
        owners.append(np.full(int(seen.sum()), k))
    return np.concatenate(pixels), np.concatenate(inverse_depths), np.concatenate(owners)


def nearest_mover(
    movers: Sequence[Mover], t: int, pixels: np.ndarray, camera: PinholeCamera, tracked: bool = True
) -> np.ndarray:
    """The mover (P,) whose track is nearest to `pixels` (P, 2) of `camera` at the t-th
    time.

    `NO_MOVER` where the mover is rigid and its shape out of reach: something else moves
    there, such as a shadow. The tracks are of this camera's frames if `tracked`. In the
    picture of another camera, and where no track is seen, they are where it sees the
    points of the movers' shapes. Without these, all is the first mover if it is known
    at that time, else `NO_MOVER`.
    """
    shapes = [shape_in_picture(mover, t, camera) for mover in movers]
    tracks = [tracks_in_picture(mover, t) for mover in movers] if tracked else shapes
    if not any(map(len, tracks)):
        tracks = shapes
    owners = np.repeat(np.arange(len(tracks)), [len(p) for p in tracks])
    if not len(owners) or not len(pixels):
        return np.full(len(pixels), 0 if movers[0].known[t] else NO_MOVER)
    distance, nearest = cKDTree(np.concatenate(tracks)).query(pixels)
    owner = owners[nearest]
    for k, (mover, shape) in enumerate(zip(movers, shapes, strict=True)):
        far = np.nonzero((owner == k) & (distance > mover.reach_px))[0]
        if mover.rigid and len(shape) and len(far):
            to_shape = cKDTree(shape).query(pixels[far])[0]
            owner[far[to_shape > mover.reach_px]] = NO_MOVER
    return owner


def movers_in_picture(
    movers: Sequence[Mover],
    t: int,
    moving: np.ndarray,
    camera: PinholeCamera,
    tracked: bool,
    in_turn: bool,
) -> np.ndarray:
    """The mover (H, W) of every pixel that is `moving` (H, W) bool in the picture of
    `camera` at the t-th time; `NO_MOVER` elsewhere.

    As `nearest_mover` has it. But before cameras that take turns, `in_turn`, what is
    connected to a rigid mover is a part of it, such as the rod that a ball hangs from:
    no other camera sees that moment, so by itself it would have no depth.
    """
    result = np.full(moving.shape, NO_MOVER)
    rows, columns = np.nonzero(moving)
    pixels = np.stack([columns, rows], -1) + 0.5
    owner = nearest_mover(movers, t, pixels, camera, tracked)
    if in_turn:
        _, regions = cv2.connectedComponents(moving.astype(np.uint8), connectivity=8)
        join_regions(owner, pixels, regions[rows, columns], [mover.rigid for mover in movers])
    result[rows, columns] = owner
    return result


def join_regions(
    owner: np.ndarray, pixels: np.ndarray, region: np.ndarray, rigid: Sequence[bool]
) -> None:
    """Give pixels (P, 2) of no mover to the rigid one that is nearest in their `region`
    (P,), if there is one; changes `owner` (P,). `rigid`: which movers are.
    """
    of_rigid = np.array([*rigid, False])[owner]
    for k in np.unique(region[owner == NO_MOVER]):
        lost = np.nonzero((region == k) & (owner == NO_MOVER))[0]
        own = np.nonzero((region == k) & of_rigid)[0]
        if len(own):
            owner[lost] = owner[own[cKDTree(pixels[own]).query(pixels[lost])[1]]]


def tracks_in_picture(mover: Mover, t: int) -> np.ndarray:
    """The pixels (N, 2) of a mover's tracks at the t-th time, in its own frame."""
    own = mover.pixels[:, t]
    return own[np.isfinite(own[:, 0])]


def shape_in_picture(mover: Mover, t: int, camera: PinholeCamera) -> np.ndarray:
    """The pixels (N, 2) where a camera sees the points of a mover's shape at the t-th
    time; those that are hidden, too.
    """
    points = mover.at(t)
    pixels, depth = pinhole.project(points[np.isfinite(points[:, 0])], *camera)
    return pixels[depth > pinhole.MIN_DEPTH]


def write_movers(path: Path, movers: Sequence[Mover]) -> None:
    """Write `movers.npz`: arrays `0/pixels`, `0/rotations`, ..., `1/pixels`, ...

    The number is that of the mover.
    """
    arrays: dict[str, np.ndarray] = {"version": np.array(VERSION)}
    for k, mover in enumerate(movers):
        for f in fields(Mover):
            arrays[f"{k}/{f.name}"] = np.asarray(getattr(mover, f.name))
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_movers(path: Path) -> tuple[Mover, ...]:
    """Read `movers.npz`; InputError where it is missing, damaged or makes no sense.

    Movers count from 0 without gaps is not required: a user may have dropped one.
    """
    advice = "run `hdr-nsff prepare` with `--redo movers`"
    if not path.is_file():
        raise InputError(f"{path}: missing; {advice}")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            data = {name: arrays[name] for name in arrays.files}
        if data.pop("version", None) != VERSION:
            raise InputError(f"{path}: of another version; {advice}")
        keys = sorted({int(name.split("/")[0]) for name in data})
        movers = tuple(mover_of(data, k) for k in keys)
    except InputError:
        raise
    except Exception as error:  # of zipfile, zlib and numpy: many unrelated types
        kind = type(error).__name__
        raise InputError(f"{path}: cut short or damaged ({kind}); {advice}") from error
    for k, mover in zip(keys, movers, strict=True):
        if problem := mover_problem(mover):
            raise InputError(f"{path}: mover {k} {problem}; {advice}")
    return movers


def mover_of(data: dict[str, np.ndarray], k: int) -> Mover:
    """The mover number `k` of a file's arrays; KeyError where an array is missing."""
    names = [f.name for f in fields(Mover)]
    given = [n for n in names if n not in OPTIONAL_ARRAYS or f"{k}/{n}" in data]
    values: dict[str, Any] = {name: data[f"{k}/{name}"] for name in given}
    for name in {"error", "flow_residual", "flow_uncertainty", "spacing"}.intersection(given):
        values[name] = float(values[name])
    values["rigid"] = bool(values["rigid"])
    return Mover(**values)


def mover_problem(mover: Mover) -> str | None:
    """What does not fit together in a mover; None where all does."""
    tracks, times = len(mover.pixels), len(mover.frames)
    shapes = {
        "pixels": (tracks, times, 2),
        "trust": (tracks, times),
        "points": (tracks, 3),
        "rotations": (times, 3, 3),
        "translations": (times, 3),
        "center": (3,),
        "known": (times,),
    }
    for name, shape in shapes.items():
        if getattr(mover, name).shape != shape:
            return f"has {name} of shape {getattr(mover, name).shape}, expected {shape}"
    motion = (mover.rotations, mover.translations, mover.center, mover.trust)
    if not all(np.isfinite(array).all() for array in motion):
        return "has a motion with NaN or Inf"
    turns = mover.rotations @ np.swapaxes(mover.rotations, 1, 2)
    if not np.allclose(turns, np.eye(3), atol=1e-3):
        return "has rotations that are not orthogonal matrices"
    return None
