"""Laws of the tone mapper: gauge, monotony, invertibility, the ends of eq. 11, and
which gradients flow.
"""

import math

import numpy as np
import pytest
import torch
from estimates import tone_mapper

from hdr_nsff.core.errors import InputError
from hdr_nsff.radiometry.response import Response
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, informative
from hdr_nsff.tonemap.build import build_tone_mapper
from hdr_nsff.tonemap.curve import GAMMA, leaky_ends, piecewise_linear

EV = [-4.0, -2.0, 0.0]


def mapper(ev=EV, cameras=(0, 0, 0, 0, 0, 0), **config):
    return tone_mapper([0, 1, 2, 0, 1, 2], list(cameras), ev, reference=2, **config)


def disturb(tonemapper, seed=0, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in tonemapper.parameters():
            p.add_(torch.randn(p.shape, generator=generator) * scale)
    return tonemapper


def grid(n=1001, top=1.0):
    return torch.linspace(0, top, n)[:, None].expand(-1, 3).contiguous()


@pytest.mark.parametrize("kind", ["shared", "per_image", "fixed"])
@pytest.mark.parametrize("knots", ["gamma", "even"])
def test_a_new_response_is_gamma(kind, knots):
    rgb = mapper(kind=kind, knots=knots)(grid(), bracket=2, frame=2, leaky=False)
    assert (rgb - grid() ** (1 / GAMMA)).abs().max() < (
        1e-4 if knots == "gamma" else 0.03
    )  # even knots starve the darks


def test_gain_is_two_to_the_ev():
    t = mapper()
    dark, reference = (
        t(grid() * 4, bracket=1),
        t(grid(), bracket=2),
    )  # bracket 1 is two stops darker: a quarter of the light
    torch.testing.assert_close(dark, reference, atol=1e-5, rtol=0)


def test_reference_gain_stays_fixed():
    t = disturb(mapper([None, None, None], cameras=(0, 1, 0, 1, 0, 1), residual=False))
    assert torch.equal(t.log_gain(2, 0, None), torch.zeros(3))
    assert t.exposures()[2] == 0 and t.exposures()[0] != 0
    assert t.log_gain(2, 1, None).abs().min() > 0  # the second camera's white balance is free


def test_residuals_cannot_carry_scale():
    t = disturb(mapper())
    residual = torch.stack(
        [t.log_gain(b, 0, i) - t.log_gain(b, 0, None) for i, b in enumerate(t.frame_brackets)]
    )
    assert residual.abs().max() > 0.1
    torch.testing.assert_close(residual.mean(0), torch.zeros(3), atol=1e-6, rtol=0)


def test_drift_is_a_known_offset_of_single_frames():
    recordings = Recordings((0, 0, 1), (0, 0, 0), (-2.0, 0.0), 1, 1, drift=(0.5, -0.5, 0.0))
    t = build_tone_mapper(ToneMapConfig(), recordings)
    torch.testing.assert_close(t.gains().mean(-1), torch.tensor([-1.5, -2.5, 0.0]))
    assert t.exposures().tolist() == [-2.0, 0.0]
    assert t.log_gain(0, 0, None)[0].item() == pytest.approx(-2 * np.log(2), abs=1e-5)


def test_the_white_balance_of_single_frames_is_a_known_offset():
    balance = ((0.1, 0.0, -0.1), (0.0, 0.0, 0.0), (-0.1, 0.0, 0.1))
    recordings = Recordings((0, 0, 1), (0, 0, 0), (-2.0, 0.0), 1, 1, balance=balance)
    t = build_tone_mapper(ToneMapConfig(), recordings)
    torch.testing.assert_close(t.log_gain(0, 0, 0) / np.log(2), torch.tensor([-1.9, -2.0, -2.1]))
    torch.testing.assert_close(t.log_gain(1, 0, None), torch.zeros(3))


@pytest.mark.parametrize("kind", ["per_image", "sigmoid"])
def test_free_gains_start_at_the_drift_of_their_images(kind):
    """Relative to the reference image, frame 1; one gain takes the mean of colors."""
    drift, balance = (0.5, 0.25, -0.5, 0.0), ((0.3, 0.0, 0.0), *[(0.0,) * 3] * 3)
    recordings = Recordings((0, 1, 0, 1), (0,) * 4, (-2.0, 0.0), 1, 1, drift, balance)
    t = build_tone_mapper(ToneMapConfig(kind=kind), recordings)
    t.start(measured([-2.0, 0.0]))
    stops = torch.tensor([[-1.45, -1.75, -1.75], [0.0] * 3, [-2.75] * 3, [-0.25] * 3])
    if kind == "sigmoid":
        stops = stops.mean(1, keepdim=True).expand(-1, 3)
    torch.testing.assert_close(t.gains(), stops, atol=1e-6, rtol=0)


def test_known_exposures_are_exact_and_not_learned():
    t = mapper([-4.0, None, 0.0])
    t.set_exposures([-9.0, -1.5, 7.0])
    assert t.exposures().tolist() == [-4.0, -1.5, 0.0]
    assert t.bracket_gain.learned_ev.shape == (1,)


def test_unknown_exposure_learns_from_its_bracket():
    t = mapper([-4.0, None, 0.0], residual=False)
    t(grid(), bracket=1).sum().backward()
    assert t.bracket_gain.learned_ev.grad.item() > 0
    t.zero_grad()
    t(grid(), bracket=0).sum().backward()
    assert t.bracket_gain.learned_ev.grad.item() == 0


@pytest.mark.parametrize("knots", ["gamma", "even"])
def test_any_parameters_give_a_strictly_rising_curve_between_fixed_ends(knots):
    t = disturb(mapper(knots=knots), scale=4.0)
    _, y = t.curve()
    assert (y[:, 0] == 0).all() and (y[:, -1] == 1).all()
    assert (y.diff(dim=-1) > 0).all()


@pytest.mark.parametrize("kind", ["shared", "fixed", "per_image"])
def test_inverse_undoes_the_recording(kind):
    t = mapper(kind=kind)
    if kind == "shared":
        disturb(t)
    rgb = torch.linspace(0.05, 0.95, 50)[:, None].expand(-1, 3).contiguous()
    radiance = t.inverse(rgb, bracket=0, frame=3)
    torch.testing.assert_close(t(radiance, bracket=0, frame=3, leaky=False), rgb, atol=2e-4, rtol=0)


def test_ends_are_eq_11_and_continuous():
    x = torch.tensor([-2.0, -1e-7, 0.0, 1.0, 1 + 1e-6, 4.0, math.inf])
    y = leaky_ends(x, x.clamp(0, 1), leak=0.01)
    expected = torch.tensor(
        [-0.02, 0.0, 0.0, 1.0, 1.0, 1 + 0.01 - 0.01 / 2, 1.01]
    )  # -a / sqrt(4) + a + 1
    torch.testing.assert_close(y, expected, atol=1e-6, rtol=0)


def test_saturated_radiance_keeps_a_gradient_only_while_training():
    radiance = torch.full((1, 3), 4.0, requires_grad=True)
    (grad,) = torch.autograd.grad(mapper()(radiance, bracket=2).sum(), radiance)
    torch.testing.assert_close(grad, torch.full((1, 3), 0.01 / 2 / 4**1.5))  # d/dx of -a / sqrt(x)
    (grad,) = torch.autograd.grad(mapper()(radiance, bracket=2, leaky=False).sum(), radiance)
    assert (grad == 0).all()


@pytest.mark.parametrize("power", [1.0, 1 / GAMMA])
def test_lookup_and_its_gradients_agree_with_numpy_interpolation(power):
    generator = torch.Generator().manual_seed(0)
    knots = torch.linspace(0, 1, 9, dtype=torch.float64) ** (1 / power)
    values = torch.rand(3, 9, generator=generator, dtype=torch.float64, requires_grad=True)
    x = torch.rand(40, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    y = piecewise_linear(x, values, knots, power)
    slow = [
        torch.from_numpy(np.interp(x[:, c].detach(), knots, values[c].detach())) for c in range(3)
    ]
    torch.testing.assert_close(y, torch.stack(slow, -1))
    assert torch.autograd.gradcheck(lambda a, b: piecewise_linear(a, b, knots, power), (x, values))


def test_gamma_knots_resolve_what_even_knots_hide():
    x = torch.full((1, 3), 1e-4)  # a fortieth of the first even cell
    true = 1e-4 ** (1 / GAMMA)
    fine, coarse = (mapper(knots=k)(x, bracket=2).max().item() for k in ("gamma", "even"))
    assert abs(fine - true) < 2e-4 and abs(coarse - true) > 0.01


@pytest.mark.parametrize("knots", ["gamma", "even"])
def test_a_set_curve_is_reproduced(knots):
    x = torch.linspace(0, 1, 500) ** 2.2
    y = torch.stack([x**p / (x**p + 0.3 * (1 - x)) for p in (0.6, 0.7, 0.8)])  # rising, from 0 to 1
    t = mapper(knots=knots)
    t.set_curve(x, y)
    at = x[:, None].expand(-1, 3)[100:]  # above even knots' blind first cells
    assert (t(at, bracket=2, leaky=False).T - y[:, 100:]).abs().max() < (
        2e-3 if knots == "gamma" else 5e-3
    )


def test_a_set_curve_that_falls_is_made_monotone():
    x = torch.linspace(0, 1, 200)
    y = (x + 0.2 * torch.sin(x * 4 * math.pi)).expand(3, -1)  # falls in the middle
    t = mapper()
    t.set_curve(x, y)
    _, values = t.curve()
    assert (values.diff(dim=-1) > 0).all()


def test_cameras_have_curves_of_their_own():
    t = mapper(cameras=(0, 1, 0, 1, 0, 1))
    x = torch.linspace(0, 1, 100)
    t.set_curve(x, x.expand(3, -1), camera_id=1)
    torch.testing.assert_close(t(grid(), 2, camera_id=1, leaky=False), grid(), atol=2e-3, rtol=0)
    torch.testing.assert_close(
        t(grid(), 2, camera_id=0, leaky=False), grid() ** (1 / GAMMA), atol=1e-4, rtol=0
    )


def test_smoothness_is_the_sum_of_squared_second_differences():
    t = disturb(mapper(kind="per_image", knots="even"), scale=0.1)
    y = t.response.values(slice(None)).detach()
    slow = sum(
        (y[:, :, k + 1] - 2 * y[:, :, k] + y[:, :, k - 1]) ** 2 for k in range(1, 255)
    ).sum()  # over images and channels too, as eq. 15 is printed
    torch.testing.assert_close(t.regularizers()["response_smoothness"].detach(), slow)


def test_gamma_costs_no_smoothness_on_gamma_knots():
    assert mapper().regularizers()["response_smoothness"].item() < 1e-10


def test_the_anchor_pulls_back_and_is_saved_with_the_state():
    t = mapper([None, None, None])
    assert t.regularizers()["response_anchor"].item() == 0
    t.anchor()
    copy = mapper([None, None, None])
    copy.load_state_dict(t.state_dict())
    assert copy.regularizers()["response_anchor"].item() == 0
    with torch.no_grad():
        copy.bracket_gain.learned_ev.add_(1.0)  # two brackets drift by one stop: (2/3) ln(2)^2
    distance = copy.regularizers()["response_anchor"]
    assert distance.item() == pytest.approx(2 / 3 * math.log(2) ** 2, rel=1e-5)
    distance.backward()
    assert (copy.bracket_gain.learned_ev.grad > 0).all()


def test_param_groups_hold_every_parameter_once():
    t = mapper([None, None, None], cameras=(0, 1, 0, 1, 0, 1))
    grouped = [id(p) for g in t.param_groups(1e-3) for p in g.params]
    assert sorted(grouped) == sorted(id(p) for p in t.parameters())
    assert mapper(kind="none").param_groups(1e-3) == []


def test_develop_is_the_recording_of_a_bracket_at_its_ev():
    t = disturb(mapper(residual=False))
    torch.testing.assert_close(
        t.develop(grid(top=20), ev=-4.0), t(grid(top=20), bracket=0, leaky=False)
    )
    picture = t.develop(torch.rand(4, 5, 3), ev=1.5)
    assert picture.shape == (4, 5, 3) and picture.min() >= 0 and picture.max() <= 1


def test_a_network_response_is_undone_through_its_curve():
    t = mapper(kind="mlp", residual=False)
    radiance = torch.rand(50, 3) * 0.6 + 0.1
    torch.testing.assert_close(
        t.inverse(t(radiance, bracket=2), bracket=2), radiance, atol=2e-3, rtol=0
    )


def test_the_papers_gain_is_free_but_for_the_reference_image():
    t = disturb(mapper(kind="per_image", knots="even"), scale=0.3)
    assert torch.equal(
        t.gains()[2], torch.zeros(3)
    )  # frame 2 is the first of the reference bracket
    assert (t.gains()[[0, 1, 3, 4, 5]].abs() > 0).all()
    borrowed = t.log_gain(0, 0, None)
    torch.testing.assert_close(
        borrowed, (t.log_gain(0, 0, 0) + t.log_gain(0, 0, 3)) / 2
    )  # frames 0 and 3 have bracket 0


def test_none_takes_radiance_for_rgb():
    t = mapper(kind="none")
    radiance = torch.tensor([[-0.1, 0.5, 1.5]])
    assert torch.equal(t(radiance, bracket=0), radiance)
    assert torch.equal(t(radiance, bracket=0, leaky=False), radiance.clamp(0, 1))
    assert t.regularizers() == {}


def measured(ev):
    """A response from brightness, at these EVs."""
    x, y = np.linspace(0, 1, 9) ** GAMMA, np.tile(np.linspace(0, 1, 9), (1, 3, 1))
    white_balance = np.zeros((1, 3))
    return Response(x, y, np.array(ev), white_balance, "brightness", None, 0, True, ())


def test_none_learns_no_exposure_and_reports_the_estimated_one():
    t = mapper([None, None, None], kind="none")
    assert list(t.parameters()) == []
    t.start(measured([-3.0, -1.0, 0.0]))  # for matching exposures by rank, not for recording
    assert t.exposures().tolist() == [-3.0, -1.0, 0.0] and (t.gains() == 0).all()
    radiance = torch.full((1, 3), 0.3, requires_grad=True)
    assert torch.equal(t(radiance, bracket=0, leaky=False), radiance)
    assert mapper([-4.0, None, 0.0], kind="none").exposures().tolist() == [-4.0, 0.0, 0.0]


def test_the_sigmoid_records_x_over_one_plus_x_with_one_exposure_per_image():
    t = mapper(kind="sigmoid")
    with torch.no_grad():
        t.image_gain.copy_(torch.log(torch.tensor([[0.25], [1.0], [9.0], [4.0], [2.0], [1.0]])))
    radiance = torch.full((1, 3), 3.0)
    for frame, gain in (
        (0, 0.25),
        (1, 1.0),
        (2, 1.0),
        (3, 4.0),
    ):  # frame 2 is the reference image: gain 1 whatever it says
        x = 3.0 * gain
        torch.testing.assert_close(
            t(radiance, t.frame_brackets[frame], frame=frame), torch.full((1, 3), x / (1 + x))
        )
    torch.testing.assert_close(
        t(radiance, bracket=0), torch.full((1, 3), 0.75)
    )  # borrowed: geometric mean of 1/4 and 4 is 1
    torch.testing.assert_close(
        t.inverse(t(radiance, bracket=1, frame=4), bracket=1, frame=4), radiance
    )
    torch.testing.assert_close(t.develop(radiance, ev=1.0), torch.full((1, 3), 6 / 7))
    torch.testing.assert_close(t.curve()[1], (t.knots / (1 + t.knots)).expand(3, -1))


def test_the_sigmoids_exposure_learns_from_its_image_alone():
    t = mapper(kind="sigmoid")
    t(grid(), bracket=1, frame=4).sum().backward()
    assert (t.image_gain.grad[:, 0] != 0).tolist() == [False, False, False, False, True, False]


def test_a_network_response_starts_at_the_curve_it_is_given_and_is_not_kept_monotone():
    t = mapper(kind="mlp", residual=False)
    above = grid()[20:650]
    assert (t(above, bracket=2) - above ** (1 / GAMMA)).abs().max() < 0.01
    assert (
        t(grid(), bracket=2) - grid() ** (1 / GAMMA)
    ).abs().max() < 0.08  # a sigmoid never gets to 1
    x = torch.linspace(0, 1, 64) ** 2
    t.set_curve(x, (x**0.3).expand(3, -1))
    assert (t(above, bracket=2) - above**0.3).abs().max() < 0.02
    with torch.no_grad():
        t.response.out.neg_()
    assert (t(above, bracket=2).diff(dim=0) < 0).any()  # nothing stops it from falling


def test_a_network_response_holds_the_point_that_fixes_the_scale():
    t = mapper(kind="mlp", residual=False)
    assert float(t.regularizers()["unit_exposure"].detach()) < 1e-3
    with torch.no_grad():
        t.response.level.add_(1.0)  # as a common gain would
    assert float(t.regularizers()["unit_exposure"].detach()) > 0.05


def test_a_network_response_teaches_gains_and_radiance_beyond_saturation():
    t = mapper([None, None, 0.0], kind="mlp", residual=False)
    radiance = torch.full((1, 3), 4.0, requires_grad=True)
    t(radiance, bracket=0).sum().backward()
    assert radiance.grad.min() > 0 and t.bracket_gain.learned_ev.grad[0] > 0


def test_a_look_is_the_recording_and_names_the_images_it_resembles():
    t = disturb(mapper())
    assert t.recorder(1, 0).images == (1, 4) and t.recorder(1, 0, 4).images == (4,)
    torch.testing.assert_close(
        t.recorder(1, 0, 4, leaky=True).rgb(grid()), t(grid(), bracket=1, frame=4)
    )
    assert t.recorder_at(-3.9).images == (0, 3)  # the exposures are -4, -2, 0
    torch.testing.assert_close(t.recorder_at(-3.9).rgb(grid()), t.develop(grid(), -3.9))


def test_black_and_saturated_pixels_are_not_informative():
    rgb = torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.5, 1.0], [0.0, 0.5, 0.5]])
    assert informative(rgb).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("ev", "reference", "word"),
    [([0.0, 1.0], 2, "reference"), ([0.0], 0, "lists only"), ([-2.0, 1.0], 1, "must be 0")],
)
def test_brackets_that_make_no_sense_are_refused(ev, reference, word):
    with pytest.raises(InputError, match=word):
        tone_mapper([0, 1], [0, 0], ev, reference)


