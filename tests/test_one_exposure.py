"""Frames brought to one exposure: by pixels at rest that flow found in several,
whatever else comes and goes.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.priors.flow.one_exposure import at_one_exposure, matched_samples, response_from_flow
from hdr_nsff.radiometry.debevec import linked
from hdr_nsff.radiometry.exposure_cycle import equalize
from hdr_nsff.radiometry.recording import Noise, record, response_curve

T, H, W = 6, 72, 108
EV = (0.0, 2.0, 4.0)
BRACKETS = np.arange(T) % 3
SLIDE = 2  # pixels a frame
PAIRS = np.array([p for i in range(T - 1) for p in ((i, i + 1), (i + 1, i))])
STILL = np.zeros((T, H, W), bool)


def radiance(curtain: bool = False) -> np.ndarray:
    """A smooth wall (T, H, W, 3) over six stops that slides by; with a bright curtain
    that a third of it is behind whenever the exposure is the shortest.
    """
    noise = np.random.default_rng(0).random((H, W + SLIDE * T, 3)).astype(np.float32)
    wall = cv2.GaussianBlur(noise, (0, 0), 7)
    wall = 0.015 * 2 ** (6 * (wall - wall.min()) / np.ptp(wall))
    frames = np.stack([wall[:, SLIDE * t : SLIDE * t + W] for t in range(T)])
    if curtain:
        frames[::3, :, : W // 3] = 0.5
    return frames


def recorded(frames: np.ndarray) -> np.ndarray:
    rng, camera = np.random.default_rng(1), response_curve("film")
    return np.stack(
        [
            record(f, EV[b] - 3.0, (1, 1, 1), camera, Noise(), rng)
            for f, b in zip(frames, BRACKETS, strict=True)
        ]
    ).astype(np.float32)


def flows(believed: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The exact flow, and where it is believed: all but the margins, or `believed` (T,
    H, W) too.
    """
    flow = np.zeros((len(PAIRS), H, W, 2), np.float32)
    flow[..., 0] = -SLIDE * np.diff(PAIRS, axis=1)[:, :, None]
    valid = np.zeros((len(PAIRS), H, W), bool)
    valid[:, :, SLIDE:-SLIDE] = True
    if believed is not None:
        for k, (i, _) in enumerate(PAIRS):
            valid[k] &= believed[i]
    return flow, valid, PAIRS


def unlike(frames: np.ndarray, video: np.ndarray) -> float:
    """How much neighbors differ where both recorded the wall, mean absolute."""
    parts = []
    for t in range(T - 1):
        a, b = frames[t, :, SLIDE:], frames[t + 1, :, :-SLIDE]
        both = ((video[t, :, SLIDE:] > 0.05) & (video[t, :, SLIDE:] < 0.95)).all(-1)
        both &= ((video[t + 1, :, :-SLIDE] > 0.05) & (video[t + 1, :, :-SLIDE] < 0.95)).all(-1)
        both[:, : W // 3] = False
        parts.append(np.abs(a - b)[both])
    return float(np.concatenate(parts).mean())


@pytest.mark.parametrize("known", [[None] * 3, list(EV), [None, 2.0, None]])
def test_matched_pixels_look_alike_and_their_steps_are_found(known: list[float | None]) -> None:
    video = recorded(radiance())
    fit = response_from_flow(video, BRACKETS, known, 1, flows(), STILL)
    assert fit is not None and fit.misfit < 0.1
    assert np.allclose(np.diff(fit.ev), 2.0, atol=0.1)
    level = at_one_exposure(video, BRACKETS, fit)
    assert unlike(level, video) < 0.016 < 0.1 < unlike(video, video)
    assert level.min() >= 0 and level.max() <= 1


def test_what_comes_and_goes_bends_brightness_but_not_the_response() -> None:
    video = recorded(radiance(curtain=True))
    wall = np.ones((T, H, W), bool)
    wall[:, :, : W // 3 + SLIDE] = False
    fit = response_from_flow(video, BRACKETS, [None] * 3, 0, flows(wall), STILL)
    assert fit is not None
    by_response, by_brightness = (
        at_one_exposure(video, BRACKETS, fit),
        equalize(video, BRACKETS.tolist())[0],
    )
    assert unlike(by_response, video) < 0.5 * unlike(by_brightness, video)


def test_what_moves_is_not_asked() -> None:
    video, moving = recorded(radiance()), STILL.copy()
    moving[:, :40] = True
    samples = matched_samples(video, BRACKETS, 3, flows(), moving)
    video[:, :39] = np.random.default_rng(2).random(
        (T, 39, W, 3)
    )  # the pixels around a pixel count with it
    again = matched_samples(video, BRACKETS, 3, flows(), moving)
    assert len(samples.rgb) > 500
    assert np.array_equal(samples.rgb, again.rgb) and np.array_equal(samples.valid, again.valid)


def test_believed_flow_links_the_same_places() -> None:
    samples = matched_samples(recorded(radiance()), BRACKETS, 3, flows(), STILL)
    pair = samples.valid[:, :2].all((1, 2))
    assert pair.sum() > 200
    assert (
        samples.rgb[pair, 0] < samples.rgb[pair, 1]
    ).all()  # every one brighter in the brighter bracket


def test_nothing_is_told_where_no_flow_is_believed_all_moves_or_there_is_one_exposure() -> None:
    video = recorded(radiance())
    assert response_from_flow(video, BRACKETS, [None] * 3, 0, flows(STILL), STILL) is None
    assert response_from_flow(video, BRACKETS, [None] * 3, 0, flows(), ~STILL) is None
    assert response_from_flow(video, 0 * BRACKETS, [None], 0, flows(), STILL) is None
    nothing = tuple(part[:0] for part in flows())
    assert (
        response_from_flow(video[:0], BRACKETS[:0], [None] * 3, 0, nothing, STILL[:0]) is None
    )  # a camera that is all held out


def test_points_that_do_not_agree_tell_nothing() -> None:
    video = (
        np.random.default_rng(3).random((T, 1, 1, 3)).astype(np.float32).repeat(H, 1).repeat(W, 2)
    )  # flickers at will
    video[:, :, ::2] = np.random.default_rng(4).random((T, 1, 1, 3)).astype(np.float32)
    video = blurred(video)
    assert linked(
        matched_samples(video, BRACKETS, 3, flows(), STILL), {0, 1, 2}
    )  # it is not for want of points
    assert response_from_flow(video, BRACKETS, list(EV), 0, flows(), STILL) is None


def blurred(video: np.ndarray) -> np.ndarray:
    return np.stack([cv2.GaussianBlur(frame, (0, 0), 9) for frame in video])
