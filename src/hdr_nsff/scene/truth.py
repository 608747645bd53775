"""Held-out truth: views and times that no clip shows.

`evaluate` reads it, and `export --truth` writes it in other layouts; a test of imports
keeps it from everything that estimates or trains.

A truth folder holds `truth.json`. Per held-out view it holds linear radiance (EXR), or
what a camera recorded of it at one exposure or several (PNG), or both; a moving mask
(PNG); and, where they are known, depth and motion (EXR). Poses are in the truth's
world, and a view names the clip frame nearest to it in space. Through that frame it is
transferred to estimated poses. Where the response is known, recordings are made from
the radiance.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.core.io import read_json
from hdr_nsff.core.notes import first_problem
from hdr_nsff.geometry.paths import MAX_EV
from hdr_nsff.radiometry.recording import Curve, vignette
from hdr_nsff.scene.manifest import FrameEntry, Strict, inside, is_intrinsic, is_matrix, is_pose

RESPONSE_MARGIN = 1e-3  # of a recorded value: rounding may take it this far out of [0, 1]
MAX_GAIN = 1e6  # of a white balance, so that products stay finite
MAX_NAME_LENGTH = 100  # characters of a view's name, which becomes a file name
# Channels of a view's geometry, for the ray through each pixel's center:
# - Z: z-depth in true units, 0 where the ray hits nothing
# - u, v: motion of the surface in pixels of this camera, held still, until one frame
#   later and one frame earlier
# - x, y, z: the same motion in the truth's world, in true units
GEOMETRY = ("Z", *(f"{side}.{axis}" for side in MOTION_DIRECTIONS.values() for axis in "uvxyz"))


class TruthView(Strict):
    """One held-out view."""

    name: str
    time: float  # in frames of the clip, may be fractional
    bracket: int  # the exposure of the headline scores (all others are compared too)
    anchor: int  # index of the clip frame whose pose is nearest
    c2w: list[list[float]] | None = None  # 3x4 OpenCV, truth units; None: the anchor's pose
    K: list[list[float]] | None = None  # 3x3 pixels of its pictures; None: the anchor's
    radiance: str | None = None  # EXR, linear, relative path
    recorded: dict[int, str] = Field(default_factory=dict)  # bracket to PNG of the recording
    mask: str | None = None  # PNG, moving = 255
    geometry: str | None = None  # EXR: depth and motion, see `GEOMETRY`

    @property
    def files(self) -> list[str]:
        """The names of all files of this view."""
        names = (self.radiance, *self.recorded.values(), self.mask, self.geometry)
        return [name for name in names if name is not None]

    def problem(self, num_brackets: int, response: bool) -> str | None:
        """What makes no sense in this view; None for a valid one.

        `response`: whether recordings can be made from radiance.
        """
        if not is_file_name(self.name):
            return "a name that cannot be a file's"
        if not 0 <= self.bracket < num_brackets:
            return f"bracket {self.bracket}, but bracket_ev lists {num_brackets}"
        if self.c2w is not None and not is_matrix(self.c2w, (3, 4), is_pose):
            return "a c2w that is no 3x4 camera pose"
        if self.K is not None and not is_matrix(self.K, (3, 3), is_intrinsic):
            return "a K that is not a 3x3 camera matrix"
        if not all(0 <= b < num_brackets for b in self.recorded):
            brackets = sorted(self.recorded)
            return f"recordings at brackets {brackets}, but bracket_ev lists {num_brackets}"
        if self.bracket not in self.recorded and (self.radiance is None or not response):
            return (
                f"no picture of bracket {self.bracket}: neither a recording, nor radiance "
                "and a response to make it from"
            )
        return None


def is_file_name(name: str) -> bool:
    """Whether a view's name can name files, on any system."""
    if name in ("", ".", "..") or len(name) > MAX_NAME_LENGTH:
        return False
    return not set(name) & set("/\\\0")


