"""The response of a scene's cameras, from frames of a wall in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from estimates import tone_mapper
from wall import EV, GAMMA22, S_CURVE, rmse, wall_view

from hdr_nsff.core.errors import InputError
from hdr_nsff.radiometry.bracket_response import (
    ResponseTuning,
    alternating_medians,
    problem_of,
)
from hdr_nsff.radiometry.estimate_response import estimate_response
from hdr_nsff.radiometry.one_exposure import at_one_exposure
from hdr_nsff.radiometry.response import Response
from hdr_nsff.radiometry.response_words import describe
from hdr_nsff.scene.response import read_response, write_response
from hdr_nsff.tonemap.base import ToneMapper

UNKNOWN = [None, None, None]
BRACKETS = [0, 1, 2] * 2


def mapper(ev=UNKNOWN, cameras=(0,) * 6, **config) -> ToneMapper:
    return tone_mapper(BRACKETS, list(cameras), ev, reference=2, **config)


@pytest.fixture(scope="module")
def measured() -> Response:
    """From noisy depth, exposures known."""
    rng = np.random.default_rng(0)
    views = [wall_view(i, S_CURVE, rng, depth_noise=0.02) for i in range(18)]
    return estimate_response(views, [0] * 18, EV, reference=2, num_cameras=1)


def test_the_curve_is_found_through_noisy_depth(measured: Response) -> None:
    assert measured.source == "static points" and not measured.guessed
    assert rmse(measured.x, measured.y[0], S_CURVE) < 0.01
    assert "static points" in describe(measured, EV) and "as given" in describe(measured, EV)


def test_unknown_exposures_come_with_their_interval() -> None:
    rng = np.random.default_rng(0)
    views = [wall_view(i, S_CURVE, rng) for i in range(18)]
    response = estimate_response(views, [0] * 18, UNKNOWN, reference=2, num_cameras=1)
    np.testing.assert_allclose(response.ev, EV, atol=0.1)
    assert response.scale_low < 1 < response.scale_high
    words = describe(response, UNKNOWN)
    assert "95 % confidence" in words and "--ev" in words
    assert response.moved_stops > 0.1  # the recordings alone give half a stop more
    assert f"moved by {response.moved_stops:.2f} to usual steps" in words


def test_steps_moved_to_usual_ones_are_named_with_their_number(measured: Response) -> None:
    ev = np.array([-4.0, -2.0, 0.0])
    guess = replace(measured, guessed=True, ev=ev, scale_low=0.9, scale_high=1.4)
    longer = describe(replace(guess, measured_scale=1.125), UNKNOWN)
    assert "give 4.50 from darkest to brightest, 3.60 to 5.60 with 95 % confidence" in longer
    assert "moved by 0.50 to usual steps" in longer
    shorter = describe(replace(guess, measured_scale=0.95), UNKNOWN)
    assert "moved by 0.20 to usual steps" in shorter
    assert "moved" not in describe(replace(guess, measured_scale=1.0), UNKNOWN)


def test_the_tone_mapper_starts_there_and_is_held_from_the_first_step(measured: Response) -> None:
    t = mapper(EV)
    t.start(measured)
    x, y = t.curve()
    assert t.anchored and rmse(x.numpy(), y.numpy(), S_CURVE) < 0.01


def test_without_static_points_it_falls_back_on_brightness_and_reports_it() -> None:
    rng = np.random.default_rng(0)
    views = [wall_view(i, GAMMA22, rng) for i in range(6)]
    for view in views:
        view.moving[:] = True
    response = estimate_response(views, [0] * 6, UNKNOWN, reference=2, num_cameras=1)
    words = describe(response, UNKNOWN)
    assert "too few static points" in words and "brightness" in words
    t = mapper()
    t.start(response)
    assert not t.anchored and t.exposures().tolist() == pytest.approx(EV, abs=0.4)
    x, y = t.curve()
    torch.testing.assert_close(y, (x ** (1 / 2.2)).expand(3, -1), atol=1e-5, rtol=0)


def test_a_single_exposure_leaves_gamma() -> None:
    views = [
        replace(wall_view(0, S_CURVE, np.random.default_rng(0)), time=float(t)) for t in (0, 1)
    ]
    response = estimate_response(views, [0, 0], [0.0], reference=0, num_cameras=1)
    assert response.source == "one exposure" and response.ev.tolist() == [0.0]
    np.testing.assert_allclose(response.y[0, 0], response.x ** (1 / 2.2), atol=1e-9)


def test_a_single_exposure_is_said_to_lack_light_beyond_its_white() -> None:
    rng = np.random.default_rng(0)
    views = [replace(wall_view(3 * t + 1, S_CURVE, rng), bracket=0, time=t) for t in range(6)]
    words = describe(estimate_response(views, [0] * 6, [None], 0, 1), [None])
    assert words.count("light beyond its white is not recorded") == 1
    alternating = [wall_view(t, S_CURVE, rng) for t in range(6)]
    assert "beyond its white" not in describe(estimate_response(alternating, [0] * 6, EV, 2, 1), EV)


def test_the_papers_tone_mapper_is_left_as_published(measured: Response) -> None:
    t = mapper(kind="per_image", knots="even", from_recordings=False)
    t.start(measured)
    assert (t.gains() == 0).all()


def test_white_balance_of_a_second_camera_is_recovered() -> None:
    rng = np.random.default_rng(0)
    gains = np.array([0.8, 1.0, 1.25])
    cameras = [(i // 3) % 2 for i in range(18)]
    views = [wall_view(i, S_CURVE, rng, gain=gains if c else 1.0) for i, c in enumerate(cameras)]
    response = estimate_response(views, cameras, EV, reference=2, num_cameras=2)
    assert response.own_curves == (0, 1)
    saturation = response.white_balance[1] - np.log2(gains)  # curves end where each saturates
    assert np.abs(saturation).max() < 0.1
    t = mapper(EV, cameras=(0, 0, 0, 1, 1, 1))
    t.start(response)
    stops = t.log_gain(2, 1, None) / np.log(2)
    torch.testing.assert_close(stops.detach().double(), torch.from_numpy(response.white_balance[1]))


def test_offsets_of_cameras_are_recovered_through_a_chain() -> None:
    rng = np.random.default_rng(0)
    camera, true = np.array([0, 1, 2]), np.array([0.0, 0.5, -0.25])
    stops = rng.normal(size=(600, 1)) + true + 0.01 * rng.normal(size=(600, 3))
    stops[:300, 2] = np.nan  # cameras 0 and 1
    stops[300:, 0] = np.nan  # cameras 1 and 2
    np.testing.assert_allclose(alternating_medians(stops, camera, 3), true, atol=0.02)


def test_frames_of_two_exposures_become_one_picture(measured: Response) -> None:
    views = [wall_view(i, S_CURVE, np.random.default_rng(1), shift=0.0) for i in (1, 2)]
    video = np.stack([v.image for v in views])
    brackets, cameras = np.array([1, 2]), np.zeros(2, int)
    one, other = at_one_exposure(video, brackets, cameras, measured)
    unclipped = ((video > 0.1) & (video < 0.9)).all((0, -1)) & ~views[0].moving & ~views[1].moving
    assert unclipped.sum() > 100 and np.abs(one - other)[unclipped].mean() < 0.02


def test_frames_that_drift_are_brought_to_their_brackets(measured: Response) -> None:
    gains = 0.0, 0.8  # stops
    views = [wall_view(1, S_CURVE, np.random.default_rng(1), gain=2**g) for g in gains]
    video, nothing = np.stack([v.image for v in views]), np.zeros(2, int)
    one, other = at_one_exposure(video, nothing + 1, nothing, measured, np.array(gains))
    unclipped = ((video > 0.1) & (video < 0.9)).all((0, -1)) & ~views[0].moving
    assert np.abs(video[0] - video[1])[unclipped].mean() > 0.1
    assert unclipped.sum() > 100 and np.abs(one - other)[unclipped].mean() < 0.02


def test_it_is_read_as_it_was_written(measured: Response, tmp_path) -> None:
    write_response(tmp_path / "response.json", measured)
    found = read_response(tmp_path / "response.json", num_cameras=1, num_brackets=3)
    for name, value in vars(measured).items():
        np.testing.assert_array_equal(getattr(found, name), value)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: replace(r, ev=r.ev[:2]),
        lambda r: replace(r, y=r.y[..., ::-1]),
        lambda r: replace(r, x=r.x[:-1]),
        lambda r: replace(r, white_balance=np.zeros((2, 3))),
    ],
)
def test_one_of_another_scene_is_refused_in_a_sentence(change, measured, tmp_path) -> None:
    write_response(tmp_path / "response.json", change(measured))
    with pytest.raises(InputError, match="--redo response"):
        read_response(tmp_path / "response.json", num_cameras=1, num_brackets=3)


@pytest.mark.parametrize("text", ["", "{", "[]", "3", '{"version": 9}'])
def test_what_is_no_response_is_refused_in_a_sentence(text: str, tmp_path) -> None:
    (tmp_path / "response.json").write_text(text)
    with pytest.raises(InputError, match="--redo response"):
        read_response(tmp_path / "response.json", num_cameras=1, num_brackets=3)


@pytest.mark.parametrize("curve, believed", [("gamma", True), ("step", False)])
def test_a_curve_that_no_camera_has_is_not_believed(curve, believed):
    x = np.linspace(0, 1, 256) ** 2.2
    y = x ** (1 / 2.2) if curve == "gamma" else np.interp(x, [0, 0.5, 0.6, 1], [0, 0.01, 0.9, 1])
    problem = problem_of(x, np.tile(y, (3, 1)), 0.01, ResponseTuning())
    assert (problem == "") == believed
    if not believed:
        assert "from black to white within 0.2 stops" in problem
