"""The Gaussians of a moment by numba kernels on the CPU, against plain torch."""

from typing import Any

import pytest
from moments import MOMENTS, compare, field_of_times, random_field
from test_splat import scattered

from hdr_nsff.fields.splat import draw
from hdr_nsff.fields.splat.numba_cloud import numba_cloud


@pytest.fixture(autouse=True)
def gaussians_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be rasterized is the picture."""
    monkeypatch.setattr(draw, "rasterize", lambda *arguments: arguments[:5])


@pytest.mark.parametrize(("seed", "settings", "knot", "offset"), MOMENTS)
def test_moments(seed: int, settings: dict[str, Any], knot: float, offset: int | None) -> None:
    compare(numba_cloud, random_field(seed, **settings), knot, offset)


@pytest.mark.parametrize("num_times", [1, 2, 3])
def test_short_clips(num_times: int) -> None:
    compare(numba_cloud, field_of_times(num_times), float(num_times - 1), -1)
    compare(numba_cloud, field_of_times(num_times), 0.0, None)


def test_more_gaussians_than_a_chunk() -> None:
    field = scattered(5, static=600, moving=550)
    field.find_neighbors()
    compare(numba_cloud, field, 5.0, 1)
    compare(numba_cloud, field, 5.0, None)
