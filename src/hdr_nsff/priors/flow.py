"""Optical flow between frames of different exposure: where each pixel of one frame goes in another, and where that can be believed.

A flow prior is a function `(video, clipped, pairs) -> (flow, valid)`; `flow` runs the offline default (OpenCV's dense inverse
search) and `read_flow` reads a folder made by any other tool. Flow is in pixels, `flow[row, column]` = where the pixel goes in the
other frame minus where it is. Valid means: forward and backward flow agree to sub-pixel strictness, the target lies inside
the other frame, and neither end is clipped."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from hdr_nsff.errors import InputError
from hdr_nsff.io import read_mask, read_npy
from hdr_nsff.priors.local_motion import filled
from hdr_nsff.progress import say, track

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
TOLERANCE = 0.5  # pixels forward and backward flow may disagree by ...
RELATIVE_TOLERANCE = 0.01  # ... plus this share of the flow's length (METHOD.md 5: the reference allows 50 %)
SMALL = 100_000  # frames of fewer pixels are matched at twice their size
MISSED = 0.1  # pixels: a round trip that misses by so much is trusted exp(-1/2); one that misses by more, or is clipped, is told by what is around
PLAIN = 64.0  # squared greys per pixel: the smaller eigenvalue of the structure tensor at which a pixel is trusted by half
BLIND = 0.1  # trust in a clipped pixel, relative to others: patches around it may show something


class FlowPrior(Protocol):
    """What `prepare` calls, whatever is behind it."""

    def __call__(self, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Exposure-equalised rgb `video` (T, H, W, 3) in [0, 1], `clipped` (T, H, W) bool, `pairs` (P, 2) of frames (from, to)
        -> flow (P, H, W, 2) float32 px, valid (P, H, W) bool."""
        ...


def flow(
    video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray, report: str | None = "optical flow"
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) float32 px and valid (P, H, W) bool of `pairs` (P, 2) by dense inverse search, checked against the reverse.

    `video` (T, H, W, 3) is exposure-equalised rgb in [0, 1], `clipped` (T, H, W) bool marks pixels without information.
    The answer does not depend on the order of the pairs or on the number of cores. `report` None shows no progress."""
    ranges = {int(k): recorded_range(video[k], clipped[k]) for k in np.unique(np.asarray(pairs, np.int64))}

    def both_ways(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        a, b = common_grey(video, ranges, i, j)
        return dense_inverse_search(a, b), dense_inverse_search(b, a)

    return checked(both_ways, clipped, pairs, report)


def checked(
    both_ways: Callable[[int, int], tuple[np.ndarray, np.ndarray]],
    clipped: np.ndarray,
    pairs: np.ndarray,
    report: str | None,
    threads: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) float32 px and valid (P, H, W) bool of `pairs` (P, 2), each matched once in both directions.

    `both_ways(i, j)` with i < j gives the flow (H, W, 2) from frame i to j and that from j to i; `clipped` (T, H, W) bool."""
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    assert pairs.size == 0 or (pairs.min() >= 0 and pairs.max() < len(clipped)), f"pairs reach beyond {len(clipped)} frames"
    wanted = sorted({(int(min(p)), int(max(p))) for p in pairs})
    found = {}
    for (i, j), (there, back) in zip(wanted, in_threads(lambda p: both_ways(*p), wanted, report, threads), strict=True):
        found[i, j], found[j, i] = there, back
    forward = [found[int(i), int(j)] for i, j in pairs]
    valid = [agreement(found[int(i), int(j)], found[int(j), int(i)], clipped[i], clipped[j]) for i, j in pairs]
    size = clipped.shape[1:]
    return np.array(forward, np.float32).reshape(-1, *size, 2), np.array(valid, bool).reshape(-1, *size)


def in_threads(work: Callable, items: list, report: str | None, threads: int = 2) -> list:
    """`work` of every item, in order, on a few threads with OpenCV's own threads off (its results depend on their number)."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(threads)
    try:
        results = pool.map(work, items)
        return list(results if report is None else track(results, report, total=len(items)))
    finally:
        pool.shutdown(cancel_futures=True)  # Ctrl-C waits for what is under way, not for what is to come
        cv2.setNumThreads(before)


def recorded_range(frame: np.ndarray, clipped: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest equalised rgb (3,), (3,) that this frame really recorded; (0, 1) where all of it is clipped."""
    if clipped.all():
        return np.zeros(3, np.float32), np.ones(3, np.float32)
    low, high = np.quantile(frame[~clipped], [0.001, 0.999], axis=0).astype(np.float32)
    return low, high


