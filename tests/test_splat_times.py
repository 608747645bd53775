"""A field of Gaussians between its training times, and with one or two of them."""

from dataclasses import replace

import pytest
import torch
from test_splat import CAMERA, STEP, batch_of, card_field, pixel_of

from hdr_nsff.fields.base import RadianceField
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.training.optimizers import Optimizers


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_two_training_times_have_the_scene_flow_from_one_to_the_other(time: float) -> None:
    render = card_field(times=2).render(CAMERA, time)
    at = pixel_of(torch.tensor([0.0, 0, 2]) + time * STEP)
    torch.testing.assert_close(render.scene_flow[1][at], STEP, atol=1e-3, rtol=0)
    torch.testing.assert_close(render.scene_flow[-1][at], -STEP, atol=1e-3, rtol=0)


def test_fractional_times_lie_between() -> None:
    field = card_field()
    for time in (3.25, 3.5, 3.75):
        at = field.positions(time).detach()
        low, high = (field.positions(k).detach() for k in (3.0, 4.0))
        torch.testing.assert_close(at, torch.lerp(low, high, time - 3))
    columns = torch.arange(1200) % 40
    motions = [field.render(CAMERA, t).motion for t in (3.0, 3.5, 4.0)]
    middles = [float((m * columns).sum() / m.sum()) for m in motions]
    assert middles[0] < middles[1] < middles[2]
    assert middles[1] == pytest.approx((middles[0] + middles[2]) / 2, abs=0.05)


def test_times_may_be_uneven() -> None:
    field = card_field()
    field.times[:] = torch.tensor([0.0, 1, 2, 3, 7, 8, 9, 10, 11, 12])
    expected = torch.lerp(field.positions(3.0), field.positions(4.0), 0.5)
    torch.testing.assert_close(field.positions(field.knot(5.0)), expected)


def first_step(unit: float) -> dict[str, float]:
    """By how much a first step moves every kind of number, in a scene of that unit."""
    config = SplatConfig(static=3, moving=3, local=3, bases=1)
    field = Splat(config, torch.arange(4), unit, 6 * unit, 1200)
    optimizers = Optimizers(field.param_groups())
    learned = {name: p for name, p in field.named_parameters() if p.numel()}
    before = {name: p.detach().clone() for name, p in learned.items()}
    for p in learned.values():
        p.grad = torch.ones_like(p)
    for name, marks in field.named_buffers():
        if name.endswith("touched"):
            marks.fill_(1)
    optimizers.step(1.0, 0.0)
    return {name: float((p.detach() - before[name]).abs().max()) for name, p in learned.items()}


def test_lengths_are_learned_in_units_of_the_scene_and_nothing_else_is() -> None:
    one, other = first_step(1.0), first_step(50.0)
    grown = {name for name in one if other[name] > 2 * one[name]}
    kinds = "static.means", "moving.means", "local.means", "local.velocities"
    assert grown == {*kinds, "trajectories.translations"}
    for name, moved in one.items():
        assert other[name] == pytest.approx(moved * (50 if name in grown else 1), rel=1e-3), name


def test_one_training_time_has_no_flow() -> None:
    field = Splat(SplatConfig(static=20, moving=20, bases=1), torch.zeros(1), 1.0, 6.0, 1200)
    for g in (field.static, field.moving):
        g.means.data[:, 2], g.opacity_logits.data[:], g.log_scales.data[:] = 2.0, 0.0, -2.0
    assert isinstance(field, RadianceField)
    render = field.render(CAMERA, 0.7)
    assert float(render.scene_flow[1].abs().max()) == float(render.scene_flow[-1].abs().max()) == 0
    assert float(render.motion.max()) > 0.1
    _, own = field(replace(batch_of(0, 1), flow={}))
    assert torch.isfinite(own["trajectory"])
