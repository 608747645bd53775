"""Settings as frozen dataclasses: bounds stand at each setting, pydantic checks them.

A number's bounds are part of its type (`Count`, `Weight`, `Annotated[int, Ge(2)]`), and
hold for a config.json as well. `Advanced` settings have no flag: any setting can be
changed by `--set KEY=VALUE`, with the key of config.json.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any, TypeVar

from annotated_types import Ge, Gt, Le
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails
from tyro.conf import Suppress as Advanced  # noqa: F401

from hdr_nsff.core.errors import InputError

MAX_SHOWN = 40  # characters of a bad value that a message repeats

T = TypeVar("T")

Count = Annotated[int, Ge(1), Le(10**6)]
Number = Annotated[int, Ge(0), Le(10**6)]  # 0: none
Weight = Annotated[float, Ge(0), Le(1e6)]  # of a loss; 0 turns it off
Rate = Annotated[float, Ge(0), Le(1e6)]  # learning rate
Share = Annotated[float, Ge(0), Le(1)]
Positive = Annotated[float, Gt(0), Le(1e6)]


def to_plain(settings: Any) -> dict[str, Any]:
    """Settings as plain data for JSON; paths become text."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [plain(v) for v in value]
        return str(value) if isinstance(value, Path) else value

    return plain(dataclasses.asdict(settings))


def from_plain(kind: type[T], data: Any, command: str = "") -> T:
    """Settings of a `kind` of dataclass from plain data.

    InputError that names the option whose value is missing, unknown, of the wrong type
    or out of bounds; `command` is what explains the options.
    """
    try:
        text = json.dumps(data)
        return TypeAdapter(kind).validate_json(text, strict=True, extra="forbid")
    except ValidationError as error:
        raise InputError(explain(error.errors()[0], command)) from error
    except (TypeError, ValueError) as error:
        raise InputError(f"settings that are no plain numbers and words ({error})") from error


def check(settings: Any, command: str = "") -> None:
    """InputError that names the first option whose value is out of bounds."""
    from_plain(type(settings), to_plain(settings), command)


def explain(error: ErrorDetails, command: str) -> str:
    """One of pydantic's findings as a sentence about an option."""
    names = [str(part) for part in error["loc"]]
    types = {"splat", "nsff", "nerf-wt", "hdr-hexplane", "grids", "network"}
    # `budget` is written out into flags of its own
    # nor are the kinds of number that a setting may be, besides a word
    unnamed = types | {"budget", "constrained-float"}
    flags = [name.replace("_", "-") for name in names if name not in unnamed]
    option = "--" + ".".join(flags) if flags else "the settings"
    shown = repr(error["input"])
    if len(shown) > MAX_SHOWN:
        shown = shown[:MAX_SHOWN] + "..."
    context = error.get("ctx", {})
    match error["type"]:
        case "greater_than_equal":
            return f"{option} {shown}: choose a number from {context['ge']:g}"
        case "greater_than":
            return f"{option} {shown}: choose a number above {context['gt']:g}"
        case "less_than_equal":
            return f"{option} {shown}: choose a number up to {context['le']:g}"
        case "less_than":
            return f"{option} {shown}: choose a number below {context['lt']:g}"
        case "value_error":
            return f"{option} {shown}: {context['error']}"
        case "missing":
            return f"{option}: missing"
    explained = f"; `{command}` lists what there is" if command else ""
    return f"{option} {shown}: no such value{explained}"


def with_changes(settings: T, changes: tuple[str, ...], command: str = "") -> T:
    """Settings after `--set KEY=VALUE ...`.

    Keys are dotted as in `field.lr`, values JSON or words. InputError where a key is
    unknown or a value out of bounds.
    """
    data = to_plain(settings)
    for change in changes:
        key, equals, text = change.partition("=")
        *path, last = key.split(".")
        place = data
        for part in path:
            place = place.get(part) if isinstance(place, dict) else None  # type: ignore[assignment]
        if not equals or not isinstance(place, dict) or last not in place:
            raise InputError(
                f"--set {change[:MAX_SHOWN]!r}: not KEY=VALUE with a key of config.json, "
                "like --set schedule.lr_final=0.1"
            )
        try:
            place[last] = json.loads(text)
        except ValueError:
            place[last] = text
    return from_plain(type(settings), data, command)
