"""A scene folder -> the HDR-GoPro / NSFF layout (LLFF), as `datasets/llff.py` describes
it: training frames in time, and held-out views of a truth folder.

The layout has one focal length and a principal point at the center, one picture per
time, and no place for exposures and for confidence of the depth:
`dense/hdr_nsff.json` and `dense/disp_confidence/` hold those, and other readers pass
over them. Held-out views have the poses of training pictures (camera k stands where
training picture k - 1 does), and the times of these or half-way to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import atomic, read_npy, write_json, write_npy
from hdr_nsff.core.progress import say
from hdr_nsff.footage.datasets.extra import ExtraFrame, ExtraView
from hdr_nsff.footage.datasets.llff import MULTI_VIEW, NOTE
from hdr_nsff.footage.layouts.colmap import VisiblePoints, model_files, visible_points
from hdr_nsff.footage.layouts.writer import (
    HeldOutPicture,
    LayoutFiles,
    Source,
    copy,
    write_files,
    z_depth,
)
from hdr_nsff.footage.pose_formats import FROM_LLFF
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry

SAME_TIME = 1e-6  # frames: times closer than that are one
MAX_OFFSET_PX = 0.5  # by which intrinsics may differ from the layout's unreported
MIN_POINTS = 10  # visible points from which a frame's depth bounds are taken


def write(source: Source, out: Path, held_out: Sequence[HeldOutPicture] = ()) -> Path:
    """Write the layout into `out`/dense and `out`/masks.

    InputError for a scene that it cannot hold.
    """
    m = source.manifest
    frames = sorted((f for f in m.frames if f.split == "train"), key=lambda f: f.time)
    if len({f.time for f in frames}) < len(frames):
        raise InputError(
            f"{source.folder}: several cameras record at one time, and the HDR-GoPro layout "
            "holds one picture per time; use --layout nerfstudio"
        )
    lost = len(m.frames) - len(frames)
    if lost:
        say(
            f"{out}: the layout has no place for the {lost} frames that the scene holds "
            "out of training: left out"
        )
    files: LayoutFiles = {}
    extras = {}
    for number, frame in enumerate(frames):
        files |= frame_files(source, frame, number)
        files |= flow_files(source, frames, number)
        extras[f"{number:05d}.png"] = ExtraFrame(
            time=frame.time, camera_id=frame.camera_id, bracket=frame.bracket, K=frame.K
        )
    files |= pose_files(source, frames)
    views = place_views(out, frames, held_out)
    view_extras = {}
    for name, (camera, view) in views.items():
        files |= view_files(view, name)
        view_extras[name] = view_extra(view, name, camera)
    extra = source.extra(extras).model_copy(update={"held_out": view_extras})
    # last: with it the export is whole
    files[f"dense/{NOTE}"] = partial(write_json, value=extra.model_dump())
    write_files(out, "hdr-gopro", source.folder, files)
    return out


# Frames


def frame_files(source: Source, frame: FrameEntry, number: int) -> LayoutFiles:
    """The picture, masks and depth of a frame as training picture `number`."""
    m = source.manifest
    picture = partial(copy, source.file(frame.image))
    files: LayoutFiles = {
        f"dense/images/{number:05d}.png": picture,
        f"dense/images_{m.width}x{m.height}/{number:05d}.png": picture,
    }
    if frame.mask is not None:
        mask = source.file(frame.mask)
        files[f"dense/motion_masks/{number:05d}.png"] = partial(write_moving, mask)
        files[f"masks/{number:05d}.png"] = partial(write_static, mask)
    if frame.disparity is None:
        return files
    disparity = source.file(frame.disparity)
    files[f"dense/disp/{number:05d}.npy"] = partial(write_single, disparity)
    if m.depth_kind == "scene":
        files[f"dense/depth-anything/{number:05d}.npy"] = partial(write_depth, disparity)
    if frame.disparity_confidence is not None:
        confidence = source.file(frame.disparity_confidence)
        files[f"dense/disp_confidence/{number:05d}.npy"] = partial(write_single, confidence)
    return files


def write_moving(mask: Path, path: Path) -> None:
    """Write a moving mask, moving = white."""
    write_png(path, read_mask(mask))


def write_static(mask: Path, path: Path) -> None:
    """Write a moving mask, moving = black, as structure from motion takes it."""
    write_png(path, ~read_mask(mask))


def write_single(array: Path, path: Path) -> None:
    """Write a map of the scene in single precision."""
    write_npy(path, np.array(read_npy(array), np.float32))


def write_depth(disparity: Path, path: Path) -> None:
    """Write the z-depth of a disparity map, scene units."""
    write_npy(path, z_depth(np.array(read_npy(disparity))))


def flow_files(source: Source, frames: Sequence[FrameEntry], number: int) -> LayoutFiles:
    """The flow of training picture `number` to the next and the previous one."""
    frame = frames[number]
    files: LayoutFiles = {}
    for neighbor, side in ((number + 1, "fwd"), (number - 1, "bwd")):
        if not 0 <= neighbor < len(frames):
            continue
        to = frames[neighbor].index
        if to not in frame.flow:
            raise InputError(
                f"{source.folder}: no flow from frame {frame.index} to frame {to}; "
                "run `hdr-nsff prepare` again"
            )
        name = f"dense/flow_i1/{number:05d}_{side}.npz"
        files[name] = partial(write_flow, source, frame.flow[to])
    return files


def write_flow(source: Source, files: FlowFiles, path: Path) -> None:
    """Write `flow` (H, W, 2) px and `mask` (H, W), float32."""
    flow = np.array(read_npy(source.file(files.flow)), np.float32)
    mask = read_mask(source.file(files.valid)).astype(np.float32)
    buffer = BytesIO()
    np.savez_compressed(buffer, flow=flow, mask=mask)
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getbuffer())


# Poses


def pose_files(source: Source, frames: Sequence[FrameEntry]) -> LayoutFiles:
    """`poses_bounds.npy`, and `sparse/` where the scene has static points."""
    m = source.manifest
    K = np.array([f.K for f in frames], np.float64)
    c2w = np.array([f.c2w for f in frames], np.float64)
    off_center = np.abs(K[:, :2, 2] - [m.width / 2, m.height / 2]).max()
    off_square = np.abs(K[:, 0, 0] - K[:, 1, 1]).max()
    if max(off_center, off_square) > MAX_OFFSET_PX:
        say(
            "the layout has one focal length and a centered principal point: "
            "exact only in dense/hdr_nsff.json and dense/sparse"
        )
    files: LayoutFiles = {}
    bounds = np.tile([m.near, m.far], (len(frames), 1))
    if source.points is not None:
        views = [visible_in(source, source.points, f) for f in frames]
        names = [f"{number:05d}.png" for number in range(len(frames))]
        model = model_files(names, K, c2w, (m.height, m.width), source.points, views)
        for name, data in model.items():
            files[f"dense/sparse/{name}"] = partial(write_bytes, data)
        bounds = np.array([depth_bounds(source, view) for view in views])
    table = llff_table(K, c2w, (m.height, m.width), bounds)
    files["dense/poses_bounds.npy"] = partial(write_npy, array=table)
    return files


def visible_in(source: Source, points: np.ndarray, frame: FrameEntry) -> VisiblePoints:
    """The static `points` (P, 3) that a frame sees."""
    disparity = source.disparity(frame)
    assert disparity is not None, frame.index
    K = np.array(frame.K, np.float64)
    c2w = np.array(frame.c2w, np.float64)
    return visible_points(points, K, c2w, disparity.astype(np.float32))


def depth_bounds(source: Source, view: VisiblePoints) -> tuple[float, float]:
    """The 5th and 95th percentile of the depth of the points that a frame sees.

    Near and far of the scene where it sees too few.
    """
    m = source.manifest
    assert m.near is not None and m.far is not None, "`Scene.open` refuses this"
    if len(view.depth) < MIN_POINTS:
        return m.near, m.far
    near, far = np.percentile(view.depth, [5, 95])
    return float(near), float(far)


def llff_table(
    K: np.ndarray, c2w: np.ndarray, size: tuple[int, int], bounds: np.ndarray
) -> np.ndarray:
    """Rows (N, 17) of `poses_bounds.npy`.

    A 3x5 matrix with the columns down, right, back, center, (height, width, focal);
    then the depth `bounds` (N, 2).
    """
    height, width = size
    rotation = c2w[:, :, :3] @ np.linalg.inv(FROM_LLFF)
    heights = np.full(len(K), height)
    widths = np.full(len(K), width)
    last = np.stack([heights, widths, K[:, 0, 0]], -1)[:, :, None]
    matrices = np.concatenate([rotation, c2w[:, :, 3:], last], 2)  # (N, 3, 5)
    return np.concatenate([matrices.reshape(-1, 15), bounds], 1).astype(np.float64)


def write_bytes(data: bytes, path: Path) -> None:
    """Write a file, atomically."""
    with atomic(path) as temporary:
        temporary.write_bytes(data)


# Held-out views


def place_views(
    out: Path, frames: Sequence[FrameEntry], views: Sequence[HeldOutPicture]
) -> dict[str, tuple[int, HeldOutPicture]]:
    """The held-out views that the layout has a place for, with their camera.

    They go by the names of their pictures below `dense/`; `frames` are the training
    pictures in order. Prints which have no place.
    """
    placed: dict[str, tuple[int, HeldOutPicture]] = {}
    lost = []
    for view in views:
        camera = camera_of(frames, view)
        step = step_of(frames, view.time)
        name = f"{step}/{camera + 1:05d}.png" if camera is not None else ""
        if camera is None or step is None or name in placed:
            lost.append(view.name)
        else:
            placed[name] = camera, view
    if lost:
        say(
            f"{out / 'dense'}: left out {len(lost)} of {len(views)} held-out views "
            f"({', '.join(lost)}): the layout holds one view per pose of a training picture "
            "and per time, of a training picture or half-way to the next; "
            "--layout nerfstudio takes all"
        )
    return placed


def camera_of(frames: Sequence[FrameEntry], view: HeldOutPicture) -> int | None:
    """The first training picture that has exactly the pose and intrinsics of a view.

    In a rig that is its camera, from 0. None where there is none.
    """
    for number, frame in enumerate(frames):
        same_pose = np.array_equal(np.array(frame.c2w), view.c2w)
        if same_pose and np.array_equal(np.array(frame.K), view.K):
            return number
    return None


def step_of(frames: Sequence[FrameEntry], time: float) -> str | None:
    """The folder of views at a `time`; None where there is none.

    It is that of a training picture, or half-way to the next.
    """
    times = np.array([f.time for f in frames])
    between = (times[1:] + times[:-1]) / 2
    for folder, steps in zip(MULTI_VIEW, (times, between), strict=True):
        found = np.flatnonzero(np.abs(steps - time) < SAME_TIME)
        if len(found):
            return f"{folder}/{found[0]:05d}"
    return None


def view_files(view: HeldOutPicture, name: str) -> LayoutFiles:
    """The picture of a held-out view as `name` below `dense/`, and its mask."""
    files: LayoutFiles = {f"dense/{name}": view.write}
    if view.mask is not None:
        files[f"dense/{mask_name(name)}"] = partial(copy, view.mask)
    return files


def view_extra(view: HeldOutPicture, name: str, camera: int) -> ExtraView:
    """What the layout has no place for of a held-out view."""
    return ExtraView(
        name=view.name,
        time=view.time,
        bracket=view.bracket,
        anchor=f"{camera:05d}.png",
        mask=None if view.mask is None else mask_name(name),
    )


def mask_name(name: str) -> str:
    """The moving mask of a held-out picture."""
    return name.replace("images", "masks")
