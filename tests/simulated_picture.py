"""Recordings and losses of a picture by CUDA kernels, on a CPU by the simulator of
numba-cuda: against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

from dataclasses import replace

import pytest
import torch
from moments import random_field
from pictures import CAMERA, PRIORS, N, compare, compare_composites, compare_losses, compare_mixing
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.splat import draw
from hdr_nsff.fields.splat.fused_parts import fused_parts
from hdr_nsff.fields.splat.fused_picture import fused_composite
from hdr_nsff.fields.splat.gaussians import to_radiance
from hdr_nsff.fields.splat.late_mixing import Parts
from hdr_nsff.fields.splat.rasterize import Maps
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.batch import Recorder, Sensor
from hdr_nsff.tonemap.curve import GAMMA, knot_positions, leaky_ends, piecewise_linear
from hdr_nsff.tonemap.photograph_cuda import photograph
from hdr_nsff.tonemap.vignetting import MIN_TRANSMISSION, Vignetting
from hdr_nsff.training.fused_losses import CudaLosses

GAIN = torch.tensor([0.4, 1.0, 1.6])
DARK = torch.tensor([[0.0, 0, 0], [-0.5, 0.2, -2.0]])  # dark corners are held


def random_radiance() -> Tensor:
    """Some of it is negative, clips, or lies on an end or a knot."""
    radiance = 3 * torch.rand(N, 3, generator=torch.Generator().manual_seed(0)) ** 2 - 0.2
    radiance[0], radiance[1] = 0.0, 0.6204
    return radiance


def random_curve(knots: Tensor) -> Tensor:
    return torch.rand(3, len(knots), generator=torch.Generator().manual_seed(3)).cumsum(1) / 128


def plain_recording(x: Tensor, curve: Tensor, knots: Tensor, power: float) -> Tensor:
    return leaky_ends(x, piecewise_linear(x, curve, knots, power), 0.01)


def lens_of(coefficients: Tensor, pixels: Tensor) -> Tensor:
    """The share of light (N, 1) that the lens of camera 1 passes."""
    state = {"coefficients": coefficients}
    share: Tensor = torch.func.functional_call(Vignetting((0.4, 0.5)), state, (CAMERA, pixels, 1))
    return share


def with_lens(sensor: Sensor, coefficients: Tensor) -> Sensor:
    corners = torch.tensor([0.4, 0.5])
    return replace(
        sensor, vignetting=coefficients, corners=corners, camera_id=1, least=MIN_TRANSMISSION
    )


@pytest.mark.parametrize("leak", [0.01, None])
@pytest.mark.parametrize("spacing", ["gamma", "even"])
def test_recordings(leak: float | None, spacing: str) -> None:
    knots = knot_positions(spacing)
    power = 1 / GAMMA if spacing == "gamma" else 1.0

    def plain(radiance: Tensor, gain: Tensor, values: Tensor) -> Tensor:
        x = radiance * gain
        y = piecewise_linear(x, values, knots, power)
        return y if leak is None else leaky_ends(x, y, leak)

    def ours(radiance: Tensor, gain: Tensor, values: Tensor) -> Tensor:
        return photograph(radiance, Sensor.without_lens(gain, values, knots, leak))

    compare(ours, plain, random_radiance(), GAIN, random_curve(knots))


def test_a_radiance_that_is_not_a_number_shows_in_the_curve() -> None:
    knots = knot_positions("even")
    values = knots.expand(3, -1).clone().requires_grad_()
    radiance = torch.full((2, 3), torch.nan)
    rgb = photograph(radiance, Sensor.without_lens(torch.ones(3), values, knots, 0.01))
    rgb.sum().backward()
    assert rgb.isnan().all() and values.grad is not None and values.grad.isnan().any()


def test_lens_and_late_mixing() -> None:
    knots = knot_positions("even")
    pixels = CAMERA.pixel_grid()
    generator = torch.Generator().manual_seed(4)
    late, share = torch.rand(N, 3, generator=generator), torch.rand(N, 1, generator=generator)

    def plain(
        radiance: Tensor, coefficients: Tensor, gain: Tensor, curve: Tensor, *late: Tensor
    ) -> Tensor:
        light = radiance * lens_of(coefficients, pixels) * gain
        return plain_recording(light, curve, knots, 1.0).lerp(*late)

    def ours(
        radiance: Tensor, coefficients: Tensor, gain: Tensor, curve: Tensor, *late: Tensor
    ) -> Tensor:
        sensor = Sensor.without_lens(gain, curve, knots, 0.01)
        return photograph(radiance, with_lens(sensor, coefficients), CAMERA, pixels, late)

    compare(ours, plain, random_radiance(), DARK, GAIN, random_curve(knots), late, share)


@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("lens", [True, False])
def test_parts(lens: bool, bounded: bool) -> None:
    """Gaussians inside and outside the picture, and behind the camera."""
    knots = knot_positions("even")
    generator = torch.Generator().manual_seed(5)
    means = 4 * torch.rand(N, 3, generator=generator) - torch.tensor([2.0, 2, 0.5])
    features = torch.cat([random_radiance(), torch.rand(N, 3, generator=generator)], 1)
    background = torch.tensor([-1.0, 0.2, 1.5])

    def plain(
        features: Tensor, background: Tensor, coefficients: Tensor, gain: Tensor, curve: Tensor
    ) -> Tensor:
        recorder = Recorder(
            lambda radiance: plain_recording(radiance * gain, curve, knots, 1.0),
            (0,),
            (lambda light, _, pixels: light * lens_of(coefficients, pixels)) if lens else None,
        )
        behind = to_radiance(background, bounded)
        parts = Parts.of(recorder, CAMERA, features[:, :3], means, behind)
        made = torch.cat([features, parts.gaussians], 1)
        return torch.cat([made.flatten(), parts.background[0]])

    def ours(
        features: Tensor, background: Tensor, coefficients: Tensor, gain: Tensor, curve: Tensor
    ) -> Tensor:
        sensor = Sensor.without_lens(gain, curve, knots, 0.01)
        sensor = with_lens(sensor, coefficients) if lens else sensor
        made, behind = fused_parts(features, means, CAMERA, background, bounded, sensor)
        return torch.cat([made.flatten(), behind])

    compare(ours, plain, features, background, DARK, GAIN, random_curve(knots))


def over_background(
    field: Splat, drawn: list[Tensor], late: tuple[Tensor, Tensor] | None, with_flow: bool
) -> tuple[Render, Tensor]:
    """Planes, depth and alpha of a picture over the background of a field."""
    maps = Maps(drawn[0].permute(1, 2, 0), drawn[1], drawn[2])
    numbers = field.bounded, field.far, draw.MIN_DEPTH_SHARE, draw.MIN_ALPHA
    return fused_composite(maps, field.background, late, with_flow, numbers)


@pytest.mark.parametrize("radiance", ["exp", "sigmoid"])
@pytest.mark.parametrize("channels", [4, 6])
def test_maps_over_the_background(radiance: str, channels: int) -> None:
    compare_composites(
        lambda field, drawn: over_background(field, drawn, None, channels == 6),
        random_field(radiance=radiance),
        channels,
    )


@pytest.mark.parametrize("with_flow", [True, False])
def test_late_mixing_over_the_background(with_flow: bool) -> None:
    compare_mixing(over_background, with_flow)


@pytest.mark.parametrize("names", PRIORS)
def test_losses(names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    compare_losses(CudaLosses, names, monkeypatch)
