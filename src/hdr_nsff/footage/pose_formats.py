"""Formats of poses: a COLMAP model, `transforms.json` (nerfstudio, Blender),
`poses_bounds.npy` (LLFF), and the JSON of LLFF poses that non-rigid NeRF publishes.

Every convention is converted here: c2w OpenCV (+x right, +y down, +z forward), pixels
with centers at +0.5, and distortion with k1, k2, p1, p2 (`geometry/lens.py`). The world
and its units stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.arrays import read_array
from hdr_nsff.footage.colmap import ColmapCamera, ColmapModel
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.pinhole import camera_rays
from hdr_nsff.scene.manifest import MAX_NUMBER

# columns right, up, back -> right, down, forward
FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
# columns down, right, back -> right, down, forward
FROM_LLFF = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
# pixels by which a corner may be off where lens distortion is left out (hand-chosen)
MAX_DISTORTION_PX = 2.0
# models whose distortion is that of OpenCV: k1, k2, p1, p2, or the first of these
OPENCV_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
# words in the names of models that are not OpenCV's radial one
OTHER_MODELS = (
    *("fish", "equi", "kannala", "omni", "fov", "eucm", "division", "prism"),
    *("vr180", "ortho"),
)
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")  # of `transforms.json`
# not read: nerfstudio multiplies by what OpenCV divides by
FURTHER_KEYS = ("k4", "k5", "k6")
MAX_SIDE = 10**6  # pixels of a picture
# of the picture's width: how well k1 and k2 have to stand for more radial terms
MAX_FIT_ERROR = 1e-3
NUM_RADII = 200
# what Python and numpy raise for JSON values of another shape or size than expected
UNREADABLE = (KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError)


@dataclass(frozen=True)
class GivenPoses:
    """Poses as a file has them, in its own order."""

    names: list[str] | None  # image file names, None: only the order counts
    K: np.ndarray  # (N, 3, 3) pixels of `size`
    c2w: np.ndarray  # (N, 3, 4) OpenCV
    size: np.ndarray  # (N, 2) width, height that K is for; a height of 0 is unknown
    near: float | None = None  # z-depth, units of the poses
    far: float | None = None
    # (N, 4) k1, k2, p1, p2 of OpenCV's model; None: no pose has any
    distortion: np.ndarray | None = None

    def of(self, rows: list[int]) -> GivenPoses:
        """The poses of these rows."""
        return replace(
            self,
            names=None if self.names is None else [self.names[row] for row in rows],
            K=self.K[rows],
            c2w=self.c2w[rows],
            size=self.size[rows],
            distortion=None if self.distortion is None else self.distortion[rows],
        )


# COLMAP


def from_colmap(path: Path, model: ColmapModel) -> GivenPoses:
    """The poses of a COLMAP model, by image name; `path` is what messages name."""
    if not model.images:
        raise InputError(
            f"{path}: the COLMAP model has no registered images; run the COLMAP mapper again"
        )
    images = sorted(model.images.values(), key=lambda i: i.name)
    cameras = [model.cameras[i.camera_id] for i in images]
    return GivenPoses(
        names=[i.name for i in images],
        K=np.stack([c.K for c in cameras]),
        c2w=np.stack([i.c2w for i in images]),
        size=np.array([(c.width, c.height) for c in cameras], np.float64),
        distortion=np.stack([colmap_distortion(path, c) for c in cameras]),
    )


def colmap_distortion(path: Path, camera: ColmapCamera) -> np.ndarray:
    """k1, k2, p1, p2 of OpenCV's model.

    InputError for models beyond it, unless nothing is distorted: a fisheye always is.
    """
    values = camera.distortion
    undistorted = not np.any(values) and "FISHEYE" not in camera.model
    if camera.model in OPENCV_MODELS or undistorted:
        return np.pad(values, (0, 4))[:4]
    raise InputError(
        f"{path}: camera model {camera.model} is not a pinhole camera; undistort the frames "
        "(colmap image_undistorter) and export again"
    )


def lenses_of(given: GivenPoses) -> list[Lens]:
    """The lens of every pose; none where no pose has distortion, or numbers that no
    lens has, which are refused later.
    """
    if given.distortion is None or not given.distortion.any():
        return []
    if not all(np.isfinite(each).all() for each in (given.K, given.distortion, given.size)):
        return []
    return [
        Lens(K, (k1, k2, p1, p2), round(width), round(height))
        for K, (k1, k2, p1, p2), (width, height) in zip(
            given.K, given.distortion.tolist(), given.size, strict=True
        )
    ]


def max_displacement_px(given: GivenPoses) -> float:
    """By how many pixels pinholes in place of the lenses misplace a corner at most."""
    return max((lens.max_displacement_px() for lens in lenses_of(given)), default=0.0)


def common_lens(path: Path, given: GivenPoses) -> Lens | None:
    """The lens of all poses; None where a pinhole misplaces no corner by more than
    `MAX_DISTORTION_PX`. InputError where they have several lenses, or no size.
    """
    lenses = lenses_of(given)
    worst = max_displacement_px(given)
    if not worst > MAX_DISTORTION_PX:
        return None
    numbers = [[*each.K.ravel(), *each.distortion, each.width, each.height] for each in lenses]
    several = not np.allclose(numbers, numbers[0])
    if several or lenses[0].height <= 0 or not lenses[0].is_one_to_one():
        raise distorted(path, worst)
    return lenses[0]


def distorted(path: Path, displacement: float) -> InputError:
    """The error for frames that have to be undistorted first."""
    return InputError(
        f"{path}: lens distortion moves corners by {displacement:.0f} px; undistort the frames "
        "(colmap image_undistorter) and export again"
    )


# LLFF


def from_llff(path: Path) -> GivenPoses:
    """The poses of a `poses_bounds.npy`."""
    return llff_rows(llff_table(path, 17))


def llff_table(path: Path, columns: int) -> np.ndarray:
    """The numbers (N, columns) float64 of a `.npy` as LLFF writes it."""
    table = read_array(path, np.float64)
    if table.ndim != 2 or table.shape[1] != columns or not len(table):
        raise InputError(
            f"{path}: expected an array (frames, {columns}) as LLFF writes it, found {table.shape}"
        )
    return table


def llff_rows(table: np.ndarray) -> GivenPoses:
    """The poses of rows (N, 17) of `poses_bounds.npy`.

    A row is a 3x5 matrix with the columns down, right, back, center, (height, width,
    focal length), and then near and far.
    """
    return llff_poses(table[:, :15].reshape(-1, 3, 5), table[:, 15:], FROM_LLFF)


def llff_places(names: Sequence[str]) -> list[int]:
    """The row of each of the pictures, or cameras, `names` (N) in what LLFF writes.

    It sorts names as plain strings: img_10 stands before img_2.
    """
    parts = [PurePosixPath(name).parts for name in names]
    order = sorted(range(len(names)), key=lambda k: parts[k])
    rows = [0] * len(names)
    for row, k in enumerate(order):
        rows[k] = row
    return rows


def order_note(names: Sequence[str], rows: Sequence[int | None]) -> str | None:
    """A sentence where pictures `names` (N) do not take their `rows` (N) one after the
    other; None where they do.
    """
    distinct = dict.fromkeys(row for row in rows if row is not None)
    moved = [row for place, row in enumerate(distinct) if row != place]
    if not moved:
        return None
    first = min(moved)
    name = shorten(names[rows.index(first)])
    return (
        "poses are taken in plain string order of the names, as LLFF writes them: "
        f"row {first} (from 0) is that of {name}"
    )


def llff_poses(matrices: np.ndarray, bounds: np.ndarray, columns: np.ndarray) -> GivenPoses:
    """Poses from LLFF's `matrices` (N, 3, 5) and depth `bounds` (N, 2).

    `columns` (3, 3) turns the first three columns into right, down, forward.
    """
    heights, widths, focal = matrices[:, :, 4].T
    K = np.zeros((len(matrices), 3, 3))
    K[:, 0, 0] = focal
    K[:, 1, 1] = focal
    K[:, 0, 2] = widths / 2
    K[:, 1, 2] = heights / 2
    K[:, 2, 2] = 1
    with np.errstate(invalid="ignore"):  # NaN and Inf are refused afterwards
        c2w = np.concatenate([matrices[:, :, :3] @ columns, matrices[:, :, 3:4]], 2)
    # a single stray point makes a bound of one frame useless: not the minimum, as is
    # usual, but what nine frames in ten agree on
    near = float(0.8 * np.percentile(bounds[:, 0], 10))
    far = float(1.25 * np.percentile(bounds[:, 1], 90))
    size = np.stack([widths, heights], 1)
    if not (np.isfinite(bounds).all() and 0 < near < far):
        return GivenPoses(None, K, c2w, size)
    return GivenPoses(None, K, c2w, size, near, far)


# JSON


def from_json(path: Path) -> GivenPoses:
    """The poses of a `transforms.json`, or of a JSON with `poses` and `bds`.

    The latter holds LLFF's matrices with the columns right, up, back.
    """
    try:
        document = read_json(path)
        if isinstance(document, dict) and "frames" in document:
            return parse_transforms(path, document)
        if isinstance(document, dict) and "poses" in document and "bds" in document:
            matrices = np.array(document["poses"], np.float64).reshape(-1, 3, 5)
            bounds = np.array(document["bds"], np.float64).reshape(len(matrices), 2)
            return llff_poses(matrices, bounds, FROM_OPENGL)
    except InputError:
        raise
    except UNREADABLE as error:
        raise unreadable(path, error) from error
    raise InputError(
        f"{path}: neither `frames` (transforms.json) nor `poses` and `bds` in it; "
        "export the poses again"
    )


def from_transforms(path: Path, document: dict[str, Any]) -> GivenPoses:
    """The poses of a `transforms.json` that is read already; `path` is where it is."""
    try:
        return parse_transforms(path, document)
    except InputError:
        raise
    except UNREADABLE as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: Exception) -> InputError:
    """The error for a JSON whose poses are of another shape than they should."""
    problem = f"{type(error).__name__}: {shorten(error)}"
    return InputError(f"{path}: not readable as poses ({problem}); export them again")


def parse_transforms(path: Path, document: dict[str, Any]) -> GivenPoses:
    """nerfstudio's and Blender's layout: `transform_matrix` c2w with OpenGL axes.

    Intrinsics are for all frames or per frame. One of `UNREADABLE` for values of
    another shape.
    """
    frames = document["frames"]
    if not frames:
        raise InputError(f"{path}: no frames in it; export the poses again")
    values = [{**document, **frame} for frame in frames]
    lenses = [parse_intrinsics(path, each) for each in values]
    distortion = [
        distortion_of(path, each, K, size) for each, (K, size) in zip(values, lenses, strict=True)
    ]
    matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64)[:, :3]
    with np.errstate(invalid="ignore"):  # NaN and Inf are refused afterwards
        c2w = np.concatenate([matrices[:, :, :3] @ FROM_OPENGL, matrices[:, :, 3:4]], 2)
    near, far = parse_range(path, document)
    return GivenPoses(
        names=[str(frame["file_path"]) for frame in frames],
        K=np.stack([K for K, _ in lenses]),
        c2w=c2w,
        size=np.array([size for _, size in lenses], np.float64),
        near=near,
        far=far,
        distortion=np.array(distortion),
    )


def parse_range(path: Path, document: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """`near` and `far` of a JSON; None where it has none, or 0.

    InputError where they are not a range of depths.
    """
    near = float(document.get("near") or 0)
    far = float(document.get("far") or 0)
    least = near if near else 1 / MAX_NUMBER
    most = far if far else MAX_NUMBER
    if not (1 / MAX_NUMBER <= least < most <= MAX_NUMBER):
        raise InputError(
            f"{path}: near {near:g} and far {far:g} are not a range of depths; correct them"
        )
    return near or None, far or None


def parse_intrinsics(
    path: Path, values: Mapping[str, Any]
) -> tuple[np.ndarray, tuple[float, float]]:
    """K (3, 3) and the size (width, height) that it is for, from the keys of a frame.

    Without a size the unit is the frame's width, and the height 0.
    """
    if "fl_x" in values:
        fx = float(values["fl_x"])
        fy = float(values.get("fl_y", fx))
        width = float(values.get("w", 2 * float(values.get("cx", 0))))
        height = float(values.get("h", 2 * float(values.get("cy", 0))))
        if width <= 0 or height <= 0:
            raise InputError(
                f"{path}: `fl_x` without `w` and `h`: the size that the focal length is for "
                "is missing; add it"
            )
    elif "camera_angle_x" in values:
        width = float(values.get("w", 1))
        height = float(values.get("h", 0))
        if ("cx" in values and "w" not in values) or ("cy" in values and "h" not in values):
            raise InputError(f"{path}: `cx`, `cy` without `w`, `h`, the pictures' size; add them")
        fx = width / 2 / math.tan(float(values["camera_angle_x"]) / 2)
        fy = fx
        if height and "camera_angle_y" in values:
            fy = height / 2 / math.tan(float(values["camera_angle_y"]) / 2)
    else:
        raise InputError(f"{path}: neither `fl_x` nor `camera_angle_x`: no focal length; add one")
    cx = float(values.get("cx", width / 2))
    cy = float(values.get("cy", height / 2))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return K, (width, height)


def distortion_of(
    path: Path, values: Mapping[str, Any], K: np.ndarray, size: tuple[float, float]
) -> tuple[float, ...]:
    """k1, k2, p1, p2 from the keys of a frame; k3 becomes part of k1 and k2.

    `K` (3, 3) is for `size` (width, height).
    """
    *four, k3 = coefficients_of(path, values)
    if k3 == 0:
        return tuple(four)
    width, height = size
    if height <= 0:
        raise InputError(f"{path}: `k3` without `w` and `h`, the size of the pictures; add them")
    return lens_of_opencv(path, K, np.array([*four, k3]), round(width), round(height)).distortion


def coefficients_of(path: Path, values: Mapping[str, Any]) -> list[float]:
    """k1, k2, p1, p2, k3 of OpenCV's model from the keys of a frame.

    InputError for another model, and for terms beyond these.
    """
    check_model(path, str(values.get("camera_model", "")))
    if values.get("is_fisheye"):
        raise beyond(path, "the fisheye model (`is_fisheye`)")
    if any(float(values.get(key, 0)) for key in FURTHER_KEYS):
        raise beyond(path, "distortion with k4, k5 or k6")
    return [float(values.get(key, 0)) for key in DISTORTION_KEYS]


# OpenCV's model


def check_model(path: Path, model: str) -> None:
    """InputError for a model of distortion that is not OpenCV's radial one."""
    if any(word in model.lower() for word in OTHER_MODELS):
        raise beyond(path, f"the model {shorten(model)}")


