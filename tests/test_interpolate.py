"""Time between frames: splatted samples land where the closed form says, energy is
kept, nothing tears open.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from fakes import FOCAL, SPEED, WALL, DiscBeforeWall, H, W, camera
from torch import Tensor

from hdr_nsff.fields.outputs import Layers
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.rendering.interpolate import Mode, Picture, flow_duration, neighbors, render_at, splat

CAMERA = camera()


def red_center(radiance: Tensor) -> Tensor:
    """The centroid (x, y) in pixels of the pixels redder than the wall."""
    weight = (radiance[:, 0] - radiance[:, 1]).clamp_min(0)[:, None]
    return (CAMERA.pixel_grid() * weight).sum(0) / weight.sum()


def test_between_two_training_times_that_are_all_scene_flow_spans_them() -> None:
    field = DiscBeforeWall()
    at_start = field.render(CAMERA, 0.0).scene_flow
    between = render_at(field, CAMERA, 0.5, [0.0, 2.0], "splat").scene_flow
    assert flow_duration(1.0, 1, [0.0, 2.0]) == flow_duration(1.0, -1, [0.0, 2.0]) == 2
    for side, flow in between.items():
        assert torch.isfinite(flow).all()
        torch.testing.assert_close(flow.abs().max(), at_start[side].abs().max())


@pytest.mark.parametrize("fraction", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("empty_moves", [False, True])
def test_a_disc_at_constant_velocity_lands_at_the_closed_form_place(
    fraction: float, empty_moves: bool
) -> None:
    field = DiscBeforeWall(empty_moves=empty_moves)
    start = red_center(field.render(CAMERA, 0.0).radiance)
    step = torch.tensor([8.0, 2.0])
    seen = render_at(field, CAMERA, fraction, [0.0, 1.0])
    assert torch.allclose(red_center(seen.radiance), start + fraction * step, atol=0.2)
    truth = field.render(CAMERA, fraction)
    # 100 x half of the disc's edge (31 of 1536 pixels)
    assert (seen.radiance - truth.radiance).abs().mean() < 2.0
    assert abs(seen.motion.sum() - truth.motion.sum()) < 9  # the disc keeps its 79 pixels


@pytest.mark.parametrize(("time", "later", "earlier"), [(0.25, 1.75, 1.75), (2.5, 3.25, 2.125)])
def test_scene_flow_between_times_is_that_of_a_straight_line(
    time: float, later: float, earlier: float
) -> None:
    """Over one training interval, which ends between two times as well: 0.25 to 2.0,
    2.5 to 5.75 and to 0.375. Before the clip there is none, so the later one counts.
    """
    times = [0.0, 1.0, 5.0, 7.0]
    gap = 1.0 if time < 1 else 4.0

    class Disc(DiscBeforeWall):
        """A disc whose scene flow spans the interval that is splatted."""

        def layers(self, camera: Camera, time: float, pixels: Tensor | None = None) -> Layers:
            layers = super().layers(camera, time, pixels)
            return replace(layers, scene_flow={o: gap * f for o, f in layers.scene_flow.items()})

    speed = SPEED / 4
    seen = render_at(Disc(speed=speed), CAMERA, time, times)
    disc = seen.motion > 0.99
    assert disc.sum() > 40
    for side, frames in ((1, later), (-1, -earlier)):
        assert torch.allclose(seen.scene_flow[side][disc], frames * speed, atol=1e-3)
        assert not seen.scene_flow[side][seen.motion == 0].any()
    assert not render_at(Disc(), CAMERA, time, times, scene_flow=False).scene_flow


def test_a_wall_at_rest_is_exact_and_has_no_holes() -> None:
    seen = render_at(DiscBeforeWall(), CAMERA, 0.5, [0.0, 1.0])
    wall = DiscBeforeWall().layers(CAMERA, 0.0).radiance[:, 1]
    offset = CAMERA.pixel_grid() - torch.tensor([20.0, 13.0])
    far = offset.norm(dim=-1) > 16  # away from both places of the disc
    assert torch.allclose(seen.radiance[far], wall[far], atol=1e-5)
    assert torch.allclose(seen.depth[far], torch.tensor(WALL))
    assert torch.allclose(seen.opacity, torch.ones(W * H), atol=1e-5)


def one_layer(alpha: Tensor, value: Tensor, shift: Tensor) -> Picture:
    """A single layer at z = 2 of `alpha` (S,) and gray radiance `value` (S,) after its
    samples moved by `shift` (S, 2) pixels.
    """
    rays = CAMERA.rays(CAMERA.pixel_grid())
    flow = torch.cat([shift * 2 / FOCAL, torch.zeros(W * H, 1)], -1)[:, None]
    radiance = value[:, None, None].expand(-1, 1, 3)
    points = (rays.origins + 2 * rays.directions)[:, None]
    layers = Layers(points, alpha[:, None], radiance, {1: flow, -1: -flow}, torch.ones(W * H, 1))
    return splat(layers, CAMERA, 1, 1.0)[0]


def test_whole_pixels_of_flow_shift_the_picture_and_zero_flow_leaves_it() -> None:
    generator = torch.Generator().manual_seed(0)
    alpha = 0.1 + 0.9 * torch.rand(W * H, generator=generator)
    value = torch.rand(W * H, generator=generator)
    inside = slice(2, H - 2), slice(3, W)  # pixels from beyond the border are not known
    for dx, dy in ((0, 0), (3, -2)):
        moved = one_layer(alpha, value, torch.tensor([float(dx), float(dy)]).expand(W * H, 2))
        opacity = alpha.view(H, W).roll((dy, dx), (0, 1))
        color = (alpha * value).view(H, W).roll((dy, dx), (0, 1))
        assert torch.allclose(moved.opacity.view(H, W)[inside], opacity[inside], atol=1e-4)
        assert torch.allclose(moved.color[:, 0].view(H, W)[inside], color[inside], atol=1e-4)


def test_splatting_keeps_the_energy_of_moving_samples() -> None:
    alpha = torch.zeros(H, W)
    alpha[10:14, 10:14] = 0.5  # 16 pixels, over empty samples
    shift = torch.tensor([0.25, 0.75]).expand(W * H, 2)
    moved = one_layer(alpha.view(-1), torch.full((W * H,), 3.0), shift)
    assert moved.opacity.sum().item() == pytest.approx(8.0, rel=0.06)
    assert moved.color[:, 0].sum().item() == pytest.approx(24.0, rel=0.06)


def test_spreading_samples_leave_no_cracks() -> None:
    center = torch.tensor([W / 2, H / 2])
    moved = one_layer(torch.ones(W * H), torch.ones(W * H), (CAMERA.pixel_grid() - center) * 0.1)
    assert moved.opacity.min() > 0.95
    assert torch.allclose(moved.color[:, 0], moved.opacity[:, 0], atol=1e-5)


def test_a_mover_over_empty_samples_stays_opaque_and_leaves_no_trace() -> None:
    inside = torch.zeros(H, W)
    inside[8:16, 8:16] = 1
    shift = inside.view(-1, 1) * torch.tensor([4.0, 0.0])
    alpha = one_layer(inside.view(-1), torch.ones(W * H), shift).opacity.view(H, W)
    assert torch.allclose(alpha[8:16, 12:20], torch.ones(8, 8), atol=1e-4)
    assert alpha.sum().item() == pytest.approx(64, abs=0.01)


def test_where_both_times_are_empty_the_nearer_one_is_shown_without_motion() -> None:
    class Fleeing(DiscBeforeWall):
        """One opaque layer whose right half leaves the picture from either side."""

        def layers(self, camera: Camera, time: float, pixels: Tensor | None = None) -> Layers:
            layers = super().layers(camera, time, pixels)
            right = (camera.pixel_grid()[:, 0] > W / 2).float()[:, None, None]
            flow = right * torch.tensor([[1000.0, 0, 0]] * 2)
            radiance = torch.full_like(layers.radiance, 1.0 + time)
            return replace(
                layers,
                alpha=torch.ones_like(layers.alpha),
                scene_flow={1: flow, -1: flow},
                radiance=radiance,
            )

    seen = render_at(Fleeing(), CAMERA, 0.75, [0.0, 1.0]).radiance.reshape(H, W, 3)
    assert torch.allclose(seen[:, W // 2 + 1 :], torch.tensor(2.0))  # time 1 is nearer
    assert torch.allclose(seen[:, : W // 2], torch.tensor(1.75))  # 0.25 * 1 + 0.75 * 2


def test_neighbors_of_uneven_times() -> None:
    assert neighbors(2.5, [0.0, 1.0, 4.0]) == (1.0, 4.0, 0.5)
    assert neighbors(1.00001, [0.0, 1.0, 4.0]) == (1.0, 1.0, 0.0)
    assert neighbors(9.0, [0.0, 1.0, 4.0]) == (4.0, 4.0, 0.0)


@pytest.mark.parametrize(("mode", "time"), [("direct", 0.3), ("splat", 1.0)])
def test_direct_mode_and_training_times_render_the_field_itself(mode: Mode, time: float) -> None:
    field = DiscBeforeWall()
    seen = render_at(field, CAMERA, time, [0.0, 1.0], mode)
    assert torch.equal(seen.radiance, field.render(CAMERA, time).radiance)
