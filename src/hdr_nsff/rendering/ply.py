"""3D Gaussians as a PLY file, the common exchange format (Kerbl et al. 2023).

Binary little-endian float32, one vertex per Gaussian. Color is the constant term of
spherical harmonics, opacity a logit, scales natural logs of standard deviations,
rotation a unit quaternion w x y z; normals are there because readers expect them, and
are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic

# The constant spherical harmonic, 1 / (2 sqrt(pi)): color = 0.5 + SH_0 * f_dc.
SH_0 = 0.28209479177387814
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
MAKER = "made by hdr-nsff"
MAX_OPACITY = 1 - 1e-6  # written ones are clipped to this: logits stay finite
MIN_LENGTH = 1e-30  # scene units, of scales and quaternions: logs stay finite
MAKER_BYTES = 2000  # of a file, within which its header names its maker


@dataclass(frozen=True)
class Splats:
    """G Gaussians, numpy."""

    means: np.ndarray  # (G, 3) scene units
    quaternions: np.ndarray  # (G, 4) w x y z
    scales: np.ndarray  # (G, 3) standard deviations > 0, scene units
    opacities: np.ndarray  # (G,) in [0, 1]
    colors: np.ndarray  # (G, 3) to be composited: rgb in [0, 1], or linear radiance


def write(path: Path | str, splats: Splats, comments: Sequence[str] = ()) -> None:
    """Write `splats`, atomically; `comments` go into the header.

    NaN and Inf are an error.
    """
    data = vertices(splats)
    assert np.isfinite(data).all(), f"{path}: Gaussians hold NaN or Inf"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(data)}",  # some readers want it in the third line
        *(f"property float {name}" for name in PROPERTIES),
        *(f"comment {comment}" for comment in (MAKER, *comments)),
        "end_header\n",
    ]
    header = "\n".join(lines).encode("ascii", "replace")
    with atomic(path) as temporary:
        temporary.write_bytes(header + data.tobytes())


def vertices(splats: Splats) -> np.ndarray:
    """The columns of `PROPERTIES` (G, 17) float32."""
    opacities = splats.opacities.astype(np.float64).clip(1 - MAX_OPACITY, MAX_OPACITY)
    lengths = np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    columns = [
        splats.means,
        np.zeros((len(splats.means), 3)),
        (splats.colors.astype(np.float64) - 0.5) / SH_0,
        np.log(opacities / (1 - opacities))[:, None],
        np.log(splats.scales.astype(np.float64).clip(MIN_LENGTH)),
        splats.quaternions / lengths.clip(MIN_LENGTH),
    ]
    return np.concatenate(columns, 1).astype("<f4")


def read(path: Path | str) -> Splats:
    """The Gaussians of a file that `write` wrote.

    InputError for any other file, and where it is cut short.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; put it back or correct the name")
    header, end, body = Path(path).read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii", "replace").splitlines()
    names = tuple(line.split()[-1] for line in lines if line.startswith("property float "))
    binary = lines[1:2] == ["format binary_little_endian 1.0"]
    if not (end and binary and names == PROPERTIES and lines[2].startswith("element vertex ")):
        problem = "not a PLY of Gaussians that `hdr-nsff export` wrote"
        raise InputError(f"{path}: {problem}; export it again")
    count = int(lines[2].split()[-1])
    if len(body) != 4 * len(names) * count:
        raise InputError(f"{path}: the PLY is cut short; copy it again, or export it again")
    columns = np.frombuffer(body, "<f4").reshape(count, len(names))
    return Splats(
        means=columns[:, :3],
        quaternions=columns[:, 13:17],
        scales=np.exp(columns[:, 10:13]),
        opacities=1 / (1 + np.exp(-columns[:, 9])),
        colors=0.5 + SH_0 * columns[:, 6:9],
    )


def is_ours(path: Path | str) -> bool:
    """Whether a file was written by `write`."""
    with open(path, "rb") as file:
        return f"comment {MAKER}\n".encode() in file.read(MAKER_BYTES)
