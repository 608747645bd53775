"""The step `flow`: optical flow between neighbors, before masks are known."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import write_half
from hdr_nsff.core.progress import track
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.footage.datasets import maps
from hdr_nsff.prepare.lens import FlowUndistorter, flow_undistorter
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.flow.sources import fallback_note, flow_source, resolve_source
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest

FLOW_CHUNK = 8  # pairs between two savings

Pair = tuple[int, int]  # frame indices (from, to)


def find_flow(work: Work) -> StepResult:
    """Optical flow between neighbors, from a folder or estimated, a few pairs at a time
    so that a killed run keeps them. Given flow is that of frames as recorded, and is
    undistorted as they are.
    """
    m, c = work.manifest, work.config
    lenses = {camera_id: entry.lens() for camera_id, entry in m.lens.items()}
    undistorted = flow_undistorter(lenses, m.width, m.height)
    pairs = flow_pairs(m.frames)
    names = {pair: flow_files("raw_flow", pair) for pair in pairs}
    missing = [pair for pair in pairs if not stored(work, names[pair])]
    given = store_given_flow(work, names, undistorted)
    missing = [pair for pair in missing if pair not in given]
    from_folder = isinstance(c.flow, Path)
    neighbors, equal = learning_pairs(m.frames)
    device = pick_device(c.device)
    source = flow_source(c.flow, c.flow_weights, c.semantic, neighbors, equal, device=device)
    size = max(len(missing), 1) if from_folder else FLOW_CHUNK
    chunks = [missing[k : k + size] for k in range(0, len(missing), size)]
    for chunk in track(chunks, "flow"):
        found, valid = source(*work.equalized, np.array(chunk))
        for pair, f, v in zip(chunk, found, valid, strict=True):
            if from_folder:
                f, v = undistorted(m.frames[pair[0]].camera_id, f, v)
            write_flow(work, names[pair], f, v)
    share = float(np.mean([read_mask(work.folder / n.valid).mean() for n in names.values()]))
    num_given = len(pairs) if from_folder else len(given)
    name = (
        "data set" if len(given) == len(pairs) else str(resolve_source(c.flow, c.semantic.features))
    )
    fallback = "" if len(given) == len(pairs) else fallback_note(c.flow, c.semantic.features)
    note = f"{len(pairs)} pairs ({name}{fallback})"
    note += f", {share:.0%} of the pixels pass the forward-backward check"
    if 0 < num_given < len(pairs):
        note += f"; {num_given} given, {len(pairs) - num_given} estimated"
    by_frame = {f.index: {j: names[i, j] for i, j in pairs if i == f.index} for f in m.frames}
    return StepResult(
        provenance="given" if num_given == len(pairs) else "estimated",
        note=note,
        details={"valid_share": round(share, 4), "source": name},
        frames={"raw_flow": by_frame, "flow": by_frame},
    )


def flow_files(folder: str, pair: Pair) -> FlowFiles:
    """The files of a pair's flow in a folder of the scene."""
    stem = f"{folder}/{pair[0]:05d}_{pair[1]:05d}"
    return FlowFiles(flow=f"{stem}.npy", valid=f"{stem}_valid.png")


def stored(work: Work, files: FlowFiles) -> bool:
    """Whether both files of a pair are there."""
    return all((work.folder / name).is_file() for name in (files.flow, files.valid))


def write_flow(work: Work, names: FlowFiles, flow: np.ndarray, valid: np.ndarray) -> None:
    """Write flow (H, W, 2) px and where it is believed (H, W)."""
    write_half(work.folder / names.flow, flow)
    write_png(work.folder / names.valid, valid)


def flow_pairs(frames: list[FrameEntry]) -> list[Pair]:
    """The pairs (from, to) that flow is wanted for, both directions side by side:
    neighbors in the clip, and neighbors among the training frames, of each camera
    and track.
    """
    pairs: dict[Pair, None] = {}
    for camera in sorted({(f.camera_id, f.track) for f in frames}):
        own = [f for f in frames if (f.camera_id, f.track) == camera]
        train = [f for f in own if f.split == "train"]
        for line in (own, train):
            pairs |= dict.fromkeys(pairwise(f.index for f in line))
    return [pair for i, j in pairs for pair in ((i, j), (j, i))]


def has_flow(m: Manifest) -> bool:
    """Whether the manifest names the flow of every pair."""
    pairs = flow_pairs(m.frames)
    return bool(pairs) and all(j in m.frames[i].raw_flow for i, j in pairs)


def has_refined_flow(m: Manifest) -> bool:
    """Whether the manifest names the refined flow of every pair."""
    pairs = flow_pairs(m.frames)
    return bool(pairs) and all(j in m.frames[i].flow for i, j in pairs)


def learning_pairs(frames: list[FrameEntry]) -> tuple[list[Pair], list[Pair]]:
    """Of the training frames of each camera and track: neighbors, and consecutive ones
    of equal exposure.
    """
    of_camera: dict[tuple[int, int], list[int]] = {}
    of_exposure: dict[tuple[int, int], list[int]] = {}
    for f in frames:
        if f.split == "train":
            of_camera.setdefault((f.camera_id, f.track), []).append(f.index)
            of_exposure.setdefault((f.camera_id, f.bracket), []).append(f.index)
    neighbors = [pair for line in of_camera.values() for pair in pairwise(line)]
    equal = [pair for line in of_exposure.values() for pair in pairwise(line)]
    return neighbors, equal


def store_given_flow(
    work: Work, names: dict[Pair, FlowFiles], undistorted: FlowUndistorter
) -> set[Pair]:
    """Write the flow that a data set gives, `undistorted`; the pairs it gives."""
    m = work.manifest
    found: set[Pair] = set()
    if work.capture_with("flow") is None:
        return found
    for (i, j), files in names.items():
        path = work.picture(m.frames[i]).flow.get(m.frames[j].source)
        if path is None:
            continue
        found.add((i, j))
        if not stored(work, files):
            flow, valid = maps.flow_map(path, (m.height, m.width))
            write_flow(work, files, *undistorted(m.frames[i].camera_id, flow, valid))
    return found


def flow_is_given(work: Work, i: int, j: int) -> bool:
    """Whether the flow between the frames `i` and `j` is the user's or the data set's,
    one way or both.
    """
    if isinstance(work.config.flow, Path):
        return True
    if work.capture_with("flow") is None:
        return False
    a, b = work.manifest.frames[i], work.manifest.frames[j]
    return b.source in work.picture(a).flow or a.source in work.picture(b).flow
