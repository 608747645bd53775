"""The flow sources that `--flow` can name, each as one `FlowPrior`.

They are a matcher without weights, matching by features, networks, and folders of maps
made by other tools.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, assert_never, get_args

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.core.tensors import CPU
from hdr_nsff.footage.flow_files import read_flow_files
from hdr_nsff.priors.flow.dense import DenseFlowTuning, FlowPrior, dense_flow
from hdr_nsff.priors.flow.networks import (
    NetworkFlowTuning,
    load_network,
    network_flow,
    weights_file,
)
from hdr_nsff.priors.flow.semantic import (
    Pairs,
    SemanticConfig,
    SemanticTuning,
    check_semantic,
    semantic_flow,
)
from hdr_nsff.priors.weights import entry, find, locate

FlowName = Literal["dis", "semantic", "gmflow", "raft", "raft-finetuned"]
WITH_WEIGHTS = ("semantic", "gmflow", "raft", "raft-finetuned")  # takers of `--flow-weights`
NETWORKS = ("gmflow", "raft", "raft-finetuned")


@dataclass(frozen=True)
class FlowTuning:
    """Tuning constants of the flow sources."""

    dense: DenseFlowTuning = field(default_factory=DenseFlowTuning)
    network: NetworkFlowTuning = field(default_factory=NetworkFlowTuning)
    semantic: SemanticTuning = field(default_factory=SemanticTuning)


FLOW_TUNING = FlowTuning()


def resolve_source(chosen: FlowName | Path | None, features: str) -> FlowName | Path:
    """The flow source that was chosen.

    None stands for `semantic` where the weights of `features` are on this machine, else
    for `dis`, which needs none.
    """
    if chosen is not None:
        return chosen
    return "dis" if locate(entry(features)) is None else "semantic"


def fallback_note(chosen: FlowName | Path | None, features: str) -> str:
    """The reason, for a step's note, where None stands for `dis`; empty elsewhere."""
    if chosen is not None or resolve_source(chosen, features) != "dis":
        return ""
    return (
        f", because the weights of {features} are not on this machine: "
        f"see `hdr-nsff weights {features}`"
    )


def check_flow(
    chosen: FlowName | Path | None,
    weights: Path | None,
    semantic: SemanticConfig | None = None,
) -> None:
    """InputError where the chosen source, its weights or its settings cannot be used.

    A network is loaded, so that bad weights are reported before any work is done.
    """
    if isinstance(chosen, Path) and not chosen.is_dir():
        names = ", ".join(get_args(FlowName))
        raise InputError(
            f"--flow {chosen}: neither a folder of flow maps nor a flow source; "
            f"use {names}, or correct the path"
        )
    if weights is not None:
        check_weights(chosen, weights)
    semantic = semantic or SemanticConfig()
    if chosen in (None, "semantic"):
        check_semantic(semantic)
    elif semantic != SemanticConfig():
        raise InputError(
            f"--semantic.*: settings of `--flow semantic`, which `--flow {chosen}` replaces; "
            "leave one of them out"
        )
    if chosen == "raft-finetuned" and weights is None:
        raise InputError(
            "--flow raft-finetuned needs the weights that `hdr-nsff finetune-flow` wrote; "
            "name them with --flow-weights"
        )
    if chosen in NETWORKS or (chosen == "semantic" and weights is not None):
        flow_source(chosen, weights, semantic)


def check_weights(chosen: FlowName | Path | None, weights: Path) -> None:
    """InputError where `weights` do not exist, or the chosen source takes none."""
    if chosen is None:
        raise InputError(
            f"--flow-weights {weights}: without a network; name the network with --flow"
        )
    if chosen not in WITH_WEIGHTS:
        raise InputError(
            f"--flow-weights {weights}: `--flow {chosen}` takes no weights; leave the option out"
        )
    if not weights.exists():
        raise InputError(f"--flow-weights {weights}: no such file; correct the path")


def flow_source(
    chosen: FlowName | Path | None,
    weights: Path | None = None,
    semantic: SemanticConfig | None = None,
    neighbors: Pairs = (),
    equal: Pairs = (),
    tuning: FlowTuning = FLOW_TUNING,
    device: torch.device = CPU,
) -> FlowPrior:
    """The flow prior that `--flow` chose, for the `video` and `pairs` of a whole clip.

    `SemanticFlow` uses the settings `semantic` (the defaults where None) and fits its
    features to `neighbors` and `equal`. Networks, and the search for their features,
    run on `device`; dense inverse search runs on the CPU. InputError where weights are
    missing.
    """
    semantic = semantic or SemanticConfig()
    match source := resolve_source(chosen, semantic.features):
        case Path():
            return partial(flow_from_folder, source)
        case "dis":
            return partial(dense_flow, tuning=tuning.dense)
        case "semantic":
            tunings = tuning.semantic, tuning.dense
            return semantic_flow(semantic, weights, neighbors, equal, *tunings, device)
        case "gmflow" | "raft":
            network = load_network(source, weights, device)
        case "raft-finetuned":
            network = load_network(None, weights, device)
        case _:
            assert_never(source)
    return partial(network_flow, network, tuning=tuning.network, dense=tuning.dense)


def flow_weights(
    chosen: FlowName | Path | None, weights: Path | None, semantic: SemanticConfig
) -> list[Path]:
    """The weights that the flow prior of these settings reads, if any.

    InputError where they are missing.
    """
    match source := resolve_source(chosen, semantic.features):
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


def flow_from_folder(
    folder: Path, video: ArrayStack, clipped: ArrayStack, pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`FlowPrior` that reads maps made by another tool."""
    return read_flow_files(folder, pairs, (clipped.shape[1], clipped.shape[2]))
