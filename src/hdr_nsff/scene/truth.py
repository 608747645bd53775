"""Held-out truth: views and times that no clip shows, read by `evaluate` only (an
import test holds this).

A truth folder holds `truth.json` and, per held-out view, linear radiance (EXR), or what
a camera recorded of it at one exposure or several (PNG), or both, a moving mask (PNG)
and, where they are known, depth and motion (EXR). Poses are in the truth's own world; a
view names the clip frame nearest to it in space, so that it can be carried over to
estimated poses. Where the response is known, recordings are made from the radiance.
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
from hdr_nsff.radiometry.recording import Curve, vignette
from hdr_nsff.scene.manifest import (
    MAX_EV,
    FrameEntry,
    Strict,
    inside,
    is_intrinsic,
    is_matrix,
    is_pose,
)

RESPONSE_MARGIN = 1e-3  # of a recorded value: how far rounding may take it out of [0, 1]
LARGEST_GAIN = 1e6  # of a white balance
# Channels of a view's geometry, of the ray through each pixel's center: z-depth in true
# units (0 where it hits nothing); pixels that the surface moves in this camera,
# standing still, until one frame later and one frame earlier; the same in the truth's
# world, in true units.
GEOMETRY = ("Z", *(f"{side}.{axis}" for side in MOTION_DIRECTIONS.values() for axis in "uvxyz"))


class TruthView(Strict):
    """One held-out view."""

    name: str
    time: float  # in frames of the clip, may be fractional
    bracket: int  # the exposure this view is compared at (all others are compared too)
    anchor: int  # index of the clip frame whose pose is nearest
    c2w: list[list[float]] | None = None  # 3x4 OpenCV, truth units; None: exactly the anchor's pose
    K: list[list[float]] | None = None  # 3x3 pixels of its pictures; None: the anchor's
    radiance: str | None = None  # EXR, linear, relative path
    recorded: dict[int, str] = Field(default_factory=dict)  # bracket -> PNG, what a camera recorded
    mask: str | None = None  # PNG, moving = 255
    geometry: str | None = None  # EXR: depth and motion, see `GEOMETRY`

    @property
    def files(self) -> list[str]:
        """The names of all files of this view."""
        return [
            n
            for n in (self.radiance, *self.recorded.values(), self.mask, self.geometry)
            if n is not None
        ]

    def problem(self, num_brackets: int, response: bool) -> str | None:
        """What makes no sense in this view; None where all does. `response`: whether
        recordings can be made from radiance.
        """
        if self.name in ("", ".", "..") or len(self.name) > 100 or set(self.name) & set("/\\\0"):
            return "a name that cannot be a file's"
        if not 0 <= self.bracket < num_brackets:
            return f"bracket {self.bracket}, but bracket_ev lists {num_brackets}"
        if self.c2w is not None and not is_matrix(self.c2w, (3, 4), is_pose):
            return "a c2w that is no 3x4 camera pose"
        if self.K is not None and not is_matrix(self.K, (3, 3), is_intrinsic):
            return "a K that is no 3x3 camera matrix"
        if not all(0 <= b < num_brackets for b in self.recorded):
            brackets = sorted(self.recorded)
            return f"recordings at brackets {brackets}, but bracket_ev lists {num_brackets}"
        if self.bracket not in self.recorded and (self.radiance is None or not response):
            return (
                f"no picture of bracket {self.bracket}: neither a recording, nor radiance "
                "and a response to make it from"
            )
        return None


class Truth(Strict):
    """`truth.json`."""

    version: Literal[1] = 1
    bracket_ev: Sequence[float | None]  # log2 exposure of each bracket, None where it is unknown
    reference_bracket: int
    # per bracket a clip frame exposed like it (None: no frame is); absent: told by EV
    bracket_frame: list[int | None] | None = None
    # the camera's response curve sampled: exposure in [0, 1] ...
    response_x: list[float] | None = None
    # ... to recorded value, per channel (3 lists); absent where it is unknown
    response_y: list[list[float]] | None = None
    white_balance: list[float] = Field(default=[1.0, 1.0, 1.0])
    vignetting: float = Field(
        default=0.0, ge=0.0, le=1.0
    )  # strength of the lens's fall-off, see `recording.vignette`
    K: list[list[float]] | None = None  # 3x3 pixels
    settings: dict[str, str | int | float | bool] | None = None  # of what made it, for the record
    # true poses of the clip's frames, for pose errors and for carrying views over
    clip_c2w: list[list[list[float]]] | None = None
    views: list[TruthView]

    @property
    def response(self) -> Curve | None:
        """The response curve, where it is known."""
        return (
            None
            if self.response_x is None
            else Curve(np.array(self.response_x), np.array(self.response_y))
        )

    @staticmethod
    def open(folder: Path | str) -> Truth:
        """Read `truth.json`; InputError in one sentence where it is missing or makes no
        sense.
        """
        path = Path(folder) / "truth.json"
        if not path.is_file():
            raise InputError(
                f"{folder}: no truth.json here; "
                "leave `--truth` out to evaluate on held-out frames of the clip"
            )
        try:
            truth = Truth.model_validate(read_json(path))
        except ValueError as error:
            raise InputError(
                f"{path}: not a valid truth file ({first_problem(error)}); "
                "restore it, or make the truth anew"
            ) from error
        if problem := truth.problem():
            raise InputError(f"{path}: {problem}; restore it, or make the truth anew")
        return truth

    def problem(self) -> str | None:
        """What makes no sense together; None where all does."""
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
        if problem := self.response_problem():
            return problem
        if len(self.white_balance) != 3 or not all(
            0 < gain <= LARGEST_GAIN for gain in self.white_balance
        ):
            return f"white_balance {self.white_balance} is not three gains above 0"
        if self.K is not None and not is_matrix(self.K, (3, 3), is_intrinsic):
            return "K is no 3x3 camera matrix"
        if self.vignetting > 0 and self.K is None:
            return (
                "vignetting is known, but K is missing, so that nobody knows how wide the lens sees"
            )
        if not all(is_matrix(c2w, (3, 4), is_pose) for c2w in self.clip_c2w or []):
            return "clip_c2w are no 3x4 camera poses"
        if self.clip_c2w is None and any(v.geometry is not None for v in self.views):
            return (
                "views have depth and motion, but clip_c2w is missing, "
                "so that nobody knows which way they point"
            )
        if len({v.name for v in self.views}) < len(self.views):
            return "two views have the same name"
        return next(
            (
                f"view {v.name[:60]!r} has {p}"
                for v in self.views
                if (p := v.problem(num, self.response_x is not None))
            ),
            None,
        )

    def response_problem(self) -> str | None:
        """What makes no sense in the response curve; None where all does, or where
        there is none.
        """
        x, y = self.response_x, self.response_y
        if x is None and y is None:
            return None
        if x is None or y is None or len(y) != 3 or any(len(c) != len(x) for c in y) or len(x) < 2:
            return "response_x and response_y are not three curves over the same exposures"
        if any(b <= a for a, b in itertools.pairwise(x)):
            return "response_x does not rise"
        if any(not -RESPONSE_MARGIN <= v <= 1 + RESPONSE_MARGIN for c in y for v in c):
            return "response_y leaves [0, 1], the range of a recorded value"
        return (
            "bracket_ev has an unknown exposure beside a known response"
            if None in self.bracket_ev
            else None
        )


def true_pictures(
    truth: Truth, view: TruthView, folder: Path
) -> tuple[np.ndarray | None, dict[int, np.ndarray]]:
    """The exact radiance (H, W, 3) of a view, if it is known, and what the camera
    recorded (H, W, 3) by bracket of the truth: from a file, else made from the radiance
    by the true response. InputError where the files do not fit together.
    """
    exact = None
    if view.radiance is not None:
        exact = read_exr(inside(folder, view.radiance)).get("RGB")
        if exact is None:
            raise InputError(
                f"{folder / view.radiance}: no R, G and B channels in this truth image"
            )
        if exact.min() < 0:
            raise InputError(
                f"{folder / view.radiance}: negative radiance; "
                "clip at zero before writing the truth"
            )
    pictures = {b: read_image(inside(folder, name)) for b, name in view.recorded.items()}
    if exact is not None and truth.response is not None:
        pictures = {
            b: record(truth, exact, b, view.K or truth.K) for b in range(len(truth.bracket_ev))
        } | pictures
    sizes = {p.shape[:2] for p in pictures.values()} | (
        {exact.shape[:2]} if exact is not None else set()
    )
    if len(sizes) > 1:
        raise InputError(
            f"{folder}: the pictures of view {view.name} have several sizes; make the truth anew"
        )
    return exact, pictures


def record(
    truth: Truth, radiance: np.ndarray, bracket: int, K: list[list[float]] | None
) -> np.ndarray:
    """What the true camera, with `K`, records (H, W, 3) of `radiance` (H, W, 3) at a
    bracket, without noise.
    """
    ev, response = truth.bracket_ev[bracket], truth.response
    assert ev is not None and response is not None, "`Truth.problem` refuses this"
    if truth.vignetting > 0:
        radiance = radiance * vignette(
            radiance.shape[0], radiance.shape[1], np.array(K), truth.vignetting
        )
    return response.apply(radiance * 2.0**ev * np.array(truth.white_balance)).astype(np.float32)


def match_brackets(true_ev: Sequence[float], learned_ev: Sequence[float]) -> dict[int, int]:
    """{bracket of the truth: bracket of the scene}, by rank of exposure; where their
    numbers differ, by distance from the brightest.
    """
    if len(true_ev) == len(learned_ev):
        order = zip(
            np.argsort(true_ev, kind="stable"), np.argsort(learned_ev, kind="stable"), strict=True
        )
        return {int(b): int(s) for b, s in order}
    learned = np.array(learned_ev) - max(learned_ev)
    return {b: int(np.abs(learned - (ev - max(true_ev))).argmin()) for b, ev in enumerate(true_ev)}


def scene_brackets(
    truth: Truth, frames: Sequence[FrameEntry], learned_ev: Sequence[float]
) -> dict[int, int]:
    """{bracket of the truth: bracket of the scene} for a scene of these `frames`, whose
    brackets have the exposures `learned_ev`; without exposures of the truth that no
    frame of the scene has. InputError where that of reference is among those.
    """
    if truth.bracket_frame is None:
        return match_brackets(
            [ev for ev in truth.bracket_ev if ev is not None], learned_ev
        )  # all: `Truth.problem` sees to it
    brackets = {e.index: e.bracket for e in frames}
    match = {
        b: brackets[f] for b, f in enumerate(truth.bracket_frame) if f is not None and f in brackets
    }
    if truth.reference_bracket not in match:
        frame = truth.bracket_frame[truth.reference_bracket]
        raise InputError(
            f"truth.json: frame {frame} shows the reference exposure, and the scene has none; "
            "prepare the whole clip"
        )
    return match
