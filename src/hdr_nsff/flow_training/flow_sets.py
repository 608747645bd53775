"""Image pairs whose flow is known: FlyingThings3D, MPI Sintel, and scenes of `synth`.

Layouts, each below the folder that the user names:

- synth: `exact/clip_00000.exr` with linear radiance, `forward` and `backward` flow.
- Sintel: `[training/]final/SCENE/frame_0001.png`,
  `[training/]flow/SCENE/frame_0001.flo`, and where there is one
  `[training/]invalid/SCENE/frame_0001.png`, white where the flow is unknown.
- FlyingThings3D: `frames_finalpass/TRAIN/A/0000/left/0006.png` (or .webp in
  `frames_finalpass_webp`) and below `optical_flow/TRAIN/A/0000/`
  `into_future/left/OpticalFlowIntoFuture_0006_L.pfm` and
  `into_past/left/OpticalFlowIntoPast_0007_L.pfm`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr
from hdr_nsff.core.images import read_image, read_mask
from hdr_nsff.radiometry.recording import response_curve

FLO_MAGIC = 202021.25  # the first four bytes of a .flo, "PIEH", as a float
MAX_FLOW_PX = 1e4  # files write larger numbers where flow is unknown
PFM_HEADER = re.compile(rb"(PF|Pf)\s+(\d{1,9})\s+(\d{1,9})\s+(-?\d+(?:\.\d*)?(?:e[+-]?\d+)?)\s")


@dataclass(frozen=True)
class FlowPair:
    """Two frames, and the files of the flow between them."""

    first: Path
    second: Path
    forward: Path  # flow from the first to the second
    backward: Path | None  # flow from the second to the first, where the set has it
    scene: str  # pairs of one scene show the same objects
    invalid: Path | None = None  # white where `forward` is unknown


@dataclass(frozen=True)
class Sample:
    """The content of a pair."""

    radiance: np.ndarray  # (2, H, W, 3) linear
    flow: np.ndarray  # (2, H, W, 2) px, forward and backward
    known: np.ndarray  # (2, H, W) bool


# Which pairs


def flow_pairs(folder: Path) -> list[FlowPair]:
    """The pairs of a data set in their order; InputError for an unknown layout."""
    for find_pairs in (synth_pairs, sintel_pairs, flyingthings_pairs):
        pairs = find_pairs(folder)
        if pairs:
            return pairs
    raise InputError(
        f"{folder}: no pairs with known flow; name a folder of `synth`, or of Sintel "
        "(final/, flow/) or FlyingThings3D (frames_finalpass/, optical_flow/)"
    )


def synth_pairs(folder: Path) -> list[FlowPair]:
    """Neighbors of a rendered clip."""
    frames = sorted((folder / "exact").glob("clip_*.exr"))
    return [FlowPair(a, b, a, b, str(folder)) for a, b in pairwise(frames)]


def sintel_pairs(folder: Path) -> list[FlowPair]:
    """Neighbors of Sintel's final pass."""
    root = folder / "training" if (folder / "training").is_dir() else folder
    pairs = []
    for flow in sorted((root / "flow").glob("*/frame_*.flo")):
        match = re.fullmatch(r"frame_(\d+)", flow.stem)
        if match is None:
            continue
        scene = flow.parent.name
        number = int(match[1])
        first = root / "final" / scene / f"frame_{number:04d}.png"
        second = root / "final" / scene / f"frame_{number + 1:04d}.png"
        invalid = root / "invalid" / scene / f"frame_{number:04d}.png"
        if first.is_file() and second.is_file():
            mask = invalid if invalid.is_file() else None
            pairs.append(FlowPair(first, second, flow, None, scene, mask))
    return pairs


def flyingthings_pairs(folder: Path) -> list[FlowPair]:
    """Neighbors of FlyingThings3D's final pass, both eyes."""
    root = folder / "optical_flow"
    pairs = []
    for forward in sorted(root.glob("*/*/*/into_future/*/OpticalFlowIntoFuture_*.pfm")):
        match = re.fullmatch(r"OpticalFlowIntoFuture_(\d+)_([LR])", forward.stem)
        if match is None:
            continue
        number = int(match[1])
        eye = forward.parent.name
        scene = forward.parents[2]
        name = f"OpticalFlowIntoPast_{number + 1:04d}_{match[2]}.pfm"
        backward = scene / "into_past" / eye / name
        place = scene.relative_to(root) / eye
        first = flyingthings_frame(folder, place, number)
        second = flyingthings_frame(folder, place, number + 1)
        if first is not None and second is not None:
            reverse = backward if backward.is_file() else None
            pairs.append(FlowPair(first, second, forward, reverse, str(scene)))
    return pairs