def beyond(path: Path, what: str) -> InputError:
    """The error for a lens that k1, k2, p1, p2 do not describe."""
    return InputError(
        f"{path}: {what} is not that of a lens with k1, k2, p1, p2; undistort the frames first"
    )


def lens_of_opencv(
    path: Path, K: np.ndarray, distortion: np.ndarray, width: int, height: int
) -> Lens:
    """A lens from OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, or the first of
    them; further radial terms become part of k1 and k2.
    """
    coefficients = np.pad(np.asarray(distortion, np.float64), (0, 14))[:14]
    numbers = (K, coefficients)
    possible = all(np.abs(n).max() <= MAX_NUMBER for n in numbers) and min(K[0, 0], K[1, 1]) > 0
    possible = possible and 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE
    if not possible or abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise InputError(f"{path}: impossible numbers in the calibration; calibrate again")
    if coefficients[8:].any():
        raise beyond(path, "a thin prism or a tilted sensor")
    k1, k2, p1, p2 = coefficients[:4].tolist()
    if coefficients[4:8].any():
        with np.errstate(all="ignore"):  # numbers that no lens has fit nothing
            k1, k2 = fit_two_terms(path, K, coefficients, width)
    lens = Lens(K, (k1, k2, p1, p2), width, height)
    if not lens.is_one_to_one():
        raise beyond(path, "distortion that folds the picture over")
    return lens


