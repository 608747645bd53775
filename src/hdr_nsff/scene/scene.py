"""The scene folder: what `prepare` writes and everything else reads.

`scene.json` (pydantic, unknown keys are errors) names every file relative to the
folder, says where it came from, in which units, and holds the hashes of the inputs.
Maps are one half-precision `.npy` per array, images and masks are PNG. Held-out truth
of a synthetic scene lives outside, see `truth.py`; nothing here can read it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor
from torch.nn.functional import max_pool2d

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_image, read_json, read_mask, read_npy, write_json
from hdr_nsff.core.names import resolve_name
from hdr_nsff.core.notes import first_problem
from hdr_nsff.geometry.cameras import Camera

Parallax = Literal["full", "rotation", "none"]
Split = Literal["train", "test"]
Protocol = Literal["novel-view", "novel-view-time"]
# numbers beyond it, or depths below 1 / it, are no measurement and would overflow in
# single precision
LARGEST = 1e15
OUTLINE = 2  # pixels by which the outline of an estimated mask may be wrong
LARGEST_EV = 60.0  # stops from the reference


class Strict(BaseModel):
    """A model that refuses what it does not know, and NaN and Inf."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class FlowFiles(Strict):
    """Optical flow from one frame to another."""

    flow: (
        str  # .npy (H, W, 2) half, pixels: where a pixel goes in the other frame, minus where it is
    )
    valid: str  # PNG, 255 where the forward-backward check passed


class FrameEntry(Strict):
    """One recorded frame and the files of its priors."""

    index: int = Field(ge=0)
    image: str  # PNG, recorded rgb, 8 or 16 bit
    source: str  # which file (and frame of it) this came from
    time: float  # in frames of the footage
    camera_id: int = Field(
        default=0, ge=0
    )  # physical camera: owns a response curve and a white balance
    bracket: int = Field(ge=0)  # which exposure of the cycle
    ev: float | None = None  # log2 exposure relative to the reference bracket where it is known
    split: Split = "train"
    K: list[list[float]] | None = None  # 3x3 pixels
    c2w: list[list[float]] | None = None  # 3x4 OpenCV, scene units
    mask: str | None = None  # PNG, moving = 255
    disparity: str | None = None  # .npy (H, W) half, 1 / z-depth
    disparity_confidence: str | None = None  # .npy (H, W) half, in [0, 1]
    flow: dict[int, FlowFiles] = {}  # other frame's index -> flow towards it
    raw_flow: dict[
        int, FlowFiles
    ] = {}  # the same as it was before masks were known, which poses and masks come from

    @property
    def files(self) -> list[str]:
        """The names of all files of this frame."""
        flow = [
            n
            for kind in (self.flow, self.raw_flow)
            for f in kind.values()
            for n in (f.flow, f.valid)
        ]
        return [
            n
            for n in (self.image, self.mask, self.disparity, self.disparity_confidence, *flow)
            if n is not None
        ]


