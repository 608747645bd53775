"""The steps of `prepare` that find what training starts from: flow, poses, moving
masks, depth; and the contact sheet of it all.

Pixels of held-out frames are used for their own pose and mask only: nothing about a
training frame depends on them but poses.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import (
    colorize,
    colorize_flow,
    contact_sheet,
    read_mask,
    read_npy,
    write_npy,
    write_png,
)
from hdr_nsff.core.parallel import in_threads
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage import ingest
from hdr_nsff.footage.datasets import maps
from hdr_nsff.footage.depth_files import read_depth
from hdr_nsff.footage.pose_files import import_poses, placed
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.geometry.round_trip import agreement
from hdr_nsff.prepare.steps.neural import network_depth, sam2_masks
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.depth.geometric import depth_range, geometric_depth
from hdr_nsff.priors.flow.dense import average_with_reverse
from hdr_nsff.priors.flow.local_motion import fill_uncertain_flow
from hdr_nsff.priors.flow.masked_least_squares import refine_mover_flow
from hdr_nsff.priors.flow.one_exposure import equalize_through_response, response_from_flow
from hdr_nsff.priors.flow.sources import fallback_note, flow_source, resolve_source
from hdr_nsff.priors.masks.geometric import geometric_mask, rough_mask
from hdr_nsff.priors.poses.estimate import estimate_poses
from hdr_nsff.radiometry.common_range import common_gray, common_rgb, recorded_range
from hdr_nsff.scene.scene import FlowFiles, FrameEntry, Step

DEPTH_FILES = {".npy", ".exr", ".png"}
ROUNDS = 2  # of structure from motion after the first
SAME_MASKS = 0.85  # intersection over union from which masks count as the same
FLOW_CHUNK = 8  # pairs between two savings
SPHERE_NEAR, SPHERE_FAR = (
    0.5,
    2.0,
)  # around distance 1, where everything lies when there is no parallax


def flow_pairs(frames: list[FrameEntry]) -> list[tuple[int, int]]:
    """The pairs (from, to) that flow is wanted for, both directions side by side:
    neighbors in the clip, and neighbors among the training frames, of each camera.
    """
    pairs = dict.fromkeys(
        pair
        for camera in sorted({f.camera_id for f in frames})
        for split in ({"train", "test"}, {"train"})
        for pair in pairwise(
            [f.index for f in frames if f.camera_id == camera and f.split in split]
        )
    )
    return [p for i, j in pairs for p in ((i, j), (j, i))]


def learning_pairs(frames: list[FrameEntry]) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Of the training frames of each camera: neighbors, and consecutive ones of equal
    exposure.
    """
    among: list[dict[tuple[int, ...], list[int]]] = [{}, {}]
    for f in frames:
        if f.split == "train":
            among[0].setdefault((f.camera_id,), []).append(f.index)
            among[1].setdefault((f.camera_id, f.bracket), []).append(f.index)
    neighbors, equal = (
        [pair for line in lines.values() for pair in pairwise(line)] for lines in among
    )
    return neighbors, equal


def flow_step(work: Work) -> Step:
    """Optical flow between neighbors, from a folder or estimated, a few pairs at a time
    so that a killed run keeps them.
    """
    m, c = work.manifest, work.config
    pairs = flow_pairs(m.frames)
    names = {
        (i, j): FlowFiles(
            flow=f"raw_flow/{i:05d}_{j:05d}.npy", valid=f"raw_flow/{i:05d}_{j:05d}_valid.png"
        )
        for i, j in pairs
    }
    missing = [
        p
        for p in pairs
        if not all((work.folder / n).is_file() for n in (names[p].flow, names[p].valid))
    ]
    own = given_flow(work, names)
    missing = [p for p in missing if p not in own]
    from_folder = isinstance(c.flow, Path)
    source = flow_source(c.flow, c.flow_weights, c.semantic, *learning_pairs(m.frames))
    size = max(len(missing), 1) if from_folder else FLOW_CHUNK
    for chunk in track([missing[k : k + size] for k in range(0, len(missing), size)], "flow"):
        found, valid = source(*work.equalized, np.array(chunk))
        for pair, f, v in zip(chunk, found, valid, strict=True):
            write_flow(work, names[pair], f, v)
    for f in m.frames:
        f.flow = f.raw_flow = {j: names[i, j] for i, j in pairs if i == f.index}
    share = np.mean([read_mask(work.folder / n.valid).mean() for n in names.values()])
    vars(work).pop("flows", None)
    given = len(pairs) if from_folder else len(own)
    name = (
        "data set" if len(own) == len(pairs) else f"{resolve_source(c.flow, c.semantic.features)}"
    )
    why = "" if len(own) == len(pairs) else fallback_note(c.flow, c.semantic.features)
    note = f"{len(pairs)} pairs ({name}{why}), {share:.0%} of the pixels pass the forward-backward check"
    return Step(
        provenance="given" if given == len(pairs) else "estimated",
        note=note
        + (f"; {given} given, {len(pairs) - given} estimated" if 0 < given < len(pairs) else ""),
        details={"valid_share": round(float(share), 4), "source": name},
    )


