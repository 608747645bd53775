"""The verb `check`: what a clip is, what will work, and what to shoot otherwise.

It looks at the first frames of a clip at a small size, takes less than a minute, and
writes one picture. Nothing is stored for `prepare`.
"""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from hdr_nsff.check.findings import Finding, judge, outlook
from hdr_nsff.check.measure import measure_clip
from hdr_nsff.check.picture import MARKS, draw
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.footage.footage import Footage, open_footage
from hdr_nsff.footage.frame_files import CHECK_PICTURE
from hdr_nsff.footage.tracks import open_tracks

PNG_START = b"\x89PNG"
WIDTH = 100  # characters of a line


@dataclass(frozen=True)
class CheckConfig:
    """Look at a clip before working with it: a minute instead of an hour.

    hdr-nsff check CLIP
    """

    clip: tyro.conf.Positional[Path]
    """Footage: a video, a folder of frames, or a folder of such folders or videos."""
    picture: Path | None = None
    """The picture to write; its folder is made where there is none. Default:
    CLIP_check.png in the current folder.
    """
    json: bool = False
    """Print facts and findings as JSON instead of sentences."""
    same_camera: tuple[str, str] | None = None
    """Two tracks of one camera in the folder CLIP, as for `prepare`."""


def check(config: CheckConfig) -> Path:
    """The verb: the picture that was written."""
    picture = config.picture or default_picture(config.clip)
    check_place(picture)
    footage = open_clip(config)
    check_no_frame(picture, footage)
    facts, video, brackets = measure_clip(footage)
    findings, works = judge(facts), outlook(facts)
    if config.json:
        document = {
            "clip": str(config.clip),
            "picture": str(picture),
            "works": works,
            "findings": [asdict(finding) for finding in findings],
            "facts": asdict(facts),
        }
        print(json.dumps(document, indent=1, ensure_ascii=False))
    else:
        print_findings(works, findings)
    with writing_to(picture):
        draw(picture, facts, video, brackets, works, findings)
    if not config.json:
        print(f"picture: {picture}")
    return picture


def open_clip(config: CheckConfig) -> Footage:
    """The footage; InputError where it is not understood."""
    if config.same_camera is not None:
        return open_tracks(config.clip, config.same_camera)
    return open_footage(config.clip)


def default_picture(clip: Path) -> Path:
    """The picture of a clip in the current folder. Only a file has an ending to drop:
    the folders of 2024.11.29 and 2024.11.30 have two pictures.
    """
    place = clip.resolve()
    name = place.name if place.is_dir() else place.stem
    return Path(f"{name}{CHECK_PICTURE}")


def check_place(picture: Path) -> None:
    """InputError where the picture is none, or would replace something else."""
    if picture.suffix.lower() != ".png":
        raise InputError(f"--picture {picture}: give a name that ends in .png")
    if picture.is_dir():
        raise InputError(f"--picture {picture}: is a folder; name a file")
    if picture.is_file() and picture.read_bytes()[:4] != PNG_START:
        raise InputError(f"--picture {picture}: exists and is no picture; name another file")


def check_no_frame(picture: Path, footage: Footage) -> None:
    """InputError where the picture would replace a frame of the clip."""
    if picture.is_file() and not picture.name.endswith(CHECK_PICTURE):
        frames = [frame for files in footage.cameras for frame in files]
        if picture.resolve() in [frame.resolve() for frame in frames]:
            raise InputError(f"--picture {picture}: is a frame of the clip; name another file")


def print_findings(works: dict[str, str], findings: list[Finding]) -> None:
    """What a user reads."""
    for name, answer in works.items():
        print(f"{name}: {answer}")
    print()
    for finding in findings:
        text = finding.text + (f"; {finding.advice}" if finding.advice else "")
        head = f"{MARKS[finding.level]} {finding.subject:<12}"
        indent = " " * len(head)
        print(textwrap.fill(text, WIDTH, initial_indent=head, subsequent_indent=indent))
