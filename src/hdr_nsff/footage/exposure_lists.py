"""Exposures that somebody wrote down: on the command line, in a CSV beside the frames,
in the EXIF of photographs.

All become EV, log2 of an exposure to any reference. Exposure times are in seconds;
EXIF counts sensitivity and aperture too.
"""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from hdr_nsff.core.errors import InputError, check_number, shorten
from hdr_nsff.footage.footage import Footage
from hdr_nsff.geometry.paths import MAX_EV
from hdr_nsff.scene.manifest import MAX_SECONDS

LIST = "exposures.csv"  # in a folder of frames
# columns of a CSV: times, and the seconds of their unit
TIMES = {"exposure": 1.0, "exposure_s": 1.0, "exposure_us": 1e-6, "exposure_ns": 1e-9}
GAINS = ("iso", "gain_db", "aperture")  # count where a time is given
DB_PER_STOP = 20 * math.log10(2)
T = TypeVar("T")
EXAMPLE = "write times like 1/250 and EV like -2"


# Command line


def parse_exposures(exposures: str | None, ev: str | None) -> list[float] | None:
    """The EV of each frame of one cycle, from the command line.

    `exposures` are times in seconds (1/1000,1/250), `ev` is -4,-2; None where neither
    is given, or they are "auto".
    """
    times_given = exposures is not None and exposures.strip() != "auto"
    if times_given and ev is not None:
        raise InputError("--exposures and --ev both given; leave one out")
    if times_given:
        assert exposures is not None
        texts = exposures.split(",")
        advice = "write times in seconds like 1/250, or relative exposures as `--ev`"
        for text in texts:
            check_seconds(parse_number(text, "--exposures"), "--exposures", advice)
        return [log2_seconds(text, "--exposures") for text in texts]
    if ev is None or ev.strip() == "auto":
        return None
    cycle = [parse_number(text, "--ev") for text in ev.split(",")]
    for value in cycle:
        check_number("--ev", value, -MAX_EV, MAX_EV)
    return cycle


def parse_number(text: str, where: str) -> float:
    """A finite number written as 2, -0.5 or 1/3; InputError that names `where`."""
    shown = repr(shorten(text))
    above, slash, below = text.partition("/")
    try:
        value = float(above) / float(below) if slash else float(above)
    except ZeroDivisionError as error:
        raise InputError(f"{where}: {shown} divides by zero; {EXAMPLE}") from error
    except ValueError as error:
        raise InputError(f"{where}: {shown} is not a number; {EXAMPLE}") from error
    if not math.isfinite(value):
        raise InputError(f"{where}: {shown} is not finite; {EXAMPLE}")
    return value


def log2_seconds(text: str, where: str) -> float:
    """The EV of an exposure time in seconds; InputError that names `where`."""
    seconds = parse_number(text, where)
    if seconds <= 0:
        raise InputError(
            f"{where}: an exposure of {shorten(text)} seconds is impossible; write times like 1/250"
        )
    return math.log2(seconds)


def check_seconds(seconds: float, where: str, advice: str) -> None:
    """InputError with `advice` for a time that no camera exposes."""
    if seconds > MAX_SECONDS:
        raise InputError(f"{where}: an exposure of {seconds:.4g} seconds is impossible; {advice}")


# CSV


@dataclass(frozen=True)
class Listed:
    """The exposure of a frame in a CSV."""

    ev: float  # log2 of light times gain
    seconds: float | None  # the exposure time, where the CSV has one


def read_exposure_csv(footage: Footage) -> tuple[Path, dict[str, float]] | None:
    """The CSV beside the frames and its EV by frame; None where there is none.

    Frames go by file name or `#number`. Columns: `file` (or `frame`, a number from 0),
    and `ev` or a time (`TIMES`), with those of `GAINS`. InputError that names the line
    of what is not understood.
    """
    table = read_listed(footage)
    if table is None:
        return None
    path, rows = table
    return path, {key: row.ev for key, row in rows.items()}


def read_listed(footage: Footage) -> tuple[Path, dict[str, Listed]] | None:
    """The same, with exposure times."""
    path = find_csv(footage)
    if path is None:
        refuse_scattered(footage)
        return None
    reader = csv.DictReader(io.StringIO(read_utf8(path), newline=""), skipinitialspace=True)
    try:
        name, values = find_columns(path, reader.fieldnames or [])
        rows: dict[str, Listed] = {}
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            check_cells(row, (name, *values), where)
            key = frame_key(name, row[name])
            ev = sum(ev_of_cell(column, row[column], where) for column in values)
            if abs(ev) > MAX_EV:
                raise InputError(
                    f"{where}: {ev:.4g} EV is beyond all light (at most {MAX_EV:g}); correct it"
                )
            listed = Listed(ev, seconds_of_cell(values[0], row[values[0]], where))
            if rows.setdefault(key, listed).ev != ev:
                raise InputError(
                    f"{where}: a second exposure of {shorten(row[name])}; give each frame one, "
                    "and with several cameras the folder before the name, as in left/0001.png"
                )
    except csv.Error as error:
        line = reader.line_num + 1
        raise InputError(
            f"{path}, line {line}: no readable CSV ({error}); correct the line"
        ) from error
    return path, rows


def csv_path(footage: Footage) -> Path:
    """Where the CSV of a clip is."""
    if footage.path.is_dir():
        return footage.path / LIST
    return footage.path.with_suffix(".csv")


def find_csv(footage: Footage) -> Path | None:
    """The CSV of a clip, None without one; InputError where that is no file."""
    path = csv_path(footage)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no file, where a list of exposures is read; rename it")
    return path if path.is_file() else None


