"""`scene.json`: what a scene folder holds, where it came from, and in which units.

`prepare` writes it, step by step; everything else reads it. File names are relative to
the folder and never leave it. Unknown keys, NaN and Inf are errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json, write_json
from hdr_nsff.core.names import resolve_name
from hdr_nsff.core.notes import first_problem
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.paths import MAX_EV

Parallax = Literal["full", "rotation", "none"]
Provenance = Literal["estimated", "given", "absent"]
Split = Literal["train", "test"]
Protocol = Literal["novel-view", "novel-view-time"]

# Numbers beyond it, and depths below 1 / it, are no measurements and would overflow in
# single precision.
MAX_NUMBER = 1e15
MAX_SECONDS = 1e6  # of an exposure


class Strict(BaseModel):
    """A model that refuses unknown keys, NaN and Inf."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class FlowFiles(Strict):
    """Optical flow from one frame to another."""

    # .npy (H, W, 2) half, px: where a pixel goes in the other frame, minus where it is
    flow: str
    valid: str  # PNG, 255 where the forward-backward check passed


class LensEntry(Strict):
    """The camera as it recorded, before `prepare` undistorted its frames."""

    K: list[list[float]]  # 3x3 px of width x height
    distortion: list[float] = Field(min_length=4, max_length=4)  # k1, k2, p1, p2 (OpenCV)
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    given: bool = False  # by the user or with the poses; else estimated

    @staticmethod
    def of(lens: Lens, given: bool) -> LensEntry:
        """The entry of a lens."""
        return LensEntry(
            given=given,
            K=lens.K.tolist(),
            distortion=list(lens.distortion),
            width=lens.width,
            height=lens.height,
        )

    def lens(self) -> Lens:
        """The lens of an entry."""
        k1, k2, p1, p2 = self.distortion
        return Lens(np.array(self.K), (k1, k2, p1, p2), self.width, self.height)


class FrameEntry(Strict):
    """One recorded frame and the files of its priors."""

    index: int = Field(ge=0)
    image: str  # PNG, recorded rgb, 8 or 16 bit
    source: str  # which file (and frame of it) this came from
    time: float  # in frames of the footage
    camera_id: int = Field(default=0, ge=0)  # physical camera: owns a response curve
    # of the tracks that one camera records at the same times (HDRx, dual gain)
    track: int = Field(default=0, ge=0)
    bracket: int = Field(ge=0)  # which exposure of the cycle
    ev: float | None = None  # log2 exposure relative to the reference bracket, if known
    # stops by which it differs from its bracket's (auto exposure), None: not at all
    drift: float | None = None
    # seconds for which the shutter was open, None where unknown
    exposure_time: float | None = Field(default=None, gt=0, le=MAX_SECONDS)
    # stops (3,) by which its white balance differs from the clip's, None: not at all
    white_balance: list[float] | None = None
    split: Split = "train"
    K: list[list[float]] | None = None  # 3x3 px
    c2w: list[list[float]] | None = None  # 3x4 OpenCV, scene units
    mask: str | None = None  # PNG, moving = 255
    # depth of the static scene, also behind movers, before these were found:
    static_disparity: str | None = None  # .npy (H, W) half, 1 / z-depth
    static_confidence: str | None = None  # .npy (H, W) half, in [0, 1]
    still: str | None = None  # PNG, 255 where a pixel of the mask stands still after all
    # first depth of movers, one distance per moving region:
    mover_disparity: str | None = None  # .npy (H, W) half, 1 / z-depth
    mover_confidence: str | None = None  # .npy (H, W) half, in [0, 1]
    # depth of all, what training reads:
    disparity: str | None = None  # .npy (H, W) half, 1 / z-depth
    disparity_confidence: str | None = None  # .npy (H, W) half, in [0, 1]
    flow: dict[int, FlowFiles] = {}  # index of another frame -> flow towards it
    raw_flow: dict[int, FlowFiles] = {}  # as matched, before masks were known

    @property
    def files(self) -> list[str]:
        """The names of all files of this frame."""
        names = [self.image, self.mask, self.static_disparity, self.static_confidence]
        names += [self.still, self.mover_disparity, self.mover_confidence]
        names += [self.disparity, self.disparity_confidence]
        for flow in (*self.flow.values(), *self.raw_flow.values()):
            names += [flow.flow, flow.valid]
        return [name for name in names if name is not None]


class StepRecord(Strict):
    """One finished step of `prepare`, with a hash of what it depended on."""

    done: bool = False
    key: str = ""  # hash of settings and inputs; with another key the step is redone
    provenance: Provenance = "estimated"
    note: str = ""  # one sentence for people
    seconds: float = 0.0
    cpu_seconds: float = 0.0  # of processor time, worker processes included
    peak_memory_mb: int = 0  # of the process, up to the end of the step
    details: dict[str, Any] = {}


