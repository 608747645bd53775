"""The step `movers`: which pixels of the masks its tracks follow, and how much their
depth is trusted.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from hdr_nsff.prepare.steps import movers as step
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.posed_video import PosedVideo

TIMES, H, W = 2, 20, 30
MOVING = np.zeros((TIMES, H, W), bool)
MOVING[:, 4:16, 4:16] = True  # 12 x 12: an outline of 2 pixels leaves 8 x 8
MOVING[:, 5:15, 22:25] = True  # 3 pixels wide: nothing would be left
INNER = MOVING.copy()
INNER[:, :, :20] = False
INNER[:, 6:14, 6:14] = True
STILL = np.zeros((TIMES, H, W), bool)
STILL[:, 9:11, 9:11] = True  # a hole in the larger mover


def work(still: np.ndarray | None, masks: str = "estimated") -> SimpleNamespace:
    """A scene of two frames with the masks `MOVING`, as far as the step reads it."""
    ones = np.ones((TIMES, H, W), np.float32)
    c2w = np.tile(np.eye(3, 4), (TIMES, 1, 1))
    K = np.tile(np.array([[30.0, 0, W / 2], [0, 30.0, H / 2], [0, 0, 1]]), (TIMES, 1, 1))
    video = np.full((TIMES, H, W, 3), 0.5, np.float32)
    none = np.zeros((TIMES, H, W), bool)
    steps = {"masks": SimpleNamespace(provenance=masks)}
    return SimpleNamespace(
        manifest=SimpleNamespace(
            depth_kind="scene", steps=steps, parallax="full", synchronized=False, rig=1
        ),
        train=[SimpleNamespace(index=k) for k in range(TIMES)],
        refined_flows=(),
        training_flows=lambda _: (np.zeros((0, H, W, 2)), np.zeros((0, H, W)), np.zeros((0, 2))),
        training_clip=lambda: PosedVideo(K, c2w, np.arange(2.0), video, none, MOVING),
        static_depth=lambda: (ones, ones),
        still=lambda: still,
    )


@pytest.fixture
def rounds(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The masks (T, H, W) of every round of the step, which finds one shape."""
    masks: list[np.ndarray] = []
    path = np.zeros((TIMES, 3))
    found = Mover(
        frames=np.arange(TIMES),
        pixels=np.full((1, TIMES, 2), 10.0),
        trust=np.ones((1, TIMES)),
        points=np.array([[0, 0, 1.0]]),
        rotations=np.tile(np.eye(3), (TIMES, 1, 1)),
        translations=path,
        center=path[0],
        known=np.ones(TIMES, bool),
        error=0.1,
    )

    def estimate(clip: PosedVideo, *_: object) -> tuple[Mover]:
        masks.append(clip.moving)
        return (found,)

    monkeypatch.setattr(step, "estimate_movers", estimate)
    return masks


def test_masks_lose_their_outline_and_thin_movers_stay_whole() -> None:
    assert np.array_equal(step.within_outlines(MOVING), INNER)


def test_the_second_round_removes_outlines_of_masks_and_not_of_static_pixels(rounds) -> None:
    step.find_movers(work(STILL))
    first, second = rounds
    assert np.array_equal(first, MOVING & ~STILL)
    assert np.array_equal(second, INNER & ~STILL)


def test_the_outline_of_given_masks_is_certain(rounds) -> None:
    step.find_movers(work(STILL, masks="given"))
    assert np.array_equal(rounds[-1], MOVING & ~STILL)


def test_where_depth_holds_the_movers_already_one_round_is_enough(rounds) -> None:
    step.find_movers(work(None))
    (only,) = rounds
    assert np.array_equal(only, MOVING)


def test_before_cameras_in_turn_depth_is_trusted_as_much_as_its_pixels_deserve() -> None:
    disparity, confidence = np.ones((TIMES, H, W)), np.full((TIMES, H, W), 0.3)
    counts = [int(mask.sum()) for mask in MOVING]
    sigmas = [np.full(counts[0], 0.1), np.full(counts[1], 0.001)]
    bundle, pixels = MOVERS_TUNING.bundle, MOVERS_TUNING.pixels
    trust = step.trust_in(step.FirstDepth(MOVING, disparity, confidence, sigmas), MOVERS_TUNING)
    for k, sigma in enumerate((0.1, pixels.min_common_sigma)):
        assert (trust[k][~MOVING[k]] == 0.3).all()
        (found,) = np.unique(trust[k][MOVING[k]])
        assert bundle.sigma_of_depth(float(found)) == pytest.approx(sigma)
    alone = step.FirstDepth(MOVING, disparity, confidence, None)
    assert step.trust_in(alone, MOVERS_TUNING) is confidence
