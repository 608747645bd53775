"""A scene folder -> nerfstudio's `transforms.json` with pictures, depth in millimeters
and held-out frames and views as `test_filenames`. What nerfstudio has no word for
(exposures, times in frames, flow, moving masks, trust in the depth) stands under
`hdr_nsff`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.io import write_json, write_npy
from hdr_nsff.core.progress import track
from hdr_nsff.footage.datasets.capture import ExtraFrame
from hdr_nsff.footage.datasets.nerfstudio import EXTRA, MILLIMETERS, NAME, VIEWS
from hdr_nsff.footage.layouts.writer import HeldOutPicture, Source, claim, copy, z_depth
from hdr_nsff.footage.pose_files import FROM_OPENGL
from hdr_nsff.scene.manifest import FrameEntry


def write(source: Source, out: Path, held_out: Sequence[HeldOutPicture] = ()) -> Path:
    """Write the layout into the folder `out`."""
    claim(out, "nerfstudio", source.folder)
    m = source.manifest
    names = {f.index: f"images/{f.index:05d}.png" for f in m.frames}
    times = [f.time for f in m.frames]
    first, length = min(times), max(max(times) - min(times), 1e-9)
    frames, own = [], {}
    for view in track(held_out, "held-out views"):
        name = f"{VIEWS}{view.name}.png"
        view.write(out / name)
        frames.append(pose_entry(name, view.K, view.c2w, (view.time - first) / length))
        own[name] = view_entry(view, out)
    views = list(own)
    for f in track(m.frames, "exporting"):
        copy(source.file(f.image), out / names[f.index])
        frames.append(frame_entry(source, f, out, names[f.index], (f.time - first) / length))
        own[names[f.index]] = extra_entry(source, f, out, names)
    extra = source.extra(own)
    if source.points is not None:
        write_npy(out / "points.npy", source.points)
        extra = extra.model_copy(update={"points": "points.npy"})
    listed = {s: [names[f.index] for f in m.frames if f.split == s] for s in ("train", "test")}
    listed["test"] += views
    document = {
        "camera_model": "OPENCV",
        "w": m.width,
        "h": m.height,
        "train_filenames": listed["train"],
        "val_filenames": listed["test"],
        "test_filenames": listed["test"],
        "frames": frames,
        EXTRA: extra.model_dump(),
    }
    write_json(out / NAME, document)
    return out


def frame_entry(source: Source, f: FrameEntry, out: Path, name: str, time: float) -> dict[str, Any]:
    """A frame in nerfstudio's words, with its depth."""
    entry = pose_entry(name, np.array(f.K), np.array(f.c2w), time)
    disparity = source.disparity(f)
    if disparity is not None and source.manifest.depth_kind == "scene":
        entry["depth_file_path"] = f"depth/{f.index:05d}.npy"
        write_npy(out / f"depth/{f.index:05d}.npy", np.float32(MILLIMETERS) * z_depth(disparity))
    return entry


def pose_entry(name: str, K: np.ndarray, c2w: np.ndarray, time: float) -> dict[str, Any]:
    """A picture with its camera: K (3, 3), c2w (3, 4)."""
    matrix = np.concatenate(
        [np.concatenate([c2w[:, :3] @ FROM_OPENGL, c2w[:, 3:]], 1), [[0, 0, 0, 1]]]
    )
    return {
        "file_path": name,
        "transform_matrix": matrix.tolist(),
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "time": time,
    }


def view_entry(view: HeldOutPicture, out: Path) -> ExtraFrame:
    """A held-out view in our words; its mask is copied."""
    mask = None if view.mask is None else f"held_out_masks/{view.name}.png"
    if view.mask is not None and mask is not None:
        copy(view.mask, out / mask)
    return ExtraFrame(time=view.time, camera_id=view.camera_id, bracket=view.bracket, moving=mask)


def extra_entry(source: Source, f: FrameEntry, out: Path, names: dict[int, str]) -> ExtraFrame:
    """A frame in our words; its maps are copied."""

    def copied(name: str | None) -> str | None:
        if name is not None:
            copy(source.file(name), out / name)
        return name

    for files in f.flow.values():
        copied(files.valid)
    return ExtraFrame(
        time=f.time,
        camera_id=f.camera_id,
        bracket=f.bracket,
        flow={names[to]: str(copied(files.flow)) for to, files in f.flow.items()},
        disparity=copied(f.disparity),
        confidence=copied(f.disparity_confidence),
        moving=copied(f.mask),
    )
