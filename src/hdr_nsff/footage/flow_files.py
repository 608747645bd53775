"""Optical flow made by other tools, read from files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_mask
from hdr_nsff.core.progress import say
from hdr_nsff.footage.arrays import read_array, read_arrays
from hdr_nsff.geometry.round_trip import agreement


def read_flow(
    folder: Path | str, pairs: Iterable[tuple[int, int]], size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` of frame numbers, made
    elsewhere, for frames of `size` (H, W).

    Two layouts: `00003_00004.npy` (H, W, 2) px with an optional mask
    `00003_00004_valid.png`, or the public NSFF layout `00003_fwd.npz`, `00004_bwd.npz`
    with `flow` and `mask` for neighbors. A pair without a mask is checked against its
    reverse in the same folder. InputError for what is missing, of another size or not
    finite.
    """
    folder, pairs = Path(folder), [(int(i), int(j)) for i, j in pairs]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of flow maps")
    nothing_clipped = np.zeros(size, bool)
    flows, masks, unchecked = [], [], 0
    for i, j in pairs:
        one, mask = read_pair(folder, i, j, size)
        if mask is None and pair_file(folder, j, i) is not None:
            mask = agreement(
                one, read_pair(folder, j, i, size)[0], nothing_clipped, nothing_clipped
            )
        unchecked += mask is None
        flows.append(one)
        masks.append(np.ones(size, bool) if mask is None else mask)
    if unchecked:
        say(
            f"{folder}: {unchecked} of {len(flows)} flow maps have neither a mask nor a reverse: believed everywhere"
        )
    return np.array(flows, np.float32).reshape(-1, *size, 2), np.array(masks, bool).reshape(
        -1, *size
    )


def pair_file(folder: Path, i: int, j: int) -> Path | None:
    """The file that holds the flow from frame `i` to frame `j`, or None."""
    neighbor = {1: [f"{i:05d}_fwd.npz"], -1: [f"{i:05d}_bwd.npz"]}.get(j - i, [])
    names = [f"{i:05d}_{j:05d}.npy", *neighbor]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_pair(
    folder: Path, i: int, j: int, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Flow (H, W, 2) px from frame `i` to frame `j` and its mask (H, W) bool, or None
    where the folder has no mask for it.
    """
    path = pair_file(folder, i, j)
    if path is None:
        raise InputError(
            f"{folder}: no flow from frame {i} to frame {j}; add {i:05d}_{j:05d}.npy, or leave the folder out"
        )
    mask = None
    if path.suffix == ".npz":
        flow, mask = read_npz(path)
    else:
        flow = read_array(path)
        if (picture := path.with_name(f"{path.stem}_valid.png")).is_file():
            mask = read_mask(picture)
    if flow.shape != (*size, 2):
        raise InputError(
            f"{path}: flow of shape {flow.shape}, the frames need {(*size, 2)}; make it at the size of the frames"
        )
    if mask is not None and mask.shape != size:
        raise InputError(
            f"{path}: its mask has shape {mask.shape}, the frames need {size}; make it at the size of the frames"
        )
    if not np.isfinite(flow).all():
        raise InputError(
            f"{path}: the flow holds NaN or Inf; write 0 there and mask those pixels out"
        )
    return flow, mask


def read_npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """`flow` and `mask` of a file in the public NSFF layout."""
    flow, mask = read_arrays(path, ("flow", "mask"), "flow file")
    return flow, mask > 0.5
