"""The scene file: a trained field of 4D Gaussians in one file, linear HDR and playable.

A scene file is a safetensors file whose metadata holds one JSON document under the key
`hdr4d`. docs/formats.md, section "Scene file", specifies both, and how a Gaussian is
evaluated at a time; `examples/read_scene.py` is a reader in plain numpy. Radiance is
linear, with Rec. 709 primaries as the camera saw them, and 1 saturates at the reference
exposure. Axes are OpenCV's.

Gaussians come in groups. The arrays that a group has say how it moves: none, along
shared motion bases (`mixture`), or in a straight line around a time of its own
(`velocities`, `centers`, `log_durations`).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from safetensors.numpy import load, save

from hdr_nsff.core.errors import InputError

KEY = "hdr4d"  # of the document in the file's metadata
VERSION = 1
MAX_INT16, MAX_UINT16 = 32767, 65535
# how arrays are stored: half precision, or integers times a factor
HALF = {
    "log_scales",
    "opacity_logits",
    "log_radiance",
    "color_offsets",
    "opacity_offsets",
    "velocities",
    "log_durations",
    "sh1",
}
SCALED: dict[str, tuple[type, float]] = {
    "quaternions": (np.int16, 1 / MAX_INT16),
    "mixture": (np.uint16, 1 / MAX_UINT16),
}

Array = np.ndarray


@dataclass(frozen=True)
class GaussianGroup:
    """N Gaussians that move and change in the same way; float32 arrays.

    Optional arrays are None where they do not apply. `x(t)` of a time-local Gaussian is
    `means + velocities (t - centers)`; its opacity is multiplied by
    `exp(-0.5 ((t - centers) / exp(log_durations))^2)`.
    """

    name: str
    motion: float  # share of dynamic content in [0, 1] that these count as
    means: Array  # (N, 3) scene units, at rest
    quaternions: Array  # (N, 4) unit, w x y z, at rest
    log_scales: Array  # (N, 3) natural log of standard deviations in scene units
    opacity_logits: Array  # (N,)
    log_radiance: Array  # (N, 3) natural log, or log odds of a bounded field
    # (K, N, 3) or (K, N, 1) added to `log_radiance`, spread evenly over the clip
    color_offsets: Array | None = None
    opacity_offsets: Array | None = None  # (K, N) added to `opacity_logits`
    mixture: Array | None = None  # (N, B) weights of the motion bases, sum 1
    velocities: Array | None = None  # (N, 3) scene units per frame
    centers: Array | None = None  # (N,) in frames: when a Gaussian is at its mean
    log_durations: Array | None = None  # (N,) natural log of a duration in frames
    # (N, 3, 3) change of log radiance (rgb) per unit of view direction (xyz)
    sh1: Array | None = None

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class MotionBases:
    """B rigid motions at the T training times, which Gaussians mix."""

    centers: Array  # (B, 3) scene units: what each turns about
    quaternions: Array  # (T, B, 4) w x y z
    shifts: Array  # (T, B, 3) scene units


@dataclass(frozen=True)
class FilmedView:
    """One recorded frame: where it was filmed, and how it was exposed."""

    time: float  # in frames
    K: list[list[float]]  # (3, 3) pixels of the clip's frame size
    c2w: list[list[float]]  # (3, 4) OpenCV camera to world, scene units
    bracket: int
    camera_id: int
    picture: list[int] | None = None  # first and last + 1 byte in `recorded`
    ev: float | None = None  # of its own exposure; None in older files


@dataclass(frozen=True)
class CameraResponse:
    """How one physical camera records: rgb = curve(white_balance * 2^EV * radiance)."""

    x: list[float]  # (M,) exposures from 0 to where the curve ends, rising
    y: list[list[float]]  # (3, M) recorded values in [0, 1]
    white_balance: list[float]  # (3,) gains relative to camera 0
    neutral: list[float]  # (3,) gains that make the camera's mid gray neutral


@dataclass(frozen=True)
class SceneFile:
    """All that a player needs to show a scene."""

    title: str
    width: int  # pixels of the clip's frames
    height: int
    fps: float
    times: list[float]  # (T,) distinct training times in frames, rising
    near: float  # z-depths, scene units
    far: float
    parallax: str  # full, rotation or none
    background: list[float]  # (3,) linear radiance where no Gaussian is
    exposures: list[float]  # EV of every bracket relative to the reference
    display_exposure: float  # factor that brings the clip to the key of a display
    views: list[FilmedView]
    responses: list[CameraResponse]  # of every physical camera
    groups: list[GaussianGroup] = field(default_factory=list)
    bases: MotionBases | None = None
    recorded: bytes = b""  # JPEG files of the views, one after the other
    radiance: Literal["exp", "sigmoid"] = "exp"
    """How radiance follows from `log_radiance`."""

    def count(self) -> int:
        """Number of Gaussians."""
        return sum(len(group) for group in self.groups)


OPTIONAL_ARRAYS = (
    "color_offsets",
    "opacity_offsets",
    "mixture",
    "velocities",
    "centers",
    "log_durations",
    "sh1",
)
REQUIRED_ARRAYS = ("means", "quaternions", "log_scales", "opacity_logits", "log_radiance")


def to_bytes(scene: SceneFile) -> bytes:
    """The scene as the bytes of a scene file."""
    arrays: dict[str, Array] = {}
    factors: dict[str, float] = {}

    def store(name: str, values: Array) -> None:
        stored, factor = quantize(name.rpartition(".")[2], values)
        arrays[name] = np.ascontiguousarray(stored)
        if factor is not None:
            factors[name] = factor

    for group in scene.groups:
        check_group(group)
        for name in (*REQUIRED_ARRAYS, *OPTIONAL_ARRAYS):
            values = getattr(group, name)
            if values is not None:
                store(f"{group.name}.{name}", values)
    if scene.bases is not None:
        # few numbers that all Gaussians depend on: not quantized
        for name, values in asdict(scene.bases).items():
            arrays[f"bases.{name}"] = np.ascontiguousarray(values, np.float32)
    arrays["recorded"] = np.frombuffer(scene.recorded, np.uint8)
    document = document_of(scene, factors)
    return save(arrays, {KEY: json.dumps(document, allow_nan=False)})


def document_of(scene: SceneFile, factors: dict[str, float]) -> dict[str, Any]:
    """The JSON document of a scene file; `factors` are those of its integer arrays."""
    left_out = {"groups", "bases", "recorded"}
    plain = {name: value for name, value in vars(scene).items() if name not in left_out}
    plain["views"] = [asdict(view) for view in scene.views]
    plain["responses"] = [asdict(response) for response in scene.responses]
    groups = [{"name": g.name, "count": len(g), "motion": g.motion} for g in scene.groups]
    return {"version": VERSION, **plain, "groups": groups, "factors": factors}


def from_bytes(data: bytes) -> SceneFile:
    """The scene of a scene file's bytes. InputError where they are none."""
    try:
        length = int.from_bytes(data[:8], "little")
        document = json.loads(json.loads(data[8 : 8 + length])["__metadata__"][KEY])
        stored = load(data)
    except Exception as error:
        raise InputError("not a scene file; write one with `hdr-nsff export`") from error
    if document.pop("version") != VERSION:
        raise InputError("a scene file of another version; export it again")
    factors = document.pop("factors")
    arrays = {
        name: values.astype(np.float32) * np.float32(factors.get(name, 1.0))
        for name, values in stored.items()
        if name != "recorded"
    }
    groups = []
    for entry in document.pop("groups"):
        prefix = f"{entry['name']}."
        own = {n.removeprefix(prefix): v for n, v in arrays.items() if n.startswith(prefix)}
        groups.append(GaussianGroup(name=entry["name"], motion=entry["motion"], **own))
    bases = None
    if "bases.centers" in arrays:
        bases = MotionBases(
            arrays["bases.centers"], arrays["bases.quaternions"], arrays["bases.shifts"]
        )
    document["views"] = [FilmedView(**view) for view in document["views"]]
    document["responses"] = [CameraResponse(**entry) for entry in document["responses"]]
    recorded = stored["recorded"].tobytes()
    return SceneFile(**document, groups=groups, bases=bases, recorded=recorded)


def quantize(name: str, values: Array) -> tuple[Array, float | None]:
    """The array `name` as it is stored, and the factor of integers."""
    if name in HALF:
        limit = float(np.finfo(np.float16).max)
        return np.clip(values, -limit, limit).astype(np.float16), None
    if name in SCALED:
        dtype, factor = SCALED[name]
        return np.rint(values / factor).astype(dtype), factor
    return values.astype(np.float32), None


def check_group(group: GaussianGroup) -> None:
    """Shapes that do not fit are a mistake of the caller."""
    n = len(group)
    shapes = {
        "means": (n, 3),
        "quaternions": (n, 4),
        "log_scales": (n, 3),
        "opacity_logits": (n,),
        "log_radiance": (n, 3),
        "velocities": (n, 3),
        "centers": (n,),
        "log_durations": (n,),
        "sh1": (n, 3, 3),
    }
    for name, shape in shapes.items():
        values = getattr(group, name)
        assert values is None or values.shape == shape, (group.name, name, values.shape)
    local = [group.velocities, group.centers, group.log_durations]
    assert all(a is None for a in local) or all(a is not None for a in local), group.name