class Truth(Strict):
    """`truth.json`."""

    version: Literal[1] = 1
    bracket_ev: Sequence[float | None]  # log2 exposure of each bracket, None where it is unknown
    reference_bracket: int
    # per bracket a clip frame of that exposure (None: there is none); absent: brackets
    # are matched by EV
    bracket_frame: list[int | None] | None = None
    # the sampled response curve, absent where it is unknown: exposures in [0, 1], and
    # recorded values per channel (3 lists)
    response_x: list[float] | None = None
    response_y: list[list[float]] | None = None
    white_balance: list[float] = Field(default=[1.0, 1.0, 1.0])
    # strength of the lens's fall-off, see `recording.vignette`
    vignetting: float = Field(default=0.0, ge=0.0, le=1.0)
    # k1, k2 of the lens that recorded the clip (OpenCV); the views have no distortion.
    # None: views are as the camera recorded them
    lens: list[float] | None = None
    K: list[list[float]] | None = None  # 3x3 pixels
    settings: dict[str, str | int | float | bool] | None = None  # of what made it, for the record
    # true poses of the clip's frames, for pose errors and for the transfer of views
    clip_c2w: list[list[list[float]]] | None = None
    # EV by which every frame of the clip deviates from its bracket (auto exposure)
    clip_drift: list[float] | None = None
    views: list[TruthView]

    @property
    def response(self) -> Curve | None:
        """The response curve, where it is known."""
        if self.response_x is None:
            return None
        return Curve(np.array(self.response_x), np.array(self.response_y))

    @staticmethod
    def open(folder: Path | str) -> Truth:
        """Read `truth.json`; InputError where it is missing or makes no sense."""
        path = Path(folder) / "truth.json"
        if not path.is_file():
            raise InputError(
                f"--truth {folder}: no truth.json here; give a folder that `synth`, `reexpose` or "
                "`prepare` of a public data set wrote, or leave the option out"
            )
        try:
            truth = Truth.model_validate(read_json(path))
        except ValueError as error:
            raise InputError(
                f"{path}: not a valid truth file ({first_problem(error)}); "
                "restore it, or make the truth again"
            ) from error
        problem = truth.problem()
        if problem is not None:
            raise InputError(f"{path}: {problem}; restore it, or make the truth again")
        return truth

    def problem(self) -> str | None:
        """What makes no sense together; None for a valid truth."""
        camera = self.exposure_problem() or self.response_problem() or self.camera_problem()
        if camera is not None:
            return camera
        if self.clip_c2w is None and any(v.geometry is not None for v in self.views):
            return (
                "views have depth and motion, but clip_c2w is missing, "
                "so that nobody knows which way they point"
            )
        if len({v.name for v in self.views}) < len(self.views):
            return "two views have the same name"
        for view in self.views:
            problem = view.problem(len(self.bracket_ev), self.response_x is not None)
            if problem is not None:
                return f"view {view.name[:60]!r} has {problem}"
        return None

    def exposure_problem(self) -> str | None:
        """What makes no sense in the exposures; None for valid ones."""
        num = len(self.bracket_ev)
        out_of_range = [ev for ev in self.bracket_ev if ev is not None and abs(ev) > MAX_EV]
        if out_of_range or not 0 <= self.reference_bracket < num:
            return (
                f"bracket_ev {self.bracket_ev} and reference_bracket "
                f"{self.reference_bracket} are no exposures in stops"
            )
        if self.bracket_frame is None and None in self.bracket_ev:
            return "an exposure is unknown, and bracket_frame does not say which frames have it"
        if self.bracket_frame is not None and len(self.bracket_frame) != num:
            return f"bracket_frame lists {len(self.bracket_frame)} brackets, bracket_ev {num}"
        if self.bracket_frame is not None and self.bracket_frame[self.reference_bracket] is None:
            return (
                f"bracket_frame names no frame of the reference exposure {self.reference_bracket}"
            )
        return None

    def camera_problem(self) -> str | None:
        """What makes no sense in white balance, lens and poses; None for valid ones."""
        gains_in_range = all(0 < gain <= MAX_GAIN for gain in self.white_balance)
        if len(self.white_balance) != 3 or not gains_in_range:
            return f"white_balance {self.white_balance} is not three gains above 0"
        if self.K is not None and not is_matrix(self.K, (3, 3), is_intrinsic):
            return "K is no 3x3 camera matrix"
        if self.vignetting > 0 and self.K is None:
            return (
                "vignetting is known, but K is missing, so that nobody knows how wide the lens sees"
            )
        if not all(is_matrix(c2w, (3, 4), is_pose) for c2w in self.clip_c2w or []):
            return "clip_c2w are no 3x4 camera poses"
        return None

    def response_problem(self) -> str | None:
        """What makes no sense in the response; None for a valid or unknown one."""
        x, y = self.response_x, self.response_y
        if x is None and y is None:
            return None
        mismatch = "response_x and response_y are not three curves over the same exposures"
        if x is None or y is None:
            return mismatch
        if len(x) < 2 or [len(channel) for channel in y] != [len(x)] * 3:
            return mismatch
        if any(b <= a for a, b in itertools.pairwise(x)):
            return "response_x does not rise"
        values = itertools.chain.from_iterable(y)
        if not all(-RESPONSE_MARGIN <= value <= 1 + RESPONSE_MARGIN for value in values):
            return "response_y leaves [0, 1], the range of a recorded value"
        if None in self.bracket_ev:
            return "bracket_ev has an unknown exposure beside a known response"
        return None


