"""Painting a grid field from the depth prior: the first render already shows the scene."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import random_field, small, trainer

from hdr_nsff.fields import build_field
from hdr_nsff.fields.nsff.branches import GridConfig
from hdr_nsff.fields.nsff.encodings import AdditiveGrid
from hdr_nsff.fields.nsff.initialize_grid import Splash, exposure_trust, paint, paint_radiance
from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.scene.batch import PixelBatch, gather
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.train import Trainer

FINE = GridConfig(finest=1.0, depth_cells=48, levels=4, max_rows=2**20)


@pytest.fixture(scope="module")
def painted(toy: Scene, toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """Before its first step."""
    config = small("grid", toy_folder, tmp_path_factory.mktemp("paint") / "run")
    return trainer(
        replace(config, field=replace(config.field, encoding=FINE, render_samples=48)), toy
    )


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(float((a - b).square().mean()))


def test_a_painted_field_renders_the_recordings_and_the_depth(painted: Trainer, toy: Scene) -> None:
    for i in (1, 2, 4):
        f = toy.train[i]
        render = painted.field.render(f.camera, f.time)
        rgb = (
            painted.tonemapper(render.radiance, f.bracket, f.camera_id, i, leaky=False)
            .detach()
            .view_as(f.image)
        )
        flat = f.image.mean((0, 1)).expand_as(f.image)
        assert psnr(rgb, f.image) > psnr(flat, f.image) + 4  # dB
        assert float((1 / render.depth - f.disparity.reshape(-1)).abs().median()) < 0.03
        motion = render.motion.view(f.moving.shape)
        assert float(motion[f.moving].mean()) > 0.4 > 0.1 > float(motion[~f.moving].mean())


def flat(scene: Scene, rgb: float, moving: float) -> Scene:
    """The scene with one color for what stands and one for what moves."""
    frames = [
        replace(
            f,
            image=torch.where(f.moving[..., None], moving, rgb).expand(*f.moving.shape, 3).clone(),
        )
        for f in scene.train
    ]
    return replace(scene, train=frames)


def field_of(scene: Scene, rgb: float, moving: float) -> NSFF:
    field = build_field(small("grid").field, scene)
    assert paint(field, flat(scene, rgb, moving).train, lambda recorded, i: recorded**2.2)
    return field


def test_a_flat_color_is_painted_exactly(toy: Scene) -> None:
    f = toy.train[2]
    pixels = (~f.moving).nonzero().flip(-1)[::7]
    radiance = surface(field_of(toy, 0.5, 0.8), toy, pixels)
    torch.testing.assert_close(radiance, torch.full_like(radiance, 0.5**2.2), atol=0.03, rtol=0)


def surface(field: NSFF, scene: Scene, pixels: torch.Tensor) -> torch.Tensor:
    """Static radiance where the pixels' depth says the surface is."""
    b: PixelBatch = gather(scene, 2, pixels)
    rays = b.camera.rays(b.pixels)
    coords = field.space.encode(rays.origins + rays.directions / b.disparity[:, None])
    with torch.no_grad():
        return field.to_radiance(field.branches.static(coords, coords)[:, :3])


def test_moving_pixels_paint_no_static_color(toy: Scene) -> None:
    one, other = field_of(toy, 0.5, 0.8), field_of(toy, 0.5, 0.2)
    assert torch.equal(one.branches.static_grid.table, other.branches.static_grid.table)
    assert not torch.equal(one.branches.dynamic_grid.table, other.branches.dynamic_grid.table)


def test_without_depth_or_without_grids_nothing_is_painted(toy: Scene) -> None:
    network = random_field("paper", toy)
    before = {k: v.clone() for k, v in network.state_dict().items()}
    assert not paint(network, toy.train, lambda rgb, i: rgb)
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    blind = [replace(f, disparity=None) for f in toy.train]
    grid = build_field(small("grid").field, toy)
    assert not paint(grid, blind, lambda rgb, i: rgb) and not grid.branches.static_grid.table.any()


def test_every_frame_is_inverted_by_its_own_recording(toy: Scene) -> None:
    asked = []
    paint(
        build_field(small("grid").field, toy),
        toy.train,
        lambda rgb, i: (asked.append((i, len(rgb))), rgb)[1],
    )
    assert asked == [(i, 60 * 34) for i in range(6)]


def test_clipped_recordings_are_hardly_trusted() -> None:
    trust = exposure_trust(
        torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [0.0, 0.0, 0.0], [0.2, 0.2, 0.2]])
    )
    torch.testing.assert_close(trust, torch.tensor([0.5, 1e-3, 1e-3, 0.2]))


def left_over(sweeps: int, monkeypatch: pytest.MonkeyPatch) -> float:
    """RMS of what painting leaves of a chequered wall, three cells to a square."""
    monkeypatch.setattr("hdr_nsff.fields.nsff.initialize_grid.SWEEPS", sweeps)
    axis = (torch.arange(64) + 0.5) / 64
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    coords = torch.stack([x, y, torch.full_like(x, 0.5)], -1).reshape(-1, 3)
    squares = ((coords[:, 0] * 64 // 3 + coords[:, 1] * 64 // 3) % 2)[:, None].expand(-1, 3)
    n = len(coords)
    wall = Splash(
        coords,
        squares,
        torch.ones(n),
        torch.zeros(n, dtype=torch.bool),
        torch.zeros(n, 1, 3),
        torch.zeros(n),
        0.0,
    )
    grid = AdditiveGrid([(16, 16, 4, 1), (32, 32, 4, 1), (64, 64, 4, 1)])
    paint_radiance(grid, [wall], moving=False)
    return float((grid(coords).detach()[:, :3] - squares).square().mean().sqrt())


def test_more_sweeps_sharpen_what_one_leaves_blurred(monkeypatch: pytest.MonkeyPatch) -> None:
    one, four = left_over(1, monkeypatch), left_over(4, monkeypatch)
    assert four < 0.75 * one < 0.75 * 0.5  # half is what painting nothing but the mean would leave