def refuse_scattered(footage: Footage) -> None:
    """InputError for lists in the folders of cameras, which nobody would read."""
    for folder in {files[0].parent: None for files in footage.cameras if files}:
        scattered = folder / LIST
        if folder != footage.root and scattered.is_file():
            advice = f"{footage.path} takes one list for all cameras"
            raise InputError(
                f"{scattered}: {advice}; join them to {footage.root / LIST}, with files like "
                f"{folder.name}/0001.png"
            )


def ev_in_list(
    path: Path,
    rows: dict[str, float],
    source: str,
    number: int,
    whole_name: bool = False,
    advice: str = "add it, or give `--exposures auto`",
) -> float:
    """The EV of a frame in the `rows` of a CSV, by its name `source` or `number`; by
    its `whole_name`, with the folder, only, where several tracks have the others.

    InputError with `advice` where the list lacks it.
    """
    ev = row_of(rows, source, number, whole_name)
    if ev is not None:
        return ev
    raise InputError(f"{path}: no row for frame {source}; {advice}")


def row_of(rows: Mapping[str, T], source: str, number: int, whole_name: bool = False) -> T | None:
    """The row of a frame by its name or number, as of `ev_in_list`; None without."""
    keys = [source]
    if not whole_name:
        keys += [Path(source).name, f"#{number}"]
    return next((rows[key] for key in keys if key in rows), None)


def read_utf8(path: Path) -> str:
    """A text file, with or without a byte order mark.

    InputError that names the line where it is not UTF-8.
    """
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError(
            f"{path}, line {line}: not UTF-8 text; save the list as CSV UTF-8"
        ) from error


def ev_of_cell(column: str, text: str, where: str) -> float:
    """What a cell adds to the EV of its frame, log2 of light times gain."""
    if column == "ev":
        return parse_number(text, where)
    if column in TIMES:
        return log2_seconds(text, where) + math.log2(TIMES[column])
    value = parse_number(text, where)
    if column == "gain_db":
        return value / DB_PER_STOP
    if value <= 0:
        raise InputError(f"{where}: {column} {shorten(text)} is not above 0; correct it")
    if column == "iso":
        return math.log2(value / 100)
    return -2 * math.log2(value)  # f-number


def frame_key(column: str, text: str) -> str:
    """What names a frame, of a cell in the column `file` or `frame`: its file name, or
    `#number` without leading zeros.
    """
    text = text.strip()
    if column == "file":
        return text
    return f"#{text.lstrip('0') or '0'}" if text.isdecimal() else f"#{text}"


def seconds_of_cell(column: str, text: str, where: str) -> float | None:
    """The exposure time in a cell; None where its column has none."""
    if column not in TIMES:
        return None
    seconds = parse_number(text, where) * TIMES[column]
    advice = "name the column `exposure_us` or `exposure_ns` where times are in these units"
    check_seconds(seconds, where, f"{advice}, or `ev` where they are log2 exposures")
    return seconds


def find_columns(path: Path, columns: Sequence[str]) -> tuple[str, list[str]]:
    """The columns that name the frame, and those that make its exposure; InputError
    without.
    """
    name = next((c for c in ("file", "frame") if c in columns), None)
    value = next((c for c in (*TIMES, "ev") if c in columns), None)
    if name is None or value is None:
        found = shorten(", ".join(columns)) or "none"
        raise InputError(
            f"{path}: its columns are {found}; it needs `file` or `frame`, "
            "and `exposure` (seconds), `exposure_us`, `exposure_ns` or `ev`, separated by commas"
        )
    gains = [c for c in GAINS if c in columns and value != "ev"]
    return name, [value, *gains]


def check_cells(row: Mapping[str | Any, Any], columns: Sequence[str], where: str) -> None:
    """InputError where a row of a CSV has too few or too many cells.

    Each of `columns` needs one; empty ones at the end of the row are passed over.
    """
    lost = next((c for c in columns if row[c] is None), None)
    if lost is not None:
        raise InputError(f"{where}: no value for column {lost}; complete the line")
    if any(row.get(None, ())):  # where `csv` puts the surplus
        raise InputError(
            f"{where}: more values than columns; separate values by commas, decimals by a point"
        )


# EXIF


def read_exif_ev(path: Path) -> float | None:
    """log2 of (exposure time x ISO / 100 / f-number^2) from a file's EXIF, or from the
    same tags of a DNG's pictures.

    None where it has no exposure time, or is damaged.
    """
    tags = read_exif(path)
    seconds = exif_number(tags, "ExposureTime") or 0.0
    iso = exif_number(tags, "ISOSpeedRatings") or 100.0
    aperture = exif_number(tags, "FNumber") or 1.0
    exposure = seconds * iso / 100 / aperture**2
    return math.log2(exposure) if 0 < exposure < math.inf else None


def read_exif_seconds(path: Path) -> float | None:
    """The exposure time in the same tags; None without a possible one."""
    seconds = exif_number(read_exif(path), "ExposureTime") or 0.0
    return seconds if 0 < seconds <= MAX_SECONDS else None


def read_exif(path: Path) -> Mapping[str, Any]:
    """The tags of a file's EXIF; none where it is damaged."""
    import exifread

    # it warns of every picture without EXIF
    logging.getLogger("exifread").setLevel(logging.ERROR)
    try:
        with open(path, "rb") as file:
            return exifread.process_file(file, details=False)
    except Exception:  # many unrelated types, for damaged EXIF
        return {}


def exif_number(tags: Mapping[str, Any], name: str) -> float | None:
    """The first value of a tag of the EXIF, else of the picture; None where it is
    missing or no number.
    """
    tag = tags.get(f"EXIF {name}", tags.get(f"Image {name}"))
    try:
        return float(tag.values[0])
    except (AttributeError, ArithmeticError, ValueError, TypeError, IndexError):
        return None
