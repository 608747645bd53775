"""Frames brought to one exposure: by pixels at rest that flow matches in several,
whatever enters and leaves the frame.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.priors.flow.one_exposure import (
    equalize_through_response,
    matched_samples,
    response_from_flow,
)
from hdr_nsff.radiometry.debevec import linked
from hdr_nsff.radiometry.exposure_cycle import equalize
from hdr_nsff.radiometry.recording import Noise, record, response_curve

T, H, W = 6, 72, 108
EV = (0.0, 2.0, 4.0)
BRACKETS = np.arange(T) % 3
SLIDE = 2  # pixels a frame
PAIRS = np.array([p for i in range(T - 1) for p in ((i, i + 1), (i + 1, i))])
NOTHING = np.zeros((T, H, W), bool)


def radiance(curtain: bool = False) -> np.ndarray:
    """A smooth wall (T, H, W, 3) over six stops that slides by; with a bright curtain
    that hides a third of it whenever the exposure is the shortest.
    """
    noise = np.random.default_rng(0).random((H, W + SLIDE * T, 3)).astype(np.float32)
    wall = cv2.GaussianBlur(noise, (0, 0), 7)
    wall = 0.015 * 2 ** (6 * (wall - wall.min()) / np.ptp(wall))
    frames = np.stack([wall[:, SLIDE * t : SLIDE * t + W] for t in range(T)])
    if curtain:
        frames[::3, :, : W // 3] = 0.5
    return frames


def recorded(frames: np.ndarray) -> np.ndarray:
    """The frames as a camera with alternating exposures records them."""
    rng, camera = np.random.default_rng(1), response_curve("film")
    video = []
    for frame, bracket in zip(frames, BRACKETS, strict=True):
        video.append(record(frame, EV[bracket] - 3.0, (1, 1, 1), camera, Noise(), rng))
    return np.stack(video).astype(np.float32)


def flows(allowed: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The exact flow, its validity and its pairs: valid but for the margins, and where
    `allowed` (T, H, W).
    """
    flow = np.zeros((len(PAIRS), H, W, 2), np.float32)
    flow[..., 0] = -SLIDE * np.diff(PAIRS, axis=1)[:, :, None]
    valid = np.zeros((len(PAIRS), H, W), bool)
    valid[:, :, SLIDE:-SLIDE] = True
    if allowed is not None:
        for k, (i, _) in enumerate(PAIRS):
            valid[k] &= allowed[i]
    return flow, valid, PAIRS


def difference(frames: np.ndarray, video: np.ndarray) -> float:
    """Mean absolute difference of neighboring frames where both recorded the wall."""
    parts = []
    for t in range(T - 1):
        a, b = frames[t, :, SLIDE:], frames[t + 1, :, :-SLIDE]
        both = ((video[t, :, SLIDE:] > 0.05) & (video[t, :, SLIDE:] < 0.95)).all(-1)
        both &= ((video[t + 1, :, :-SLIDE] > 0.05) & (video[t + 1, :, :-SLIDE] < 0.95)).all(-1)
        both[:, : W // 3] = False
        parts.append(np.abs(a - b)[both])
    return float(np.concatenate(parts).mean())


@pytest.mark.parametrize("known", [[None] * 3, list(EV), [None, 2.0, None]])
def test_matched_pixels_become_alike_and_their_exposure_steps_are_found(
    known: list[float | None],
) -> None:
    video = recorded(radiance())
    fit = response_from_flow(video, BRACKETS, known, 1, flows(), NOTHING)
    assert fit is not None and fit.misfit < 0.1
    assert np.allclose(np.diff(fit.ev), 2.0, atol=0.1)
    equalized = equalize_through_response(video, BRACKETS, fit)
    assert difference(equalized, video) < 0.016 < 0.1 < difference(video, video)
    assert equalized.min() >= 0 and equalized.max() <= 1


def test_what_enters_and_leaves_biases_brightness_but_not_the_response() -> None:
    video = recorded(radiance(curtain=True))
    wall = np.ones((T, H, W), bool)
    wall[:, :, : W // 3 + SLIDE] = False
    fit = response_from_flow(video, BRACKETS, [None] * 3, 0, flows(wall), NOTHING)
    assert fit is not None
    by_response = equalize_through_response(video, BRACKETS, fit)
    by_brightness, _ = equalize(video, BRACKETS.tolist())
    assert difference(by_response, video) < 0.5 * difference(by_brightness, video)


def test_moving_pixels_are_not_sampled() -> None:
    """The 3 x 3 pixels around a sample count with it, so 39 of 40 moving rows may
    change.
    """
    video, moving = recorded(radiance()), NOTHING.copy()
    moving[:, :40] = True
    samples = matched_samples(video, BRACKETS, 3, flows(), moving)
    video[:, :39] = np.random.default_rng(2).random((T, 39, W, 3))
    again = matched_samples(video, BRACKETS, 3, flows(), moving)
    assert len(samples.rgb) > 500
    assert np.array_equal(samples.rgb, again.rgb) and np.array_equal(samples.valid, again.valid)


def test_samples_of_one_place_are_brighter_in_the_brighter_bracket() -> None:
    samples = matched_samples(recorded(radiance()), BRACKETS, 3, flows(), NOTHING)
    in_both = samples.valid[:, :2].all((1, 2))
    assert in_both.sum() > 200
    assert (samples.rgb[in_both, 0] < samples.rgb[in_both, 1]).all()


def test_there_is_no_response_without_valid_flow_without_pixels_at_rest_or_of_one_exposure() -> (
    None
):
    video = recorded(radiance())
    unknown = [None] * 3
    assert response_from_flow(video, BRACKETS, unknown, 0, flows(NOTHING), NOTHING) is None
    assert response_from_flow(video, BRACKETS, unknown, 0, flows(), ~NOTHING) is None
    assert response_from_flow(video, 0 * BRACKETS, [None], 0, flows(), NOTHING) is None


def test_there_is_no_response_of_a_camera_without_training_frames() -> None:
    video = recorded(radiance())
    no_flows = tuple(part[:0] for part in flows())
    fit = response_from_flow(video[:0], BRACKETS[:0], [None] * 3, 0, no_flows, NOTHING[:0])
    assert fit is None


def test_there_is_no_response_where_points_do_not_agree() -> None:
    """Every frame has brightnesses of its own, so there are points, but no response
    explains them.
    """
    size = np.ones((1, H, W, 1), np.float32)
    video = size * np.random.default_rng(3).random((T, 1, 1, 3)).astype(np.float32)
    video[:, :, ::2] = np.random.default_rng(4).random((T, 1, 1, 3)).astype(np.float32)
    video = np.stack([cv2.GaussianBlur(frame, (0, 0), 9) for frame in video])
    samples = matched_samples(video, BRACKETS, 3, flows(), NOTHING)
    assert linked(samples, {0, 1, 2})
    assert response_from_flow(video, BRACKETS, list(EV), 0, flows(), NOTHING) is None
