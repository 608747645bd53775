"""What `--flow` can name, each as one function behind `FlowPrior`: the matcher that needs no weights, or a folder of maps."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal, assert_never, get_args

import numpy as np

from hdr_nsff.errors import InputError
from hdr_nsff.priors.flow import FlowPrior, flow, read_flow

FlowName = Literal["dis"]
DEFAULT: FlowName = "dis"
NETWORKS: frozenset[str] = frozenset()  # the names that `--flow-weights` is for


def check_flow(chosen: FlowName | Path | None, weights: Path | None) -> None:
    """InputError where the source that was chosen, or its weights, cannot be used."""
    if isinstance(chosen, Path) and not chosen.is_dir():
        raise InputError(
            f"--flow {chosen}: no such folder of flow maps, and no source of that name; use {', '.join(get_args(FlowName))}, or mend the path"
        )
    if weights is not None and chosen not in NETWORKS:
        raise InputError(f"--flow-weights {weights}: `--flow {chosen or DEFAULT}` takes no weights; leave the option out")
    if weights is not None and not weights.is_file():
        raise InputError(f"--flow-weights {weights}: no such file; mend the path")


def flow_source(chosen: FlowName | Path | None, weights: Path | None = None) -> FlowPrior:
    """The flow prior that `--flow` chose, None for the default; its `video` and `pairs` are those of the whole clip."""
    match chosen:
        case Path():
            return partial(from_folder, chosen)
        case "dis" | None:
            return partial(flow, report=None)
        case _:
            assert_never(chosen)


def from_folder(folder: Path, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`FlowPrior` of maps made elsewhere."""
    return read_flow(folder, pairs, clipped.shape[1:3])
