"""HDR-HexPlane: recording before compositing, growth, and verbs that open its runs."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import HEXPLANE, random_field, small
from torch import nn

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.evaluation.evaluate import EvaluateConfig, evaluate
from hdr_nsff.fields.baselines.hexplane import NUM_GROWTHS, HexPlane, HexPlaneConfig
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.rendering.output import Output
from hdr_nsff.rendering.render import RenderConfig, render
from hdr_nsff.scene.batch import PixelBatch, Recorder, draw_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.config import check_config
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train


def test_the_grid_grows_three_times_to_its_finest(toy: Scene) -> None:
    field = random_field("hdr-hexplane", toy)
    assert isinstance(field, HexPlane)
    sizes = []
    for step in range(1, 5 * HEXPLANE.grow_every):
        field.after_step(step, None)
        sizes.append(int(field.density_planes.cells))
    assert (
        sorted(set(sizes)) == [8, 10, 13, 16] and len(set(sizes)) == NUM_GROWTHS + 1
    )  # 8 * 2^(k/3)


class Slab(nn.Module):
    """Density features by depth in the cube, such as a veil in front of a wall."""

    def __init__(self, densities: dict[float, float]) -> None:
        super().__init__()
        self.densities = densities

    def forward(self, coords: torch.Tensor, share: float) -> torch.Tensor:
        raw = torch.full_like(coords[:, :1], -30.0)
        for z, density in self.densities.items():
            raw[(coords[:, 2] - z).abs() < 0.03] = density
        return raw

    def total_variation(self) -> torch.Tensor:
        return torch.zeros(())


def veil_and_wall(toy: Scene, bright: float, dark: float) -> tuple[HexPlane, PixelBatch]:
    """A field of a dark veil that stops half of the light before a bright wall, and a
    batch of pixels.
    """

    def radiance(coords: torch.Tensor, directions: torch.Tensor, share: float) -> torch.Tensor:
        return torch.where(coords[:, 2:] > 0.5, dark, bright).expand(-1, 3)

    field = random_field("hdr-hexplane", toy)
    assert isinstance(field, HexPlane)
    field.config = replace(field.config, samples=200, cull_after=0)
    field.density_planes = Slab({0.7: 8.2, 0.3: 30.0})  # type: ignore[assignment]
    field.to_density = nn.Identity()  # type: ignore[assignment]
    field.radiance = radiance  # type: ignore[method-assign]
    return field, draw_pixels(toy, 2, 30, 0, torch.Generator().manual_seed(0))


def test_recording_samples_and_then_compositing_is_not_recording_the_composite(toy: Scene) -> None:
    bright, dark = 8.0, 0.05
    field, batch = veil_and_wall(toy, bright, dark)
    sigmoid = Recorder(lambda e: e / (1 + e), (0,))
    render = field(replace(batch, recorder=sigmoid))[0]
    assert render.rgb is not None
    opacity = render.opacity[:, None]
    wall = (render.radiance - dark * opacity) / (bright - dark)  # weight, from the radiance
    veil = opacity - wall
    assert 0.05 < float(veil.mean()) < 0.95
    expected = veil * dark / (1 + dark) + wall * bright / (1 + bright)
    torch.testing.assert_close(render.rgb, expected, atol=1e-4, rtol=1e-3)
    after = sigmoid.rgb(render.radiance)
    assert bool((render.rgb < after - 0.01).all())  # Jensen: the response is concave


def test_a_linear_response_commutes_with_compositing(toy: Scene) -> None:
    field, batch = veil_and_wall(toy, 8.0, 0.05)
    render = field(replace(batch, recorder=Recorder(lambda e: e, (0,))))[0]
    torch.testing.assert_close(render.rgb, render.radiance)


def test_a_constant_radiance_along_an_opaque_ray_is_recorded_equally_both_ways(toy: Scene) -> None:
    field, batch = veil_and_wall(toy, 2.0, 2.0)
    seen = field(replace(batch, recorder=Recorder(lambda e: e / (1 + e), (0,))))[0]
    torch.testing.assert_close(seen.rgb, torch.full_like(seen.rgb, 2 / 3), atol=2e-3, rtol=0)


def test_the_recording_trains_planes_networks_and_exposure(toy: Scene) -> None:
    field, gain = random_field("hdr-hexplane", toy), torch.zeros(1, requires_grad=True)
    batch = draw_pixels(toy, 2, 60, 0, torch.Generator().manual_seed(0))
    recorder = Recorder(lambda e: e * gain.exp() / (1 + e * gain.exp()), (2,))
    render, own = field(replace(batch, recorder=recorder))
    assert render.rgb is not None and set(own) == {"total_variation"}
    (render.rgb - batch.rgb).square().mean().backward()
    assert gain.grad is not None and float(gain.grad.abs()) > 0
    assert all(p.grad is not None and bool(p.grad.any()) for p in field.parameters())


def test_density_is_the_published_softplus_of_a_shifted_number(toy: Scene) -> None:
    field, batch = veil_and_wall(toy, 1.0, 1.0)
    field.density_planes = Slab({0.5: 9.0})  # type: ignore[assignment]
    render = field(replace(batch, recorder=Recorder(lambda e: e, (0,))))[0]
    # softplus(9 - 10) = log(1 + 1 / e), over a slab of 0.06, at a right angle
    thickness = 75 * math.log(1 + math.exp(-1)) * 0.06
    opacity = float(render.opacity.mean())  # rays are slanted, samples coarse
    assert opacity == pytest.approx(1 - math.exp(-thickness), rel=0.12)


@pytest.fixture(scope="module", params=["hdr-hexplane", "nerf-wt"])
def run_of(
    request: pytest.FixtureRequest, toy_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run of a few steps of a baseline that records by itself."""
    out = tmp_path_factory.mktemp(request.param) / "run"
    return train(small(request.param, toy_folder, out, steps=6))


