"""The points file: prompts that a user gives for a segmentation network, and those that
`prepare` writes.

Its format stands in docs/formats.md. Entries count the frames of the whole scene; the
objects of `prompts` count those of one camera's clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json
from hdr_nsff.priors.masks.prompts import Prompt, PromptedObject

FORMAT_HINT = "docs/formats.md describes the points file"


class Entry(BaseModel):
    """An object in a frame."""

    model_config = ConfigDict(extra="forbid", strict=True)

    frame: int = Field(ge=0)
    object: int = Field(ge=1)


class PointEntry(Entry):
    """One point of a points file, in pixels."""

    x: FiniteFloat
    y: FiniteFloat
    label: int = Field(ge=0, le=1)


class BoxEntry(Entry):
    """One box of a points file, in pixels."""

    left: FiniteFloat
    top: FiniteFloat
    right: FiniteFloat
    bottom: FiniteFloat


class PointsFile(BaseModel):
    """The contents of a points file."""

    model_config = ConfigDict(extra="forbid", strict=True)

    points: list[PointEntry] = []
    boxes: list[BoxEntry] = []


def read_points(path: Path, count: int, size: tuple[int, int]) -> PointsFile:
    """The points file at `path`, for a clip of `count` frames.

    Their `size` is (height, width). InputError where it is no points file, or where an
    entry lies outside the clip.
    """
    try:
        given = PointsFile.model_validate(read_json(path))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); correct the path of --mask-points"
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        entry = ".".join(str(name) for name in first["loc"]) or "the file"
        raise InputError(f"{path}: {entry}: {first['msg']}; {FORMAT_HINT}") from error
    except ValueError as error:
        raise InputError(f"{path}: not a JSON file ({error}); {FORMAT_HINT}") from error
    for point in given.points:
        check_point(path, point, count, size)
    for box in given.boxes:
        check_box(path, box, count, size)
    return given


def check_point(path: Path, point: PointEntry, count: int, size: tuple[int, int]) -> None:
    """InputError for a point outside the frames, or in none of them."""
    height, width = size
    inside = 0 <= point.x <= width and 0 <= point.y <= height
    if point.frame >= count or not inside:
        raise InputError(
            f"{path}: point ({point.x:g}, {point.y:g}) of frame {point.frame} is outside the clip "
            f"of {count} frames of {width}x{height} pixels; correct it"
        )


def check_box(path: Path, box: BoxEntry, count: int, size: tuple[int, int]) -> None:
    """InputError for an empty box, or one that lies beside the frames or in none."""
    height, width = size
    where = f"{path}: the box of object {box.object} in frame {box.frame}"
    beside = box.right <= 0 or box.bottom <= 0 or box.left >= width or box.top >= height
    if box.frame >= count or beside:
        raise InputError(
            f"{where} is outside the clip of {count} frames of {width}x{height} pixels; correct it"
        )
    if box.left >= box.right or box.top >= box.bottom:
        raise InputError(f"{where} is empty; correct it")


def merge_prompts(
    objects: Sequence[PromptedObject], given: PointsFile, frames: Sequence[int]
) -> list[PromptedObject]:
    """`objects` with the user's points and boxes.

    Points of an object's number are added to its prompts, a box replaces that frame's,
    and other numbers make new objects. `frames` are the scene's numbers of the clip's
    frames; entries of other frames are ignored.
    """
    position = {frame: k for k, frame in enumerate(frames)}
    by_number = {known.number: known for known in objects}
    entries: list[PointEntry | BoxEntry] = [*given.points, *given.boxes]
    for entry in entries:
        if entry.frame in position:
            known = by_number.get(entry.object, PromptedObject(entry.object, ()))
            by_number[entry.object] = add_entry(known, entry, position[entry.frame])
    return [by_number[number] for number in sorted(by_number)]


def add_entry(known: PromptedObject, entry: PointEntry | BoxEntry, frame: int) -> PromptedObject:
    """An object with one more point or box, in `frame` of its clip."""
    by_frame = {prompt.frame: prompt for prompt in known.prompts}
    prompt = by_frame.get(frame, Prompt(frame, np.zeros((0, 2)), np.zeros(0, int)))
    if isinstance(entry, BoxEntry):
        box = np.array([entry.left, entry.top, entry.right, entry.bottom])
        by_frame[frame] = replace(prompt, box=box)
    else:
        points = np.vstack([prompt.points, [entry.x, entry.y]])
        labels = np.append(prompt.labels, entry.label)
        by_frame[frame] = replace(prompt, points=points, labels=labels)
    return replace(known, prompts=tuple(by_frame[k] for k in sorted(by_frame)))


def to_points_file(objects: Sequence[PromptedObject], frames: Sequence[int]) -> dict[str, Any]:
    """The prompts of a clip as the contents of a points file.

    `frames` are the scene's numbers of the clip's frames.
    """
    points: list[PointEntry] = []
    boxes: list[BoxEntry] = []
    for known in objects:
        for prompt in known.prompts:
            frame = frames[prompt.frame]
            for (x, y), label in zip(prompt.points, prompt.labels, strict=True):
                points.append(
                    PointEntry(
                        frame=frame,
                        object=known.number,
                        x=round(float(x), 2),
                        y=round(float(y), 2),
                        label=int(label),
                    )
                )
            if prompt.box is not None:
                left, top, right, bottom = prompt.box.round(2).tolist()
                boxes.append(
                    BoxEntry(
                        frame=frame,
                        object=known.number,
                        left=left,
                        top=top,
                        right=right,
                        bottom=bottom,
                    )
                )
    return PointsFile(points=points, boxes=boxes).model_dump()
