"""HDR-GoPro / NSFF layout (LLFF poses): under `<scene>/dense/` the pictures,
`poses_bounds.npy` (c2w columns down, right, back; a row for every picture, in plain
string order of the names), and where they are there moving masks, depth and optical
flow. Cameras take turns: training picture i, in the order of the numbers in the names,
is of camera i mod C, and stands at time i. Held out (opened by `held_out.py` alone):
`mv_images/<time>/<camera>.png`, `mv_images_time/`, `mv_masks/`; of sets that `export`
wrote only the ones that `hdr_nsff.json` lists.

The pictures are those of `images_<W>x<H>/` (the largest), else of `images/`. Maps of
another size are resampled. Flow is that of `semantic_flow_i1/` before `flow_i1/`; depth
that of `depth-anything/` (metric) before `disp/` (disparity up to scale and shift),
brought to the units of the poses by the points of `sparse/`. No exposure times are
stored: exposures are found by brightness.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.colmap import ColmapImage, ColmapModel, read_model
from hdr_nsff.footage.datasets.capture import Capture, Picture, SparseDepth
from hdr_nsff.footage.datasets.extra import Extra, parse_extra
from hdr_nsff.footage.datasets.set_files import check_count, source_of
from hdr_nsff.footage.frame_files import frame_files, natural_key
from hdr_nsff.footage.pose_formats import (
    GivenPoses,
    llff_places,
    llff_rows,
    llff_table,
    order_note,
)

FLOWS = ("semantic_flow_i1", "flow_i1")
MULTI_VIEW = ("mv_images", "mv_images_time")
NOTE = "hdr_nsff.json"  # beside poses_bounds.npy where `export` wrote the folder
# reprojection error of a point of `sparse/` up to which it counts (hand-chosen)
MAX_POINT_ERROR_PX = 1.5
MIN_TRACK_LENGTH = 3  # pictures that must see it (hand-chosen)
SIZED = re.compile(r"images_(\d+)x(\d+)")


# Places


def dense_folder(folder: Path) -> Path:
    """`dense/` inside the scene, or the folder itself."""
    return folder / "dense" if (folder / "dense").is_dir() else folder


def recognized(folder: Path) -> bool:
    """Whether `folder` holds this layout."""
    dense = dense_folder(folder)
    if not picture_folders(dense):
        return False
    if (dense / "poses_bounds.npy").is_file():
        return True
    has_maps = any((dense / name).is_dir() for name in (*FLOWS, "motion_masks"))
    return dense.name == "dense" and has_maps


def picture_folders(dense: Path) -> list[Path]:
    """Where pictures are: sized folders, largest first, then `images/`."""
    sized = []
    for path in dense.iterdir():
        match = SIZED.fullmatch(path.name)
        if match is not None and path.is_dir():
            sized.append((int(match[1]) * int(match[2]), path))
    found = [path for _, path in sorted(sized, reverse=True)]
    if (dense / "images").is_dir():
        found.append(dense / "images")
    return found


def multi_view(folder: Path, name: str) -> Path | None:
    """A folder of held-out pictures, under `dense/` or beside it."""
    places = (dense_folder(folder) / name, folder / name)
    return next((place for place in places if place.is_dir()), None)


# Reading


def read(folder: Path) -> Capture:
    """The training pictures with all that the set gives of them.

    InputError where something is missing or short.
    """
    dense = dense_folder(folder)
    given, bounds = read_poses(dense)
    files = read_pictures(dense, len(bounds))
    sources = [source_of(folder, file) for file in files]
    rows = llff_places([file.name for file in files])
    extra = read_extra(dense, [file.name for file in files])
    masks, white_moves = moving_masks(folder, dense, len(files))
    depth, is_metric = depth_maps(dense, len(files), extra)
    confidence = None
    if extra is not None:
        purpose = "the confidence of the disparity"
        confidence = map_files(dense / "disp_confidence", ".npy", len(files), purpose)
    flow, flow_notes = flow_files(dense, sources)
    model = sparse_model(dense)
    sparse = sparse_depths(model, bounds)
    pictures = [
        Picture(
            source,
            float(number),
            mask=masks[number] if masks else None,
            depth=depth[number] if depth else None,
            confidence=confidence[number] if confidence else None,
            flow=flow[number],
        )
        for number, source in enumerate(sources)
    ]
    notes = [f"pictures of {files[0].parent.name}/", *flow_notes]
    reordered = order_note(sources, rows)
    if reordered is not None:
        notes.append(reordered)
    if depth:
        notes.append(f"depth of {depth[0].parent.name}/")
    has_views = any(multi_view(folder, name) is not None for name in MULTI_VIEW)
    capture = Capture(
        layout="HDR-GoPro / NSFF (LLFF)",
        root=folder,
        pictures=pictures,
        poses=replace(given.of(rows), names=sources),
        has_held_out=has_views,
        white_moves=white_moves,
        depth_kind="metric" if is_metric else "disparity",
        depth_units="own",
        sparse_depth={source: sparse[row] for source, row in zip(sources, rows, strict=True)},
        points=trusted_points(model),
        notes=tuple(notes),
    )
    if extra is None:
        return capture
    points = None if model is None else model.points
    capture = replace(capture, points=points, has_held_out=has_views or bool(extra.held_out))
    return with_extra(capture, extra, [file.name for file in files])


def with_extra(capture: Capture, extra: Extra, names: list[str]) -> Capture:
    """`capture` with the times, exposures, intrinsics and range that `export` noted."""
    own = [extra.frames[name] for name in names]
    assert capture.poses is not None
    K = np.array(capture.poses.K)
    for row, frame in enumerate(own):
        if frame.K is not None:
            K[row] = np.array(frame.K)
    pictures = [
        replace(picture, time=frame.time, camera_id=frame.camera_id, bracket=frame.bracket)
        for picture, frame in zip(capture.pictures, own, strict=True)
    ]
    return replace(
        capture,
        layout="HDR-GoPro / NSFF (LLFF), written by hdr-nsff",
        pictures=pictures,
        poses=replace(capture.poses, K=K, near=extra.near, far=extra.far),
        white_moves=True,
        depth_kind="disparity" if extra.depth_kind == "scene" else "relative",
        depth_units="scene",
        exposures=extra.exposures(),
        fps=extra.fps,
    )


def read_poses(dense: Path) -> tuple[GivenPoses, np.ndarray]:
    """The poses, and the near and far bounds (N, 2), row by row."""
    path = dense / "poses_bounds.npy"
    if not path.is_file():
        raise InputError(f"{path}: missing; it holds the camera poses, copy it again")
    table = llff_table(path, 17)
    return llff_rows(table), table[:, 15:]


def read_pictures(dense: Path, count: int) -> list[Path]:
    """The training pictures in order; InputError where there are not `count`."""
    folder = picture_folders(dense)[0]
    files = frame_files(folder)
    if not files:
        raise InputError(
            f"{folder}: no pictures in it; it holds the training pictures, copy them again"
        )
    if len(files) != count:
        raise InputError(
            f"{folder}: {len(files)} pictures, but poses_bounds.npy holds the camera poses of "
            f"{count}; copy both again"
        )
    return files


def read_extra(dense: Path, names: list[str]) -> Extra | None:
    """What `export` noted, if it wrote the folder."""
    path = dense / NOTE
    if not path.is_file():
        return None
    try:
        value = read_json(path)
    except ValueError as error:
        raise InputError(f"{path}: not readable JSON ({shorten(error)}); export again") from error
    return parse_extra(path, value, names)


# Maps


def map_files(folder: Path, suffix: str, count: int, purpose: str) -> list[Path] | None:
    """The maps in a folder, one per picture; None where it does not exist."""
    if not folder.is_dir():
        return None
    files = sorted((p for p in folder.iterdir() if p.suffix == suffix), key=natural_key)
    check_count(folder, files, count, purpose)
    return files


def moving_masks(folder: Path, dense: Path, count: int) -> tuple[list[Path] | None, bool]:
    """The moving masks, and whether moving pixels are white.

    Those of `motion_masks/`, else of `masks/` beside `dense/`, where they are black.
    """
    found = map_files(dense / "motion_masks", ".png", count, "the moving masks, moving = white")
    if found is not None or dense == folder:
        return found, True
    purpose = "the masks that structure from motion used, moving = black"
    return map_files(folder / "masks", ".png", count, purpose), False


def depth_maps(dense: Path, count: int, extra: Extra | None) -> tuple[list[Path] | None, bool]:
    """The depth maps, and whether they are metric; else they hold disparity.

    Of a folder that `export` wrote, the disparity, which is exactly the scene's.
    """
    metric = map_files(dense / "depth-anything", ".npy", count, "the metric depth of the pictures")
    disparity = map_files(dense / "disp", ".npy", count, "the disparity of the pictures")
    if metric is None or (extra is not None and disparity is not None):
        return disparity, False
    return metric, True


def flow_files(dense: Path, sources: list[str]) -> tuple[list[dict[str, Path]], list[str]]:
    """Per picture the flow to its neighbors, and notes that name its folder."""
    folder = next((dense / name for name in FLOWS if (dense / name).is_dir()), None)
    flow: list[dict[str, Path]] = [{} for _ in sources]
    if folder is None:
        return flow, []
    for number in range(len(sources)):
        for neighbor, side in ((number + 1, "fwd"), (number - 1, "bwd")):
            if not 0 <= neighbor < len(sources):
                continue
            path = folder / f"{number:05d}_{side}.npz"
            if not path.is_file():
                raise InputError(
                    f"{path}: missing; it holds the optical flow from picture {number} to "
                    f"{neighbor}, copy it again"
                )
            flow[number][sources[neighbor]] = path
    return flow, [f"flow of {folder.name}/"]


# Static points


def sparse_model(dense: Path) -> ColmapModel | None:
    """The COLMAP model that the poses are from, if it is there."""
    places = (dense / "sparse", dense / "sparse" / "0")
    found = next((place for place in places if (place / "images.bin").is_file()), None)
    return None if found is None else read_model(found)


def trusted_points(model: ColmapModel | None) -> np.ndarray | None:
    """The static points (P, 3) of the model that enough pictures agree on."""
    if model is None:
        return None
    is_exact = model.errors <= MAX_POINT_ERROR_PX
    return model.points[is_exact & (model.track_lengths >= MIN_TRACK_LENGTH)]


def sparse_depths(model: ColmapModel | None, bounds: np.ndarray) -> list[SparseDepth]:
    """The static points that every picture sees, in the order of the rows; `bounds`
    (N, 2) are near and far.

    No points where there is no model of just these pictures.
    """
    ranges = [(float(near), float(far)) for near, far in bounds]
    if model is None or len(model.images) != len(bounds):
        return [SparseDepth(np.zeros((0, 2)), np.zeros(0), near_far) for near_far in ranges]
    images = sorted(model.images.values(), key=lambda i: i.name)
    rows = {int(key): row for row, key in enumerate(model.point_ids)}
    found = []
    for image, near_far in zip(images, ranges, strict=True):
        xy, depth = seen_points(model, image, rows)
        found.append(SparseDepth(xy, depth, near_far))
    return found


def seen_points(
    model: ColmapModel, image: ColmapImage, rows: dict[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The keypoints (n, 2) of static points, as shares of the picture, and their depth.

    `rows` are the positions of point ids in the model.
    """
    camera = model.cameras[image.camera_id]
    has_point = np.array([int(key) in rows for key in image.point_ids], bool)
    seen = [rows[int(key)] for key in image.point_ids[has_point]]
    points = model.points[seen].reshape(-1, 3)
    depth = (points - image.c2w[:, 3]) @ image.c2w[:, 2]
    in_front = depth > 0
    xy = image.xy[has_point][in_front] / [camera.width, camera.height]
    return xy, depth[in_front]
