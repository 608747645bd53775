"""Files of a public data set: its JSON documents, and the files that these name.

Every InputError names the purpose of the file, so that a set that was copied only in
part can be completed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.core.names import resolve_name
from hdr_nsff.footage.frame_files import FRAMES
from hdr_nsff.scene.manifest import MAX_NUMBER


def read_object(path: Path, purpose: str) -> dict[str, Any]:
    """A JSON object; `purpose` is what an InputError calls its content."""
    if not path.is_file():
        raise InputError(f"{path}: missing; it holds {purpose}, copy it again")
    try:
        found = read_json(path)
    except ValueError as error:
        raise InputError(
            f"{path}: not readable JSON ({shorten(error)}), or cut short; it holds {purpose}, "
            "copy it again"
        ) from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: not a JSON object; it holds {purpose}, copy it again")
    return found


def read_document(path: Path, purpose: str) -> dict[str, Any]:
    """A `transforms*.json` with frames; `purpose` is what an InputError names."""
    document = read_object(path, purpose)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: no list of `frames` in it; it holds {purpose}, copy it again")
    for number, frame in enumerate(frames):
        named = isinstance(frame, dict) and isinstance(frame.get("file_path"), str)
        if not named or "transform_matrix" not in frame:
            raise InputError(
                f"{path}: frame {number} has no `file_path` with a `transform_matrix`; "
                "copy the file again"
            )
    return document


def number_of(path: Path, frame: Mapping[str, Any], key: str, purpose: str) -> float:
    """A number of a frame up to `MAX_NUMBER`; `purpose` is what an InputError names."""
    value = frame.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_NUMBER:
        return float(value)
    name = shorten(frame.get("file_path"))
    raise InputError(f"{path}: {name} has no number `{key}`, {purpose}; copy the file again")


def picture_file(root: Path, name: str, purpose: str) -> Path:
    """The picture that `name` means in a JSON of the set, with or without its ending.

    InputError, which names its `purpose`, where it is missing.
    """
    base = resolve_name(root, name.replace("\\", "/"), "data set")
    endings = [*sorted(FRAMES), ""]
    if base.suffix.lower() in FRAMES:
        endings = ["", *sorted(FRAMES)]
    for ending in endings:
        path = base.with_name(base.name + ending)
        if path.is_file():
            return resolve_name(root, str(path), "data set")
    raise InputError(f"{root / shorten(name)}: missing; it is {purpose}, copy it again")


def map_file(root: Path, name: str, purpose: str) -> Path:
    """The map or mask that `name` means in a JSON of the set.

    InputError, which names its `purpose`, where it is missing.
    """
    path = resolve_name(root, name, "data set")
    if not path.is_file():
        raise InputError(f"{root / shorten(name)}: missing; it is {purpose}, copy it again")
    return path


def source_of(root: Path, path: Path) -> str:
    """A file's name relative to the root; `path` is below it, resolved or as listed."""
    base = root if path.is_relative_to(root) else root.resolve()
    return path.relative_to(base).as_posix()


def check_count(folder: Path, files: Sequence[Path], count: int, purpose: str) -> None:
    """InputError where there are not as many `files` as pictures."""
    if len(files) != count:
        raise InputError(
            f"{folder}: {len(files)} files for {count} pictures; it holds {purpose}, one each, "
            "copy it again"
        )