class Manifest(Strict):
    """`scene.json`."""

    version: Literal[2] = 2
    source: str  # the footage, as the user named it
    inputs: dict[str, str] = {}  # input file name -> sha256
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    protocol: Protocol | None = None  # how the clip was split for `evaluate`
    fps: float = Field(default=24.0, gt=0, le=1e6)
    stride: int = Field(default=1, ge=1)  # every how manyth frame of the footage is used
    # seconds from one frame of the footage to the next, None where no clock shows them
    frame_seconds: float | None = Field(default=None, gt=0, le=1e6)
    # milliseconds from a rolling shutter's first row to its last; poses are those of
    # the middle row
    readout: float = Field(default=0.0, ge=0, le=1000)
    cycle: int = Field(default=1, ge=1)  # length of the exposure cycle
    # still cameras of one make that took the frames in turn, 1: no rig
    rig: int = Field(default=1, ge=1)
    reference_bracket: int = Field(default=0, ge=0)  # its gain is 1: the radiometric gauge
    # per bracket: log2 exposure relative to the reference, None where unknown
    bracket_ev: list[float | None] = []
    exposure_given: bool = False
    parallax: Parallax = "full"
    # disparity in 1 / scene units, or known up to scale and shift per frame
    depth_kind: Literal["scene", "relative"] = "scene"
    near: float | None = Field(default=None, gt=0)  # z-depth, scene units
    far: float | None = Field(default=None, gt=0)
    points: str | None = None  # .npy (P, 3) float, scene units
    response: str | None = None  # JSON, see `scene/response.py`
    movers: str | None = None  # .npz, see `scene/movers.py`
    lens: dict[int, LensEntry] = {}  # camera_id -> its lens, where frames were undistorted
    frames: list[FrameEntry] = []
    steps: dict[str, StepRecord] = {}

    @property
    def frame_interval(self) -> float:
        """Seconds from one frame to the next, of those used."""
        if self.frame_seconds is None:
            return 1 / self.fps
        return self.frame_seconds * self.stride

    @property
    def num_brackets(self) -> int:
        """Exposures of the cycle."""
        if self.bracket_ev:
            return len(self.bracket_ev)
        return max((f.bracket for f in self.frames), default=0) + 1

    @property
    def num_cameras(self) -> int:
        """Physical cameras."""
        return max((f.camera_id for f in self.frames), default=0) + 1

    @property
    def num_tracks(self) -> int:
        """Tracks that one camera records at the same times, 1 for other cameras."""
        return max((f.track for f in self.frames), default=0) + 1

    @property
    def synchronized(self) -> bool:
        """Whether several cameras record at the same times."""
        instants = {(f.camera_id, f.time) for f in self.frames}
        return len({time for _, time in instants}) < len(instants)

    @property
    def places(self) -> list[int]:
        """Per frame the camera of the rig that took it; 0 where there is no rig.

        The turn of a camera passes where its frame is missing, too.
        """
        return [round(f.time) % self.rig for f in self.frames]

    @property
    def known_ev(self) -> list[float | None]:
        """Per bracket the known log2 exposure relative to the reference, else None."""
        return list(self.bracket_ev) or [None] * self.num_brackets

    def file_names(self) -> Iterator[str]:
        """The names of all files of the scene."""
        for name in (self.points, self.response, self.movers):
            if name is not None:
                yield name
        for f in self.frames:
            yield from f.files

    def save(self, folder: Path) -> None:
        """Write `scene.json` atomically."""
        write_json(folder / "scene.json", self.model_dump())

    @staticmethod
    def load(folder: Path) -> Manifest:
        """Read `scene.json`; InputError in one sentence where it is missing, of another
        version or makes no sense.
        """
        path = Path(folder) / "scene.json"
        scenes = {"segment_00": "segments of a long clip", "part_00": "parts of a clip with cuts"}
        for name, those in scenes.items():
            first = Path(folder) / name
            if not path.is_file() and first.is_dir():
                raise InputError(f"{folder}: holds the {those}; name one of them, such as {first}")
        if Path(folder).is_file():
            raise InputError(f"{folder}: is a file, no scene; name the folder with scene.json")
        if not path.is_file():
            raise InputError(
                f"{folder}: no scene.json here; "
                f"make a scene folder with `hdr-nsff prepare CLIP {folder}`"
            )
        try:
            data = read_json(path)
            manifest = None if is_version_1(data) else Manifest.model_validate(data)
        except ValueError as error:
            raise InputError(
                f"{path}: not a valid scene ({first_problem(error)}); "
                "restore it or run `prepare` with `--redo frames`"
            ) from error
        if manifest is None:
            raise InputError(
                f"{path}: a scene of hdr-nsff 0.1, which this version cannot read; "
                "run `hdr-nsff prepare CLIP` again into a new folder"
            )
        check_manifest(Path(folder), manifest)
        return manifest


def is_version_1(data: Any) -> bool:
    """Whether a `scene.json` is in the format of hdr-nsff 0.1."""
    return isinstance(data, dict) and data.get("version") == 1


