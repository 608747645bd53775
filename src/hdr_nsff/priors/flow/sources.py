"""What `--flow` can name, each as one function behind `FlowPrior`: a matcher that needs
no weights, networks, or a folder of maps.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal, assert_never, get_args

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.flow_files import read_flow
from hdr_nsff.priors.flow.dense import FlowPrior, flow
from hdr_nsff.priors.flow.networks import load, matched_flow, weights_file
from hdr_nsff.priors.flow.semantic import Pairs, SemanticConfig, semantic_flow
from hdr_nsff.priors.weights import entry, find, locate

FlowName = Literal["dis", "semantic", "gmflow", "raft", "raft-finetuned"]
NETWORKS = frozenset(
    {"semantic", "gmflow", "raft", "raft-finetuned"}
)  # the names that `--flow-weights` is for


def resolved(chosen: FlowName | Path | None, features: str) -> FlowName | Path:
    """What was chosen; None stands for `semantic` where the weights of its `features`
    are on this machine, else for `dis`, which needs none.
    """
    if chosen is not None:
        return chosen
    return "dis" if locate(entry(features)) is None else "semantic"


def fallback_note(chosen: FlowName | Path | None, features: str) -> str:
    """Half a sentence where None stands for `dis` for want of weights."""
    lacking = chosen is None and resolved(chosen, features) == "dis"
    return (
        f", for the weights of {features} are not on this machine: see `hdr-nsff weights {features}`"
        if lacking
        else ""
    )


def check_flow(chosen: FlowName | Path | None, weights: Path | None) -> None:
    """InputError where the source that was chosen, or its weights, cannot be used; a
    network is loaded, so that this is known early.
    """
    if isinstance(chosen, Path) and not chosen.is_dir():
        raise InputError(
            f"--flow {chosen}: no such folder of flow maps, and no source of that name; use {', '.join(get_args(FlowName))}, or mend the path"
        )
    if weights is not None and chosen not in NETWORKS:
        mend = (
            "name the network they are of with --flow"
            if chosen is None
            else f"`--flow {chosen}` takes no weights; leave the option out"
        )
        raise InputError(f"--flow-weights {weights}: {mend}")
    if weights is not None and not weights.exists():
        raise InputError(f"--flow-weights {weights}: no such file; mend the path")
    if chosen == "raft-finetuned" and weights is None:
        raise InputError(
            "--flow raft-finetuned needs the weights that `hdr-nsff finetune-flow` wrote; name them with --flow-weights"
        )
    if chosen in ("gmflow", "raft", "raft-finetuned"):
        flow_source(chosen, weights)


def flow_source(
    chosen: FlowName | Path | None,
    weights: Path | None = None,
    semantic: SemanticConfig | None = None,
    neighbors: Pairs = (),
    equal: Pairs = (),
) -> FlowPrior:
    """The flow prior that `--flow` chose, None for what it stands for; its `video` and
    `pairs` are those of the whole clip.

    `semantic` (its defaults where None), `neighbors` and `equal` are what
    `SemanticFlow` fits its features by.
    """
    semantic = semantic or SemanticConfig()
    match source := resolved(chosen, semantic.features):
        case Path():
            return partial(from_folder, source)
        case "dis":
            return partial(flow, report=None)
        case "semantic":
            return semantic_flow(semantic, weights, neighbors, equal)
        case "gmflow" | "raft":
            return partial(matched_flow, load(source, weights, device()))
        case "raft-finetuned":
            return partial(matched_flow, load(None, weights, device()))
        case _:
            assert_never(source)


def flow_weights(
    chosen: FlowName | Path | None, weights: Path | None, semantic: SemanticConfig
) -> list[Path]:
    """The weights that the flow prior of these settings reads; none where it reads
    none. InputError where they are not to be had.
    """
    match source := resolved(chosen, semantic.features):
        case Path() | "dis":
            return []
        case "semantic":
            return [find(semantic.features, weights)]
        case "gmflow" | "raft":
            return [weights_file(source, weights)]
        case "raft-finetuned":
            return [weights_file(None, weights)]
        case _:
            assert_never(source)


def device() -> torch.device:
    """Where networks run: on a GPU where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def from_folder(
    folder: Path, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`FlowPrior` of maps made elsewhere."""
    return read_flow(folder, pairs, clipped.shape[1:3])
