"""Optical flow that other programs estimated, read from files.

Two layouts are known: `00003_00004.npy` (H, W, 2) px with an optional mask
`00003_00004_valid.png`, and the public NSFF layout `00003_fwd.npz`, `00004_bwd.npz`
with `flow` and `mask` for neighbors.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask
from hdr_nsff.core.progress import say
from hdr_nsff.footage.arrays import read_array, read_arrays
from hdr_nsff.geometry.round_trip import valid_flow

MAX_FLOW_PX = 1e6  # beyond any frame: a larger value is a mistake


def read_flow_files(
    folder: Path | str, pairs: Iterable[tuple[int, int]], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` of frame numbers.

    The frames are of `size` (H, W). A pair without a mask is checked against its
    reverse in the same folder. InputError for what is missing, of another size or not
    finite.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of flow maps; correct the path")
    flows = []
    masks = []
    unchecked = 0
    for i, j in pairs:
        flow, mask = read_pair(folder, int(i), int(j), size)
        if mask is None:
            mask = check_reverse(folder, int(i), int(j), flow)
        if mask is None:
            unchecked += 1
            mask = np.ones(size, bool)
        flows.append(flow)
        masks.append(mask)
    if unchecked:
        say(
            f"{folder}: {unchecked} of {len(flows)} flow maps have neither a mask nor a "
            "reverse: trusted everywhere"
        )
    all_flows = np.array(flows, np.float32).reshape(-1, *size, 2)
    return all_flows, np.array(masks, bool).reshape(-1, *size)


def check_reverse(folder: Path, i: int, j: int, flow: np.ndarray) -> np.ndarray | None:
    """Where `flow` (H, W, 2) from frame `i` to `j` agrees with its reverse (H, W).

    None where the folder has no reverse.
    """
    if pair_file(folder, j, i) is None:
        return None
    size = (flow.shape[0], flow.shape[1])
    reverse, _ = read_pair(folder, j, i, size)
    nothing_clipped = np.zeros(size, bool)
    return valid_flow(flow, reverse, nothing_clipped, nothing_clipped)


def pair_file(folder: Path, i: int, j: int) -> Path | None:
    """The file that holds the flow from frame `i` to frame `j`, or None."""
    names = [f"{i:05d}_{j:05d}.npy"]
    if j - i == 1:
        names.append(f"{i:05d}_fwd.npz")
    if j - i == -1:
        names.append(f"{i:05d}_bwd.npz")
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_pair(
    folder: Path, i: int, j: int, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Flow (H, W, 2) px from frame `i` to frame `j`, and its mask (H, W) bool.

    The mask is None where the folder has none for it. InputError where the flow is
    missing or does not fit frames of `size` (H, W).
    """
    path = pair_file(folder, i, j)
    if path is None:
        raise InputError(
            f"{folder}: no flow from frame {i} to frame {j}; "
            f"add {i:05d}_{j:05d}.npy, or leave the folder out"
        )
    mask = None
    if path.suffix == ".npz":
        flow, mask = read_npz(path)
    else:
        flow = read_array(path)
        picture = path.with_name(f"{path.stem}_valid.png")
        if picture.is_file():
            mask = read_mask(picture)
    if flow.shape != (*size, 2):
        raise InputError(
            f"{path}: flow of shape {flow.shape}, the frames need {(*size, 2)}; "
            "make it at the size of the frames"
        )
    if mask is not None and mask.shape != size:
        raise InputError(
            f"{path}: its mask has shape {mask.shape}, the frames need {size}; "
            "make it at the size of the frames"
        )
    check_flow(path, flow)
    return flow, mask


def check_flow(path: Path, flow: np.ndarray) -> None:
    """InputError where flow in pixels holds NaN, Inf or impossible values."""
    if not (np.abs(flow) <= MAX_FLOW_PX).all():
        raise InputError(
            f"{path}: the flow holds NaN, Inf or more than {MAX_FLOW_PX:g} pixels; "
            "write 0 there and mask those pixels out"
        )


def read_npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px and mask (H, W) bool of a file in the public NSFF layout."""
    flow, mask = read_arrays(path, ("flow", "mask"), "flow file")
    return flow, mask > 0.5
