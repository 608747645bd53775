"""Optical flow by a network: its weights, its working size, both directions at once.

A network here is a module that takes a pair batch of images (2B, 3, H, W) in [0, 1],
whose second half holds the partners of the first, and returns flow (2B, 2, H, W) px;
its `predictions(images)` are the flows after each of its stages, the last one being the
result. Networks find large motion; dense inverse search then corrects their flow to a
tenth of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.core.tensors import computes_bf16_fast
from hdr_nsff.priors.flow.dense import (
    DENSE_FLOW_TUNING,
    DenseFlowTuning,
    dense_inverse_search,
    match_pairs,
    recorded_ranges,
)
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.priors.flow.raft import Raft
from hdr_nsff.priors.weights import find
from hdr_nsff.radiometry.common_range import common_gray, common_rgb

Network = Literal["gmflow", "raft"]
FlowNetwork = GMFlow | Raft
FINETUNED = "weights.safetensors"  # the file that `finetune-flow` leaves in its folder
MULTIPLE = 32  # pixels: sides of a network's images are multiples of this, ...
MIN_SIDE_PX = 128  # ... and no shorter than this


@dataclass(frozen=True)
class NetworkFlowTuning:
    """Tuning constants of flow by a network, chosen on rendered scenes."""

    longer_side_px: int = 640
    """Longer side at which frames are matched. GMFlow at 240x136: median error on
    movers 3.1 px as they are, 0.4 px doubled, 0.15 px at 640.
    """
    max_enlargement: float = 3
    """Frames are enlarged at most this many times."""
    max_correction_px: float = 0.5
    """A correction by dense inverse search that is larger than this is discarded."""


NETWORK_FLOW_TUNING = NetworkFlowTuning()


def network_flow(
    network: FlowNetwork,
    video: ArrayStack,
    clipped: ArrayStack,
    pairs: np.ndarray,
    tuning: NetworkFlowTuning = NETWORK_FLOW_TUNING,
    dense: DenseFlowTuning = DENSE_FLOW_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """`FlowPrior` by a loaded network, refined by dense inverse search."""
    ranges = recorded_ranges(video, clipped, pairs)

    def match(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        forward, backward = predict_both_directions(
            network, *common_rgb(video, ranges, i, j), tuning
        )
        a, b = common_gray(video, ranges, i, j)
        forward = refine_flow(a, b, forward, tuning, dense)
        backward = refine_flow(b, a, backward, tuning, dense)
        return forward, backward

    return match_pairs(match, clipped, pairs, threads=1)


def refine_flow(
    a: np.ndarray,
    b: np.ndarray,
    flow: np.ndarray,
    tuning: NetworkFlowTuning = NETWORK_FLOW_TUNING,
    dense: DenseFlowTuning = DENSE_FLOW_TUNING,
) -> np.ndarray:
    """A network's `flow` (H, W, 2) px, corrected by dense inverse search.

    It leads from `a` to `b`, gray uint8 (H, W). Where the search goes astray, it stays.
    """
    refined = dense_inverse_search(a, b, flow, dense)
    astray = np.linalg.norm(refined - flow, axis=-1) > tuning.max_correction_px
    return np.where(astray[..., None], flow, refined)


@torch.no_grad()
def predict_both_directions(
    network: FlowNetwork,
    a: np.ndarray,
    b: np.ndarray,
    tuning: NetworkFlowTuning = NETWORK_FLOW_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px from `a` to `b`, rgb (H, W, 3) in [0, 1], and that back."""
    device = next(p.device for p in network.parameters())
    height, width = a.shape[:2]
    pair = torch.from_numpy(np.stack([a, b])).to(device).permute(0, 3, 1, 2).float()
    flow = network(resize_images(pair, working_size(height, width, tuning)))
    flow = resize_flow(flow, (height, width))
    forward, backward = flow.permute(0, 2, 3, 1).cpu().numpy()
    return forward, backward


