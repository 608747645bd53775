"""Image pairs whose optical flow is known: FlyingThings3D, MPI Sintel, and scenes of
`synth`.

Layouts, each below the folder that is named:
    synth             exact/clip_00000.exr: linear radiance, `forward` and `backward`
    flow
    Sintel            [training/]final/SCENE/frame_0001.png,
    [training/]flow/SCENE/frame_0001.flo, and where there is one
                      [training/]invalid/SCENE/frame_0001.png, white where the flow is
                      not known
    FlyingThings3D    frames_finalpass/TRAIN/A/0000/left/0006.png (or .webp in
    frames_finalpass_webp) and
optical_flow/TRAIN/A/0000/into_future/left/OpticalFlowIntoFuture_0006_L.pfm,
                      into_past/...Past_0007_L.pfm
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import SIDES, read_exr
from hdr_nsff.core.images import read_image, read_mask
from hdr_nsff.radiometry.recording import response_curve

FLO_MAGIC = 202021.25  # "PIEH"
FAR = 1e4  # pixels: what files write where flow is not known is farther than that


@dataclass(frozen=True)
class FlowPair:
    """Two frames, and the files that say how pixels go from the one to the other."""

    first: Path
    second: Path
    forward: Path  # flow of the first to the second
    backward: Path | None  # flow of the second to the first, where the set has it
    scene: str  # pairs of one scene show the same things
    invalid: Path | None = None  # where `forward` is not known


@dataclass(frozen=True)
class Sample:
    """What a pair holds."""

    radiance: np.ndarray  # (2, H, W, 3) linear
    flow: np.ndarray  # (2, H, W, 2) px, there and back
    known: np.ndarray  # (2, H, W) bool


def flow_pairs(folder: Path) -> list[FlowPair]:
    """The pairs of a data set in their order; InputError where it has none of the
    layouts above.
    """
    for reader in (synth_pairs, sintel_pairs, things_pairs):
        if pairs := reader(folder):
            return pairs
    raise InputError(
        f"{folder}: no pairs with known flow; name a folder of `synth`, or of Sintel (final/, flow/) or FlyingThings3D "
        "(frames_finalpass/, optical_flow/)"
    )


def synth_pairs(folder: Path) -> list[FlowPair]:
    """Neighbors of a rendered clip."""
    frames = sorted((folder / "exact").glob("clip_*.exr"))
    return [FlowPair(a, b, a, b, str(folder)) for a, b in pairwise(frames)]


def sintel_pairs(folder: Path) -> list[FlowPair]:
    """Neighbors of Sintel's final pass."""
    root = folder / "training" if (folder / "training").is_dir() else folder
    found = []
    for flow in sorted((root / "flow").glob("*/frame_*.flo")):
        scene, number = flow.parent.name, int(flow.stem.removeprefix("frame_"))
        first, second = (
            root / "final" / scene / f"frame_{k:04d}.png" for k in (number, number + 1)
        )
        invalid = root / "invalid" / scene / f"frame_{number:04d}.png"
        if first.is_file() and second.is_file():
            found.append(
                FlowPair(first, second, flow, None, scene, invalid if invalid.is_file() else None)
            )
    return found


def things_pairs(folder: Path) -> list[FlowPair]:
    """Neighbors of FlyingThings3D's final pass, both eyes."""
    found = []
    for flow in sorted(
        (folder / "optical_flow").glob("*/*/*/into_future/*/OpticalFlowIntoFuture_*.pfm")
    ):
        eye, scene = flow.parent.name, flow.parents[2]
        name = re.fullmatch(r"OpticalFlowIntoFuture_(\d+)_([LR])", flow.stem)
        if name is None:
            continue
        number, side = int(name[1]), name[2]
        back = scene / "into_past" / eye / f"OpticalFlowIntoPast_{number + 1:04d}_{side}.pfm"
        frames = [
            things_frame(folder, scene.relative_to(folder / "optical_flow") / eye, k)
            for k in (number, number + 1)
        ]
        if frames[0] and frames[1]:
            found.append(
                FlowPair(frames[0], frames[1], flow, back if back.is_file() else None, str(scene))
            )
    return found


