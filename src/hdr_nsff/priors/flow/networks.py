"""Optical flow by a network: its weights, the size it sees frames at, and both
directions of a pair at once.

A network here is a module whose `predictions(images)` takes a pair batch (2B, 3, H, W)
in [0, 1], whose second half holds the partners of the first, and gives flow (2B, 2, H,
W) px, better from one to the next.
"""

from __future__ import annotations

from pathlib import Path
from pickle import UnpicklingError
from typing import Literal

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.flow.dense import checked, dense_inverse_search
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.priors.flow.raft import Raft
from hdr_nsff.priors.weights import find
from hdr_nsff.radiometry.common_range import common_gray, common_rgb, recorded_range

Network = Literal["gmflow", "raft"]
FINETUNED = "weights.safetensors"  # what `finetune-flow` leaves in its folder
SIDE = 640  # pixels of the longer side at which frames are matched, ...
ENLARGED = 3  # ... unless that would enlarge them more than this many times
MEND = 0.5  # pixels by which dense inverse search may correct a network
MULTIPLE, LEAST = 32, 128  # sides are multiples of the one and no less than the other


FlowNetwork = GMFlow | Raft  # and whatever else answers `predictions`


def matched_flow(
    network: FlowNetwork,
    video: np.ndarray,
    clipped: np.ndarray,
    pairs: np.ndarray,
    report: str | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) px and valid (P, H, W) by a loaded network, then `mended`;
    `video`, `clipped` and `pairs` as in `FlowPrior`.
    """
    ranges = {
        int(k): recorded_range(video[k], clipped[k]) for k in np.unique(np.asarray(pairs, np.int64))
    }

    def match(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        there, back = both_ways(network, *common_rgb(video, ranges, i, j))
        a, b = common_gray(video, ranges, i, j)
        return mended(a, b, there), mended(b, a, back)

    return checked(match, clipped, pairs, report, threads=1)


def mended(a: np.ndarray, b: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Flow (H, W, 2) px between gray uint8 (H, W) images, searched on from a network's
    `flow`, which stays where the search leaves it.

    Networks find large motion, the search is exact to a tenth of a pixel on what they
    found; where it goes farther than `MEND`, it is lost.
    """
    found = dense_inverse_search(a, b, flow)
    lost = np.linalg.norm(found - flow, axis=-1) > MEND
    return np.where(lost[..., None], flow, found)


@torch.no_grad()
def both_ways(network: FlowNetwork, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px from rgb `a` to rgb `b` (H, W, 3) in [0, 1], and from `b` to
    `a`.
    """
    device = next(p.device for p in network.parameters())
    images = torch.from_numpy(np.stack([a, b])).to(device).permute(0, 3, 1, 2).float()
    flow = resized_flow(network(resized(images, working_size(*a.shape[:2]))), a.shape[:2])
    there, back = flow.permute(0, 2, 3, 1).cpu().numpy()
    return there, back


def working_size(height: int, width: int) -> tuple[int, int]:
    """The size (H, W) at which frames are matched: longer side near `SIDE`, whatever a
    network can take. Small frames gain most from it.
    """
    scale = min(ENLARGED, SIDE / max(height, width))
    return max(LEAST, round(height * scale / MULTIPLE) * MULTIPLE), max(
        LEAST, round(width * scale / MULTIPLE) * MULTIPLE
    )


def resized(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Images (N, C, H, W) in [0, 1] at another size."""
    return functional.interpolate(images, size=size, mode="bicubic", antialias=True).clamp(0, 1)


def resized_flow(flow: Tensor, size: tuple[int, ...]) -> Tensor:
    """Flow (N, 2, H, W) at another size (H, W), in pixels of that."""
    scale = flow.new_tensor([size[1] / flow.shape[3], size[0] / flow.shape[2]]).view(2, 1, 1)
    return functional.interpolate(flow, size=tuple(size), mode="bilinear", antialias=True) * scale


def load(
    name: Network | None, given: Path | None, device: torch.device | str = "cpu"
) -> FlowNetwork:
    """The network `name` with its weights, in evaluation mode; where `name` is None,
    the network that `given` says it is of.

    `given`: a file, a folder of `finetune-flow`, or None to look where weights are
    kept. InputError where they are missing or do not fit.
    """
    path = weights_file(name, given)
    state, of = read_weights(path)
    if name is None and of is None:
        raise InputError(
            f"{path}: does not say which network it is of; name a file that `hdr-nsff finetune-flow` wrote"
        )
    if name is not None and of not in (None, name):
        raise InputError(
            f"{path}: weights of {of}, not of {name}; use --flow {of} or other weights"
        )
    network = build(name or of, torch.device(device))
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError(
            f"{path}: these weights do not fit {name or of} ({reason}); name a file that does"
        ) from error
    return network.to(device).eval().requires_grad_(False)


def weights_file(name: Network | None, given: Path | None) -> Path:
    """The file that `load` reads."""
    return (tuned_file(given) if given is not None else None) or find(name or "gmflow", given)


def build(name: str | None, device: torch.device) -> FlowNetwork:
    """An untrained network; bfloat16 only where `device` is quick at it."""
    match name:
        case "gmflow":
            return GMFlow(bf16=device.type == "cuda" or torch.cpu._is_avx512_bf16_supported())
        case "raft":
            return Raft()
    raise InputError(f"weights of {name!r}: no such flow network; use those of gmflow or raft")


def tuned_file(given: Path) -> Path | None:
    """The safetensors file at or in `given`; None where it is something else."""
    inside = given / FINETUNED
    return (
        given
        if given.suffix == ".safetensors" and given.is_file()
        else inside
        if inside.is_file()
        else None
    )


def read_weights(path: Path) -> tuple[dict[str, Tensor], str | None]:
    """Tensors by name, and the network that a file of `finetune-flow` says it is of.
    Nothing but tensors is unpickled.
    """
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, "pt") as file:
                names = list(file.keys())
                metadata = file.metadata() or {}
                return {name: file.get_tensor(name) for name in names}, metadata.get("network")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (
        SafetensorError,
        UnpicklingError,
        RuntimeError,
        EOFError,
        OSError,
        ValueError,
        KeyError,
    ) as error:
        raise InputError(
            f"{path}: no readable weights ({' '.join(str(error).split())[:120]}); copy the file again"
        ) from error
    state = state.get("model", state) if isinstance(state, dict) else state
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise InputError(
            f"{path}: holds something else than a network's weights; name another file"
        )
    return {k.removeprefix("module."): v for k, v in state.items()}, None
