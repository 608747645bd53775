"""A scene folder -> the HDR-GoPro / NSFF layout (LLFF), as `llff.py` describes it:
training frames in time, and what a truth folder keeps back.

The layout has one focal length and a principal point at the center, one picture per
time, and no place for exposures and trust in the depth: `dense/hdr_nsff.json` and
`dense/disp_confidence/` hold those, and other readers pass over them. Held-out views it
knows from the poses of training pictures (camera k stands where training picture k - 1
does), at their times and half-way to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import atomic, read_npy, write_json, write_npy
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage.datasets.capture import ExtraFrame, ExtraView
from hdr_nsff.footage.datasets.llff import MULTI_VIEW, NOTE
from hdr_nsff.footage.layouts import colmap as to_colmap
from hdr_nsff.footage.layouts.writer import HeldOutPicture, Source, claim, copy, z_depth
from hdr_nsff.footage.pose_files import FROM_LLFF
from hdr_nsff.scene.manifest import FrameEntry

SAME_TIME = 1e-6  # frames


def write(source: Source, out: Path, held_out: Sequence[HeldOutPicture] = ()) -> Path:
    """Write the layout into `out`/dense and `out`/masks. InputError for a scene that it
    cannot hold.
    """
    scene, m = source.folder, source.manifest
    frames = sorted((f for f in m.frames if f.split == "train"), key=lambda f: f.time)
    if len({f.time for f in frames}) < len(frames):
        raise InputError(
            f"{scene}: several cameras record at one time, and the HDR-GoPro layout holds one picture per time; use --layout nerfstudio"
        )
    claim(out, "hdr-gopro", scene)
    if len(frames) < len(m.frames):
        say(
            f"{out}: the layout has no place for the {len(m.frames) - len(frames)} frames that the scene holds out of training: left out"
        )
    dense = out / "dense"
    views = write_held_out(frames, held_out, dense)
    for i, f in enumerate(track(frames, "exporting")):
        write_frame(source, f, i, out)
        for j, side in ((i + 1, "fwd"), (i - 1, "bwd")):
            if 0 <= j < len(frames):
                write_flow(source, f, frames[j], dense / f"flow_i1/{i:05d}_{side}.npz")
    write_poses(source, frames, dense)
    own = {
        f"{i:05d}.png": ExtraFrame(time=f.time, camera_id=f.camera_id, bracket=f.bracket, K=f.K)
        for i, f in enumerate(frames)
    }
    write_json(
        dense / NOTE, (source.extra(own).model_copy(update={"held_out": views})).model_dump()
    )
    return out


def write_held_out(
    frames: Sequence[FrameEntry], views: Sequence[HeldOutPicture], dense: Path
) -> dict[str, ExtraView]:
    """Write the held-out views that the layout has a place for, and their masks; what
    it cannot say of them, by their pictures' names. Says which have none. `frames` are
    the training pictures in order.
    """
    noted: dict[str, ExtraView] = {}
    lost = []
    for view in track(views, "held-out views"):
        camera, place = camera_of(frames, view), step_of(frames, view.time)
        name = None if camera is None or place is None else f"{place}/{camera + 1:05d}.png"
        if camera is None or name is None or name in noted:
            lost.append(view.name)
            continue
        view.write(dense / name)
        mask = None if view.mask is None else name.replace("images", "masks")
        if view.mask is not None and mask is not None:
            copy(view.mask, dense / mask)
        noted[name] = ExtraView(
            name=view.name,
            time=view.time,
            bracket=view.bracket,
            anchor=f"{camera:05d}.png",
            mask=mask,
        )
    if lost:
        say(
            f"{dense}: left out {len(lost)} of {len(views)} held-out views ({', '.join(lost)}): the layout has a place for one view from the pose of "
            "a training picture at the time of one or half-way to the next; --layout nerfstudio takes all"
        )
    return noted


def camera_of(frames: Sequence[FrameEntry], view: HeldOutPicture) -> int | None:
    """The first of the training pictures that has exactly the pose and intrinsics of a
    view; of a rig that is its camera, from 0.
    """
    same = (
        i
        for i, f in enumerate(frames)
        if np.array_equal(np.array(f.c2w), view.c2w) and np.array_equal(np.array(f.K), view.K)
    )
    return next(same, None)


def step_of(frames: Sequence[FrameEntry], time: float) -> str | None:
    """The folder of views at a `time`: that of a training picture, or half-way to the
    next.
    """
    times = np.array([f.time for f in frames])
    for name, steps in zip(MULTI_VIEW, (times, (times[1:] + times[:-1]) / 2), strict=True):
        if len(found := np.flatnonzero(np.abs(steps - time) < SAME_TIME)):
            return f"{name}/{found[0]:05d}"
    return None


def write_frame(source: Source, f: FrameEntry, i: int, out: Path) -> None:
    """The picture, masks and depth of a frame, as number `i`."""
    m, dense = source.manifest, out / "dense"
    copy(source.file(f.image), dense / f"images/{i:05d}.png")
    copy(source.file(f.image), dense / f"images_{m.width}x{m.height}/{i:05d}.png")
    if f.mask is not None:
        moving = read_mask(source.file(f.mask))
        write_png(dense / f"motion_masks/{i:05d}.png", moving)
        write_png(out / f"masks/{i:05d}.png", ~moving)
    disparity = source.disparity(f)
    if disparity is None:
        return
    write_npy(dense / f"disp/{i:05d}.npy", disparity.astype(np.float32))
    if m.depth_kind == "scene":
        write_npy(dense / f"depth-anything/{i:05d}.npy", z_depth(disparity))
    if f.disparity_confidence is not None:
        trust = np.array(read_npy(source.file(f.disparity_confidence)), np.float32)
        write_npy(dense / f"disp_confidence/{i:05d}.npy", trust)


def write_flow(source: Source, f: FrameEntry, to: FrameEntry, path: Path) -> None:
    """`flow` (H, W, 2) px and `mask` (H, W) to a neighbor, float32."""
    if to.index not in f.flow:
        raise InputError(
            f"{source.folder}: no flow from frame {f.index} to frame {to.index}; run `hdr-nsff prepare` again"
        )
    files = f.flow[to.index]
    flow = np.array(read_npy(source.file(files.flow)), np.float32)
    buffer = BytesIO()
    np.savez_compressed(
        buffer, flow=flow, mask=read_mask(source.file(files.valid)).astype(np.float32)
    )
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def write_poses(source: Source, frames: list[FrameEntry], dense: Path) -> None:
    """`poses_bounds.npy`, and `sparse/` where the scene has static points. Bounds are
    the 5th and 95th percentile of the depth of the points that a frame sees, else the
    scene's near and far.
    """
    m = source.manifest
    K, c2w = (
        np.array([f.K for f in frames], np.float64),
        np.array([f.c2w for f in frames], np.float64),
    )
    centered = np.abs(K[:, :2, 2] - [m.width / 2, m.height / 2]).max()
    if max(centered, np.abs(K[:, 0, 0] - K[:, 1, 1]).max()) > 0.5:
        say(
            "the layout has one focal length and a centered principal point: exact only in dense/hdr_nsff.json and dense/sparse"
        )
    views = []
    if source.points is not None:
        for f, k, pose in zip(frames, K, c2w, strict=True):
            disparity = source.disparity(f)
            assert disparity is not None, f.index
            views.append(to_colmap.seen(source.points, k, pose, disparity.astype(np.float32)))
        names = [f"{i:05d}.png" for i in range(len(frames))]
        to_colmap.write_model(
            dense / "sparse", names, K, c2w, (m.height, m.width), source.points, views
        )
    bounds = [
        np.percentile(v.depth, [5, 95]) if len(v.depth) >= 10 else [m.near, m.far] for v in views
    ]
    last = np.stack([np.full(len(K), m.height), np.full(len(K), m.width), K[:, 0, 0]], -1)
    rotation = c2w[:, :, :3] @ np.linalg.inv(FROM_LLFF)
    matrices = np.concatenate([rotation, c2w[:, :, 3:], last[:, :, None]], 2)  # (N, 3, 5)
    table = np.concatenate([matrices.reshape(-1, 15), bounds or [[m.near, m.far]] * len(K)], 1)
    write_npy(dense / "poses_bounds.npy", table.astype(np.float64))