def things_frame(folder: Path, inside: Path, number: int) -> Path | None:
    """The picture of a frame of FlyingThings3D, None where it is not there."""
    names = (
        f"frames_finalpass/{inside}/{number:04d}.png",
        f"frames_finalpass_webp/{inside}/{number:04d}.webp",
    )
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_sample(pair: FlowPair) -> Sample:
    """Radiance and flow of a pair; 8-bit pictures are taken to be sRGB, so 1 is as
    bright as they go. InputError for broken files.
    """
    flows = [
        read_flow_file(pair.forward, 1),
        read_flow_file(pair.backward, -1) if pair.backward else None,
    ]
    radiance = [read_radiance(path) for path in (pair.first, pair.second)]
    size = radiance[0].shape[:2]
    for path, shape in (
        (pair.second, radiance[1].shape[:2]),
        *((pair.forward, f.shape[:2]) for f in flows if f is not None),
    ):
        if shape != size:
            raise InputError(
                f"{path}: {shape[1]}x{shape[0]}, but {pair.first} is {size[1]}x{size[0]}; restore the file"
            )
    given = [np.zeros((*size, 2), np.float32) if f is None else f for f in flows]
    known = np.stack(
        [np.zeros(size, bool) if f is None else (np.abs(f) < FAR).all(-1) for f in flows]
    )
    if pair.invalid is not None:
        known[0] &= ~read_mask(pair.invalid)
    return Sample(
        np.stack(radiance), np.where(known[..., None], np.stack(given), 0).astype(np.float32), known
    )


def read_radiance(path: Path) -> np.ndarray:
    """Linear radiance (H, W, 3) of an EXR, or of a picture in sRGB."""
    if path.suffix == ".exr":
        return np.maximum(channels(path, "RGB"), 0).astype(np.float32)
    return response_curve("srgb").invert(read_image(path)).astype(np.float32)


def read_flow_file(path: Path, side: int) -> np.ndarray:
    """Flow (H, W, 2) px of a .flo, a .pfm, or of a rendered frame's EXR to the next
    (`side` 1) or previous (-1) one.
    """
    match path.suffix:
        case ".flo":
            return read_flo(path)
        case ".pfm":
            return read_pfm(path)[..., :2]
        case _:
            return np.stack([channels(path, f"{SIDES[side]}.{axis}") for axis in "uv"], -1)


def channels(path: Path, name: str) -> np.ndarray:
    """A channel of an EXR."""
    found = read_exr(path)
    if name not in found:
        raise InputError(
            f"{path}: no channel {name}; `hdr-nsff synth` writes it, render the scene again"
        )
    return found[name]


def read_flo(path: Path) -> np.ndarray:
    """Flow (H, W, 2) px of a Middlebury file: magic number, width, height, then u and v
    row by row, all little-endian.
    """
    data = path.read_bytes()
    if len(data) < 12 or np.frombuffer(data, "<f4", 1)[0] != FLO_MAGIC:
        raise InputError(f"{path}: not a .flo file; copy it again")
    width, height = (int(v) for v in np.frombuffer(data, "<i4", 2, 4))
    if len(data) != 12 + 8 * width * height:
        raise InputError(f"{path}: {len(data)} bytes for {width}x{height} pixels; copy it again")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)


def read_pfm(path: Path) -> np.ndarray:
    """Picture (H, W, C) float32 of a portable float map, whose rows go from the bottom
    to the top.
    """
    found = re.match(
        rb"(PF|Pf)\s+(\d+)\s+(\d+)\s+(-?[\d.]+(?:e[+-]?\d+)?)\s", data := path.read_bytes()
    )
    if found is None:
        raise InputError(f"{path}: not a .pfm file; copy it again")
    width, height, count = int(found[2]), int(found[3]), 3 if found[1] == b"PF" else 1
    if len(data) != found.end() + 4 * width * height * count:
        raise InputError(f"{path}: {len(data)} bytes for {width}x{height} pixels; copy it again")
    values = np.frombuffer(data, "<f4" if float(found[4]) < 0 else ">f4", offset=found.end())
    return values.reshape(height, width, count)[::-1].astype(np.float32)