def fit_two_terms(
    path: Path, K: np.ndarray, coefficients: np.ndarray, width: int
) -> tuple[float, float]:
    """k1 and k2 that stand for all radial terms over the picture, by least squares."""
    k1, k2, _, _, k3, k4, k5, k6 = coefficients[:8]
    corners = np.array([(0.0, 0.0), (2 * K[0, 2], 2 * K[1, 2])])
    recorded = float(np.linalg.norm(camera_rays(corners, K)[..., :2], axis=-1).max())
    radius = np.linspace(0, 3 * recorded, 20 * NUM_RADII)
    r2 = radius**2
    factor = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    bent = radius * factor
    folds = np.flatnonzero(np.diff(bent) <= 0)
    inside = bent <= recorded
    inside[int(np.argmin(inside)) or len(inside) :] = False
    if folds.size and folds[0] < inside.sum():
        raise beyond(path, "distortion that folds the picture over")
    radius, r2, bent = radius[inside], r2[inside], bent[inside]
    design = np.stack([radius * r2, radius * r2**2], 1)
    found = np.linalg.lstsq(design, bent - radius, rcond=None)[0]
    error_px = K[0, 0] * float(np.abs(design @ found - bent + radius).max())
    if not error_px <= MAX_FIT_ERROR * width:
        raise beyond(path, f"radial distortion of high order ({error_px:.1f} px off)")
    return float(found[0]), float(found[1])