def true_pictures(
    truth: Truth, view: TruthView, folder: Path
) -> tuple[np.ndarray | None, dict[int, np.ndarray]]:
    """The radiance (H, W, 3) of a view, and its recordings by bracket of the truth.

    Radiance is exact, and None where it is unknown. Recordings (H, W, 3) come from
    files, else from the radiance by the true response. InputError where files do not
    fit together.
    """
    exact = None if view.radiance is None else read_radiance(folder, view.radiance)
    recorded = {b: read_image(inside(folder, name)) for b, name in view.recorded.items()}
    pictures = {}
    if exact is not None and truth.response is not None:
        K = view.K or truth.K
        pictures = {b: record(truth, exact, b, K) for b in range(len(truth.bracket_ev))}
    pictures |= recorded
    sizes = {picture.shape[:2] for picture in pictures.values()}
    if exact is not None:
        sizes.add(exact.shape[:2])
    if len(sizes) > 1:
        raise InputError(
            f"{folder}: the pictures of view {view.name} have several sizes; make the truth again"
        )
    return exact, pictures


def read_radiance(folder: Path, name: str) -> np.ndarray:
    """Linear radiance (H, W, 3) from a file; InputError where it is none."""
    radiance = read_exr(inside(folder, name)).get("RGB")
    if radiance is None:
        raise InputError(f"{folder / name}: no R, G and B channels in this truth image")
    if radiance.min() < 0:
        raise InputError(
            f"{folder / name}: negative radiance; clip at zero before writing the truth"
        )
    return radiance


def record(
    truth: Truth, radiance: np.ndarray, bracket: int, K: list[list[float]] | None
) -> np.ndarray:
    """The noiseless recording (H, W, 3) of `radiance` (H, W, 3) by the true camera.

    `bracket` is of the truth; `K` (3x3 pixels) is needed for vignetting only.
    """
    ev, response = truth.bracket_ev[bracket], truth.response
    assert ev is not None and response is not None, "`Truth.problem` refuses this"
    if truth.vignetting > 0:
        height, width = radiance.shape[:2]
        radiance = radiance * vignette(height, width, np.array(K), truth.vignetting)
    exposed = radiance * 2.0**ev * np.array(truth.white_balance)
    return response.apply(exposed).astype(np.float32)


def as_exposed(truth: Truth, frames: Sequence[FrameEntry], learned_ev: Sequence[float]) -> Truth:
    """The truth with the exposures that the brackets of a scene stand for.

    That is the mean over its training frames, as far as the scene has no drift for
    them. `frames` are those of the clip, `learned_ev` the exposures of the scene's
    brackets.
    """
    if truth.clip_drift is None:
        return truth
    evs = list(truth.bracket_ev)
    for bracket, own in scene_brackets(truth, frames, learned_ev).items():
        moved = [
            true - (frame.drift or 0.0)
            for frame, true in zip(frames, truth.clip_drift, strict=True)
            if frame.split == "train" and frame.bracket == own
        ]
        ev = evs[bracket]
        if ev is not None and moved:
            evs[bracket] = ev + float(np.mean(moved))
    return truth.model_copy(update={"bracket_ev": evs})


def match_brackets(true_ev: Sequence[float], learned_ev: Sequence[float]) -> dict[int, int]:
    """{bracket of the truth: bracket of the scene}, by rank of exposure.

    Where their numbers differ, by distance in EV from the brightest.
    """
    if len(true_ev) == len(learned_ev):
        by_true_ev = np.argsort(true_ev, kind="stable").tolist()
        by_learned_ev = np.argsort(learned_ev, kind="stable").tolist()
        return dict(zip(by_true_ev, by_learned_ev, strict=True))
    below_brightest = np.array(learned_ev) - max(learned_ev)
    match = {}
    for bracket, ev in enumerate(true_ev):
        distances = np.abs(below_brightest - (ev - max(true_ev)))
        match[bracket] = int(distances.argmin())
    return match


def scene_brackets(
    truth: Truth, frames: Sequence[FrameEntry], learned_ev: Sequence[float]
) -> dict[int, int]:
    """{bracket of the truth: bracket of the scene} for a scene of these `frames`.

    The scene's brackets have the exposures `learned_ev`. Exposures of the truth that no
    frame of the scene has are left out. InputError where the reference is one of them.
    """
    if truth.bracket_frame is None:
        known_ev = [ev for ev in truth.bracket_ev if ev is not None]
        assert len(known_ev) == len(truth.bracket_ev), "`Truth.problem` refuses this"
        return match_brackets(known_ev, learned_ev)
    brackets = {entry.index: entry.bracket for entry in frames}
    match = {}
    for bracket, frame in enumerate(truth.bracket_frame):
        if frame is not None and frame in brackets:
            match[bracket] = brackets[frame]
    if truth.reference_bracket not in match:
        frame = truth.bracket_frame[truth.reference_bracket]
        raise InputError(
            f"truth.json: frame {frame} shows the reference exposure, and the scene has none; "
            "prepare the whole clip"
        )
    return match