def test_a_run_is_rendered_in_linear_radiance_and_developed_by_the_field(
    run_of: Path, tmp_path: Path
) -> None:
    render(RenderConfig(run_of, "fixed", tmp_path, output=Output(ev=2.0, video=False, exr="float")))
    run = Run.open(run_of)
    exr = torch.from_numpy(read_exr(tmp_path / "fixed/00002.exr")["RGB"]).reshape(-1, 3)
    camera = run.scene.train[3].camera  # the middle frame's
    torch.testing.assert_close(exr, run.field.render(camera, 2.0).radiance, atol=1e-5, rtol=1e-4)
    png = torch.from_numpy(read_image(tmp_path / "fixed/00002.png")).reshape(-1, 3)
    (rgb,) = record_pixels(run.field, camera, 2.0, [run.tonemapper.recorder_at(2.0)])
    torch.testing.assert_close(png, rgb, atol=0.003, rtol=0)


def test_a_run_is_evaluated_at_every_exposure_and_has_no_gaussians_to_export(
    run_of: Path, tmp_path: Path
) -> None:
    result = evaluate(EvaluateConfig(run_of))
    for name in ("psnr", "psnr_moving", "psnr_all_exposures"):
        assert math.isfinite(result["headline"][name])
    run = Run.open(run_of)
    f = run.scene.train[1]
    recorder = run.tonemapper.recorder(f.bracket, f.camera_id)
    (rgb,) = record_pixels(run.field, f.camera, f.time, [recorder])
    mse = float((rgb.view_as(f.image) - f.image).square().mean())
    psnr = next(v["psnr"] for v in result["views"] if v["time"] == f.time)
    assert psnr == pytest.approx(-10 * math.log10(mse), abs=0.05)
    with pytest.raises(InputError, match="Gaussian"):
        export(ExportConfig(run_of, tmp_path / "a.ply", ply=True))


def test_planes_that_would_have_to_shrink_are_refused(tmp_path: Path) -> None:
    field = HexPlaneConfig(coarsest=64, finest=40)
    config = replace(PRESETS["hdr-hexplane"], scene=tmp_path, field=field)
    with pytest.raises(InputError, match=r"--field.finest 40: .*--field.coarsest 64"):
        check_config(config)
