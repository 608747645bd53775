"""One set of laws over every preset's field: what `RadianceField` promises."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import NETWORKS, random_field, small, trainer

from hdr_nsff.fields.base import RadianceField
from hdr_nsff.fields.baselines.hexplane import HexPlane
from hdr_nsff.fields.build import AnyField
from hdr_nsff.fields.nsff.nsff import NSFF, NSFFConfig
from hdr_nsff.fields.nsff.two_branches import TwoBranches
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.fields.recording_field import RecordingField
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.maths.volume import transmittance, weighted_sum
from hdr_nsff.scene.batch import Recorder, draw_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.presets import METHODS, PRESETS

LOOK = Recorder(lambda radiance: (radiance / 2).clamp(0, 1), (1, 4))


@pytest.fixture(scope="module", params=list(NETWORKS))
def field(request: pytest.FixtureRequest, toy: Scene) -> AnyField:
    return random_field(request.param, toy)


@pytest.fixture(
    scope="module",
    params=[name for name in NETWORKS if isinstance(PRESETS[name].field, NSFFConfig)],
)
def nsff(request: pytest.FixtureRequest, toy: Scene) -> NSFF:
    field = random_field(request.param, toy)
    assert isinstance(field, NSFF)
    return field


def test_every_preset_is_tested() -> None:
    assert set(NETWORKS) == set(METHODS) | {"grid-sigmoid", "splat-sigmoid"} <= set(PRESETS)


def test_a_render_has_the_promised_shapes_and_ranges(field: AnyField, toy: Scene) -> None:
    camera = toy.train[2].camera
    assert isinstance(field, RadianceField)
    for time in (2.0, 2.4):
        r, n = field.render(camera, time), camera.width * camera.height
        assert r.radiance.shape == (
            n,
            3,
        ) and r.depth.shape == r.opacity.shape == r.motion.shape == (n,)
        flows = isinstance(field, NSFF | Splat)
        assert {o: tuple(f.shape) for o, f in r.scene_flow.items()} == (
            {1: (n, 3), -1: (n, 3)} if flows else {}
        )
        assert r.warps == () and r.dynamic_radiance is None and r.dynamic_depth is None
        assert all(torch.isfinite(v).all() for v in (r.radiance, r.depth, *r.scene_flow.values()))
        assert float(r.radiance.min()) >= 0 and float(r.radiance.max()) > 0.01
        for share in (r.opacity, r.motion):
            assert float(share.min()) >= 0 and float(share.max()) <= 1 + 1e-5
        assert toy.near * 0.99 <= float(r.depth.min()) and float(r.depth.max()) <= toy.far * 1.01
        assert float(r.motion.max()) > 0.01 or isinstance(field, HexPlane)  # one content for all
    assert not flows or float(r.scene_flow[1].abs().max()) > 1e-4


def test_rendering_in_chunks_changes_nothing(field: AnyField, toy: Scene) -> None:
    camera = toy.train[1].camera.resized(112, 80)  # 8960 pixels: the chunks end within the picture
    pixels = camera.pixel_grid()
    whole, part = field.render(camera, 1.3), field.render(camera, 1.3, pixels[8100:8300])
    for name in ("radiance", "depth", "opacity", "motion"):
        torch.testing.assert_close(
            getattr(whole, name)[8100:8300], getattr(part, name), atol=1e-5, rtol=1e-4
        )
    assert set(whole.scene_flow) == set(part.scene_flow)
    for o, flow in part.scene_flow.items():
        torch.testing.assert_close(whole.scene_flow[o][8100:8300], flow, atol=1e-5, rtol=1e-4)


def test_what_is_recorded_of_a_field_has_the_shape_and_range_of_a_picture(
    field: AnyField, toy: Scene
) -> None:
    camera = toy.train[2].camera
    darker = Recorder(lambda radiance: LOOK.rgb(radiance / 4), LOOK.images)
    rgb, dark = record_pixels(field, camera, 2.0, [LOOK, darker])
    torch.testing.assert_close(dark, record_pixels(field, camera, 2.0, [darker])[0])  # as alone
    assert dark.shape == rgb.shape and dark.mean() < rgb.mean()
    assert (
        rgb.shape == (camera.width * camera.height, 3)
        and 0 <= float(rgb.min()) <= float(rgb.max()) <= 1
    )
    assert isinstance(field, RecordingField) != isinstance(field, NSFF | Splat)
    if isinstance(field, Splat):  # a part of a pixel's averaging is done behind the camera
        field.late_mixing.share.data.zero_()
        (rgb,) = record_pixels(field, camera, 2.0, [LOOK])
    if isinstance(field, NSFF | Splat):  # the camera stands behind the field
        torch.testing.assert_close(rgb, LOOK.rgb(field.render(camera, 2.0).radiance))


def test_rendering_leaves_the_field_as_it_was(field: AnyField, toy: Scene) -> None:
    before = {k: v.clone() for k, v in field.state_dict().items()}
    field.train()
    first = field.render(toy.train[0].camera, 0.5)
    assert field.training and not first.radiance.requires_grad
    assert all(torch.equal(v, before[k]) for k, v in field.state_dict().items())
    torch.testing.assert_close(
        first.radiance, field.render(toy.train[0].camera, 0.5).radiance, atol=0, rtol=0
    )


def test_time_is_continuous_at_and_between_training_times(field: AnyField, toy: Scene) -> None:
    camera = toy.train[2].camera
    if isinstance(field, TwoBranches):  # an opaque end is there or not: nothing between
        field.config = replace(field.config, opaque_end=False)
    at, after, before, half = (field.render(camera, t).radiance for t in (2.0, 2.0005, 1.9995, 2.5))
    torch.testing.assert_close(after, at, atol=2e-3, rtol=2e-2)
    torch.testing.assert_close(before, at, atol=2e-3, rtol=2e-2)
    assert float((half - at).abs().max()) > 1e-3


def test_outside_its_times_the_field_is_at_rest(field: AnyField, toy: Scene) -> None:
    camera, last = toy.train[0].camera, toy.train[-1].time
    torch.testing.assert_close(
        field.render(camera, last + 3).radiance, field.render(camera, last).radiance
    )
    torch.testing.assert_close(
        field.render(camera, -3.0).radiance, field.render(camera, 0.0).radiance
    )


def test_layers_composite_to_the_render(nsff: NSFF, toy: Scene) -> None:
    camera = toy.train[3].camera
    layers, render = nsff.layers(camera, 3.0), nsff.render(camera, 3.0)
    weights = transmittance(layers.alpha) * layers.alpha
    radiance, motion = weighted_sum(weights, layers.radiance), (weights * layers.motion).sum(-1)
    assert float(layers.alpha.min()) >= 0 and float(layers.alpha.max()) <= 1
    still = layers.motion == 0
    assert (
        float(layers.scene_flow[1][still].abs().max())
        == 0
        < float(layers.scene_flow[1].abs().max())
    )
    # where both contents fill one sample, layers put the dynamic one in front and the
    # render shares it: hence a few per cent
    assert float((weights.sum(-1) - render.opacity).abs().max()) < (
        1e-4 if nsff.config.compositing == "add" else 0.05
    )
    assert float((radiance - render.radiance).abs().mean() / render.radiance.mean()) < 0.03
    assert float((motion - render.motion).abs().mean()) < 0.03


def test_a_training_pass_has_warps_and_regularizers(nsff: NSFF, toy: Scene) -> None:
    batch = replace(draw_pixels(toy, 3, 40, 10, torch.Generator().manual_seed(0)), seed=1, chain=-1)
    nsff.train()
    render, own = nsff(batch)
    assert [w.offset for w in render.warps] == [1, -1, -2]
    for w in render.warps:
        assert w.flow.shape == (50, 2) and w.radiance is not None and w.radiance.shape == (50, 3)
        assert float(w.confidence.detach().min()) >= 0 and float(w.confidence.detach().max()) <= 1
    blended = nsff.config.compositing == "blend"
    expected = {"cycle", "kinetic", "smoothness", "disocclusion"}
    if blended:
        expected |= {"blend_entropy", "distortion"}
    assert set(own) == expected
    assert (render.dynamic_radiance is not None) == blended
    assert all(v.requires_grad and torch.isfinite(v).all() for v in own.values())


def test_a_pass_is_determined_by_its_seed(nsff: NSFF, toy: Scene) -> None:
    batch = draw_pixels(toy, 3, 40, 0, torch.Generator().manual_seed(0))
    nsff.train()
    one, same, other = (nsff(replace(batch, seed=s))[0].radiance for s in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_at_the_ends_of_the_clip_there_is_one_neighbor(field: AnyField, toy: Scene) -> None:
    for frame, offset in ((0, 1), (len(toy.train) - 1, -1)):
        batch = replace(
            draw_pixels(toy, frame, 20, 0, torch.Generator().manual_seed(0)),
            chain=-offset,
            recorder=LOOK,
        )
        wanted = [offset] if isinstance(field, NSFF | Splat) else []
        assert [w.offset for w in field(batch)[0].warps] == wanted


@pytest.mark.parametrize("preset", list(NETWORKS))
def test_two_steps_train_every_branch_and_the_tone_mapper(
    preset: str, toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    t = trainer(
        replace(small(preset, toy_folder, tmp_path / "run"), batches=2, moving_rays=64), toy
    )
    before = {
        k: v.detach().clone()
        for k, v in [*t.field.named_parameters(), *t.tonemapper.named_parameters()]
    }
    for _ in range(2):
        values = t.step()
        assert all(v == v and abs(v) < 1e6 for v in values.values())
        t.clock = replace(t.clock, step=t.clock.step + 1)
    after = dict([*t.field.named_parameters(), *t.tonemapper.named_parameters()])
    assert all(torch.isfinite(v).all() for v in after.values())
    still = [k for k, v in after.items() if v.numel() and torch.equal(v, before[k])]
    assert not still, f"no step moved {still}"
