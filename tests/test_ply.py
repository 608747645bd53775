"""3D Gaussians as PLY files: what is written is read back, extremes stay finite."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.rendering import ply


def random_splats() -> ply.Splats:
    """Nine Gaussians."""
    g = np.random.default_rng(0)
    quaternions = g.normal(size=(9, 4)).astype(np.float32)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return ply.Splats(
        means=g.normal(size=(9, 3)),
        quaternions=quaternions,
        scales=g.random((9, 3)) + 0.01,
        opacities=g.random(9),
        colors=100 * g.random((9, 3)),
    )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    given = random_splats()
    ply.write(tmp_path / "a.ply", given, ["a remark"])
    found = ply.read(tmp_path / "a.ply")
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name), rtol=1e-5, atol=1e-6)


def test_extremes_stay_finite(tmp_path: Path) -> None:
    zeros = np.zeros((2, 3))
    given = ply.Splats(zeros, np.eye(4)[:2], zeros, np.array([0.0, 1.0]), zeros)
    ply.write(tmp_path / "a.ply", given)
    body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[2]
    assert np.isfinite(np.frombuffer(body, "<f4")).all()
    np.testing.assert_allclose(ply.read(tmp_path / "a.ply").opacities, [0, 1], atol=2e-6)


@pytest.mark.parametrize("length", [3, 300, -4])
def test_a_file_cut_short_is_refused(tmp_path: Path, length: int) -> None:
    path = tmp_path / "a.ply"
    ply.write(path, random_splats())
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(InputError, match="export it again"):
        ply.read(path)
