"""`response.json` of a scene folder: its cameras' curves, exposures and white balance.

`prepare` estimates them (`radiometry/estimate_response.py`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json, write_json
from hdr_nsff.core.notes import first_problem
from hdr_nsff.radiometry.response import Response, Source

ADVICE = "run `hdr-nsff prepare` with `--redo response`"


class ResponseFile(BaseModel):
    """The file as it is written; see `radiometry.response.Response` for the fields."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    version: Literal[1] = 1
    x: list[float]
    y: list[list[list[float]]]
    ev: list[float]
    white_balance: list[list[float]]
    source: Source
    misfit: float | None
    num_points: int
    guessed: bool
    own_curves: list[int]
    problem: str = ""
    measured_scale: float = 1.0
    scale_low: float = 1.0
    scale_high: float = 1.0


def write_response(path: Path, response: Response) -> None:
    """Write `response.json` atomically."""
    file = ResponseFile(
        x=response.x.tolist(),
        y=response.y.tolist(),
        ev=response.ev.tolist(),
        white_balance=response.white_balance.tolist(),
        source=response.source,
        misfit=response.misfit,
        num_points=response.num_points,
        guessed=response.guessed,
        own_curves=list(response.own_curves),
        problem=response.problem,
        measured_scale=response.measured_scale,
        scale_low=response.scale_low,
        scale_high=response.scale_high,
    )
    write_json(path, file.model_dump())


def read_response(path: Path, num_cameras: int, num_brackets: int) -> Response:
    """Read `response.json`; InputError where it is missing, damaged or of other cameras
    and brackets than the scene's.
    """
    if not path.is_file():
        raise InputError(f"{path}: missing; {ADVICE}")
    try:
        file = ResponseFile.model_validate(read_json(path))
        x, y = np.array(file.x), np.array(file.y)
        ev, white_balance = np.array(file.ev), np.array(file.white_balance)
    except ValueError as error:
        raise InputError(f"{path}: not a response ({first_problem(error)}); {ADVICE}") from error
    expected = {"y": (num_cameras, 3, len(x)), "ev": (num_brackets,)}
    expected["white_balance"] = (num_cameras, 3)
    for name, found in {"y": y, "ev": ev, "white_balance": white_balance}.items():
        if found.shape != expected[name]:
            raise InputError(
                f"{path}: {name} of shape {found.shape}, the scene needs {expected[name]}; {ADVICE}"
            )
    if len(x) < 2 or (np.diff(x) <= 0).any() or (np.diff(y, axis=-1) < 0).any():
        raise InputError(f"{path}: curves must rise from left to right; {ADVICE}")
    return Response(
        x=x,
        y=y,
        ev=ev,
        white_balance=white_balance,
        source=file.source,
        misfit=file.misfit,
        num_points=file.num_points,
        guessed=file.guessed,
        own_curves=tuple(file.own_curves),
        problem=file.problem,
        measured_scale=file.measured_scale,
        scale_low=file.scale_low,
        scale_high=file.scale_high,
    )