def working_size(
    height: int, width: int, tuning: NetworkFlowTuning = NETWORK_FLOW_TUNING
) -> tuple[int, int]:
    """The size (H, W) at which frames are matched.

    Its longer side is near that of `tuning`, and every network can take it.
    """
    scale = min(tuning.max_enlargement, tuning.longer_side_px / max(height, width))

    def side(pixels: int) -> int:
        return max(MIN_SIDE_PX, round(pixels * scale / MULTIPLE) * MULTIPLE)

    return side(height), side(width)


def resize_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Images (N, C, H, W) in [0, 1] at another size (H, W)."""
    return functional.interpolate(images, size=size, mode="bicubic", antialias=True).clamp(0, 1)


def resize_flow(flow: Tensor, size: tuple[int, ...]) -> Tensor:
    """Flow (N, 2, H, W) at another size (H, W), in pixels of that size."""
    scale = flow.new_tensor([size[1] / flow.shape[3], size[0] / flow.shape[2]]).view(2, 1, 1)
    return functional.interpolate(flow, size=tuple(size), mode="bilinear", antialias=True) * scale


def load_network(
    name: Network | None, given: Path | None, device: torch.device | str = "cpu"
) -> FlowNetwork:
    """The network `name` with its weights, in evaluation mode.

    None stands for the network that the weights are of. `given` is a file or a folder
    of `finetune-flow`; None looks where weights are kept. InputError where the weights
    are missing or do not fit.
    """
    path = weights_file(name, given)
    state, network_of_file = read_weights(path)
    if name is None and network_of_file is None:
        raise InputError(
            f"{path}: does not name its network; name a file that `hdr-nsff finetune-flow` wrote"
        )
    if name is not None and network_of_file not in (None, name):
        raise InputError(
            f"{path}: weights of {network_of_file}, not of {name}; "
            f"choose the network {network_of_file}, or other weights"
        )
    chosen = name or network_of_file
    network = build(chosen, torch.device(device))
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        reason = one_line(error, 150)
        raise InputError(
            f"{path}: these weights do not fit {chosen} ({reason}); name a file that does"
        ) from error
    return network.to(device).eval().requires_grad_(False)


def weights_file(name: Network | None, given: Path | None) -> Path:
    """The file that `load_network` reads; InputError where there is none."""
    finetuned = None if given is None else finetuned_file(given)
    if finetuned is None and name is None and given is not None and not given.is_file():
        raise InputError(
            f"{given}: holds no {FINETUNED}; name the folder of a `hdr-nsff finetune-flow` "
            "that has ended"
        )
    return finetuned or find(name or "gmflow", given)


def build(name: str | None, device: torch.device) -> FlowNetwork:
    """An untrained network; in bfloat16 only where `device` computes it fast."""
    match name:
        case "gmflow":
            return GMFlow(bf16=computes_bf16_fast(device))
        case "raft":
            return Raft()
    raise InputError(f"weights of {name!r}: no such flow network; use those of gmflow or raft")


def finetuned_file(given: Path) -> Path | None:
    """The safetensors file at or in `given`; None where there is none."""
    if given.suffix == ".safetensors" and given.is_file():
        return given
    inside = given / FINETUNED
    return inside if inside.is_file() else None


def read_weights(path: Path) -> tuple[dict[str, Tensor], str | None]:
    """Tensors by name, and the network that a file of `finetune-flow` names.

    For other files the network is None. Only tensors are unpickled. InputError for a
    file without weights.
    """
    try:
        if path.suffix == ".safetensors":
            return read_safetensors(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch and safetensors raise many unrelated types
        reason = one_line(error, 120)
        raise InputError(f"{path}: no readable weights ({reason}); copy the file again") from error
    if isinstance(state, dict) and "model" in state:  # a training checkpoint
        state = state["model"]
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise InputError(f"{path}: not the weights of a network; name another file")
    # saved from nn.DataParallel, names have a prefix
    return {name.removeprefix("module."): tensor for name, tensor in state.items()}, None


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], str | None]:
    """Tensors by name, and the network that the file's metadata name."""
    with safe_open(path, "pt") as file:
        state = {name: file.get_tensor(name) for name in list(file.keys())}
        metadata = file.metadata() or {}
    return state, metadata.get("network")


def one_line(error: Exception, length: int) -> str:
    """An error's message without line breaks, cut to `length` characters."""
    return " ".join(str(error).split())[:length]
