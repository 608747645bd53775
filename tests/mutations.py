"""Damaged files for the tests of readers: seeded mutations of bytes and of JSON.

A reader has to end in a result or in one short InputError for each of them.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError

# Values that a user or another program may leave in a JSON file.
ODD_VALUES = (
    None, True, "", "\0", "\ud800", "../up", "x" * 5000, -1, 0, 1e308, -1e308, 1e-320,
    float("nan"), float("inf"), 10**400, [], {}, [[]], [{}], {"a": 1}, [1, "2"], "1e400",
)  # fmt: skip
ODD_BYTES = (b"\0", b"\xff" * 4, b"\x80", b"\xff\xff\xff\x7f", b"\0" * 8, b"\r", b'"', b",,")


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` with a few damages: flipped, lost, repeated or odd bytes, or cut."""
    for _ in range(rng.integers(1, 4)):
        place = int(rng.integers(len(data) + 1))
        length = int(rng.integers(1, 9))
        match rng.integers(5):
            case 0:
                data = data[:place] + rng.bytes(length) + data[place + length :]
            case 1:
                data = data[:place]
            case 2:
                data = data[:place] + data[place + length :]
            case 3:
                data = data[:place] + data[place : place + 8 * length] + data[place:]
            case _:
                odd = ODD_BYTES[rng.integers(len(ODD_BYTES))]
                data = data[:place] + odd + data[place + len(odd) :]
    return data


def mutate_json(document: Any, rng: np.random.Generator) -> Any:
    """A copy of a JSON document in which one value is odd or lost."""
    document = copy.deepcopy(document)
    places = list(containers(document))
    place = places[rng.integers(len(places))]
    keys = list(place) if isinstance(place, dict) else list(range(len(place)))
    key = keys[rng.integers(len(keys))]
    if rng.random() < 0.15:
        del place[key]
    else:
        place[key] = ODD_VALUES[rng.integers(len(ODD_VALUES))]
    return document


def containers(value: Any) -> Iterator[Any]:
    """All dictionaries and lists in a JSON value that are not empty."""
    if isinstance(value, dict | list) and value:
        yield value
        for inner in value.values() if isinstance(value, dict) else value:
            yield from containers(inner)


def check_reader(path: Path, read: Callable[[], object], count: int, seed: int = 0) -> None:
    """Call `read` on `count` damaged versions of the file `path`, then restore it.

    It has to end in a result or in an InputError of under 600 characters.
    """
    whole, rng = path.read_bytes(), np.random.default_rng(seed)
    for _ in range(count):
        path.write_bytes(mutate(whole, rng))
        read_or_refuse(read)
    path.write_bytes(whole)


def check_json_reader(path: Path, read: Callable[[], object], count: int, seed: int = 0) -> None:
    """As `check_reader`, with odd values in the JSON file `path`."""
    text, rng = path.read_text(), np.random.default_rng(seed)
    for _ in range(count):
        path.write_text(json.dumps(mutate_json(json.loads(text), rng)))
        read_or_refuse(read)
    path.write_text(text)


def read_or_refuse(read: Callable[[], object]) -> None:
    """Call `read`; all that it may raise is a short InputError."""
    try:
        with np.errstate(all="ignore"):
            read()
    except InputError as error:
        assert len(str(error)) < 600, str(error)[:2000]