def given_flow(work: Work, names: dict[tuple[int, int], FlowFiles]) -> set[tuple[int, int]]:
    """Write the flow that a data set gives; the pairs it was given for."""
    m = work.manifest
    found: set[tuple[int, int]] = set()
    if work.gives("flow") is None:
        return found
    for (i, j), files in names.items():
        path = work.picture(m.frames[i]).flow.get(m.frames[j].source)
        if path is None:
            continue
        found.add((i, j))
        if not all((work.folder / n).is_file() for n in (files.flow, files.valid)):
            write_flow(work, files, *maps.flow_map(path, (m.height, m.width)))
    return found


def write_flow(work: Work, names: FlowFiles, flow: np.ndarray, valid: np.ndarray) -> None:
    """Write flow (H, W, 2) px and where it is believed (H, W)."""
    write_npy(work.folder / names.flow, flow.astype(np.float16))
    write_png(work.folder / names.valid, valid)


def poses_step(work: Work) -> Step:
    """Cameras of all frames: given, or by structure from motion in up to three rounds,
    since poses need masks and good masks need poses.

    The last is the one whose masks are nearly those before. A killed run keeps the
    first round.
    """
    c = work.config
    capture = work.gives("poses")
    if capture is not None and capture.poses is not None:
        store(work, given_poses(work))
    elif c.poses is not None:
        store(
            work,
            import_poses(
                c.poses,
                [f.source for f in work.manifest.frames],
                (work.manifest.height, work.manifest.width),
            ),
        )
    elif isinstance(c.masks, Path) or work.gives("masks") is not None:
        store(work, estimate(work, given_masks(work)))
    else:
        first = work.folder / "poses" / "first_masks.npy"
        if not first.is_file():
            moving = rough_mask(*work.raw_flows, work.equalized[0])
            store(work, estimate(work, moving))
            work.save()
            write_npy(first, moving)
        before = read_npy(first)
        for _ in range(ROUNDS if work.manifest.parallax == "full" else 0):
            moving = geometric_mask(*work.raw_flows, work.equalized[0], *work.cameras())
            agreement = (before & moving).sum() / max((before | moving).sum(), 1)
            again = agreement < SAME_MASKS
            say(
                f"poses: masks from these poses agree to {agreement:.0%} with those before{': once more' if again else ''}"
            )
            if not again:
                break
            store(work, estimate(work, moving))
            before = moving
    details = work.manifest.steps["poses"].details
    return Step(
        provenance="estimated" if c.poses is None and capture is None else "given",
        note=f"{sum(details['registered'])} of {len(work.manifest.frames)} frames placed, parallax: {work.manifest.parallax}",
    )


def given_poses(work: Work) -> Poses:
    """The poses of a data set, with its static points."""
    capture, m = work.capture, work.manifest
    assert capture is not None and capture.poses is not None
    rows: list[int | None] = [capture.row[f.source] for f in m.frames]
    poses = placed(capture.root, capture.poses, rows, (m.height, m.width))
    return poses if capture.points is None else replace(poses, points=capture.points)


def estimate(work: Work, moving: np.ndarray) -> Poses:
    """Poses by structure from motion on equalized frames, leaving out what is `moving`
    (T, H, W) bool.
    """
    video, clipped = work.equalized
    return estimate_poses(
        video,
        moving,
        work.folder / "poses",
        clipped,
        [f.camera_id for f in work.manifest.frames],
        matcher=work.config.matcher,
    )


