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
from hdr_nsff.footage.flow_files import pair_file, read_flow_files
from hdr_nsff.prepare.lens import FlowUndistorter, flow_undistorter
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import PrepareConfig, Work
from hdr_nsff.priors.flow.sources import FlowName, fallback_note, flow_source, resolve_source
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
    estimate_flow(work, names, [pair for pair in missing if pair not in given])
    share = float(np.mean([read_mask(work.folder / n.valid).mean() for n in names.values()]))
    num_given = len(given)
    all_given = num_given == len(pairs)
    giver = str(c.flow) if isinstance(c.flow, Path) else "data set"
    chosen = estimator(c), c.semantic.features
    name = giver if all_given else str(resolve_source(*chosen))
    fallback = "" if all_given else fallback_note(*chosen)
    note = f"{len(pairs)} pairs ({name}{fallback})"
    note += f", {share:.0%} of the pixels pass the forward-backward check"
    if 0 < num_given < len(pairs):
        note += f"; {num_given} given, {len(pairs) - num_given} estimated"
    by_frame = {f.index: {j: names[i, j] for i, j in pairs if i == f.index} for f in m.frames}
    return StepResult(
        provenance="given" if all_given else "estimated",
        note=note,
        details={"valid_share": round(share, 4), "source": name},
        frames={"raw_flow": by_frame, "flow": by_frame},
    )


def estimate_flow(work: Work, names: dict[Pair, FlowFiles], pairs: list[Pair]) -> None:
    """Estimate and write the flow of these pairs."""
    if not pairs:
        return
    c = work.config
    learned = learning_pairs(work.manifest.frames)
    device = pick_device(c.device)
    source = flow_source(estimator(c), c.flow_weights, c.semantic, *learned, device=device)
    chunks = [pairs[k : k + FLOW_CHUNK] for k in range(0, len(pairs), FLOW_CHUNK)]
    for chunk in track(chunks, "flow"):
        found, valid = source(*work.equalized, np.array(chunk))
        for pair, f, v in zip(chunk, found, valid, strict=True):
            write_flow(work, names[pair], f, v)


def estimator(config: PrepareConfig) -> FlowName | None:
    """The source that estimates flow: the default where a folder lacks some."""
    return None if isinstance(config.flow, Path) else config.flow


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
    """Write the flow that the user or a data set gives, `undistorted`; the pairs they
    give.
    """
    m, size = work.manifest, (work.manifest.height, work.manifest.width)
    if isinstance(work.config.flow, Path):
        given = pairs_of_folder(work.config.flow, m.frames, list(names))
        missing = [pair for pair in given if not stored(work, names[pair])]
        flows = read_flow_files(work.config.flow, missing, size)
        for pair, flow, valid in zip(missing, *flows, strict=True):
            camera_id = m.frames[pair[0]].camera_id
            write_flow(work, names[pair], *undistorted(camera_id, flow, valid))
        return set(given)
    found: set[Pair] = set()
    if work.capture_with("flow") is None:
        return found
    for (i, j), files in names.items():
        path = work.picture(m.frames[i]).flow.get(m.frames[j].source)
        if path is None:
            continue
        found.add((i, j))
        if not stored(work, files):
            flow, valid = maps.flow_map(path, size)
            write_flow(work, files, *undistorted(m.frames[i].camera_id, flow, valid))
    return found


def pairs_of_folder(folder: Path, frames: list[FrameEntry], pairs: list[Pair]) -> list[Pair]:
    """The pairs that the user's folder gives: all neighbors in the clip, and those
    across held-out frames that it holds.
    """
    return [p for p in pairs if pair_file(folder, *p) or not is_across_held_out(frames, p)]


def is_across_held_out(frames: list[FrameEntry], pair: Pair) -> bool:
    """Whether held-out frames lie between the two of a pair."""
    first, last = sorted(pair)
    line = (frames[first].camera_id, frames[first].track)
    between = frames[first + 1 : last]
    return any(f.split == "test" and (f.camera_id, f.track) == line for f in between)


def flow_is_given(work: Work, i: int, j: int) -> bool:
    """Whether the flow between the frames `i` and `j` is the user's or the data set's,
    one way or both.
    """
    frames, folder = work.manifest.frames, work.config.flow
    if isinstance(folder, Path):
        a, b = (i, j) if work.segment is None else (work.segment.rows[i], work.segment.rows[j])
        named = pair_file(folder, a, b) or pair_file(folder, b, a)  # by frames of the whole clip
        return named is not None or not is_across_held_out(frames, (i, j))
    if work.capture_with("flow") is None:
        return False
    here, there = frames[i], frames[j]
    return there.source in work.picture(here).flow or here.source in work.picture(there).flow
