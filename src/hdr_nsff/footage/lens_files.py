"""Calibrations of lenses that other programs wrote: COLMAP's cameras, `transforms.json`
of nerfstudio, and YAML or JSON of OpenCV, ROS and Kalibr.

Lenses here have k1, k2, p1, p2 (`geometry/lens.py`). Further radial terms of OpenCV
(k3 to k6) are replaced by the k1 and k2 that fit them best over the picture. Fisheye
models and thin prisms are refused.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.footage.colmap import ColmapCamera, cameras_bin, cameras_txt, read_part
from hdr_nsff.footage.pose_formats import (
    OPENCV_MODELS,
    UNREADABLE,
    beyond,
    check_model,
    coefficients_of,
    lens_of_opencv,
    parse_intrinsics,
)
from hdr_nsff.geometry.lens import Lens

ACCEPTED = (
    "COLMAP's cameras.txt or .bin, nerfstudio's transforms.json, or a calibration by OpenCV, ROS "
    "or Kalibr (YAML, JSON)"
)
# names of numbers in calibrations, in small letters and digits
MATRIX_NAMES = ("cameramatrix", "intrinsicmatrix", "intrinsics", "mtx", "k")
DISTORTION_NAMES = (
    "distortioncoefficients",
    "distortioncoeffs",
    "distcoeffs",
    "distcoeff",
    "distortion",
    "dist",
    "d",
)
SIZE_NAMES = ("imagesize", "resolution", "size")
WIDTH_NAMES, HEIGHT_NAMES = ("imagewidth", "width", "w"), ("imageheight", "height", "h")
MODEL_NAMES = ("distortionmodel", "cameramodel", "model")
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
TOP_LEVEL = re.compile(r"^(\w+)[ \t]*:", re.MULTILINE)

Values = dict[str, list[float] | str]


def read_lens(path: Path) -> Lens:
    """The lens of a calibration; InputError where it has none that fits the model."""
    if path.is_dir() or path.name in ("cameras.txt", "cameras.bin"):
        return colmap_lens(path)
    try:
        if path.suffix.lower() == ".json":
            document = read_json(path)
            if isinstance(document, dict) and ("frames" in document or "fl_x" in document):
                return transforms_lens(path, document)
            return calibrated_lens(path, values_of_json(document))
        if path.suffix.lower() in (".yaml", ".yml"):
            text = path.read_text(encoding="utf-8")
            return calibrated_lens(path, values_of_yaml(text))
    except InputError:
        raise
    except (*UNREADABLE, OSError) as error:
        problem = f"{type(error).__name__}: {shorten(error)}"
        raise InputError(
            f"{path}: not readable as a calibration ({problem}); give {ACCEPTED}"
        ) from (error)
    raise InputError(f"{path}: no known calibration of a lens; give {ACCEPTED}")


# COLMAP


def colmap_lens(path: Path) -> Lens:
    """The lens of all cameras of a COLMAP model."""
    folder = path if path.is_dir() else path.parent
    cameras: dict[int, ColmapCamera] = read_part(folder, "cameras", cameras_bin, cameras_txt)
    if not cameras:
        raise InputError(f"{path}: no camera in it; export the model again")
    lenses = [lens_of_colmap(path, camera) for camera in cameras.values()]
    if any(lens_numbers(lens) != lens_numbers(lenses[0]) for lens in lenses):
        raise InputError(f"{path}: {len(lenses)} cameras with different lenses; keep one of them")
    return lenses[0]


def lens_of_colmap(path: Path, camera: ColmapCamera) -> Lens:
    """The lens of one COLMAP camera."""
    if camera.model not in (*OPENCV_MODELS, "FULL_OPENCV"):
        raise beyond(path, f"COLMAP's model {camera.model}")
    return lens_of_opencv(path, camera.K, camera.distortion, camera.width, camera.height)


def lens_numbers(lens: Lens) -> tuple[float, ...]:
    """All numbers of a lens."""
    return (*lens.K.ravel().tolist(), *lens.distortion, lens.width, lens.height)


# transforms.json


def transforms_lens(path: Path, document: dict[str, Any]) -> Lens:
    """The lens of a `transforms.json`: that of all frames, or of the first one."""
    frames = document.get("frames") or [{}]
    values = {**document, **frames[0]}
    coefficients = coefficients_of(path, values)
    K, (width, height) = parse_intrinsics(path, values)
    if height <= 0:
        raise no_size(path)
    return lens_of_opencv(path, K, np.array(coefficients), round(width), round(height))


# OpenCV, ROS, Kalibr


def values_of_json(document: Any) -> Values:
    """Numbers and words of a calibration in JSON, by their names."""
    if not isinstance(document, Mapping):
        return {}
    values: Values = {}
    for name, value in document.items():
        inner = value.get("data", []) if isinstance(value, Mapping) else value
        values[plain(name)] = inner if isinstance(inner, str) else numbers_in(inner)
    return values


def numbers_in(value: Any) -> list[float]:
    """All numbers of nested lists, in order."""
    if isinstance(value, int | float):
        return [float(value)]
    if isinstance(value, Iterable) and not isinstance(value, str | Mapping):
        return [number for each in value for number in numbers_in(each)]
    return []


def values_of_yaml(text: str) -> Values:
    """Numbers and words of a calibration in YAML, by their names: lists of numbers, the
    `data` of matrices, and single values; of Kalibr's cameras the first one.
    """
    text = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    starts = list(TOP_LEVEL.finditer(text))
    ends = [start.start() for start in starts[1:]] + [len(text)]
    values: Values = {}
    for start, end in zip(starts, ends, strict=True):
        name, content = start.group(1), text[start.end() : end]
        if re.fullmatch(r"cam\d+", name):
            return values_of_yaml(textwrap.dedent(content.lstrip("\n")))
        bracket = re.search(r"\[[^\]]*(?:\][\s,]*\[[^\]]*)*\]", content)
        words = content.strip().strip("\"'")
        if bracket is not None:
            values[plain(name)] = [float(n) for n in NUMBER.findall(bracket.group())]
        elif NUMBER.fullmatch(words):
            values[plain(name)] = [float(words)]
        else:
            values[plain(name)] = words
    return values


def plain(name: str) -> str:
    """A name in small letters and digits."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def calibrated_lens(path: Path, values: Values) -> Lens:
    """The lens of a calibration's `values`."""
    model = next((values[name] for name in MODEL_NAMES if name in values), "")
    check_model(path, str(model))
    matrix = numbers_of(values, MATRIX_NAMES)
    distortion = numbers_of(values, DISTORTION_NAMES)
    if len(matrix) not in (4, 9) or not distortion:
        raise InputError(
            f"{path}: no camera matrix with distortion coefficients in it; give {ACCEPTED}"
        )
    if len(matrix) == 4:
        fx, fy, cx, cy = matrix
        matrix = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    size = numbers_of(values, SIZE_NAMES)
    if len(size) != 2:
        size = numbers_of(values, WIDTH_NAMES) + numbers_of(values, HEIGHT_NAMES)
    if len(size) != 2 or min(size) < 1:
        raise no_size(path)
    K = np.array(matrix).reshape(3, 3)
    width, height = (round(side) for side in size)
    return lens_of_opencv(path, K, np.array(distortion), width, height)


def numbers_of(values: Values, names: Iterable[str]) -> list[float]:
    """The numbers with the first of the `names` that has some; empty without."""
    for name in names:
        found = values.get(name)
        if isinstance(found, list) and found:
            return found
    return []


def no_size(path: Path) -> InputError:
    """The error for a calibration without the size of its pictures."""
    return InputError(
        f"{path}: the size of the pictures that it is for is missing; add image_width and "
        "image_height"
    )