def store(work: Work, poses: Poses) -> None:
    """Put poses and static points into the manifest."""
    m = work.manifest
    for f, K, c2w in zip(m.frames, poses.K, poses.c2w, strict=True):
        f.K, f.c2w = K.tolist(), c2w.tolist()
    m.parallax = poses.parallax
    m.near, m.far = (
        (poses.near, poses.far) if poses.near and poses.far else (SPHERE_NEAR, SPHERE_FAR)
    )
    m.points = "points.npy" if len(poses.points) else None
    if m.points:
        write_npy(work.folder / m.points, poses.points.astype(np.float32))
    m.steps["poses"].details.update(registered=poses.registered.tolist(), notes=list(poses.notes))


def given_masks(work: Work) -> np.ndarray:
    """The moving masks (T, H, W) of a data set, or the user's, one file per frame in
    order; InputError where one is missing or of another size.
    """
    m, folder, capture = work.manifest, work.config.masks, work.gives("masks")
    if capture is not None:
        files = [work.picture(f).mask for f in m.frames]
        return np.stack(
            [
                np.zeros((m.height, m.width), bool)
                if p is None
                else maps.moving_mask(p, (m.height, m.width), capture.white_moves)
                for p in files
            ]
        )
    assert isinstance(folder, Path)
    masks = []
    for f, path in zip(m.frames, given_files(work, folder, ingest.RECORDED), strict=True):
        mask = read_mask(path)
        if mask.shape != (m.height, m.width):
            raise InputError(
                f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]}, frame {f.index} is {m.width}x{m.height}; make it that size"
            )
        masks.append(mask)
    return np.stack(masks)


def given_files(work: Work, folder: Path, suffixes: set[str]) -> list[Path]:
    """The file for each frame in the user's folder of maps: as many files as frames, in
    order (of each camera, in a folder like the footage's).
    """
    folders = ingest.sorted_folders(folder) if len(work.footage.cameras) > 1 else [folder]
    found = [
        p
        for d in folders
        for p in sorted(d.iterdir(), key=ingest.natural)
        if p.suffix.lower() in suffixes
    ]
    frames = work.manifest.frames
    if len(found) != len(frames):
        raise InputError(
            f"{folder}: {len(found)} maps for {len(frames)} frames; one per used frame, in order"
        )
    return found


def masks_step(work: Work) -> Step:
    """What moves, per frame. Training frames are judged by flow among training frames
    alone; held-out ones by all.
    """
    m, c = work.manifest, work.config
    given = isinstance(c.masks, Path) or work.gives("masks") is not None
    if given:
        moving = given_masks(work)
    else:
        found, valid, pairs = work.raw_flows
        train = np.array([f.split == "train" for f in m.frames])
        among = train[pairs].all(1)
        K, c2w = work.cameras()
        moving = geometric_mask(found[among], valid[among], pairs[among], work.equalized[0], K, c2w)
        if not train.all():
            moving[~train] = geometric_mask(found, valid, pairs, work.equalized[0], K, c2w)[~train]
        if c.masks == "sam2":
            moving = sam2_masks(work, moving)
    for f, mask in zip(m.frames, moving, strict=True):
        f.mask = f"masks/{f.index:05d}.png"
        write_png(work.folder / f.mask, mask)
    return Step(
        provenance="given" if given else "estimated",
        note=f"{moving.mean():.1%} of the pixels move",
        details={"source": "given" if given else c.masks or "motion"},
    )


