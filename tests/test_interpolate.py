"""Time between frames: splatted samples land where the closed form says, energy is kept, nothing tears open."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from fakes import DiscBeforeWall, H, W, WALL, camera

from hdr_nsff.camera import Camera
from hdr_nsff.interpolate import Layers, neighbours, render_at, splat_layer

CAMERA = camera()


def red_centre(radiance: Tensor) -> Tensor:
    """The centroid (x, y) in pixels of what is redder than the wall."""
    weight = (radiance[:, 0] - radiance[:, 1]).clamp_min(0)[:, None]
    return (CAMERA.pixel_grid() * weight).sum(0) / weight.sum()


@pytest.mark.parametrize("fraction", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("empty_moves", [False, True])
def test_a_disc_at_constant_velocity_lands_at_the_closed_form_place(fraction: float, empty_moves: bool) -> None:
    field = DiscBeforeWall(empty_moves=empty_moves)
    start, step = red_centre(field.render(CAMERA, 0.0).radiance), torch.tensor([8.0, 2.0])
    seen = render_at(field, CAMERA, fraction, [0.0, 1.0])
    assert torch.allclose(red_centre(seen.radiance), start + fraction * step, atol=0.2)
    truth = field.render(CAMERA, fraction)
    assert (seen.radiance - truth.radiance).abs().mean() < 2.0  # 100 x half of the disc's edge (31 of 1536 pixels)
    assert abs(seen.motion.sum() - truth.motion.sum()) < 9  # the disc keeps its 79 pixels


def test_unmoved_wall_is_exact_and_nothing_tears_open() -> None:
    seen = render_at(DiscBeforeWall(), CAMERA, 0.5, [0.0, 1.0])
    wall = DiscBeforeWall().layers(CAMERA, 0.0).radiance[:, 1]
    far = (CAMERA.pixel_grid() - torch.tensor([20.0, 13.0])).norm(dim=-1) > 16  # away from both places of the disc
    assert torch.allclose(seen.radiance[far], wall[far], atol=1e-5) and torch.allclose(seen.depth[far], torch.tensor(WALL))
    assert torch.allclose(seen.opacity, torch.ones(W * H), atol=1e-5)


def test_splatting_with_zero_flow_is_the_identity() -> None:
    generator = torch.Generator().manual_seed(0)
    alpha, value = torch.rand(W * H, 1, generator=generator), torch.rand(W * H, 4, generator=generator)
    moved_alpha, moved_value = splat_layer(CAMERA.pixel_grid(), alpha, value, W, H)
    assert torch.allclose(moved_alpha, alpha) and torch.allclose(moved_value, value, atol=1e-5)


def test_splatting_keeps_the_energy_of_what_moves() -> None:
    alpha = torch.zeros(H, W, 1)
    alpha[10:14, 10:14] = 0.5  # 16 pixels; all samples move by a quarter and three quarters of a pixel
    value = torch.full((W * H, 1), 3.0)
    pixels = CAMERA.pixel_grid() + torch.tensor([0.25, 0.75])
    moved_alpha, moved_value = splat_layer(pixels, alpha.reshape(-1, 1), value, W, H)
    assert moved_alpha.sum().item() == pytest.approx(8.0) and (moved_alpha * moved_value).sum().item() == pytest.approx(24.0)


def test_spreading_samples_leave_no_cracks() -> None:
    centre = torch.tensor([W / 2, H / 2])
    pixels = centre + (CAMERA.pixel_grid() - centre) * 1.3
    alpha, value = splat_layer(pixels, torch.ones(W * H, 1), torch.ones(W * H, 1), W, H)
    assert alpha.min() > 0.97 and torch.allclose(value, torch.ones_like(value), atol=1e-5)


def test_a_mover_over_empty_samples_that_stand_still_stays_opaque() -> None:
    inside = torch.zeros(H, W, dtype=torch.bool)
    inside[8:16, 8:16] = True
    shift = torch.where(inside.reshape(-1, 1), torch.tensor([4.0, 0.0]), torch.zeros(2))
    alpha, _ = splat_layer(CAMERA.pixel_grid() + shift, inside.reshape(-1, 1).float(), torch.ones(W * H, 1), W, H)
    assert torch.equal(alpha.reshape(H, W)[8:16, 12:20], torch.ones(8, 8)) and alpha.sum() == 64


def test_where_neither_time_shows_anything_the_nearer_one_stands() -> None:
    class Fleeing(DiscBeforeWall):
        """One opaque layer whose right half leaves the picture from either side."""

        def layers(self, camera: Camera, time: float, pixels: Tensor | None = None) -> Layers:
            layers = super().layers(camera, time, pixels)
            right = (camera.pixel_grid()[:, 0] > W / 2).float()[:, None, None]
            flow = right * torch.tensor([[1000.0, 0, 0]] * 2)
            radiance = torch.full_like(layers.radiance, 1.0 + time)
            return replace(layers, alpha=torch.ones_like(layers.alpha), scene_flow={1: flow, -1: flow}, radiance=radiance)

    seen = render_at(Fleeing(), CAMERA, 0.75, [0.0, 1.0]).radiance.reshape(H, W, 3)
    assert torch.allclose(seen[:, W // 2 + 1 :], torch.tensor(2.0))  # time 1 is nearer
    assert torch.allclose(seen[:, : W // 2], torch.tensor(1.75))  # 0.25 * 1 + 0.75 * 2


def test_neighbours_of_uneven_times() -> None:
    assert neighbours(2.5, [0.0, 1.0, 4.0]) == (1.0, 4.0, 0.5)
    assert neighbours(1.00001, [0.0, 1.0, 4.0]) == (1.0, 1.0, 0.0)
    assert neighbours(9.0, [0.0, 1.0, 4.0]) == (4.0, 4.0, 0.0)


def test_direct_query_and_training_times_ask_the_field_itself() -> None:
    field = DiscBeforeWall()
    for mode, time in (("direct", 0.3), ("splat", 1.0)):
        assert torch.equal(render_at(field, CAMERA, time, [0.0, 1.0], mode).radiance, field.render(CAMERA, time).radiance)