def flyingthings_frame(folder: Path, place: Path, number: int) -> Path | None:
    """A frame of FlyingThings3D; None where it is not there."""
    names = (
        f"frames_finalpass/{place}/{number:04d}.png",
        f"frames_finalpass_webp/{place}/{number:04d}.webp",
    )
    return next((folder / name for name in names if (folder / name).is_file()), None)


# Reading


def read_sample(pair: FlowPair) -> Sample:
    """Radiance and flow of a pair; InputError for broken files or other sizes.

    Pictures of 8 bits are read as sRGB, so their radiance is at most 1.
    """
    first = read_radiance(pair.first)
    second = read_radiance(pair.second)
    size = (first.shape[0], first.shape[1])
    check_size(pair, pair.second, second, size)
    flow = np.zeros((2, *size, 2), np.float32)
    known = np.zeros((2, *size), bool)
    for k, (path, side) in enumerate(((pair.forward, 1), (pair.backward, -1))):
        if path is None:
            continue
        values = read_flow_file(path, side)
        check_size(pair, path, values, size)
        known[k] = (np.abs(values) < MAX_FLOW_PX).all(-1)
        flow[k] = np.where(known[k][..., None], values, 0)
    if pair.invalid is not None:
        invalid = read_mask(pair.invalid)
        check_size(pair, pair.invalid, invalid, size)
        known[0] &= ~invalid
        flow[0][invalid] = 0
    return Sample(np.stack([first, second]), flow, known)


def check_size(pair: FlowPair, path: Path, array: np.ndarray, size: tuple[int, int]) -> None:
    """InputError where a file of a pair is not of `size` (H, W), that of its first."""
    if array.shape[:2] != size:
        raise InputError(
            f"{path}: {array.shape[1]}x{array.shape[0]}, but {pair.first} is "
            f"{size[1]}x{size[0]}; restore the file"
        )


def read_radiance(path: Path) -> np.ndarray:
    """Linear radiance (H, W, 3) of an EXR, or of a picture in sRGB."""
    if path.suffix == ".exr":
        return np.maximum(read_channel(path, "RGB"), 0).astype(np.float32)
    return response_curve("srgb").invert(read_image(path)).astype(np.float32)


def read_flow_file(path: Path, side: int) -> np.ndarray:
    """Flow (H, W, 2) px of a .flo, a .pfm, or an EXR of `synth`.

    An EXR holds flow to the next frame (`side` 1) and to the previous one (-1).
    """
    match path.suffix:
        case ".flo":
            return read_flo(path)
        case ".pfm":
            return read_pfm(path)[..., :2]
        case _:
            u = read_channel(path, f"{MOTION_DIRECTIONS[side]}.u")
            v = read_channel(path, f"{MOTION_DIRECTIONS[side]}.v")
            return np.stack([u, v], -1)


def read_channel(path: Path, name: str) -> np.ndarray:
    """A channel of an EXR; InputError where it has none of that name."""
    found = read_exr(path)
    if name not in found:
        raise InputError(
            f"{path}: no channel {name}; `hdr-nsff synth` writes it, render the scene again"
        )
    return found[name]


def read_flo(path: Path) -> np.ndarray:
    """Flow (H, W, 2) px of a Middlebury file.

    It holds a magic number, width, height, then u and v row by row, all little-endian.
    """
    data = path.read_bytes()
    if len(data) < 12 or np.frombuffer(data, "<f4", 1)[0] != FLO_MAGIC:
        raise InputError(f"{path}: not a .flo file; copy it again")
    width, height = (int(v) for v in np.frombuffer(data, "<i4", 2, 4))
    if min(width, height) < 1 or len(data) != 12 + 8 * width * height:
        raise InputError(f"{path}: {len(data)} bytes for {width}x{height} pixels; copy it again")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)


def read_pfm(path: Path) -> np.ndarray:
    """A picture (H, W, C) float32 of a portable float map.

    Its rows go from the bottom to the top; a negative scale means little-endian.
    """
    data = path.read_bytes()
    header = PFM_HEADER.match(data)
    if header is None:
        raise InputError(f"{path}: not a .pfm file; copy it again")
    width = int(header[2])
    height = int(header[3])
    channels = 3 if header[1] == b"PF" else 1
    if len(data) != header.end() + 4 * width * height * channels:
        raise InputError(f"{path}: {len(data)} bytes for {width}x{height} pixels; copy it again")
    kind = "<f4" if float(header[4]) < 0 else ">f4"
    values = np.frombuffer(data, kind, offset=header.end())
    return values.reshape(height, width, channels)[::-1].astype(np.float32)