def refined_flow_step(work: Work) -> Step:
    """Estimated flow once more where things move, from what moves alone, and where it
    is not sure, from what is around; given flow stays as it is.
    """
    m = work.manifest
    own = [
        (f.index, j) for f in m.frames for j in f.raw_flow if not flow_is_given(work, f.index, j)
    ]
    clipped = work.equalized[1]
    moving = np.stack([read_mask(work.folder / str(f.mask)) for f in m.frames])
    video, how = through_response(work, moving) if own else (work.equalized[0], "")
    ranges = [recorded_range(*frame) for frame in zip(video, clipped, strict=True)]
    names = {
        (i, j): FlowFiles(
            flow=f"refined_flow/{i:05d}_{j:05d}.npy",
            valid=f"refined_flow/{i:05d}_{j:05d}_valid.png",
        )
        for i, j in own
    }

    def mend(i: int, j: int) -> None:
        if all(
            (work.folder / n).is_file()
            for p in ((i, j), (j, i))
            for n in (names[p].flow, names[p].valid)
        ):
            return  # by a run that was killed
        seen = common_rgb(video, ranges, i, j), common_rgb(video, ranges, j, i)
        there, back = (
            refine_mover_flow(
                *pictures,
                read_npy(work.folder / m.frames[a].raw_flow[b].flow).astype(np.float32),
                moving[a] & ~clipped[a],
            )
            for pictures, (a, b) in zip(seen, ((i, j), (j, i)), strict=True)
        )
        a, b = common_gray(video, ranges, i, j)
        sure = (
            agreement(there, back, clipped[i], clipped[j]),
            agreement(back, there, clipped[j], clipped[i]),
        )
        there, back = (
            fill_uncertain_flow(there, back, a, b, clipped[i], clipped[j], moving[i]),
            fill_uncertain_flow(back, there, b, a, clipped[j], clipped[i], moving[j]),
        )
        write_flow(work, names[i, j], average_with_reverse(there, back), sure[0])
        write_flow(work, names[j, i], average_with_reverse(back, there), sure[1])

    in_threads(lambda pair: mend(*pair), [(i, j) for i, j in own if i < j], "flow of movers")
    for f in m.frames:
        f.flow = {j: names.get((f.index, j), files) for j, files in f.raw_flow.items()}
    for name in ("raw_flows", "refined_flows"):
        vars(work).pop(name, None)
    return Step(
        provenance="estimated" if own else "given",
        note=f"flow of what moves told by what moves alone in {len(own)} pairs{how}"
        if own
        else "flow that is given stays as it is",
    )


def through_response(work: Work, moving: np.ndarray) -> tuple[np.ndarray, str]:
    """All frames at one brightness (T, H, W, 3): through the response of their camera
    where matched flow tells it, else by the brackets' brightness; and how, in words.
    `moving` (T, H, W) bool.
    """
    frames, ev = work.manifest.frames, work.manifest.bracket_ev
    bracket, train = (
        np.array([f.bracket for f in frames]),
        np.array([f.split == "train" for f in frames]),
    )
    known, reference = ev or [None] * int(bracket.max() + 1), work.manifest.reference_bracket
    video, (flow, valid, pairs) = work.equalized[0].copy(), work.raw_flows
    cameras = [np.array(own) for own in work.camera_frames()]
    told = []
    for own in cameras:
        learn = own[train[own]]
        among = np.isin(pairs, learn).all(1)
        flows = flow[among], valid[among], np.searchsorted(learn, pairs[among])
        fit = response_from_flow(
            work.video[learn], bracket[learn], known, reference, flows, moving[learn]
        )
        if fit is not None:
            like = own[np.isin(bracket[own], bracket[learn])]
            video[like] = equalize_through_response(work.video[like], bracket[like], fit)
            told.append(fit.misfit)
    if told:
        where = (
            ""
            if len(told) == len(cameras)
            else f" in {len(told)} of {len(cameras)} cameras, else by brightness"
        )
        return (
            video,
            f", at one exposure through the response that flow tells{where} (misfit {max(told):.3f} stops)",
        )
    return (
        video,
        ", frames equalized by brightness: too few pixels at rest in several exposures"
        if len(set(bracket)) > 1
        else "",
    )


def flow_is_given(work: Work, i: int, j: int) -> bool:
    """Whether the flow between the frames `i` and `j` is the user's or the data set's,
    one way or both.
    """
    if isinstance(work.config.flow, Path) or work.gives("flow") is None:
        return isinstance(work.config.flow, Path)
    a, b = (work.manifest.frames[k] for k in (i, j))
    return b.source in work.picture(a).flow or a.source in work.picture(b).flow


