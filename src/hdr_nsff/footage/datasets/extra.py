"""What `export` notes beside a public layout, and the layout has no place for, so that
reading it again gives the same scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.notes import first_problem
from hdr_nsff.footage.datasets.capture import Exposures
from hdr_nsff.scene.manifest import Strict, bracket_problem, is_intrinsic, is_matrix


class ExtraFrame(Strict):
    """What a layout has no place for of a frame."""

    time: float
    camera_id: int = Field(default=0, ge=0)
    bracket: int = Field(default=0, ge=0)
    K: list[list[float]] | None = None  # 3x3 pixels
    flow: dict[str, str] = Field(default_factory=dict)  # name of another picture -> flow file
    disparity: str | None = None
    confidence: str | None = None
    moving: str | None = None


class ExtraView(Strict):
    """What the HDR-GoPro layout has no place for of a held-out view."""

    name: str = Field(pattern=r"^[^/\\\x00]{1,100}$")
    time: float
    bracket: int = Field(ge=0)
    anchor: str  # the training picture whose pose it has
    mask: str | None = None


class Extra(Strict):
    """What a layout has no place for of a scene."""

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
    # by name of the picture, where the layout does not list them
    held_out: dict[str, ExtraView] = Field(default_factory=dict)

    def exposures(self) -> Exposures:
        """The exposures of the brackets."""
        return Exposures(self.bracket_ev, self.reference_bracket, self.exposure_given)


def parse_extra(path: Path, value: Any, names: Sequence[str]) -> Extra:
    """`Extra` from JSON, complete for the pictures `names`."""
    try:
        extra = Extra.model_validate(value)
    except ValidationError as error:
        detail = shorten(first_problem(error), 200)
        raise InputError(
            f"{path}: what `export` noted there is damaged ({detail}); export again"
        ) from error
    lost = [name for name in names if name not in extra.frames]
    if lost:
        raise InputError(
            f"{path}: no entry for picture {shorten(lost[0])}, which holds its time and "
            "exposure; export again"
        )
    problem = extra_problem(extra, names)
    if problem is not None:
        raise InputError(f"{path}: {problem}; export again")
    return extra


def extra_problem(extra: Extra, names: Sequence[str]) -> str | None:
    """What does not fit together in an export's note; None where all does.

    `names` are the training pictures.
    """
    brackets = [frame.bracket for frame in extra.frames.values()]
    brackets += [view.bracket for view in extra.held_out.values()]
    problem = bracket_problem(brackets, extra.bracket_ev, extra.reference_bracket)
    if problem is not None:
        return problem
    for frame in extra.frames.values():
        if frame.K is not None and not is_matrix(frame.K, (3, 3), is_intrinsic):
            return "a K is no 3x3 camera matrix"
    strange = {view.anchor for view in extra.held_out.values()} - set(names)
    if strange:
        name = shorten(min(strange))
        return f"held-out views have the pose of {name}, which is no training picture"
    return None
