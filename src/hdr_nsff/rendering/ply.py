"""3D Gaussians as a PLY file, the common exchange format (Kerbl et al. 2023): binary
little-endian float32, one vertex per Gaussian.

Color is the constant term of spherical harmonics, opacity a logit, scales natural logs
of standard deviations, rotation a unit quaternion w x y z; normals are there because
readers expect them, and are zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic

# the constant spherical harmonic, 1 / (2 sqrt(pi)): color = 0.5 + SH_0 * f_dc
SH_0 = 0.28209479177387814
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
MAKER = "made by hdr-nsff"
OPAQUE = 1 - 1e-6  # opacities beyond this are held: logits stay finite
SMALLEST = 1e-30  # lengths below this too


@dataclass(frozen=True)
class Splats:
    """G Gaussians, numpy."""

    means: np.ndarray  # (G, 3) scene units
    quaternions: np.ndarray  # (G, 4) w x y z
    scales: np.ndarray  # (G, 3) standard deviations > 0, scene units
    opacities: np.ndarray  # (G,) in [0, 1]
    colors: np.ndarray  # (G, 3) what is to be composited: rgb in [0, 1], or linear radiance


def write(path: Path | str, splats: Splats, comments: Sequence[str] = ()) -> None:
    """Write `splats`, atomically; `comments` go into the header. NaN and Inf are an
    error.
    """
    count = len(splats.means)
    opacities = splats.opacities.astype(np.float64).clip(1 - OPAQUE, OPAQUE)
    columns = [
        splats.means,
        np.zeros((count, 3)),
        (splats.colors.astype(np.float64) - 0.5) / SH_0,
        np.log(opacities / (1 - opacities))[:, None],
        np.log(splats.scales.astype(np.float64).clip(SMALLEST)),
        splats.quaternions
        / np.linalg.norm(splats.quaternions, axis=1, keepdims=True).clip(SMALLEST),
    ]
    data = np.concatenate(columns, 1).astype("<f4")
    assert np.isfinite(data).all(), f"{path}: Gaussians hold NaN or Inf"
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {count}",
        *(f"property float {name}" for name in PROPERTIES),
    ]
    lines += [
        f"comment {c}" for c in (MAKER, *comments)
    ]  # last: some readers want the vertices in the third line
    with atomic(path) as temporary:
        temporary.write_bytes(
            "\n".join([*lines, "end_header\n"]).encode("ascii", "replace") + data.tobytes()
        )


def read(path: Path | str) -> Splats:
    """The Gaussians of a file that `write` wrote. InputError for anything else and
    where it is cut short.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; put it back or mend the name")
    header, end, body = Path(path).read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii", "replace").splitlines()
    names = tuple(line.split()[-1] for line in lines if line.startswith("property float "))
    known = (
        lines[1:2] == ["format binary_little_endian 1.0"]
        and lines[2].startswith("element vertex ")
        and names == PROPERTIES
    )
    if not (end and known):
        raise InputError(
            f"{path}: no PLY of Gaussians as `hdr-nsff export` writes them; export it again"
        )
    count = int(lines[2].split()[-1])
    if len(body) != 4 * len(names) * count:
        raise InputError(f"{path}: the PLY is cut short; copy it again, or export it again")
    v = np.frombuffer(body, "<f4").reshape(count, len(names))
    return Splats(
        v[:, :3],
        v[:, 13:17],
        np.exp(v[:, 10:13]),
        1 / (1 + np.exp(-v[:, 9])),
        0.5 + SH_0 * v[:, 6:9],
    )


def is_ours(path: Path | str) -> bool:
    """Whether a file was written by `write`."""
    with open(path, "rb") as file:
        return f"comment {MAKER}\n".encode() in file.read(2000)
