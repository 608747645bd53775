"""NeRF-W with time: what an appearance code may change, and what it may not."""

from dataclasses import replace

import pytest
import torch
from presets import random_field, small
from torch import Tensor

from hdr_nsff.fields.baselines.nerf_wt import NerfWT
from hdr_nsff.fields.build import build_field
from hdr_nsff.fields.nsff.samples import BranchOutput, RaySamples
from hdr_nsff.scene.batch import Recorder, draw_pixels
from hdr_nsff.scene.scene import Scene


def recorder(*images: int) -> Recorder:
    return Recorder(lambda rgb: rgb.clamp(0, 1), images)


@pytest.fixture(params=["nerf-wt", "nerf-wt-paper"])
def field(request: pytest.FixtureRequest, toy: Scene) -> NerfWT:
    field = random_field(request.param, toy)
    assert isinstance(field, NerfWT)
    return field


def test_a_code_changes_colors_and_nothing_else(field: NerfWT, toy: Scene) -> None:
    camera = toy.train[2].camera
    a, b = (field.render(camera, 2.0, recorder=recorder(i)) for i in (0, 4))
    assert float((a.radiance - b.radiance).abs().max()) > 1e-3
    for name in ("depth", "opacity", "motion"):
        assert torch.equal(getattr(a, name), getattr(b, name))


def test_movers_do_not_depend_on_the_code(field: NerfWT, toy: Scene) -> None:
    def query_nothing(samples: RaySamples, keep: Tensor) -> BranchOutput:
        none = torch.zeros(0, dtype=torch.long)
        return field.scatter(torch.zeros(0, 5), none, keep.shape, 0.0)

    camera = toy.train[2].camera
    field.query_static = query_nothing  # type: ignore[method-assign]
    a, b = (field.render(camera, 2.0, recorder=recorder(i)) for i in (0, 4))
    assert float(a.motion.max()) > 0.01 and torch.equal(a.radiance, b.radiance)


def test_another_view_borrows_the_mean_code_of_its_exposure(field: NerfWT, toy: Scene) -> None:
    camera, table = toy.train[2].camera, field.codes.table.data
    mean = field.render(camera, 2.0, recorder=recorder(1, 4)).radiance
    table[0] = (table[1] + table[4]) / 2
    torch.testing.assert_close(field.render(camera, 2.0, recorder=recorder(0)).radiance, mean)


def test_radiance_is_rendered_at_the_reference_exposure_by_default(
    field: NerfWT, toy: Scene
) -> None:
    camera = toy.train[2].camera
    reference = tuple(
        i for i, f in enumerate(toy.train) if f.bracket == toy.manifest.reference_bracket
    )
    assert reference == (1, 4)
    field.render(camera, 2.0, recorder=recorder(3))  # must leave nothing behind
    expected = field.render(camera, 2.0, recorder=recorder(*reference)).radiance
    torch.testing.assert_close(field.render(camera, 2.0).radiance, expected)


def touched(table: Tensor) -> list[int]:
    assert table.grad is not None
    return table.grad.any(-1).nonzero()[:, 0].tolist()


def test_a_recording_trains_the_code_of_its_image_alone(field: NerfWT, toy: Scene) -> None:
    batch = draw_pixels(toy, 3, 60, 0, torch.Generator().manual_seed(0))
    render, own = field(replace(batch, recorder=recorder(3)))
    (render.radiance - batch.rgb).square().mean().backward()
    assert touched(field.codes.table) == [3] and render.warps == () and render.scene_flow == {}
    assert set(own) == {"transient"} and float(own["transient"].detach()) > 0


def test_with_grids_the_color_network_changes_nothing_at_the_start(toy: Scene) -> None:
    field = build_field(small("nerf-wt").field, toy)
    coords = torch.rand(20, 3)
    field.branches.static_grid.table.data.normal_()
    plain = field.branches.static_grid(coords)
    torch.testing.assert_close(field.branches.static(coords, coords)[:, :4], plain)
