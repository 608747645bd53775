"""The white balance of single frames comes back from a wall in closed form."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from test_frame_exposures import NUM, drifting_views, smooth_drift
from wall import S_CURVE, X

from hdr_nsff.prepare.steps.response import white_balance_of_frames
from hdr_nsff.radiometry.frame_colors import FrameColorsTuning, frame_white_balance
from hdr_nsff.scene.manifest import FrameEntry

CYCLE = (0, 1, 2)


def slow_balance(stops: float) -> np.ndarray:
    """A slow drift (NUM, 3) of red against blue in stops, mean 0 in time and color."""
    wave = stops * np.sin(2 * np.pi * np.arange(NUM) / NUM)
    return np.stack([wave, np.zeros(NUM), -wave], -1)


@pytest.mark.parametrize("exposure", [0.0, 2.0])
def test_a_slow_drift_comes_back_whatever_the_exposure_does(exposure: float) -> None:
    true = slow_balance(0.3)
    drift = true + smooth_drift(exposure)[:, None]
    found = frame_white_balance(drifting_views(S_CURVE, drift, CYCLE), X, S_CURVE)
    assert found is not None
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-9)
    np.testing.assert_allclose(found.mean(1), 0, atol=1e-9)
    assert np.abs(found - true).max() < 0.12  # the ends of a clip are smoothed
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.05


@pytest.mark.parametrize("exposure", [0.0, 2.0])
def test_without_a_drift_there_is_none(exposure: float) -> None:
    views = drifting_views(S_CURVE, smooth_drift(exposure), CYCLE)
    assert frame_white_balance(views, X, S_CURVE) is None


@pytest.mark.parametrize("bracket", CYCLE)
def test_a_change_that_one_bracket_shows_is_that_of_a_light(bracket: int) -> None:
    seen = np.resize(CYCLE, NUM) == bracket
    views = drifting_views(S_CURVE, slow_balance(0.9) * seen[:, None], CYCLE)
    assert frame_white_balance(views, X, S_CURVE) is None


@pytest.mark.parametrize("part", [np.s_[:, :32], np.s_[:24]], ids=["left", "top"])
def test_a_change_in_a_part_of_the_picture_is_that_of_a_light(part: tuple[slice, ...]) -> None:
    lit = drifting_views(S_CURVE, slow_balance(0.9), CYCLE)
    views = []
    for view, of_lit in zip(drifting_views(S_CURVE, 0 * slow_balance(0), CYCLE), lit, strict=True):
        image = view.image.copy()
        image[part] = of_lit.image[part]
        views.append(replace(view, image=image))
    assert frame_white_balance(views, X, S_CURVE) is None


def test_frames_in_any_order_give_the_same() -> None:
    views = drifting_views(S_CURVE, slow_balance(0.3), CYCLE)
    order = np.random.default_rng(1).permutation(NUM)
    found = frame_white_balance(views, X, S_CURVE)
    shuffled = frame_white_balance([views[i] for i in order], X, S_CURVE)
    assert found is not None and shuffled is not None
    np.testing.assert_allclose(shuffled, found[order])


def test_a_drift_below_its_uncertainty_is_none() -> None:
    views = drifting_views(S_CURVE, slow_balance(0.3), CYCLE)
    doubtful = FrameColorsTuning(sigmas=1e6)
    assert frame_white_balance(views, X, S_CURVE, doubtful) is None
    assert frame_white_balance(views[:4], X, S_CURVE) is None


def test_without_points_there_is_none() -> None:
    views = [
        replace(v, moving=np.ones(v.image.shape[:2], bool))
        for v in drifting_views(S_CURVE, smooth_drift(0), CYCLE)
    ]
    assert frame_white_balance(views, X, S_CURVE) is None


def test_held_out_frames_lie_between_their_neighbors() -> None:
    train = [FrameEntry(index=i, time=i, bracket=0, image="", source="") for i in (0, 2, 3)]
    test = FrameEntry(index=1, time=1, bracket=0, image="", source="", split="test")
    frames = [train[0], test, *train[1:]]
    work = SimpleNamespace(train=train, manifest=SimpleNamespace(frames=frames))
    colors = np.array([[0.1, 0, -0.1], [0.3, 0, -0.3], [-0.4, 0, 0.4]])
    found = white_balance_of_frames(cast(Any, work), colors)
    assert found == {0: [0.1, 0, -0.1], 1: [0.2, 0, -0.2], 2: [0.3, 0, -0.3], 3: [-0.4, 0, 0.4]}
    assert white_balance_of_frames(cast(Any, work), None) == {}