def check_manifest(folder: Path, m: Manifest) -> None:
    """InputError where parts of the manifest contradict each other."""
    if problem := manifest_problem(m):
        raise InputError(
            f"{folder / 'scene.json'}: {problem}; restore it or run `prepare` with `--redo frames`"
        )
    for name in m.file_names():
        inside(folder, name)


def manifest_problem(m: Manifest) -> str | None:
    """The first contradiction in a manifest, None where there is none."""
    known = m.near is not None and m.far is not None
    if known and not 1 / MAX_NUMBER < m.near < m.far < MAX_NUMBER:  # type: ignore[operator]
        return f"near {m.near:g} and far {m.far:g} are not a range of depths"
    attempts = [step.details.get("attempt", 0) for step in m.steps.values()]
    if not all(isinstance(attempt, int) for attempt in attempts):
        return "a step has an `attempt` that is no number"
    if not m.frames:
        return None
    if all(f.split != "train" for f in m.frames):
        return "no training frames, all are held out"
    indices = {f.index for f in m.frames}
    if len(indices) < len(m.frames):
        return "two frames have the same index"
    if len({(f.camera_id, f.track, f.time) for f in m.frames}) < len(m.frames):
        return "two frames of one camera have the same time"
    if not all(is_matrix(entry.K, (3, 3), is_intrinsic) for entry in m.lens.values()):
        return "a lens with a K that is not a 3x3 camera matrix"
    cameras = sorted({f.camera_id for f in m.frames})
    if cameras != list(range(len(cameras))):
        return "the camera_ids of the frames are not counted from 0 without gaps"
    brackets = [f.bracket for f in m.frames]
    num_brackets = min(max(brackets), len(brackets)) + 1
    bracket_ev = m.bracket_ev or [None] * num_brackets
    if problem := bracket_problem(brackets, bracket_ev, m.reference_bracket):
        return problem
    for f in m.frames:
        if problem := frame_problem(f, indices):
            return f"frame {f.index} has {problem}"
    return None


def frame_problem(f: FrameEntry, known: set[int]) -> str | None:
    """What makes no sense in a frame of a scene whose frames have the indices `known`;
    None where all does.
    """
    if abs(f.time) > MAX_NUMBER:
        return f"time {f.time:g}"
    if lost := set(f.flow) - known:
        return f"flow to frame {min(lost)}, which the scene does not have"
    if f.K is not None and not is_matrix(f.K, (3, 3), is_intrinsic):
        return "a K that is not a 3x3 camera matrix"
    if f.c2w is not None and not is_matrix(f.c2w, (3, 4), is_pose):
        return "a c2w that is no 3x4 camera pose"
    return None


def bracket_problem(
    brackets: Sequence[int], bracket_ev: Sequence[float | None], reference: int
) -> str | None:
    """What does not fit together in the brackets of frames and the exposures of
    brackets (a scene.json edited by hand); None where all does.
    """
    if not 0 <= reference < len(bracket_ev):
        count = len(bracket_ev)
        return f"reference bracket {reference} is not one of the {count} brackets in bracket_ev"
    if max(brackets, default=0) >= len(bracket_ev):
        return f"a frame has bracket {max(brackets)}, but bracket_ev lists only {len(bracket_ev)}"
    if bracket_ev[reference]:
        return f"bracket_ev must be 0 at the reference bracket, not {bracket_ev[reference]}"
    extreme = [ev for ev in bracket_ev if ev is not None and abs(ev) > MAX_EV]
    if extreme:
        return f"bracket_ev holds {extreme[0]:g}, which is no exposure in stops"
    return None


def is_matrix(
    rows: list[list[float]], shape: tuple[int, int], good: Callable[[np.ndarray], bool]
) -> bool:
    """Whether `rows` are a `good` matrix of that shape with numbers in range."""
    if len({len(row) for row in rows}) != 1:
        return False
    matrix = np.array(rows)
    return matrix.shape == shape and bool(np.abs(matrix).max() <= MAX_NUMBER) and good(matrix)


def is_intrinsic(K: np.ndarray) -> bool:
    """Whether (3, 3) numbers have focal lengths above 0, no skew and a last row of
    0 0 1.
    """
    focal_lengths = min(K[0, 0], K[1, 1]) > 1 / MAX_NUMBER
    return bool(focal_lengths and K[0, 1] == K[1, 0] == 0 and np.allclose(K[2], [0, 0, 1]))


def is_pose(c2w: np.ndarray) -> bool:
    """Whether (3, 4) numbers start with a rotation."""
    rotation = c2w[:, :3]
    orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    return bool(orthogonal and np.linalg.det(rotation) > 0)


def inside(folder: Path, name: str) -> Path:
    """`folder / name`; InputError where the name leaves the folder or no file can have
    it.
    """
    return resolve_name(folder, name, "scene folder")
