"""A pixel averages light, or what is recorded of its parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_splat import CAMERA, batch_of, scattered
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.draw import composite, draw, seen_radiance
from hdr_nsff.fields.splat.late_mixing import START_SHARE, LateMixing, Parts
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.batch import Recorder
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.tonemap.build import tone_mapper_for


def clip(radiance: Tensor) -> Tensor:
    return (radiance * 2).clamp(0, 1)


CLIP = Recorder(clip, (0,))
DARKENING = replace(CLIP, shade=lambda radiance, camera, pixels: radiance * pixels[:, :1] / 40)


def contrasty() -> Splat:
    """Random Gaussians, half of which clip."""
    field = scattered()
    generator = torch.Generator().manual_seed(5)
    for values in (field.static.log_radiance, field.moving.log_radiance):
        values.data += torch.randn(values.shape, generator=generator) - 1
    return field


def test_parts_are_averaged_as_they_cover_the_pixel() -> None:
    """A leaf of 0.1 covers 60 % of a pixel, a sky of 4 the rest, which clips."""
    leaf, sky = torch.full((1, 3), 0.1), torch.full((1, 3), 4.0)
    parts = Parts(clip(leaf), clip(sky))
    drawn, opacity = 0.6 * parts.gaussians, torch.tensor([0.6])
    average = parts.average(drawn, opacity)
    torch.testing.assert_close(average, torch.full((1, 3), 0.6 * 0.2 + 0.4 * 1.0))
    assert float(clip(0.6 * leaf + 0.4 * sky)[0, 0]) == 1.0  # of light, the sky drowns the leaf


def test_what_is_recorded_late_is_the_sum_over_gaussians_one_by_one() -> None:
    """Against pictures of every Gaussian's share in the pixel."""
    field = scattered(view_dependence=True)
    cloud = field.cloud(2.0)
    with torch.no_grad():
        shares = torch.eye(len(cloud.means))
        render, weights = composite(field.model(), draw(field.model(), CAMERA, cloud, [shares]))
        seen = seen_radiance(field.model(), CAMERA, cloud)
        behind = field.background.exp()
        expected = torch.zeros(len(weights), 3)
        for k in range(len(seen)):
            expected += weights[:, k : k + 1] * clip(seen[k])
        expected += (1 - render.opacity)[:, None] * clip(behind)
    ((found, share),) = field.recorded_late(CAMERA, 2.0, [CLIP])
    torch.testing.assert_close(share[:, 0], field.late_mixing.share.detach() * (1 - render.motion))
    torch.testing.assert_close(found, expected, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize("recorder", [CLIP, DARKENING])
def test_training_and_pictures_record_the_same(recorder: Recorder, toy: Scene) -> None:
    field = contrasty()
    batch = replace(batch_of(2, 1), recorder=recorder)
    render, _ = field(batch)
    assert render.late is not None and render.late_share is not None
    light = render.radiance
    if recorder.shade is not None:
        light = recorder.shade(light, CAMERA, CAMERA.pixel_grid())
    trained = clip(light).lerp(render.late, render.late_share)
    (picture,) = record_pixels(field, CAMERA, 2.0, [recorder])
    torch.testing.assert_close(picture, trained.detach(), atol=1e-5, rtol=1e-4)
    assert not torch.allclose(picture, clip(light), atol=1e-2)


@pytest.mark.parametrize("late", [True, False])
def test_the_share_moves_to_how_the_recording_was_averaged(late: bool) -> None:
    field = contrasty()
    with torch.no_grad():
        field.background.fill_(1.5)  # a bright sky
    batch = replace(batch_of(2, 1), recorder=CLIP)
    render, _ = field(batch)
    truth = (render.late if late else clip(render.radiance)).detach()
    rgb = clip(render.radiance).lerp(render.late, render.late_share)
    (rgb - truth).abs().mean().backward()
    assert (float(field.late_mixing.share.grad) < 0) == late  # a step goes against the gradient
    assert float(field.late_mixing.share.grad) != 0


def test_gaussians_behind_the_camera_leave_gradients_finite() -> None:
    field = contrasty()
    field.static.means.data[:5, 2] = torch.tensor([-3.0, -1e-6, 0.0, 1e-9, 1e-3])
    render, _ = field(replace(batch_of(2, 1), recorder=DARKENING))
    assert render.late is not None
    render.late.mean().backward()
    for name, p in field.named_parameters():
        assert p.grad is None or torch.isfinite(p.grad).all(), name


def test_the_share_stays_a_share() -> None:
    field = scattered()
    for value, kept in ((-0.2, 0.0), (1.3, 1.0), (0.4, 0.4)):
        field.late_mixing.share.data.fill_(value)
        field.after_step(1, None)
        assert float(field.late_mixing.share.detach()) == pytest.approx(kept)


def test_without_late_mixing_light_alone_is_averaged() -> None:
    config = SplatConfig(static=10, moving=0, local=0, late_mixing=False)
    field = Splat(config, torch.arange(4), 1.0, 6.0, 100)
    assert "late_mixing.share" not in dict(field.named_parameters())
    render, _ = field(replace(batch_of(2, 1), recorder=CLIP))
    assert render.late is None
    (rgb,) = record_pixels(field, CAMERA, 2.0, [CLIP])
    torch.testing.assert_close(rgb, clip(field.render(CAMERA, 2.0).radiance))


def test_late_mixing_starts_half_way_and_nothing_is_recorded_where_its_share_is_0() -> None:
    field = Splat(SplatConfig(static=10, moving=0, local=0), torch.arange(4), 1.0, 6.0, 100)
    assert float(field.late_mixing.share.detach()) == START_SHARE
    field.late_mixing.share.data.zero_()
    ((_, share),) = field.recorded_late(CAMERA, 2.0, [CLIP])
    assert not share.any()


def test_what_shines_through_a_mover_is_averaged_as_light() -> None:
    motion = torch.tensor([0.0, 0.9, 1.0], requires_grad=True)
    opacity, parts = torch.ones(3), Parts(torch.zeros(1, 3), torch.zeros(1, 3))
    render = Render(torch.zeros(3, 3), opacity, opacity, motion)
    mixing = LateMixing()
    mixing.share.data.fill_(0.6)
    _, share = mixing(parts, torch.zeros(3, 3), render)
    torch.testing.assert_close(share[:, 0], torch.tensor([0.6, 0.06, 0.0]))
    share.sum().backward()
    assert motion.grad is None  # nothing is gained by calling a pixel moving


def test_recorders_darken_corners_where_vignetting_is_learned(toy: Scene, tmp_path: Path) -> None:
    tonemapper = tone_mapper_for(ToneMapConfig(), toy)
    frame, radiance = toy.train[0], torch.full((2, 3), 0.2)
    pixels = torch.tensor([[0.5, 0.5], [frame.camera.width / 2, frame.camera.height / 2]])
    assert tonemapper.vignetting is not None
    tonemapper.vignetting.coefficients.data[0, 0] = -0.5
    for recorder in (tonemapper.recorder(0, 0), tonemapper.recorder_at(0.0, 0, lens=True)):
        assert recorder.shade is not None
        corner, middle = recorder.shade(radiance, frame.camera, pixels)
        torch.testing.assert_close(middle, radiance[1], rtol=1e-2, atol=0)
        assert float(corner[0].detach()) < 0.15
    assert tonemapper.recorder_at(0.0, 0).shade is None
    assert tone_mapper_for(ToneMapConfig(vignetting=False), toy).recorder(0, 0).shade is None


def test_runs_from_before_late_mixing_have_none() -> None:
    field = scattered()
    state = {
        name: values for name, values in field.state_dict().items() if name != "late_mixing.share"
    }
    field.load_state_dict(state)
    assert float(field.late_mixing.share.detach()) == 0
