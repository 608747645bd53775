"""A prepared clip in memory: what training, rendering and evaluation read.

`Scene.open` reads a scene folder (`manifest.py` says what it holds): maps are one
half-precision `.npy` per array, images and masks PNG. Held-out truth of a synthetic
scene lies outside, see `truth.py`; nothing here can read it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_image, read_mask
from hdr_nsff.core.io import how_to_restore, read_npy
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.radiometry.response import Response
from hdr_nsff.scene.manifest import FrameEntry, Manifest, StepRecord, inside
from hdr_nsff.scene.movers import Mover, read_movers
from hdr_nsff.scene.response import read_response

# frames in memory: as many as fit in this, each of about so many bytes for every pixel
FRAME_MEMORY = 1500 << 20
FRAME_BYTES = 42
MIN_KEPT_FRAMES = 12
OUTLINE_PX = 2  # by which the outline of an estimated mask may be wrong


@dataclass(frozen=True)
class Frame:
    """One frame in memory."""

    index: int  # in the manifest
    time: float  # in frames
    camera: Camera
    camera_id: int
    bracket: int
    image: Tensor  # (H, W, 3) recorded rgb in [0, 1]
    drift: float = 0.0  # stops by which its exposure differs from its bracket's
    # stops by which its white balance differs from the clip's
    white_balance: tuple[float, ...] = (0.0, 0.0, 0.0)
    # {+-1: position in `Scene.train`} of the neighbors in time, same physical camera
    neighbors: dict[int, int] = field(default_factory=dict)
    moving: Tensor | None = None  # (H, W) bool
    outline: Tensor | None = None  # (H, W) bool: near the outline of an estimated mask
    disparity: Tensor | None = None  # (H, W) 1 / z-depth
    disparity_confidence: Tensor | None = None  # (H, W) in [0, 1]
    flow: dict[int, Tensor] = field(default_factory=dict)  # {+-1: (H, W, 2)} px
    flow_valid: dict[int, Tensor] = field(default_factory=dict)  # {+-1: (H, W) bool}

    def with_camera(self, camera: Camera) -> Frame:
        """The same frame, of another camera."""
        return dataclasses.replace(self, camera=camera)


class StoredFrame(Frame):
    """A frame whose image and maps are read from the scene folder when they are asked
    for, and forgotten when others need the memory. Replacing a field makes a frame that
    holds all of them.
    """

    load: Callable[[], Frame]

    def __init__(self, load: Callable[[], Frame] | None = None, **fields: Any) -> None:
        """`load` reads the whole frame; `fields` are those of `Frame` without its image
        and maps, or all of them without `load`.
        """
        if load is None:
            whole = Frame(**fields)
            fields = {name: value for name, value in fields.items() if name not in STORED}
            load = partial(copy, whole)
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "load", load)

    def with_camera(self, camera: Camera) -> Frame:
        """The same frame, of another camera: image and maps stay in the folder."""
        fields = {name: getattr(self, name) for name in LIGHT}
        return StoredFrame(self.load, **fields | {"camera": camera})


STORED = (
    "image",
    "moving",
    "outline",
    "disparity",
    "disparity_confidence",
    "flow",
    "flow_valid",
)
LIGHT = tuple(f.name for f in dataclasses.fields(Frame) if f.name not in STORED)


def stored_value(name: str) -> property:
    """The property of a stored frame that reads the field `name`."""
    return property(lambda self: getattr(self.load(), name))


for stored_name in STORED:
    setattr(StoredFrame, stored_name, stored_value(stored_name))


class FrameStore:
    """Reads frames of a scene folder; those used last stay in memory."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder = folder
        self.manifest = manifest
        num_pixels = manifest.width * manifest.height
        limit = max(MIN_KEPT_FRAMES, FRAME_MEMORY // (FRAME_BYTES * num_pixels))
        self.read = lru_cache(limit)(self.read_frame)
        self.arguments: dict[int, tuple[FrameEntry, dict[int, int], dict[int, int]]] = {}

    def read_frame(self, index: int) -> Frame:
        """The whole frame of that index in the manifest."""
        return load_frame(self.folder, self.manifest, *self.arguments[index])

    def frame(
        self, entry: FrameEntry, neighbor_index: dict[int, int], positions: dict[int, int]
    ) -> StoredFrame:
        """A frame, read once to check it; arguments as of `load_frame`."""
        self.arguments[entry.index] = (entry, neighbor_index, positions)
        whole = self.read(entry.index)
        light = {name: getattr(whole, name) for name in LIGHT}
        return StoredFrame(partial(self.read, entry.index), **light)


@dataclass(frozen=True)
class Scene:
    """A prepared clip in memory."""

    folder: Path
    train: list[Frame]
    test: list[Frame]  # frames of the clip kept out of training
    near: float  # z-depth, scene units
    far: float
    points: Tensor  # (P, 3) static points, scene units
    response: Response
    movers: tuple[Mover, ...]  # largest first
    manifest: Manifest

    @property
    def times(self) -> Tensor:
        """Distinct training times in order, (T,)."""
        return torch.tensor(sorted({f.time for f in self.train}), dtype=torch.float64)

    @staticmethod
    def open(folder: Path | str) -> Scene:
        """Read a prepared scene folder; InputError in one sentence where something is
        missing, short or of the wrong size.
        """
        folder = Path(folder)
        m = Manifest.load(folder)
        near, far = check_complete(folder, m)
        entries = [e for e in m.frames if e.split == "train"]
        store = FrameStore(folder, m)
        train: list[Frame] = []
        for entry, positions in zip(entries, neighbors(entries), strict=True):
            indices = {o: entries[j].index for o, j in positions.items()}
            train.append(store.frame(entry, indices, positions))
        return Scene(
            folder=folder,
            train=train,
            test=[store.frame(e, {}, {}) for e in m.frames if e.split == "test"],
            near=near,
            far=far,
            points=load_points(folder, m.points) if m.points else torch.zeros(0, 3),
            response=load_response(folder, m),
            movers=load_movers(folder, m, entries),
            manifest=m,
        )


def check_complete(folder: Path, m: Manifest) -> tuple[float, float]:
    """Near and far of a scene; InputError where `prepare` has not finished it."""
    again = "run `hdr-nsff prepare` again"
    segment = folder.parent / "segment_00"
    is_segment = folder.name.startswith("segment_")
    if not is_segment and "masks" not in m.steps and (segment / "scene.json").is_file():
        raise InputError(
            f"{folder}: holds what the segments of a clip share, and is no scene; "
            f"name a segment, such as {segment}"
        )
    if not m.frames:
        raise InputError(f"{folder}: the scene has no frames; {again}")
    posed = all(f.c2w is not None and f.K is not None for f in m.frames)
    if m.near is None or m.far is None or not posed:
        raise InputError(
            f"{folder}: the scene has no camera poses yet; {again}, it continues where it stopped"
        )
    if step := unfinished_step(m):
        raise InputError(
            f"{folder}: `prepare` has not finished the step {step} of this scene; "
            f"{again}, it continues where it stopped"
        )
    return m.near, m.far


def unfinished_step(m: Manifest) -> str | None:
    """The first step of `prepare` that training needs and that has not finished, None
    where all have, or the scene was made otherwise. The contact sheet is for people.
    """
    started = {name: step.done for name, step in m.steps.items() if name != "sheet"}
    if "movers" in started:  # which `prepare` alone finds
        started.setdefault("depth", False)
    return next((name for name, done in started.items() if not done), None)


def training_key(m: Manifest) -> str | None:
    """A hash of what of a scene cannot change under a trained run: its frames, their
    cameras, times and exposures, and which are held out; None while `prepare` is at it.
    """
    if unfinished_step(m) is not None or any(f.c2w is None for f in m.frames):
        return None
    names = {"time", "camera_id", "track", "bracket", "split", "K", "c2w"}
    frames = [f.model_dump(include=names) for f in m.frames]
    values = [m.width, m.height, m.bracket_ev, m.reference_bracket, frames]
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def load_response(folder: Path, m: Manifest) -> Response:
    """The scene's response curves and exposures."""
    if m.response is None:
        raise InputError(
            f"{folder}: the scene has no response curve yet; "
            "run `hdr-nsff prepare` again, it continues where it stopped"
        )
    return read_response(inside(folder, m.response), m.num_cameras, m.num_brackets)


def load_movers(folder: Path, m: Manifest, entries: list[FrameEntry]) -> tuple[Mover, ...]:
    """The scene's movers; InputError where they are of other frames than those of
    training.
    """
    if m.movers is None:
        raise InputError(
            f"{folder}: the scene has no movers yet; "
            "run `hdr-nsff prepare` again, it continues where it stopped"
        )
    movers = read_movers(inside(folder, m.movers))
    first: dict[float, int] = {}
    for entry in sorted(entries, key=lambda e: (e.time, e.index)):
        first.setdefault(entry.time, entry.index)
    for mover in movers:
        if mover.frames.tolist() != list(first.values()):
            raise InputError(
                f"{folder / m.movers}: movers of other frames than the training frames; "
                "run `hdr-nsff prepare` with `--redo movers`"
            )
    return movers


def load_points(folder: Path, name: str) -> Tensor:
    """Static points (P, 3)."""
    points = read_npy(inside(folder, name))
    table = points.ndim == 2 and points.shape[1] == 3 and points.dtype.kind == "f"
    if not table or not np.isfinite(points).all():
        raise InputError(
            f"{folder / name}: expected finite points of shape (P, 3), not {points.shape}; "
            "run `prepare` with `--redo poses`"
        )
    return torch.from_numpy(points.astype(np.float32))


def neighbors(entries: list[FrameEntry]) -> list[dict[int, int]]:
    """For each frame the positions of the frames at the previous (-1) and next (+1)
    training time of the same physical camera, and track of it.

    A camera that has no frame at that time has no neighbor there: fields know scene
    flow from one training time to the next.
    """
    result: list[dict[int, int]] = [{} for _ in entries]
    rank = {time: k for k, time in enumerate(sorted({e.time for e in entries}))}
    lines = [(e.camera_id, e.track) for e in entries]
    for line in set(lines):
        own = [i for i, other in enumerate(lines) if other == line]
        for a, b in itertools.pairwise(sorted(own, key=lambda i: entries[i].time)):
            if rank[entries[b].time] - rank[entries[a].time] == 1:
                result[a][1] = b
                result[b][-1] = a
    return result


def load_frame(
    folder: Path,
    m: Manifest,
    entry: FrameEntry,
    neighbor_index: dict[int, int],
    positions: dict[int, int],
) -> Frame:
    """One frame with its maps.

    `neighbor_index` {+-1: index in the manifest}, `positions` {+-1: place in
    `Scene.train`}.
    """
    read = MapReader(folder, (m.height, m.width), entry.index)
    image = read(entry.image, read_image, "image", (3,))
    assert image is not None
    disparity = read(entry.disparity, read_npy, "disparity")
    if disparity is not None and m.depth_kind == "scene" and float(disparity.min()) < 0:
        raise InputError(
            f"{folder / str(entry.disparity)}: disparity of frame {entry.index} is negative; "
            "run `prepare` with `--redo depth`"
        )
    flow, flow_valid = {}, {}
    for offset, index in neighbor_index.items():
        if index in entry.flow:
            files = entry.flow[index]
            flow[offset] = read(files.flow, read_npy, "flow", (2,))
            flow_valid[offset] = read(files.valid, read_mask, "flow mask")
    moving = read(entry.mask, read_mask, "mask")
    estimated = m.steps.get("masks", StepRecord()).provenance == "estimated"
    assert entry.K is not None and entry.c2w is not None
    return Frame(
        index=entry.index,
        time=entry.time,
        camera=Camera(torch.tensor(entry.K), torch.tensor(entry.c2w), m.width, m.height),
        camera_id=entry.camera_id,
        bracket=entry.bracket,
        image=image,
        drift=entry.drift or 0.0,
        white_balance=tuple(entry.white_balance or (0.0, 0.0, 0.0)),
        neighbors=positions,
        moving=moving,
        outline=outline(moving) if moving is not None and estimated else None,
        disparity=disparity,
        disparity_confidence=read(entry.disparity_confidence, read_npy, "disparity confidence"),
        flow={o: v for o, v in flow.items() if v is not None},
        flow_valid={o: v for o, v in flow_valid.items() if v is not None},
    )


@dataclass(frozen=True)
class MapReader:
    """Reads maps of one frame, with its size checked."""

    folder: Path
    size: tuple[int, int]  # height, width
    index: int  # of the frame

    def __call__(
        self,
        name: str | None,
        read: Callable[[Path], np.ndarray],
        what: str,
        channels: tuple[int, ...] = (),
    ) -> Tensor | None:
        """The map of that name, float32 or bool, None where there is none; InputError
        for another size, no numbers, NaN or Inf.
        """
        if name is None:
            return None
        array = read(inside(self.folder, name))
        place = f"{self.folder / name}: {what} of frame {self.index}"
        again = how_to_restore(self.folder / name)
        expected = self.size + channels
        if array.shape != expected:
            raise InputError(f"{place} has shape {array.shape}, expected {expected}; {again}")
        if array.dtype.kind not in "fiub":
            raise InputError(f"{place} holds no numbers; {again}")
        if array.dtype == bool:
            return torch.from_numpy(array)
        with np.errstate(over="ignore"):
            values = array.astype(np.float32)
        if not np.isfinite(values).all():
            raise InputError(f"{place} holds NaN or Inf; {again}")
        return torch.from_numpy(values)


def outline(mask: Tensor) -> Tensor:
    """(H, W) bool: pixels within `OUTLINE_PX` of the outline of a mask (H, W)."""
    window = np.ones((2 * OUTLINE_PX + 1,) * 2, np.uint8)
    marks = mask.numpy().astype(np.uint8)
    return torch.from_numpy(cv2.dilate(marks, window) > cv2.erode(marks, window))


def without_outline(moving: Tensor, outline: Tensor) -> Tensor:
    """(H, W) bool: a moving mask without its doubtful outline; small and thin objects
    stay whole.
    """
    count, objects = cv2.connectedComponents(moving.numpy().astype(np.uint8), connectivity=4)
    sure = moving & ~outline
    whole = ~np.isin(np.arange(count), np.unique(objects[sure.numpy()]))
    return sure | (moving & torch.from_numpy(whole[objects]))


def surely_moving(frame: Frame) -> Tensor:
    """(H, W) bool: the moving mask, as far as it is certain."""
    if frame.moving is None:
        return torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    return frame.moving if frame.outline is None else without_outline(frame.moving, frame.outline)
