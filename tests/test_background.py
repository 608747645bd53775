"""Masks corrected by the background that a camera without parallax sees behind
everything.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.masks.background import correct_masks, laid_over, parts

T, H, W, FOCAL = 12, 48, 64, 60.0
K = np.tile(np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]]), (T, 1, 1))
STILL = np.tile(np.eye(4)[:3], (T, 1, 1))
NOTHING = np.zeros((T, H, W), bool)


def square(t: int) -> np.ndarray:
    """A plain square of 16 pixels that moves by 4 pixels per frame: (H, W) bool."""
    mask = np.zeros((H, W), bool)
    mask[16:32, 4 * t : 4 * t + 16] = True
    return mask


def clip() -> tuple[np.ndarray, np.ndarray]:
    """A white square before a plain gray wall with a little noise, and where the square
    is.
    """
    video = (
        np.full((T, H, W, 3), 0.3, np.float32)
        + np.random.default_rng(0).normal(size=(T, H, W, 3)).astype(np.float32) * 0.005
    )
    truth = np.stack([square(t) for t in range(T)])
    video[truth] = 0.8
    return video, truth


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / (a | b).sum())


def test_a_plain_mover_known_in_part_is_completed_and_wandering_flow_is_dropped():
    video, truth = clip()
    flow_says = truth.copy()
    flow_says[:, 20:32] = False  # a third of the square only
    flow_says[:, 36:46, 5:60] = True  # and a stretch of plain wall
    corrected = correct_masks(flow_says, video, NOTHING, K, STILL, np.arange(T))
    assert iou(flow_says, truth) < 0.3
    assert iou(corrected, truth) > 0.9


def test_what_differs_but_never_moved_is_left_out():
    video, _ = clip()
    assert not correct_masks(NOTHING, video, NOTHING, K, STILL, np.arange(T)).any()


def test_textured_flow_is_believed_against_the_background():
    video = np.tile(
        np.random.default_rng(0).random((1, H, W, 3)).astype(np.float32), (T, 1, 1, 1)
    )  # never changes: no evidence at all
    moving = NOTHING.copy()
    moving[:, 10:30, 10:30] = True
    assert iou(correct_masks(moving, video, NOTHING, K, STILL, np.arange(T)), moving) == 1


def test_saturated_pixels_do_not_differ_from_a_brighter_background():
    video = np.full((T, H, W, 3), 0.9, np.float32)
    video[0] = 0.6  # frame 0 saturates at 0.6 on the common scale
    video[0, :10] = 0.5
    clipped = NOTHING.copy()
    clipped[0, 10:] = True
    moving = NOTHING.copy()
    moving[0, 20:40, 20:40] = True
    assert not correct_masks(moving, video, clipped, K, STILL, np.arange(T))[0, 12:].any()


@pytest.mark.parametrize("angle", [0.0, 5.0])
def test_homography_follows_a_direction(angle):
    turned = np.concatenate(
        [Rotation.from_euler("y", angle, degrees=True).as_matrix(), np.zeros((3, 1))], 1
    )
    direction = np.array([0.1, -0.05, 1.0])
    indices = []
    for pose in (STILL[0], turned):
        seen = K[0] @ pose[:, :3].T @ direction
        indices.append(seen[:2] / seen[2] - 0.5)
    mapped = laid_over(K[0], STILL[0], K[0], turned) @ [*indices[0], 1]
    assert np.allclose(mapped[:2] / mapped[2], indices[1])


def test_parts_need_a_quarter_of_a_patch():
    differs, moving = np.zeros((8, 20), bool), np.zeros((8, 20), bool)
    differs[2:6, 1:9], differs[2:6, 11:19] = True, True
    moving[2:6, 1:3], moving[2:6, 11:12] = True, True  # 8 of 32, 4 of 32
    assert parts(differs, moving)[:, :10].sum() == 32
    assert not parts(differs, moving)[:, 10:].any()