def depth_step(work: Work) -> Step:
    """Disparity of the training frames and how far it can be believed."""
    m, c = work.manifest, work.config
    train = [f for f in m.frames if f.split == "train"]
    index = np.array([f.index for f in train])
    size = (m.height, m.width)
    m.depth_kind = "scene"
    capture = work.gives("depth")
    given = capture is not None or isinstance(c.depth, Path)
    details: dict[str, Any] = {"source": "given" if given else c.depth or "geometric"}
    if capture is not None:
        disparity, confidence, how = maps.disparities(
            capture, [work.picture(f) for f in train], size
        )
        m.depth_kind = "relative" if capture.depth_kind == "relative" else "scene"
        note = "; ".join(n for n in (f"given ({capture.depth_kind})", how) if n)
        if m.depth_kind == "scene" and capture.poses is not None and capture.poses.near is None:
            m.near, m.far = depth_range(disparity, confidence)
    elif isinstance(c.depth, Path):
        disparity, confidence = read_depth(
            given_files(work, c.depth, DEPTH_FILES), c.depth_kind, size
        )
        disparity, confidence = disparity[index], confidence[index]
        m.depth_kind = "relative" if c.depth_kind == "relative" else "scene"
        note = f"given ({c.depth_kind})"
    elif m.parallax != "full":
        disparity, confidence = (
            np.ones((len(train), *size), np.float32),
            np.ones((len(train), *size), np.float32),
        )
        note = "everything at distance 1: without parallax there is no depth to find"
    elif c.depth == "depth-anything":
        disparity, confidence, m.near, m.far, details["kind"] = network_depth(work, index)
        details["weights"] = c.depth_weights
        note = (
            f"{c.depth_weights} ({details['kind']}), near {m.near:.2f}, far {m.far:.2f} scene units"
        )
    else:
        disparity, confidence, m.near, m.far = dense_depth(work, index)
        note = f"{(confidence > 0.5).mean():.0%} of the pixels well known, near {m.near:.2f}, far {m.far:.2f} scene units"
    for f in m.frames:
        f.disparity = f.disparity_confidence = (
            None  # of a frame that is held out now and was not before
        )
    for f, d, w in zip(train, disparity, confidence, strict=True):
        f.disparity, f.disparity_confidence = (
            f"disparity/{f.index:05d}.npy",
            f"disparity_confidence/{f.index:05d}.npy",
        )
        write_npy(work.folder / f.disparity, d.astype(np.float16))
        write_npy(work.folder / f.disparity_confidence, w.astype(np.float16))
    return Step(provenance="given" if given else "estimated", note=note, details=details)


def dense_depth(work: Work, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Depth of the frames `index` (increasing) from those frames alone."""
    m = work.manifest
    frames = [m.frames[i] for i in index]
    found, valid, pairs = work.refined_flows
    among = np.isin(pairs, index).all(1)
    video, clipped = work.equalized
    K, c2w = work.cameras()
    return geometric_depth(
        K[index],
        c2w[index],
        found[among],
        valid[among],
        np.searchsorted(index, pairs[among]),
        np.stack([read_mask(work.folder / f.mask) for f in frames if f.mask is not None]),
        np.array(read_npy(work.folder / m.points)) if m.points else np.zeros((0, 3)),
        video[index],
        clipped[index],
        np.array([f.time for f in frames]),
    )


def sheet_step(work: Work) -> Step:
    """`contact_sheet.png`: a few training frames as recorded, equalized, with moving
    pixels red, flow to the next frame (from the last to the one before), and disparity.
    """
    m = work.manifest
    train = [f for f in m.frames if f.split == "train"]
    some = [train[k] for k in np.unique(np.linspace(0, len(train) - 1, 6).astype(int))]
    disparity = [
        read_npy(work.folder / f.disparity).astype(np.float32) for f in some if f.disparity
    ]
    low, high = (float(v) for v in np.percentile(np.stack(disparity), [1, 99]))
    rows: list[list[np.ndarray]] = [[], [], [], [], []]
    for f, d in zip(some, disparity, strict=True):
        shown = work.equalized[0][f.index]
        moving = read_mask(work.folder / f.mask) if f.mask else np.zeros(d.shape, bool)
        red = np.where(moving[..., None], 0.5 * shown + [0.5, 0, 0], shown)
        names = f.flow[max(f.flow)]
        flow_rgb = colorize_flow(read_npy(work.folder / names.flow).astype(np.float32))
        flow_rgb = np.where(read_mask(work.folder / names.valid)[..., None], flow_rgb, 0.25)
        for row, cell in zip(
            rows, (work.video[f.index], shown, red, flow_rgb, colorize(d, low, high)), strict=True
        ):
            row.append(cell.astype(np.float32))
    if m.parallax != "full":
        rows.pop()  # the same disparity everywhere
    write_png(work.folder / "contact_sheet.png", contact_sheet(rows))
    return Step(note="recorded, equalized, moving, flow (gray: not believed), disparity")
