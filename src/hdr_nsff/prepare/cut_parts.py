"""A clip in which the picture cuts, as parts: a scene folder for what lies between two
cuts.

Parts share nothing, each has exposures, poses and a response of its own. `parts.json`
keeps where they begin, so the same command continues with them.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.notes import ClipPart, ClipParts
from hdr_nsff.core.progress import say
from hdr_nsff.prepare.segments import MIN_FRAMES
from hdr_nsff.prepare.steps.footage import ClipCutsError
from hdr_nsff.prepare.work import PrepareConfig, Work

PARTS = "parts.json"


def known_parts(config: PrepareConfig) -> list[ClipPart] | None:
    """The parts that the same command found before; None where it found none.

    InputError where they are of other frames.
    """
    note = notes.read(config.out / PARTS, ClipParts)
    if note is None:
        return None
    if note.choice != choice_of(config):
        raise InputError(
            f"{config.out}: holds the parts of other frames of the clip ({describe(note.choice)}); "
            "choose another folder"
        )
    return note.parts


def choice_of(config: PrepareConfig) -> dict[str, int | None]:
    """The choice of frames."""
    return {"start": config.start, "end": config.end, "stride": config.stride}


def describe(choice: dict[str, int | None]) -> str:
    """A choice of frames, as options."""
    return " ".join(f"--{name} {value}" for name, value in choice.items() if value is not None)


def part_at_cuts(work: Work, cuts: ClipCutsError) -> list[ClipPart]:
    """The parts of a clip with `cuts`; its folder then holds no scene of the whole.

    `cuts` itself where the clip has several cameras, files are given for its frames, or
    the folder held more of a scene before.
    """
    c, m = work.config, work.manifest
    given = (c.poses, c.flow, c.masks, c.mask_points, c.depth)
    several = m.num_cameras > 1 or m.num_tracks > 1
    if several or any(isinstance(value, Path) for value in given):
        raise cuts
    if not m.steps.keys() <= {"frames", "exposure"}:
        raise cuts
    numbers = work.frame_numbers()
    parts = []
    for start, end in pairwise([numbers[0], *cuts.first, numbers[-1] + 1]):
        count = sum(start <= number < end for number in numbers)
        if count >= MIN_FRAMES:
            parts.append(ClipPart(start=start, end=end))
        else:
            say(f"{c.clip}: frames {start} to {end - 1} are left out, too few for a scene")
    if not parts:
        raise cuts
    notes.write(work.folder / PARTS, ClipParts(choice=choice_of(c), parts=parts))
    (work.folder / "scene.json").unlink()
    shutil.rmtree(work.folder / "images")
    return parts


def part_settings(config: PrepareConfig, parts: list[ClipPart]) -> list[PrepareConfig]:
    """The settings of every part."""
    return [
        replace(config, out=config.out / f"part_{k:02d}", start=part.start, end=part.end)
        for k, part in enumerate(parts)
    ]
