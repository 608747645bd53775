"""What messages advise exists: extras, verbs and their options."""

import ast
import re
import tomllib
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import pytest

from hdr_nsff import cli

ROOT = Path(__file__).parents[1]
EXTRAS = set(
    tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
)
VERB = "|".join(sorted(cli.VERBS, key=len, reverse=True))
# `hdr-nsff VERB ...`, `VERB --flag ...`: a command in backticks, as messages write it.
COMMAND = re.compile(rf"`(?:hdr-nsff )?({VERB})((?: [^`]*)?)`|`hdr-nsff ([a-z][a-z-]*)")
OPTION = re.compile(r"--[a-z][a-z0-9.-]*")


def sentences(path: Path) -> Iterator[str]:
    """Every text in a source file; what an f-string fills in is one word."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        if isinstance(node, ast.JoinedStr):
            parts = [p.value if isinstance(p, ast.Constant) else "X" for p in node.values]
            yield "".join(str(part) for part in parts)


TEXTS = [text for p in sorted((ROOT / "src").rglob("*.py")) for text in sentences(p)]


@cache
def options(verb: str) -> set[str]:
    """The options of a verb, from its help; with those of two presets of `train`."""
    starts = [["train"], ["train", "splat"], ["train", "grid"]] if verb == "train" else [[verb]]
    output = StringIO()
    for start in starts:
        with redirect_stdout(output), pytest.raises(SystemExit):
            cli.main([*start, "--help"])
    return set(OPTION.findall(output.getvalue()))


def test_every_extra_that_a_message_names_exists() -> None:
    named = {e for text in TEXTS for e in re.findall(r"hdr-nsff\[([a-z,]+)\]", text)}
    named |= {e for text in TEXTS for e in re.findall(r"\bextra `([a-z]+)`", text)}
    assert named >= {"gpu", "neural", "synth"}
    assert {e for names in named for e in names.split(",")} <= EXTRAS


def commands() -> set[tuple[str, str]]:
    """(verb, option) of every command that a message names; option "" for the verb."""
    found = set()
    for text in TEXTS:
        for verb, rest, unknown in COMMAND.findall(" ".join(text.split())):
            found.add((verb or unknown, ""))
            found |= {(verb, option) for option in OPTION.findall(rest)}
    return found


def test_every_verb_that_a_message_names_exists() -> None:
    verbs = {verb for verb, _ in commands()}
    assert len(verbs) > 8 and verbs <= {*cli.VERBS, "VERB"}


@pytest.mark.parametrize("verb", [verb for verb in cli.VERBS if verb != "doctor"])
def test_every_option_that_a_message_names_exists(verb: str) -> None:
    named = {option for name, option in commands() if name == verb and option}
    assert named <= options(verb)
