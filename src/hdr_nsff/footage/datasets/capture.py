"""What a public data set says about its training pictures, whatever its layout: footage
whose frames are known better.

A reader turns a folder into a `Capture` and opens nothing that the set keeps back for
testing; `held_out.py` does that, for `evaluate` alone. Times are in frames of the set,
axes OpenCV, depth in units of the poses unless `depth_units` says otherwise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.core.names import resolve_name
from hdr_nsff.footage.ingest import FRAMES, LINEAR, Footage
from hdr_nsff.footage.pose_formats import GivenPoses
from hdr_nsff.scene.scene import (
    LARGEST,
    Strict,
    bracket_problem,
    first_problem,
    is_intrinsic,
    is_matrix,
)

# frames: a time this near to a whole number is one, since files store rounded fractions
SNAP = 1e-3


@dataclass(frozen=True)
class Picture:
    """One training picture."""

    source: str  # file name relative to the root
    time: float  # in frames
    camera_id: int = 0
    ev: float | None = None  # log2 exposure, to any reference
    bracket: int | None = None  # which row of `Capture.exposures`
    mask: Path | None = None
    depth: Path | None = None
    confidence: Path | None = None  # of the depth, in [0, 1]
    # source of another picture -> flow towards it
    flow: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class Exposures:
    """Exposures as a set written by `export` stores them."""

    ev: list[float | None]  # per bracket
    reference: int
    given: bool


@dataclass(frozen=True)
class Sighting:
    """Static points that a picture sees, to bring its depth map to the units of the
    poses.
    """

    xy: np.ndarray  # (n, 2) in [0, 1], shares of width and height
    depth: np.ndarray  # (n,) z-depth, scene units
    bounds: tuple[float, float]  # 5th and 95th percentile of z-depth, scene units


@dataclass(frozen=True)
class Capture:
    """The training part of a data set."""

    layout: str  # in words
    root: Path
    pictures: list[Picture]  # camera by camera, in time
    poses: GivenPoses | None  # row by row those of `pictures`
    withheld: bool  # the set keeps views back, which `prepare` writes into a truth folder
    over: float | None = (
        # what shows through transparent pixels: 1 white, 0 black; None: no transparency
        # expected
        None
    )
    still: bool = False  # nothing moves: times only number the views
    white_moves: bool = True  # what is white in the masks
    depth_kind: Literal["metric", "disparity", "relative"] = "metric"
    depth_units: Literal["scene", "own"] = (
        "scene"  # own: of the depth network, brought to scene units by `sightings`
    )
    depth_scale: float = 1.0  # what a metric depth file's unit is
    sightings: Mapping[str, Sighting] = field(default_factory=dict)  # by source
    points: np.ndarray | None = None  # (P, 3) static, scene units
    exposures: Exposures | None = None
    fps: float = 24.0
    notes: tuple[str, ...] = ()  # sentences for people

    @cached_property
    def by_source(self) -> dict[str, Picture]:
        """The pictures by file name."""
        return {p.source: p for p in self.pictures}

    @cached_property
    def row(self) -> dict[str, int]:
        """Where in `pictures` and `poses` a file name is."""
        return {p.source: k for k, p in enumerate(self.pictures)}

    def footage(self) -> Footage:
        """The pictures as footage, one list of files per camera."""
        cameras = sorted({p.camera_id for p in self.pictures})
        files = [[self.root / p.source for p in self.pictures if p.camera_id == c] for c in cameras]
        linear = {f.suffix.lower() in LINEAR for camera in files for f in camera}
        if len(linear) > 1:
            raise InputError(
                f"{self.root}: linear (EXR, DNG) and recorded pictures are mixed; keep one kind"
            )
        return Footage(
            self.root, files, False, max(map(len, files)), self.fps, linear.pop(), self.over
        )

    def parts(self) -> dict[str, bool]:
        """What the set gives for all of its pictures."""
        ps = self.pictures
        return {
            "exposures": self.exposures is not None or all(p.ev is not None for p in ps),
            "poses": self.poses is not None,
            "flow": any(p.flow for p in ps),
            "masks": self.still or all(p.mask for p in ps),
            "depth": all(p.depth for p in ps),
        }


class ExtraFrame(Strict):
    """What neither layout can say of a frame."""

    time: float
    camera_id: int = Field(default=0, ge=0)
    bracket: int = Field(default=0, ge=0)
    K: list[list[float]] | None = None  # 3x3 pixels
    flow: dict[str, str] = Field(default_factory=dict)  # name of another picture -> flow file
    disparity: str | None = None
    confidence: str | None = None
    moving: str | None = None


class ExtraView(Strict):
    """What the HDR-GoPro layout cannot say of a held-out view."""

    name: str = Field(pattern=r"^[^/\\\x00]{1,100}$")
    time: float
    bracket: int = Field(ge=0)
    anchor: str  # the training picture whose pose it has
    mask: str | None = None


class Extra(Strict):
    """What `export` writes beside a public layout, so that reading it again gives the
    same scene.
    """

    version: Literal[1] = 1
    fps: float = Field(gt=0)
    reference_bracket: int
    bracket_ev: list[float | None]
    exposure_given: bool
    near: float = Field(gt=0)
    far: float = Field(gt=0)
    depth_kind: Literal["scene", "relative"]
    points: str | None = None  # .npy (P, 3) static, scene units
    frames: dict[str, ExtraFrame]  # by name of the picture
    held_out: dict[str, ExtraView] = Field(
        default_factory=dict
    )  # by name of the picture, where the layout names none

    def exposures(self) -> Exposures:
        """The exposures of the brackets."""
        return Exposures(self.bracket_ev, self.reference_bracket, self.exposure_given)


def parse_extra(path: Path, value: Any, names: Sequence[str]) -> Extra:
    """`Extra` from JSON, complete for the pictures `names`."""
    try:
        extra = Extra.model_validate(value)
    except ValidationError as error:
        raise InputError(
            f"{path}: what `export` noted there is damaged ({first_problem(error)}); export again"
        ) from error
    if lost := [n for n in names if n not in extra.frames]:
        raise InputError(
            f"{path}: no entry for picture {lost[0]}, which holds its time and exposure; export again"
        )
    brackets = [f.bracket for f in extra.frames.values()] + [
        v.bracket for v in extra.held_out.values()
    ]
    problem = bracket_problem(brackets, extra.bracket_ev, extra.reference_bracket)
    if any(
        f.K is not None and not is_matrix(f.K, (3, 3), is_intrinsic) for f in extra.frames.values()
    ):
        problem = "a K is no 3x3 camera matrix"
    if strange := {v.anchor for v in extra.held_out.values()} - set(names):
        problem = f"held-out views have the pose of {min(strange)}, which is no training picture"
    if problem is not None:
        raise InputError(f"{path}: {problem}; export again")
    return extra


def read_object(path: Path, purpose: str) -> dict[str, Any]:
    """A JSON object; InputError that says what the file is for."""
    if not path.is_file():
        raise InputError(f"{path}: missing; it holds {purpose}, copy it again")
    try:
        found = read_json(path)
    except ValueError as error:
        raise InputError(
            f"{path}: not readable JSON ({error}), or cut short; it holds {purpose}, copy it again"
        ) from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: not a JSON object; it holds {purpose}, copy it again")
    return found


def read_document(path: Path, purpose: str) -> dict[str, Any]:
    """A `transforms*.json` with frames; InputError that says what the file is for."""
    document = read_object(path, purpose)
    if not isinstance(document.get("frames"), list) or not document["frames"]:
        raise InputError(f"{path}: no list of `frames` in it; it holds {purpose}, copy it again")
    for k, frame in enumerate(document["frames"]):
        if (
            not isinstance(frame, dict)
            or not isinstance(frame.get("file_path"), str)
            or "transform_matrix" not in frame
        ):
            raise InputError(
                f"{path}: frame {k} has no `file_path` with a `transform_matrix`; copy the file again"
            )
    return document


def number_of(path: Path, frame: Mapping[str, Any], key: str, purpose: str) -> float:
    """A number of a frame, up to `LARGEST`; InputError that says what it is for."""
    value = frame.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST:
        return float(value)
    name = shorten(frame.get("file_path"))
    raise InputError(f"{path}: {name} has no number `{key}`, {purpose}; copy the file again")


def named_file(root: Path, name: str, purpose: str) -> Path:
    """The file that `name` means in a JSON of the set, with or without its ending;
    InputError that says what it is for.
    """
    base = resolve_name(root, name.replace("\\", "/"), "data set")
    endings = ("", *sorted(FRAMES)) if base.suffix.lower() in FRAMES else (*sorted(FRAMES), "")
    found = next((p for e in endings if (p := base.with_name(base.name + e)).is_file()), None)
    if found is None:
        raise InputError(f"{root / shorten(name)}: missing; it is {purpose}, copy it again")
    return resolve_name(root, str(found), "data set")


def named_map(root: Path, name: str, purpose: str) -> Path:
    """The map or mask that `name` means in a JSON of the set; InputError that says what
    it is for.
    """
    path = resolve_name(root, name, "data set")
    if not path.is_file():
        raise InputError(f"{root / shorten(name)}: missing; it is {purpose}, copy it again")
    return path


def source_of(root: Path, path: Path) -> str:
    """A file's name relative to the root; `path` is below it, resolved or as listed."""
    base = root if path.is_relative_to(root) else root.resolve()
    return path.relative_to(base).as_posix()