class Step(Strict):
    """One finished step of `prepare`: what it did, and the hash of everything it
    depended on.
    """

    done: bool = False
    key: str = ""  # hash of settings and inputs; another key means the step is redone
    provenance: Literal["estimated", "given", "absent"] = "estimated"
    note: str = ""  # one sentence for people
    seconds: float = 0.0
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
    cycle: int = Field(default=1, ge=1)  # length of the exposure cycle
    reference_bracket: int = Field(
        default=0, ge=0
    )  # the bracket whose gain is 1: the radiometric gauge
    bracket_ev: list[
        float | None
    ] = []  # per bracket: log2 exposure relative to the reference, None = to be learned
    exposure_given: bool = False
    parallax: Parallax = "full"
    depth_kind: Literal["scene", "relative"] = (
        "scene"  # disparity in 1 / scene units, or known up to scale and shift per frame
    )
    near: float | None = Field(default=None, gt=0)  # z-depth, scene units
    far: float | None = Field(default=None, gt=0)
    points: str | None = None  # .npy (P, 3) float, scene units
    frames: list[FrameEntry] = []
    steps: dict[str, Step] = {}

    def save(self, folder: Path) -> None:
        """Write `scene.json` atomically."""
        write_json(folder / "scene.json", self.model_dump())

    @staticmethod
    def load(folder: Path) -> Manifest:
        """Read `scene.json`; InputError in one sentence where it is missing or makes no
        sense.
        """
        path = Path(folder) / "scene.json"
        if not path.is_file():
            raise InputError(
                f"{folder}: no scene.json here; make a scene folder with `hdr-nsff prepare CLIP {folder}`"
            )
        try:
            data = read_json(path)
            manifest = None if is_version_1(data) else Manifest.model_validate(data)
        except ValueError as error:
            raise InputError(
                f"{path}: not a valid scene ({first_problem(error)}); restore it or run `prepare` with `--redo frames`"
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


@dataclass(frozen=True)
class Frame:
    """One frame in memory."""

    index: int  # in the manifest
    time: float  # in frames
    camera: Camera
    camera_id: int
    bracket: int
    exposure: float | None  # EV relative to the reference bracket, None = unknown
    image: Tensor  # (H, W, 3) recorded rgb in [0, 1]
    # {+-1: position in `Scene.train`}, same physical camera
    neighbors: dict[int, int] = field(default_factory=dict)
    moving: Tensor | None = None  # (H, W) bool
    # (H, W) bool: within `OUTLINE` pixels of the mask's outline, on either side
    outline: Tensor | None = None
    disparity: Tensor | None = None  # (H, W)
    disparity_confidence: Tensor | None = None  # (H, W) in [0, 1]
    flow: dict[int, Tensor] = field(default_factory=dict)  # {+-1: (H, W, 2)} pixels
    flow_valid: dict[int, Tensor] = field(default_factory=dict)  # {+-1: (H, W) bool}


@dataclass(frozen=True)
class Scene:
    """A prepared clip in memory: what training reads."""

    folder: Path
    train: list[Frame]
    test: list[Frame]  # frames of the clip kept out of training
    near: float  # z-depth, scene units
    far: float
    points: Tensor  # (P, 3) static points, scene units
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
        if not m.frames:
            raise InputError(f"{folder}: the scene has no frames; run `hdr-nsff prepare` again")
        if m.near is None or m.far is None or any(f.c2w is None or f.K is None for f in m.frames):
            raise InputError(
                f"{folder}: the scene has no camera poses yet; run `hdr-nsff prepare` again, it goes on where it stopped"
            )
        train = [e for e in m.frames if e.split == "train"]
        links = neighbors(train)
        return Scene(
            folder=folder,
            train=[
                load_frame(folder, m, e, {o: train[j].index for o, j in n.items()}, n)
                for e, n in zip(train, links, strict=True)
            ],
            test=[load_frame(folder, m, e, {}, {}) for e in m.frames if e.split == "test"],
            near=m.near,
            far=m.far,
            points=load_points(folder, m.points) if m.points else torch.zeros(0, 3),
            manifest=m,
        )


def check_manifest(folder: Path, m: Manifest) -> None:
    """InputError where what the manifest holds so far makes no sense together."""

    def refuse(problem: str) -> None:
        raise InputError(
            f"{folder / 'scene.json'}: {problem}; restore it or run `prepare` with `--redo frames`"
        )

    if m.near is not None and m.far is not None and not 1 / LARGEST < m.near < m.far < LARGEST:
        refuse(f"near {m.near:g} and far {m.far:g} are no range of depths")
    if any(not isinstance(step.details.get("attempt", 0), int) for step in m.steps.values()):
        refuse("a step has an `attempt` that is no number")
    if not m.frames:
        return
    if all(f.split != "train" for f in m.frames):
        refuse("no training frames, all are held out")
    if len({f.index for f in m.frames}) < len(m.frames):
        refuse("two frames have the same index")
    if len({(f.camera_id, f.time) for f in m.frames}) < len(m.frames):
        refuse("two frames of one camera have the same time")
    if sorted({f.camera_id for f in m.frames}) != list(range(len({f.camera_id for f in m.frames}))):
        refuse("the camera_ids of the frames are not counted from 0 without gaps")
    brackets = [f.bracket for f in m.frames]
    if problem := bracket_problem(
        brackets,
        m.bracket_ev or [None] * (min(max(brackets), len(brackets)) + 1),
        m.reference_bracket,
    ):
        refuse(problem)
    for f in m.frames:
        if problem := frame_problem(f, {g.index for g in m.frames}):
            refuse(f"frame {f.index} has {problem}")
    for name in [m.points, *(n for f in m.frames for n in f.files)]:
        if name is not None:
            inside(folder, name)


def frame_problem(f: FrameEntry, known: set[int]) -> str | None:
    """What makes no sense in a frame of a scene whose frames have the indices `known`;
    None where all does.
    """
    if abs(f.time) > LARGEST:
        return f"time {f.time:g}"
    if lost := set(f.flow) - known:
        return f"flow to frame {min(lost)}, which the scene does not have"
    if f.K is not None and not is_matrix(f.K, (3, 3), is_intrinsic):
        return "a K that is no 3x3 camera matrix"
    if f.c2w is not None and not is_matrix(f.c2w, (3, 4), is_pose):
        return "a c2w that is no 3x4 camera pose"
    return None


def is_matrix(
    rows: list[list[float]], shape: tuple[int, int], good: Callable[[np.ndarray], bool]
) -> bool:
    """Whether `rows` are a matrix of that shape, with numbers in range, that is `good`."""
    matrix = np.array(rows) if len({len(row) for row in rows}) == 1 else np.zeros(0)
    return matrix.shape == shape and bool(np.abs(matrix).max() <= LARGEST) and good(matrix)


def bracket_problem(
    brackets: Sequence[int], bracket_ev: Sequence[float | None], reference: int
) -> str | None:
    """What does not fit together in the brackets of frames and the exposures of
    brackets (a scene.json edited by hand); None where all does.
    """
    if not 0 <= reference < len(bracket_ev):
        return f"reference bracket {reference} is not one of the {len(bracket_ev)} brackets in bracket_ev"
    if max(brackets, default=0) >= len(bracket_ev):
        return f"a frame has bracket {max(brackets)}, but bracket_ev lists only {len(bracket_ev)}"
    if bracket_ev[reference]:
        return f"bracket_ev must be 0 at the reference bracket, not {bracket_ev[reference]}"
    if (
        extreme := next((ev for ev in bracket_ev if ev is not None and abs(ev) > LARGEST_EV), None)
    ) is not None:
        return f"bracket_ev holds {extreme:g}, which is no exposure in stops"
    return None


def is_intrinsic(K: np.ndarray) -> bool:
    """Whether (3, 3) numbers have focal lengths above 0, no skew and a last row of 0 0
    1.
    """
    return bool(
        min(K[0, 0], K[1, 1]) > 1 / LARGEST
        and K[0, 1] == K[1, 0] == 0
        and np.allclose(K[2], [0, 0, 1])
    )


def is_pose(c2w: np.ndarray) -> bool:
    """Whether (3, 4) numbers start with a rotation."""
    rotation = c2w[:, :3]
    return bool(
        np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    )


def load_points(folder: Path, name: str) -> Tensor:
    """Static points (P, 3)."""
    points = read_npy(inside(folder, name))
    if (
        points.ndim != 2
        or points.shape[1] != 3
        or points.dtype.kind != "f"
        or not np.isfinite(points).all()
    ):
        raise InputError(
            f"{folder / name}: expected finite points of shape (P, 3), not {points.shape}; run `prepare` with `--redo poses`"
        )
    return torch.from_numpy(points.astype(np.float32))


def neighbors(entries: list[FrameEntry]) -> list[dict[int, int]]:
    """For each frame the positions of the frames at the previous (-1) and next (+1)
    training time of the same physical camera.

    A camera that has no frame at that time has no neighbor there: fields know scene
    flow from one training time to the next.
    """
    result: list[dict[int, int]] = [{} for _ in entries]
    place = {time: k for k, time in enumerate(sorted({e.time for e in entries}))}
    for camera_id in {e.camera_id for e in entries}:
        order = sorted(
            (i for i, e in enumerate(entries) if e.camera_id == camera_id),
            key=lambda i: entries[i].time,
        )
        for a, b in itertools.pairwise(order):
            if place[entries[b].time] - place[entries[a].time] == 1:
                result[a][1] = b
                result[b][-1] = a
    return result


def load_frame(
    folder: Path, m: Manifest, e: FrameEntry, neighbor_index: dict[int, int], links: dict[int, int]
) -> Frame:
    """One frame with its maps, every size checked against the manifest."""
    size = (m.height, m.width)

    def checked(
        name: str | None,
        read: Callable[[Path], np.ndarray],
        what: str,
        channels: tuple[int, ...] = (),
    ) -> Tensor | None:
        if name is None:
            return None
        array = read(inside(folder, name))
        if array.shape != size + channels:
            raise InputError(
                f"{folder / name}: {what} of frame {e.index} has shape {array.shape}, expected {size + channels}; run `prepare` with `--redo`"
            )
        if array.dtype.kind not in "fiub":
            raise InputError(
                f"{folder / name}: {what} of frame {e.index} holds no numbers; run `prepare` with `--redo`"
            )
        if array.dtype != bool and not np.isfinite(array).all():
            raise InputError(
                f"{folder / name}: {what} of frame {e.index} holds NaN or Inf; run `prepare` with `--redo`"
            )
        return torch.from_numpy(array if array.dtype == bool else array.astype(np.float32))

    image = checked(e.image, read_image, "image", (3,))
    assert image is not None
    disparity = checked(e.disparity, read_npy, "disparity")
    if disparity is not None and m.depth_kind == "scene" and float(disparity.min()) < 0:
        raise InputError(
            f"{folder / str(e.disparity)}: disparity of frame {e.index} is negative; run `prepare` with `--redo depth`"
        )
    flows = {o: e.flow[i] for o, i in neighbor_index.items() if i in e.flow}
    flow = {o: checked(f.flow, read_npy, "flow", (2,)) for o, f in flows.items()}
    valid = {o: checked(f.valid, read_mask, "flow mask") for o, f in flows.items()}
    moving = checked(e.mask, read_mask, "mask")
    guessed = moving is not None and m.steps.get("masks", Step()).provenance == "estimated"
    return Frame(
        index=e.index,
        time=e.time,
        camera=Camera(torch.tensor(e.K), torch.tensor(e.c2w), m.width, m.height),
        camera_id=e.camera_id,
        bracket=e.bracket,
        exposure=e.ev,
        image=image,
        neighbors=links,
        moving=moving,
        outline=outline(moving) if moving is not None and guessed else None,
        disparity=disparity,
        disparity_confidence=checked(e.disparity_confidence, read_npy, "disparity confidence"),
        flow={o: v for o, v in flow.items() if v is not None},
        flow_valid={o: v for o, v in valid.items() if v is not None},
    )


def outline(mask: Tensor) -> Tensor:
    """(H, W) bool: the pixels of a mask (H, W) within `OUTLINE` of its outline, on
    either side.
    """
    width, image = 2 * OUTLINE + 1, mask[None, None].float()
    grown, kept = (
        max_pool2d(image, width, 1, OUTLINE)[0, 0] > 0,
        -max_pool2d(-image, width, 1, OUTLINE)[0, 0] > 0,
    )
    return grown & ~kept


def inside(folder: Path, name: str) -> Path:
    """`folder / name`, refusing a name that leaves the folder or that no file can have."""
    return resolve_name(folder, name, "scene folder")
