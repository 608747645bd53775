"""Movers are rigid where their motion explains their flow as well as the cameras
explain that of the static scene.
"""

from dataclasses import replace

import numpy as np
import pytest
from estimates import movers_of, video_of

from hdr_nsff.priors.movers.rigidity import judge_rigidity
from hdr_nsff.scene.movers import Mover
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


def test_without_flow_nothing_is_known_and_a_mover_stays_rigid(six: Scene) -> None:
    clip, flow, valid, pairs = video_of(six)
    disparity = np.ones((6, *clip.size), np.float32)
    (mover,) = judge_rigidity(movers_of(six), clip, flow[:0], valid[:0], pairs[:0], disparity)
    assert mover.rigid and mover.flow_residual == 0
    assert judge_rigidity([], clip, flow, valid, pairs, disparity) == ()
