"""A clip in which the picture cuts, as parts: a scene folder for what lies between two
cuts.

Each part has poses and a response of its own. Where its exposures alternate as those of
the longest part do, it takes what was found there: a short part shows less of them.
`parts.json` keeps where the parts begin, so the same command continues with them.
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
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.response import read_response

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


def refuse_parts(out: Path) -> None:
    """InputError where the folder `out` holds the parts of a clip, for `--segment`."""
    if (out / PARTS).is_file():
        raise InputError(
            f"{out}: holds the parts of a clip in which the picture cuts; choose another folder "
            "for segments (of one part with --start and --end)"
        )


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
        own = [k for k, number in enumerate(numbers) if start <= number < end]
        if len(own) >= MIN_FRAMES:
            parts.append(ClipPart(start=start, end=end, cycle=cycle_of(work, own)))
        else:
            say(f"{c.clip}: frames {start} to {end - 1} are left out, too few for a scene")
    if not parts:
        raise cuts
    notes.write(work.folder / PARTS, ClipParts(choice=choice_of(c), parts=parts))
    (work.folder / "scene.json").unlink()
    shutil.rmtree(work.folder / "images")
    return parts


def cycle_of(work: Work, own: list[int]) -> list[int]:
    """The cycle of the frames `own`, as `ClipPart` has it; empty for a stride."""
    found = exposure.detect_cycle(work.video[own])
    if found.length == 1 or work.config.stride > 1:
        return []
    first = work.frame_numbers()[own[0]]
    brackets = [found.brackets[(n - first) % found.length] for n in range(found.length)]
    return [found.order.index(bracket) for bracket in brackets]


def longest(parts: list[ClipPart]) -> int:
    """The part with the most frames."""
    return max(range(len(parts)), key=lambda k: parts[k].end - parts[k].start)


def with_exposures_of(scene: Path, part: ClipPart, settings: PrepareConfig) -> PrepareConfig:
    """The `settings` of a `part` with the exposures that static points showed in the
    `scene` of another one, in the cycle of `part`.

    As they are where exposures are given, or nothing showed them.
    """
    m = Manifest.load(scene)
    if m.response is None or m.steps["exposure"].provenance == "given":
        return settings
    response = read_response(scene / m.response, 1, len(m.bracket_ev))
    if response.source != "static points" or len(response.ev) != max(part.cycle) + 1:
        return settings
    ev = sorted(float(value) for value in response.ev)
    listed = ",".join(f"{ev[level]:.4f}" for level in part.cycle)
    say(f"{settings.out.name}: exposures of {listed} EV in turn, as found in {scene.name}")
    return replace(settings, exposures=None, ev=listed)


def part_settings(config: PrepareConfig, parts: list[ClipPart]) -> list[PrepareConfig]:
    """The settings of every part."""
    return [
        replace(config, out=config.out / f"part_{k:02d}", start=part.start, end=part.end)
        for k, part in enumerate(parts)
    ]
