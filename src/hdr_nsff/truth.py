"""Held-out truth: views and times that no clip shows, read by `evaluate` only (an import test holds this).

A truth folder holds `truth.json` and, per held-out view, linear radiance (EXR), a moving mask (PNG) and, where they are known, depth
and motion (EXR). Poses are in the truth's own world; a view names the clip frame nearest to it in space, so that it can be carried
over to estimated poses."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Literal

from pydantic import Field

from hdr_nsff.errors import InputError
from hdr_nsff.io import SIDES, read_json
from hdr_nsff.notes import first_problem
from hdr_nsff.scene import LARGEST_EV, Strict, is_intrinsic, is_matrix, is_pose

# Channels of a view's geometry, of the ray through each pixel's centre: z-depth in true units (0 where it hits nothing); pixels that the surface
# moves in this camera, standing still, until one frame later and one frame earlier; the same in the truth's world, in true units.
GEOMETRY = ("Z", *(f"{side}.{axis}" for side in SIDES.values() for axis in "uvxyz"))


class TruthView(Strict):
    """One held-out view."""

    name: str
    time: float  # in frames of the clip, may be fractional
    bracket: int  # the exposure this view is compared at (all others are compared too)
    anchor: int  # index of the clip frame whose pose is nearest
    c2w: list[list[float]] | None = None  # 3x4 OpenCV, truth units; None: exactly the anchor's pose
    radiance: str  # EXR, linear, relative path
    mask: str | None = None  # PNG, moving = 255
    geometry: str | None = None  # EXR: depth and motion, see `GEOMETRY`

    def problem(self, num_brackets: int) -> str | None:
        """What makes no sense in this view; None where all does."""
        if self.name in ("", ".", "..") or len(self.name) > 100 or set(self.name) & set("/\\\0"):
            return "a name that cannot be a file's"
        if not 0 <= self.bracket < num_brackets:
            return f"bracket {self.bracket}, but bracket_ev lists {num_brackets}"
        if self.c2w is not None and not is_matrix(self.c2w, (3, 4), is_pose):
            return "a c2w that is no 3x4 camera pose"
        return None


class Truth(Strict):
    """`truth.json`."""

    version: Literal[1] = 1
    bracket_ev: list[float]  # log2 exposure of each bracket
    reference_bracket: int
    response_x: list[float]  # the camera's response curve sampled: exposure in [0, 1] ...
    response_y: list[list[float]]  # ... to recorded value, per channel (3 lists)
    white_balance: list[float] = Field(default=[1.0, 1.0, 1.0])
    K: list[list[float]] | None = None  # 3x3 pixels
    clip_c2w: list[list[list[float]]] | None = (
        None  # true poses of the clip's frames, for pose errors and for carrying views over
    )
    views: list[TruthView]

    @staticmethod
    def open(folder: Path | str) -> Truth:
        """Read `truth.json`; InputError in one sentence where it is missing or makes no sense."""
        path = Path(folder) / "truth.json"
        if not path.is_file():
            raise InputError(f"{folder}: no truth.json here; leave `--truth` out to evaluate on held-out frames of the clip")
        try:
            truth = Truth.model_validate(read_json(path))
        except ValueError as error:
            raise InputError(
                f"{path}: not a valid truth file ({first_problem(error)}); restore it, or make the truth anew"
            ) from error
        if problem := truth.problem():
            raise InputError(f"{path}: {problem}; restore it, or make the truth anew")
        return truth

    def problem(self) -> str | None:
        """What makes no sense together; None where all does."""
        num = len(self.bracket_ev)
        if not 0 <= self.reference_bracket < num or any(abs(ev) > LARGEST_EV for ev in self.bracket_ev):
            return f"bracket_ev {self.bracket_ev} and reference_bracket {self.reference_bracket} are no exposures in stops"
        if len(self.response_y) != 3 or any(len(y) != len(self.response_x) for y in self.response_y) or len(self.response_x) < 2:
            return "response_x and response_y are not three curves over the same exposures"
        if any(b <= a for a, b in itertools.pairwise(self.response_x)):
            return "response_x does not rise"
        if len(self.white_balance) != 3 or min(self.white_balance) <= 0:
            return f"white_balance {self.white_balance} is not three gains above 0"
        if self.K is not None and not is_matrix(self.K, (3, 3), is_intrinsic):
            return "K is no 3x3 camera matrix"
        if not all(is_matrix(c2w, (3, 4), is_pose) for c2w in self.clip_c2w or []):
            return "clip_c2w are no 3x4 camera poses"
        if self.clip_c2w is None and any(v.geometry is not None for v in self.views):
            return "views have depth and motion, but clip_c2w is missing, so that nobody knows which way they point"
        if len({v.name for v in self.views}) < len(self.views):
            return "two views have the same name"
        return next((f"view {v.name[:60]!r} has {p}" for v in self.views if (p := v.problem(num))), None)
