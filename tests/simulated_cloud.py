"""The Gaussians of a moment by CUDA kernels, on a CPU by the simulator of numba-cuda:
against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

from typing import Any

import pytest
import torch
from moments import MOMENTS, THERE, compare, field_of_times, random_field
from test_splat import TIMES, scattered

from hdr_nsff.fields.splat import draw, local_gaussians
from hdr_nsff.fields.splat.fused_cloud import fused_cloud
from hdr_nsff.fields.splat.trajectories import weights_of_differences


@pytest.fixture(autouse=True)
def gaussians_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be rasterized is the picture."""
    monkeypatch.setattr(draw, "rasterize", lambda *arguments: arguments[:5])


@pytest.mark.parametrize(("seed", "settings", "knot", "offset"), MOMENTS)
def test_moments(seed: int, settings: dict[str, Any], knot: float, offset: int | None) -> None:
    compare(fused_cloud, random_field(seed, **settings), knot, offset)


def test_poses_are_smooth_in_time_where_frames_are_missing() -> None:
    times = torch.arange(float(TIMES))
    times[4:] += 1.5
    field = random_field()
    field.trajectories.times = times.tolist()
    field.trajectories.differences = weights_of_differences(times)
    compare(fused_cloud, field, 4.2, None)


@pytest.mark.parametrize("num_times", [1, 2, 3])
def test_short_clips(num_times: int) -> None:
    compare(fused_cloud, field_of_times(num_times), float(num_times - 1), -1)
    compare(fused_cloud, field_of_times(num_times), 0.0, None)


def test_more_gaussians_than_a_block() -> None:
    field = scattered(5, static=130, moving=150)
    field.find_neighbors()
    compare(fused_cloud, field, 5.0, 1)


def test_flow_is_limited_near_the_camera() -> None:
    field = random_field(4)
    with torch.no_grad():
        field.static.means[:5, 2] = 1e-5
        field.static.means[5:8, 2] = -1.0
    assert float(THERE.project(field.static.means.detach())[0].abs().max()) > 100
    compare(fused_cloud, field, 4.0, 1)


@pytest.mark.parametrize("knot", [0.0, 2.4, 4.0])
def test_time_local_gaussians_that_are_alive(knot: float, monkeypatch: pytest.MonkeyPatch) -> None:
    field = random_field()
    with torch.no_grad():
        field.local.log_scales[:, 3] = -1.0
        field.local.means[:, 3] = torch.linspace(0, 4, len(field.local))
    expected = field.alive(knot)
    monkeypatch.setattr(local_gaussians, "kernels_on", lambda device: True)
    assert torch.equal(field.alive(knot), expected)
    assert 0 < len(expected) < len(field.local)