def common_grey(video: np.ndarray, ranges: Mapping | Sequence, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames `i` and `j` as grey uint8 (H, W), cut to the range both exposures recorded and stretched to it.

    What saturates in one frame then looks saturated in the other too, so its rim stays the same curve in the scene."""
    low, high = common_range(ranges[i], ranges[j])
    offset, scale = low @ LUMA, 255.0 / ((high - low) @ LUMA)
    a, b = ((np.clip(video[k], low, high) @ LUMA - offset) * scale for k in (i, j))
    return np.rint(a).astype(np.uint8), np.rint(b).astype(np.uint8)


def common_rgb(video: np.ndarray, ranges: Mapping | Sequence, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """The same in colour: frames `i` and `j` (H, W, 3) in [0, 1], every channel stretched to the range both exposures recorded."""
    low, high = common_range(ranges[i], ranges[j])
    a, b = ((np.clip(video[k], low, high) - low) / (high - low) for k in (i, j))
    return a, b


def common_range(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest rgb (3,), (3,) that two frames of these ranges both recorded."""
    low, high = np.maximum(one[0], other[0]), np.minimum(one[1], other[1])
    if (high - low < 0.02).any():  # nothing in common: better the frames as they are than stretched noise
        return np.zeros(3, np.float32), np.ones(3, np.float32)
    return low, high


def dense_inverse_search(a: np.ndarray, b: np.ndarray, initial: np.ndarray | None = None) -> np.ndarray:
    """Flow (H, W, 2) px between grey uint8 (H, W) images, by OpenCV's DIS with a long variational refinement.

    With `initial` flow (H, W, 2) the search starts from it and at half the size, so it only mends what is nearly right.
    Small frames are doubled first: measured on moving objects, the median error falls by a quarter; larger ones only gain noise."""
    h, w = a.shape
    scale = 2 if h * w < SMALL else 1
    a, b = (cv2.GaussianBlur(x, (0, 0), 0.6) for x in (a, b))  # the dark exposures are noisy
    if scale == 2:
        a, b = (cv2.resize(x, (w * 2, h * 2), interpolation=cv2.INTER_CUBIC) for x in (a, b))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    small = scale == 1 or initial is not None
    search.setPatchSize(8 if small else 12)
    search.setPatchStride(3 if small else 4)
    search.setVariationalRefinementIterations(10)
    search.setVariationalRefinementAlpha(20.0 * scale)
    start = np.zeros((*a.shape, 2), np.float32)
    if initial is not None:
        search.setCoarsestScale(1)
        start = cv2.resize(initial, a.shape[::-1], interpolation=cv2.INTER_LINEAR) * np.float32(scale)
    found = np.asarray(search.calc(a, b, start))
    return cv2.resize(found, (w, h), interpolation=cv2.INTER_AREA) / np.float32(scale)


def follow(field: np.ndarray, flow: np.ndarray, fill: float | None = None, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
    """`field` (H, W) or (H, W, C) of the other frame, read where `flow` (H, W, 2) px leads; outside is `fill`, or the edge."""
    h, w = flow.shape[:2]
    x = np.arange(w, dtype=np.float32) + flow[..., 0]
    y = np.arange(h, dtype=np.float32)[:, None] + flow[..., 1]
    mode = cv2.BORDER_REPLICATE if fill is None else cv2.BORDER_CONSTANT
    return cv2.remap(field, x, y, interpolation, borderMode=mode, borderValue=0.0 if fill is None else fill)


def round_trip(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """`|f(x) + b(x + f(x))|` (H, W) px: how far a pixel lands from where it started."""
    return np.linalg.norm(forward + follow(backward, forward), axis=-1)


def agreement(forward: np.ndarray, backward: np.ndarray, clipped_from: np.ndarray, clipped_to: np.ndarray) -> np.ndarray:
    """Where flow can be believed (H, W) bool: round trip within tolerance, target inside the frame, neither end clipped."""
    blocked = follow(clipped_to.astype(np.float32), forward, fill=1.0)  # also 1 outside the frame
    return (round_trip(forward, backward) < allowed(forward)) & (blocked < 0.01) & ~clipped_from


def allowed(flow: np.ndarray) -> np.ndarray:
    """By how many pixels (H, W) a round trip that begins with `flow` (H, W, 2) px may miss."""
    return TOLERANCE + RELATIVE_TOLERANCE * np.linalg.norm(flow, axis=-1)


def told(
    flow: np.ndarray,
    reverse: np.ndarray,
    here: np.ndarray,
    there: np.ndarray,
    clipped_here: np.ndarray,
    clipped_there: np.ndarray,
    moving: np.ndarray,
) -> np.ndarray:
    """`flow` (H, W, 2) px between grey uint8 pictures (H, W), where it is not sure told by the trusted pixels around that move alike.

    What stands still tells nothing of what is `moving` (H, W) bool. Masks miss some of that, so the rest is told by all; of what is clipped
    they know nothing. Trusted is what agrees with its `reverse`, shows something in both pictures, and is clipped at neither end."""
    blind = clipped_here | (follow(clipped_there.astype(np.float32), flow, fill=1.0) > 0.01)
    missed = round_trip(flow, reverse)
    shown = np.minimum(detail(here), follow(detail(there), flow))
    trust = np.exp(-0.5 * (missed / MISSED) ** 2) * np.where(blind, BLIND, 1) * shown / (shown + PLAIN)
    side = np.where(blind, 0, np.where(moving, 1, -1))
    return filled(flow, trust, blind | (missed > MISSED), side)


def halfway(forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """`forward` (H, W, 2) px, and where it agrees with `backward` the mean of both: each is off by errors of its own."""
    missed = forward + follow(backward, forward)
    near = np.linalg.norm(missed, axis=-1) < allowed(forward)
    return forward - 0.5 * missed * near[..., None]


def detail(grey: np.ndarray) -> np.ndarray:
    """The smaller eigenvalue (H, W) of the structure tensor over 5x5 pixels, in squared greys per pixel (Shi & Tomasi 1994)."""
    return cv2.cornerMinEigenVal(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 0.6), 5) / 4


def read_flow(folder: Path | str, pairs: Iterable[tuple[int, int]], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Flow (P, H, W, 2) px and valid (P, H, W) of `pairs` of frame numbers, made elsewhere, for frames of `size` (H, W).

    Two layouts: `00003_00004.npy` (H, W, 2) px with an optional mask `00003_00004_valid.png`, or the public NSFF layout
    `00003_fwd.npz`, `00004_bwd.npz` with `flow` and `mask` for neighbours. A pair without a mask is checked against its
    reverse in the same folder. InputError for what is missing, of another size or not finite."""
    folder, pairs = Path(folder), [(int(i), int(j)) for i, j in pairs]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of flow maps")
    nothing_clipped = np.zeros(size, bool)
    flows, masks, unchecked = [], [], 0
    for i, j in pairs:
        one, mask = read_pair(folder, i, j, size)
        if mask is None and pair_file(folder, j, i) is not None:
            mask = agreement(one, read_pair(folder, j, i, size)[0], nothing_clipped, nothing_clipped)
        unchecked += mask is None
        flows.append(one)
        masks.append(np.ones(size, bool) if mask is None else mask)
    if unchecked:
        say(f"{folder}: {unchecked} of {len(flows)} flow maps have neither a mask nor a reverse: believed everywhere")
    return np.array(flows, np.float32).reshape(-1, *size, 2), np.array(masks, bool).reshape(-1, *size)


def pair_file(folder: Path, i: int, j: int) -> Path | None:
    """The file that holds the flow from frame `i` to frame `j`, or None."""
    neighbour = {1: [f"{i:05d}_fwd.npz"], -1: [f"{i:05d}_bwd.npz"]}.get(j - i, [])
    names = [f"{i:05d}_{j:05d}.npy", *neighbour]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_pair(folder: Path, i: int, j: int, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray | None]:
    """Flow (H, W, 2) px from frame `i` to frame `j` and its mask (H, W) bool, or None where the folder has no mask for it."""
    path = pair_file(folder, i, j)
    if path is None:
        raise InputError(f"{folder}: no flow from frame {i} to frame {j}; add {i:05d}_{j:05d}.npy, or leave the folder out")
    mask = None
    if path.suffix == ".npz":
        flow, mask = read_npz(path)
    else:
        flow = np.array(read_npy(path), np.float32)
        if (picture := path.with_name(f"{path.stem}_valid.png")).is_file():
            mask = read_mask(picture)
    if flow.shape != (*size, 2):
        raise InputError(f"{path}: flow of shape {flow.shape}, the frames need {(*size, 2)}; make it at the size of the frames")
    if mask is not None and mask.shape != size:
        raise InputError(f"{path}: its mask has shape {mask.shape}, the frames need {size}; make it at the size of the frames")
    if not np.isfinite(flow).all():
        raise InputError(f"{path}: the flow holds NaN or Inf; write 0 there and mask those pixels out")
    return flow, mask


def read_npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """`flow` and `mask` of a file in the public NSFF layout."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return np.array(arrays["flow"], np.float32), np.array(arrays["mask"]) > 0.5
    except (KeyError, ValueError, OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a flow file with `flow` and `mask` ({error}); copy it again or make it anew") from error
