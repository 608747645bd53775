"""Grids initialized from the depth prior: the first render already shows the scene."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import random_field, small, trainer

from hdr_nsff.fields.build import build_field
from hdr_nsff.fields.nsff.branches import GridConfig
from hdr_nsff.fields.nsff.encodings import AdditiveGrid
from hdr_nsff.fields.nsff.initialize_grid import SurfaceSamples, fit_radiance, initialize_grid
from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.scene.batch import PixelBatch, gather
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.train import Trainer

FINE = GridConfig(finest=1.0, depth_cells=48, levels=4, max_rows=2**20)


@pytest.fixture(scope="module")
def untrained(toy: Scene, toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """Before its first step."""
    config = small("grid", toy_folder, tmp_path_factory.mktemp("initialize") / "run")
    field = replace(config.field, encoding=FINE, render_samples=48)
    return trainer(replace(config, field=field), toy)


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(float((a - b).square().mean()))


def test_an_initialized_field_renders_the_recordings_and_the_depth(
    untrained: Trainer, toy: Scene
) -> None:
    for i in (1, 2, 4):
        f = toy.train[i]
        render = untrained.field.render(f.camera, f.time)
        recorded = untrained.tonemapper(render.radiance, f.bracket, f.camera_id, i, leaky=False)
        rgb = recorded.detach().view_as(f.image)
        flat = f.image.mean((0, 1)).expand_as(f.image)
        assert psnr(rgb, f.image) > psnr(flat, f.image) + 4  # dB
        assert float((1 / render.depth - f.disparity.reshape(-1)).abs().median()) < 0.03
        motion = render.motion.view(f.moving.shape)
        assert float(motion[f.moving].mean()) > 0.4 > 0.1 > float(motion[~f.moving].mean())


def flat(scene: Scene, rgb: float, moving: float) -> Scene:
    """The scene with one color for static and one for moving pixels."""
    frames = []
    for f in scene.train:
        gray = torch.where(f.moving[..., None], moving, rgb)
        frames.append(replace(f, image=gray.expand(*f.moving.shape, 3).clone()))
    return replace(scene, train=frames)


def field_of(scene: Scene, rgb: float, moving: float) -> NSFF:
    field = build_field(small("grid").field, scene)
    frames = flat(scene, rgb, moving).train
    assert initialize_grid(field, frames, lambda recorded, i: recorded**2.2)
    return field


def test_a_flat_color_is_stored_exactly(toy: Scene) -> None:
    f = toy.train[2]
    pixels = (~f.moving).nonzero().flip(-1)[::7]
    radiance = surface(field_of(toy, 0.5, 0.8), toy, pixels)
    torch.testing.assert_close(radiance, torch.full_like(radiance, 0.5**2.2), atol=0.03, rtol=0)


def surface(field: NSFF, scene: Scene, pixels: torch.Tensor) -> torch.Tensor:
    """Static radiance at the pixels' prior depth."""
    b: PixelBatch = gather(scene, 2, pixels)
    rays = b.camera.rays(b.pixels)
    coords = field.space.encode(rays.origins + rays.directions / b.disparity[:, None])
    with torch.no_grad():
        return field.to_radiance(field.branches.static(coords, coords)[:, :3])


def test_moving_pixels_leave_the_static_grid_alone(toy: Scene) -> None:
    one, other = field_of(toy, 0.5, 0.8), field_of(toy, 0.5, 0.2)
    assert torch.equal(one.branches.static_grid.table, other.branches.static_grid.table)
    assert not torch.equal(one.branches.dynamic_grid.table, other.branches.dynamic_grid.table)


def test_without_depth_or_without_grids_nothing_is_initialized(toy: Scene) -> None:
    network = random_field("paper", toy)
    before = {k: v.clone() for k, v in network.state_dict().items()}
    assert not initialize_grid(network, toy.train, lambda rgb, i: rgb)
    assert all(torch.equal(v, before[k]) for k, v in network.state_dict().items())
    blind = [replace(f, disparity=None) for f in toy.train]
    grid = build_field(small("grid").field, toy)
    assert not initialize_grid(grid, blind, lambda rgb, i: rgb)
    assert not grid.branches.static_grid.table.any()


def test_every_frame_is_inverted_by_its_recording(toy: Scene) -> None:
    calls = []

    def to_radiance(rgb: torch.Tensor, frame: int) -> torch.Tensor:
        calls.append((frame, len(rgb)))
        return rgb

    initialize_grid(build_field(small("grid").field, toy), toy.train, to_radiance)
    assert calls == [(i, 60 * 34) for i in range(6)]


def fit_residual(sweeps: int, monkeypatch: pytest.MonkeyPatch) -> float:
    """RMS residual of a chequered wall after fitting, three cells to a square."""
    monkeypatch.setattr("hdr_nsff.fields.nsff.initialize_grid.FINEST_SWEEPS", sweeps)
    axis = (torch.arange(64) + 0.5) / 64
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    coords = torch.stack([x, y, torch.full_like(x, 0.5)], -1).reshape(-1, 3)
    squares = ((coords[:, 0] * 64 // 3 + coords[:, 1] * 64 // 3) % 2)[:, None].expand(-1, 3)
    n = len(coords)
    wall = SurfaceSamples(
        coords,
        squares,
        trust=torch.ones(n),
        moving=torch.zeros(n, dtype=torch.bool),
        knot=0.0,
        free_space=lambda: (torch.zeros(n, 1, 3), torch.zeros(n)),
    )
    grid = AdditiveGrid([(16, 16, 4, 1), (32, 32, 4, 1), (64, 64, 4, 1)])
    fit_radiance(grid, [wall], moving=False)
    return float((grid(coords).detach()[:, :3] - squares).square().mean().sqrt())


def test_more_sweeps_sharpen_what_one_leaves_blurred(monkeypatch: pytest.MonkeyPatch) -> None:
    one, four = fit_residual(1, monkeypatch), fit_residual(4, monkeypatch)
    assert four < 0.75 * one < 0.75 * 0.5  # 0.5: the residual of the mean alone
