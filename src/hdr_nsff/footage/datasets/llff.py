"""HDR-GoPro / NSFF layout (LLFF poses): under `<scene>/dense/` the pictures,
`poses_bounds.npy` (c2w columns down, right, back), and where they are there moving
masks, depth and optical flow. Cameras take turns: training picture i is of camera i mod
C, and stands at time i. Held out (opened by `held_out.py` alone):
`mv_images/<time>/<camera>.png`, `mv_images_time/`, `mv_masks/`; of sets that `export`
wrote only the ones that `hdr_nsff.json` lists.

The pictures are those of `images_<W>x<H>/` (the largest), else of `images/`. Maps of
another size are resampled. Flow is that of `semantic_flow_i1/` before `flow_i1/`; depth
that of `depth-anything/` (metric) before `disp/` (disparity up to scale and shift),
brought to the units of the poses by the points of `sparse/`. No exposure times are
stored: brightness tells the exposures apart.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.colmap import ColmapModel, read_model
from hdr_nsff.footage.datasets.capture import (
    Capture,
    Extra,
    Picture,
    Sighting,
    parse_extra,
    same_number,
    source_of,
)
from hdr_nsff.footage.ingest import frame_files, natural
from hdr_nsff.footage.pose_formats import GivenPoses, llff_rows, llff_table

FLOWS = ("semantic_flow_i1", "flow_i1")
MULTI_VIEW = ("mv_images", "mv_images_time")
NOTE = "hdr_nsff.json"  # beside poses_bounds.npy where `export` wrote the folder
TRUSTED = 1.5  # pixels of reprojection error up to which a point of `sparse/` counts
SHORTEST = 3  # pictures that must see it
SIZED = re.compile(r"images_(\d+)x(\d+)")


def dense_folder(folder: Path) -> Path:
    """`dense/` inside the scene, or the folder itself."""
    return folder / "dense" if (folder / "dense").is_dir() else folder


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    dense = dense_folder(folder)
    if (dense / "poses_bounds.npy").is_file():
        return bool(picture_folders(dense))
    return (
        dense.name == "dense"
        and bool(picture_folders(dense))
        and any((dense / n).is_dir() for n in (*FLOWS, "motion_masks"))
    )


def picture_folders(dense: Path) -> list[Path]:
    """Where pictures are: sized folders, largest first, then `images/`."""
    sized = [
        (int(m[1]) * int(m[2]), p)
        for p in dense.iterdir()
        if p.is_dir() and (m := SIZED.fullmatch(p.name))
    ]
    plain = [dense / "images"] if (dense / "images").is_dir() else []
    return [p for _, p in sorted(sized, reverse=True)] + plain


def read(folder: Path) -> Capture:
    """The training pictures with what the set gives of them; InputError where something
    is missing or short.
    """
    dense = dense_folder(folder)
    given, bounds = poses(dense)
    count = len(given.c2w)
    files = pictures(dense)
    if len(files) != count:
        raise InputError(
            f"{files[0].parent}: {len(files)} pictures, but poses_bounds.npy holds the camera poses of {count}; copy both again"
        )
    root = folder
    names = [source_of(root, f) for f in files]
    extra = noted(dense, [f.name for f in files])
    masks, white_moves = moving_masks(folder, dense, count)
    depth, kind = depth_maps(dense, count, extra)
    trust = (
        listed(dense / "disp_confidence", ".npy", count, "how far the disparity is to be believed")
        if extra
        else None
    )
    flow, flow_notes = flow_maps(dense, names)
    model = sparse_model(dense)
    entries = [
        Picture(
            n,
            float(i),
            mask=at(masks, i),
            depth=at(depth, i),
            confidence=at(trust, i),
            flow=flow[i],
        )
        for i, n in enumerate(names)
    ]
    capture = Capture(
        layout="HDR-GoPro / NSFF (LLFF)",
        root=root,
        pictures=entries,
        poses=replace(given, names=names),
        withheld=bool(extra and extra.held_out)
        or any(multi_view(folder, n) is not None for n in MULTI_VIEW),
        white_moves=white_moves,
        depth_kind="disparity" if kind == "disparity" else "metric",
        depth_units="own",
        sightings={n: s for n, s in zip(names, sightings(model, files, bounds), strict=True)},
        points=model.points if extra and model else trusted(model),
        notes=(
            f"pictures of {files[0].parent.name}/",
            *flow_notes,
            *([f"depth of {depth[0].parent.name}/"] if depth else []),
        ),
    )
    return with_note(capture, extra, [f.name for f in files]) if extra else capture


def at(files: list[Path] | None, i: int) -> Path | None:
    """The file of picture `i`."""
    return files[i] if files is not None else None


def with_note(capture: Capture, extra: Extra, names: list[str]) -> Capture:
    """Times, exposures, intrinsics and range as `export` noted them."""
    own = [extra.frames[n] for n in names]
    assert capture.poses is not None
    K = np.stack(
        [k if e.K is None else np.array(e.K) for k, e in zip(capture.poses.K, own, strict=True)]
    )
    entries = [
        replace(p, time=e.time, camera_id=e.camera_id, bracket=e.bracket)
        for p, e in zip(capture.pictures, own, strict=True)
    ]
    return replace(
        capture,
        layout="HDR-GoPro / NSFF (LLFF), written by hdr-nsff",
        pictures=entries,
        poses=replace(capture.poses, K=K, near=extra.near, far=extra.far),
        white_moves=True,
        depth_kind="disparity" if extra.depth_kind == "scene" else "relative",
        depth_units="scene",
        exposures=extra.exposures(),
        fps=extra.fps,
    )


def poses(dense: Path) -> tuple[GivenPoses, np.ndarray]:
    """The poses, and the near and far bounds (N, 2) of every picture."""
    path = dense / "poses_bounds.npy"
    if not path.is_file():
        raise InputError(f"{path}: missing; it holds the camera poses, copy it again")
    table = llff_table(path, 17)
    return llff_rows(table), table[:, 15:]


def pictures(dense: Path) -> list[Path]:
    """The training pictures in order."""
    folder = picture_folders(dense)[0]
    files = frame_files(folder)
    if not files:
        raise InputError(
            f"{folder}: no pictures in it; it holds the training pictures, copy them again"
        )
    return files


def noted(dense: Path, names: list[str]) -> Extra | None:
    """What `export` noted, if it wrote the folder."""
    path = dense / NOTE
    if not path.is_file():
        return None
    try:
        value = read_json(path)
    except ValueError as error:
        raise InputError(f"{path}: not readable JSON ({error}); export again") from error
    return parse_extra(path, value, names)


def listed(folder: Path, suffix: str, count: int, purpose: str) -> list[Path] | None:
    """The maps in a folder, one per picture; None where it does not exist."""
    if not folder.is_dir():
        return None
    return same_number(
        folder,
        sorted((p for p in folder.iterdir() if p.suffix == suffix), key=natural),
        count,
        purpose,
    )


def moving_masks(folder: Path, dense: Path, count: int) -> tuple[list[Path] | None, bool]:
    """The moving masks, and whether what moves is white: `motion_masks/`, else `masks/`
    beside `dense/`, where it is black.
    """
    found = listed(dense / "motion_masks", ".png", count, "the moving masks, moving = white")
    if found is not None or dense == folder:
        return found, True
    return listed(
        folder / "masks", ".png", count, "the masks that structure from motion used, moving = black"
    ), False


def depth_maps(dense: Path, count: int, extra: Extra | None) -> tuple[list[Path] | None, str]:
    """The depth maps and what they hold. Of our own export the disparity, which is
    exactly what the scene had.
    """
    metric = listed(dense / "depth-anything", ".npy", count, "the metric depth of the pictures")
    disparity = listed(dense / "disp", ".npy", count, "the disparity of the pictures")
    if metric is not None and not (extra and disparity):
        return metric, "metric"
    return disparity, "disparity"


def flow_maps(dense: Path, names: list[str]) -> tuple[list[dict[str, Path]], list[str]]:
    """Per picture the flow to its neighbors, and which folder it is from."""
    folder = next((dense / n for n in FLOWS if (dense / n).is_dir()), None)
    flow: list[dict[str, Path]] = [{} for _ in names]
    if folder is None:
        return flow, []
    for i in range(len(names)):
        for j, side in ((i + 1, "fwd"), (i - 1, "bwd")):
            if not 0 <= j < len(names):
                continue
            path = folder / f"{i:05d}_{side}.npz"
            if not path.is_file():
                raise InputError(
                    f"{path}: missing; it holds the optical flow from picture {i} to {j}, copy it again"
                )
            flow[i][names[j]] = path
    return flow, [f"flow of {folder.name}/"]


def sparse_model(dense: Path) -> ColmapModel | None:
    """The COLMAP model that the poses are from, if it is there."""
    found = next(
        (f for f in (dense / "sparse", dense / "sparse" / "0") if (f / "images.bin").is_file()),
        None,
    )
    return None if found is None else read_model(found)


def trusted(model: ColmapModel | None) -> np.ndarray | None:
    """The static points (P, 3) of the model that are well seen."""
    if model is None:
        return None
    return model.points[(model.errors <= TRUSTED) & (model.track_lengths >= SHORTEST)]


def sightings(model: ColmapModel | None, files: list[Path], bounds: np.ndarray) -> list[Sighting]:
    """What every picture sees of the static points; only its bounds where there is no
    model.
    """
    empty = np.zeros((0, 2)), np.zeros(0)
    if model is None or len(model.images) != len(files):
        return [Sighting(*empty, (float(n), float(f))) for n, f in bounds]
    row = {int(key): r for r, key in enumerate(model.point_ids)}
    found = []
    for image, (near, far) in zip(
        sorted(model.images.values(), key=lambda i: i.name), bounds, strict=True
    ):
        camera = model.cameras[image.camera_id]
        has = np.array([int(p) in row for p in image.point_ids], bool)
        points = model.points[[row[int(p)] for p in image.point_ids[has]]].reshape(-1, 3)
        depth = (points - image.c2w[:, 3]) @ image.c2w[:, 2]
        front = depth > 0
        xy = image.xy[has][front] / [camera.width, camera.height]
        found.append(Sighting(xy, depth[front], (float(near), float(far))))
    return found


def multi_view(folder: Path, name: str) -> Path | None:
    """A folder of held-out pictures, under `dense/` or beside it."""
    return next((p for p in (dense_folder(folder) / name, folder / name) if p.is_dir()), None)
