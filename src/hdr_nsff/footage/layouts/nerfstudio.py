"""A scene folder -> nerfstudio's `transforms.json` with pictures, depth in millimeters,
and held-out frames and views as `test_filenames`.

What nerfstudio has no place for (exposures, times in frames, flow, moving masks,
confidence of the depth) stands under `hdr_nsff`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.io import write_json, write_npy
from hdr_nsff.footage.datasets.extra import ExtraFrame
from hdr_nsff.footage.datasets.nerfstudio import EXTRA, MILLIMETERS, NAME, VIEWS
from hdr_nsff.footage.layouts.writer import (
    HeldOutPicture,
    LayoutFiles,
    Source,
    copy,
    write_files,
    z_depth,
)
from hdr_nsff.footage.pose_formats import FROM_OPENGL
from hdr_nsff.scene.manifest import FrameEntry

VIEW_MASKS = "held_out_masks/"  # where the moving masks of held-out views go


def write(source: Source, out: Path, held_out: Sequence[HeldOutPicture] = ()) -> Path:
    """Write the layout into the folder `out`; InputError where that is not possible."""
    m = source.manifest
    names = {f.index: f"images/{f.index:05d}.png" for f in m.frames}
    clip_times = [f.time for f in m.frames]
    first = min(clip_times)
    length = max(max(clip_times) - first, 1e-9)  # frames
    files: LayoutFiles = {}
    entries, extras = [], {}
    for view in held_out:
        name = f"{VIEWS}{view.name}.png"
        files |= view_files(view, name)
        entries.append(pose_entry(name, view.K, view.c2w, (view.time - first) / length))
        extras[name] = view_extra(view)
    for frame in m.frames:
        name = names[frame.index]
        files |= frame_files(source, frame, name)
        entries.append(frame_entry(source, frame, name, (frame.time - first) / length))
        extras[name] = frame_extra(frame, names)
    extra = source.extra(extras)
    if source.points is not None:
        files["points.npy"] = partial(write_npy, array=source.points)
        extra = extra.model_copy(update={"points": "points.npy"})
    trained = [names[f.index] for f in m.frames if f.split == "train"]
    tested = [names[f.index] for f in m.frames if f.split == "test"]
    tested += [f"{VIEWS}{view.name}.png" for view in held_out]
    document = {
        "camera_model": "OPENCV",
        "w": m.width,
        "h": m.height,
        "train_filenames": trained,
        "val_filenames": tested,
        "test_filenames": tested,
        "frames": entries,
        EXTRA: extra.model_dump(),
    }
    files[NAME] = partial(write_json, value=document)  # last: with it the export is whole
    write_files(out, "nerfstudio", source.folder, files)
    return out


def frame_files(source: Source, frame: FrameEntry, name: str) -> LayoutFiles:
    """The picture of a frame and its maps; those keep the names of the scene."""
    files: LayoutFiles = {name: partial(copy, source.file(frame.image))}
    maps = [frame.disparity, frame.disparity_confidence, frame.mask]
    for flow in frame.flow.values():
        maps += [flow.valid, flow.flow]
    for own in maps:
        if own is not None:
            files[own] = partial(copy, source.file(own))
    if has_depth(source, frame):
        files[depth_name(frame)] = partial(write_depth, source, frame)
    return files


def view_files(view: HeldOutPicture, name: str) -> LayoutFiles:
    """The picture of a held-out view, and its mask where it has one."""
    files: LayoutFiles = {name: view.write}
    if view.mask is not None:
        files[f"{VIEW_MASKS}{view.name}.png"] = partial(copy, view.mask)
    return files


def has_depth(source: Source, frame: FrameEntry) -> bool:
    """Whether the depth of a frame is known in the units of the poses."""
    return frame.disparity is not None and source.manifest.depth_kind == "scene"


def depth_name(frame: FrameEntry) -> str:
    """The depth map of a frame, in millimeters."""
    return f"depth/{frame.index:05d}.npy"


def write_depth(source: Source, frame: FrameEntry, path: Path) -> None:
    """Write the z-depth (H, W) float32 of a frame; a unit of the poses is 1000."""
    disparity = source.disparity(frame)
    assert disparity is not None, frame.index
    write_npy(path, np.float32(MILLIMETERS) * z_depth(disparity))


def frame_entry(source: Source, frame: FrameEntry, name: str, time: float) -> dict[str, Any]:
    """A frame as nerfstudio lists it, with its depth; `time` from 0 to 1."""
    entry = pose_entry(name, np.array(frame.K), np.array(frame.c2w), time)
    if has_depth(source, frame):
        entry["depth_file_path"] = depth_name(frame)
    return entry


def pose_entry(name: str, K: np.ndarray, c2w: np.ndarray, time: float) -> dict[str, Any]:
    """A picture with its camera: K (3, 3), c2w (3, 4) OpenCV."""
    opengl = np.concatenate([c2w[:, :3] @ FROM_OPENGL, c2w[:, 3:]], 1)
    matrix = np.concatenate([opengl, [[0, 0, 0, 1]]])
    return {
        "file_path": name,
        "transform_matrix": matrix.tolist(),
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "time": time,
    }


def view_extra(view: HeldOutPicture) -> ExtraFrame:
    """What nerfstudio has no place for of a held-out view."""
    mask = None if view.mask is None else f"{VIEW_MASKS}{view.name}.png"
    return ExtraFrame(time=view.time, camera_id=view.camera_id, bracket=view.bracket, moving=mask)


def frame_extra(frame: FrameEntry, names: dict[int, str]) -> ExtraFrame:
    """What nerfstudio has no place for of a frame; `names` of the pictures by index."""
    return ExtraFrame(
        time=frame.time,
        camera_id=frame.camera_id + frame.track,  # tracks become cameras
        bracket=frame.bracket,
        flow={names[to]: files.flow for to, files in frame.flow.items()},
        disparity=frame.disparity,
        confidence=frame.disparity_confidence,
        moving=frame.mask,
    )