def same_number(folder: Path, files: Sequence[Path], wanted: int, purpose: str) -> list[Path]:
    """`files`, one for each of the `wanted` pictures; InputError that says what they
    are for.
    """
    if len(files) != wanted:
        raise InputError(
            f"{folder}: {len(files)} files for {wanted} pictures; it holds {purpose}, one each, copy it again"
        )
    return list(files)


@dataclass(frozen=True)
class Clock:
    """Times as a set stores them, in whatever unit -> frames: the first training time
    is 0, the median gap between two is 1.
    """

    start: float
    step: float

    @staticmethod
    def of(times: Sequence[float]) -> Clock:
        """The clock of the training times."""
        distinct = np.unique(np.asarray(times, np.float64))
        return Clock(
            float(distinct[0]), float(np.median(np.diff(distinct))) if len(distinct) > 1 else 1.0
        )

    def __call__(self, time: float) -> float:
        """A time in frames."""
        value = (time - self.start) / self.step
        return float(round(value)) if abs(value - round(value)) < SNAP else value


def turns(times: Sequence[float]) -> list[int]:
    """A camera for each picture: 0, and for a further picture of the same time 1, 2,
    ...
    """
    seen: Counter[float] = Counter()
    cameras = []
    for t in times:
        cameras.append(seen[t])
        seen[t] += 1
    return cameras


def reorder(given: GivenPoses, order: Sequence[int]) -> GivenPoses:
    """The same poses, picked in another order."""
    rows = list(order)
    names = None if given.names is None else [given.names[k] for k in rows]
    return GivenPoses(
        names, given.K[rows], given.c2w[rows], given.size[rows], given.near, given.far
    )
