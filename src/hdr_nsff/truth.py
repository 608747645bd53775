"""Held-out truth: views and times that no clip shows, read by `evaluate` only (an import test holds this).

A truth folder holds `truth.json` and, per held-out view, linear radiance (EXR) and a moving mask (PNG). Poses are in the
truth's own world; a view names the clip frame nearest to it in space, so that it can be carried over to estimated poses."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from hdr_nsff.errors import InputError
from hdr_nsff.io import read_json
from hdr_nsff.scene import first_problem


class TruthView(BaseModel):
    """One held-out view."""

    model_config = ConfigDict(extra="forbid")
    name: str
    time: float  # in frames of the clip, may be fractional
    bracket: int  # the exposure this view is compared at (all others are compared too)
    anchor: int  # index of the clip frame whose pose is nearest
    c2w: list[list[float]] | None = None  # 3x4 OpenCV, truth units; None: exactly the anchor's pose
    radiance: str  # EXR, linear, relative path
    mask: str | None = None  # PNG, moving = 255


class Truth(BaseModel):
    """`truth.json`."""

    model_config = ConfigDict(extra="forbid")
    version: Literal[1] = 1
    bracket_ev: list[float]  # log2 exposure of each bracket
    reference_bracket: int
    response_x: list[float]  # the camera's response curve sampled: exposure in [0, 1] ...
    response_y: list[list[float]]  # ... to recorded value, per channel (3 lists)
    white_balance: list[float] = [1.0, 1.0, 1.0]
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
            return Truth.model_validate(read_json(path))
        except ValueError as error:
            raise InputError(
                f"{path}: not a valid truth file ({first_problem(error)}); restore it, or make the truth anew"
            ) from error
