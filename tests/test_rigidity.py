"""Movers are rigid where their motion explains their flow as well as the cameras
explain that of the static scene.
"""

from dataclasses import replace

import numpy as np
import pytest
from estimates import movers_of, video_of

from hdr_nsff.priors.movers.rigidity import is_part_of, judge_rigidity
from hdr_nsff.priors.movers.tuning import RIGIDITY_TUNING
from hdr_nsff.scene.movers import Mover, nearest_mover
from hdr_nsff.scene.scene import Scene


def judged(scene: Scene, deform: float, noise: float = 0.0) -> Mover:
    """The toy's card, whose flow is that of a stretching cloth by `deform` px, with
    `noise` px in the flow of everything.
    """
    clip, flow, valid, pairs = video_of(scene)
    (mover,) = movers_of(scene)
    disparity = np.stack([f.disparity.numpy() for f in scene.train if f.disparity is not None])
    generator = np.random.default_rng(0)
    flow = flow + noise * generator.standard_normal(flow.shape)
    wave = deform * np.sin(np.arange(flow.shape[2]))[None, None, :]
    flow[..., 1] += np.where(clip.moving[pairs[:, 0]], wave, 0.0)
    return judge_rigidity([mover], clip, flow, valid, pairs, disparity)[0]


@pytest.fixture(scope="module")
def six(toy: Scene) -> Scene:
    return replace(toy, train=[replace(f, index=i) for i, f in enumerate(toy.train[:6])])


def test_a_card_is_rigid_and_a_cloth_is_not(six: Scene) -> None:
    card, cloth = judged(six, 0.0), judged(six, 1.5)
    assert card.rigid and card.flow_residual < 0.2
    assert not cloth.rigid and cloth.flow_residual > 0.5
    assert card.flow_uncertainty == pytest.approx(cloth.flow_uncertainty)


def test_uncertain_flow_of_the_static_scene_excuses_as_much_of_a_mover(six: Scene) -> None:
    card = judged(six, 0.0, noise=1.0)
    assert card.rigid and card.flow_residual > 0.5 and card.flow_uncertainty > 0.5


def test_a_mover_whose_shape_misses_its_tracks_is_not_rigid(six: Scene) -> None:
    clip, flow, valid, pairs = video_of(six)
    disparity = np.stack([f.disparity.numpy() for f in six.train if f.disparity is not None])
    (card,) = movers_of(six)
    tuning = RIGIDITY_TUNING
    for error, rigid in ((0.15, True), (0.45, False), (np.inf, True)):
        (found,) = judge_rigidity(
            [replace(card, error=error)], clip, flow, valid, pairs, disparity, tuning
        )
        assert found.rigid == rigid and found.flow_residual < 0.2


def test_a_first_depth_that_was_wrong_is_not_held_against_a_mover(six: Scene) -> None:
    clip, flow, valid, pairs = video_of(six)
    disparity = np.stack([f.disparity.numpy() for f in six.train if f.disparity is not None])
    wrong = np.where(clip.moving, 1.5 * disparity, disparity)
    (card,) = judge_rigidity(movers_of(six), clip, flow, valid, pairs, wrong)
    assert card.rigid and card.flow_residual < 0.2


def test_times_at_which_a_mover_is_not_known_are_not_held_against_it(six: Scene) -> None:
    clip, flow, valid, pairs = video_of(six)
    disparity = np.stack([f.disparity.numpy() for f in six.train if f.disparity is not None])
    later = pairs.min(1) >= 2  # something else moves there
    bent = flow + np.where(later[:, None, None] & clip.moving[pairs[:, 0]], 5.0, 0.0)[..., None]
    (card,) = movers_of(six)
    seen = replace(card, known=np.arange(6) <= 2)
    found = judge_rigidity([card, seen], clip, bent, valid, pairs, disparity)
    assert not found[0].rigid
    (alone,) = judge_rigidity([seen], clip, bent, valid, pairs, disparity)
    assert alone.rigid and alone.flow_residual < 0.2


def seen_at(x: float, times: slice = slice(None)) -> Mover:
    """A mover of two tracks around column `x`, at some of ten times."""
    pixels = np.full((2, 10, 2), np.nan)
    pixels[:, times] = np.array([[x, 10.0], [x + 2, 10.0]])[:, None]
    return Mover(
        frames=np.arange(10),
        pixels=pixels,
        trust=np.isfinite(pixels[..., 0]).astype(float),
        points=np.full((2, 3), np.nan),
        rotations=np.tile(np.eye(3), (10, 1, 1)),
        translations=np.zeros((10, 3)),
        center=np.zeros(3),
        known=np.ones(10, bool),
        error=np.inf,
    )


def test_what_touches_a_mover_whenever_it_is_seen_is_a_part_of_it() -> None:
    arm, hand = seen_at(20), seen_at(26, slice(0, 5))
    assert is_part_of(hand, arm) and not is_part_of(arm, hand)  # the arm is seen longer
    passing = seen_at(26, slice(3, 10))
    passing.pixels[:, 6:, 0] += 50
    assert not is_part_of(passing, arm)
    later = seen_at(20, slice(5, 10))
    assert not is_part_of(seen_at(26), seen_at(35)) and not is_part_of(hand, later)


def test_tracks_that_start_far_apart_touch_from_farther_away() -> None:
    """Neighbors of a grid touch, however wide it is."""
    for spacing, touch in ((3.0, False), (6.0, False), (9.0, True)):
        hand, arm = (replace(seen_at(x), spacing=spacing) for x in (20, 31))
        assert is_part_of(hand, arm) == touch  # their nearest tracks are 9 pixels apart


def test_a_part_of_what_is_not_rigid_is_not_rigid(six: Scene) -> None:
    clip, flow, valid, pairs = video_of(six)
    disparity = np.stack([f.disparity.numpy() for f in six.train if f.disparity is not None])
    (card,) = movers_of(six)
    west = card.points[:, 0] < np.nanmedian(card.points[:, 0])
    halves = [
        replace(card, pixels=card.pixels[own], trust=card.trust[own], points=card.points[own])
        for own in (west, ~west)
    ]
    y, x = np.mgrid[: flow.shape[1], : flow.shape[2]]
    pixels = np.stack([x, y], -1).reshape(-1, 2) + 0.5
    bent = flow.copy()
    for k, start in enumerate(pairs[:, 0]):
        owner = nearest_mover(halves, int(start), pixels, (clip.K[start], clip.c2w[start]))
        bent[k, ..., 1] += 1.5 * np.sin(x) * (owner == 0).reshape(x.shape) * clip.moving[start]
    apart = replace(RIGIDITY_TUNING, touching_px=0.0)
    for tuning, east in ((RIGIDITY_TUNING, False), (apart, True)):
        found = judge_rigidity(halves, clip, bent, valid, pairs, disparity, tuning)
        assert [mover.rigid for mover in found] == [False, east]


def test_without_flow_nothing_is_known_and_a_mover_stays_rigid(six: Scene) -> None:
    clip, flow, valid, pairs = video_of(six)
    disparity = np.ones((6, *clip.size), np.float32)
    (mover,) = judge_rigidity(movers_of(six), clip, flow[:0], valid[:0], pairs[:0], disparity)
    assert mover.rigid and mover.flow_residual == 0
    assert judge_rigidity([], clip, flow, valid, pairs, disparity) == ()