def test_a_response_is_learned_from_known_exposures():
    """Recordings of known radiance through an S-curve: the curve comes back to within
    0.02 where it was seen.
    """
    generator = torch.Generator().manual_seed(1)
    truth = lambda x: (x**0.6 * (1.4 - 0.4 * x)).clamp(0, 1)  # noqa: E731
    t = mapper(residual=False)
    optimizer = torch.optim.Adam(t.parameters(), 5e-2)
    for _ in range(250):
        radiance = 2.0 ** (torch.rand(512, 3, generator=generator) * 10 - 6)
        bracket = int(torch.randint(3, (1,), generator=generator))
        loss = (
            (t(radiance, bracket) - truth((radiance * 2 ** EV[bracket]).clamp(0, 1))).abs().mean()
        )
        optimizer.zero_grad()
        (loss + 1e-3 * t.regularizers()["response_smoothness"]).backward()
        optimizer.step()
    x, y = t.curve()
    assert (y - truth(x))[:, x > 0.002].square().mean().sqrt() < 0.02


def test_neutral_gains_make_a_gray_recording_gray() -> None:
    t = tone_mapper([0, 1], [0, 0], [0.0, -2.0])
    x = torch.linspace(0, 1, 64)
    t.set_curve(x, torch.stack([x ** (1 / 2.2), x ** (1 / 1.6), x ** (1 / 3.0)]))
    radiance = t.inverse(torch.full((1, 3), 0.5), 0)[0]  # 0.5^2.2, 0.5^1.6, 0.5^3: far from gray
    seen = radiance * t.neutral()
    assert float(radiance.max() / radiance.min()) > 2
    torch.testing.assert_close(seen, seen.mean().expand(3), rtol=1e-4, atol=0)
    assert float(t.neutral().prod()) == pytest.approx(1, rel=1e-4)
