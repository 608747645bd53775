"""Dense inverse search: exact on a sliding plane, invalid where nothing is known."""

import cv2
import numpy as np
import pytest

from hdr_nsff.priors.flow.dense import DenseFlowTuning, average_with_reverse, dense_flow

H, W = 64, 96
NONE_CLIPPED = np.zeros((2, H, W), bool)


def texture(seed: int = 0, size: tuple[int, int] = (H + 40, W + 40)) -> np.ndarray:
    """Smooth noise (H, W, 3) in [0.1, 0.9]."""
    noise = np.random.default_rng(seed).random((*size, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def sliding(dx: float, dy: float) -> np.ndarray:
    """Two frames (2, H, W, 3) of a plane that moves by (dx, dy) pixels."""
    shifts = [np.float32([[1, 0, x - 20], [0, 1, y - 20]]) for x, y in ((0, 0), (dx, dy))]
    return np.stack([cv2.warpAffine(texture(), m, (W, H), flags=cv2.INTER_CUBIC) for m in shifts])


@pytest.mark.parametrize("doubled", [True, False])  # as small and as large frames are
def test_a_sliding_plane_gives_its_motion_everywhere(doubled):
    tuning = DenseFlowTuning(doubled_below_pixels=H * W + doubled)
    found, valid = dense_flow(sliding(2.5, -1.25), NONE_CLIPPED, np.array([[0, 1]]), tuning)
    inner = found[0, 8:-8, 8:-8]
    assert np.abs(inner - [2.5, -1.25]).max() < 0.15
    assert valid[0, 8:-8, 8:-8].mean() > 0.99


def test_another_exposure_of_the_same_plane_gives_the_same_motion():
    frames = sliding(2.5, -1.25)
    frames[1] = np.minimum(frames[1], 0.5)  # the second frame saturates at half
    found, _ = dense_flow(frames, frames.min(-1) >= 0.5, np.array([[0, 1]]))
    assert np.median(np.abs(found[0, 8:-8, 8:-8] - [2.5, -1.25])) < 0.1


def test_the_reverse_pair_is_the_opposite_motion():
    found, _ = dense_flow(sliding(3, 0), NONE_CLIPPED, np.array([[0, 1], [1, 0]]))
    assert np.abs(found[0] + found[1])[8:-8, 8:-8].max() < 0.15


def test_the_order_of_pairs_does_not_change_the_result():
    frames = np.concatenate([sliding(1, 0), sliding(2, 2)])
    clipped = np.zeros(frames.shape[:3], bool)
    pairs = np.array([[0, 1], [1, 3], [3, 0]])
    flow, valid = dense_flow(frames, clipped, pairs)
    reordered_flow, reordered_valid = dense_flow(frames, clipped, pairs[::-1])
    assert np.array_equal(flow, reordered_flow[::-1])
    assert np.array_equal(valid, reordered_valid[::-1])


def test_directions_that_agree_are_averaged_and_others_stay():
    shape = (20, 30, 2)
    forward = np.full(shape, 2.0, np.float32)
    backward = np.full(shape, -1.8, np.float32)
    assert np.allclose(average_with_reverse(forward, backward), 1.9)
    assert np.allclose(average_with_reverse(backward, forward), -1.9)
    assert np.array_equal(average_with_reverse(forward, -forward), forward)
    # One direction of these is wrong; which one is unknown.
    assert np.array_equal(average_with_reverse(forward, -forward + 1), forward)


def test_averaging_both_directions_reduces_noise():
    shape = (20, 30, 2)
    flow = np.full(shape, 2.0, np.float32)
    rng = np.random.default_rng(0)
    forward = flow + rng.normal(0, 0.05, shape).astype(np.float32)
    backward = -flow + rng.normal(0, 0.05, shape).astype(np.float32)
    averaged = average_with_reverse(forward, backward)
    assert np.std(averaged - flow) < 0.85 * np.std(forward - flow)


def test_what_an_occluder_hides_fails_the_check():
    """A patch slides 6 px to the right over a background at rest; it hides the next 6
    columns to its right.
    """
    background, patch = texture(1)[:H, :W], texture(2)[:32, :32]
    frames = np.stack([background, background])
    frames[0, 16:48, 30:62] = patch
    frames[1, 16:48, 36:68] = patch
    found, valid = dense_flow(frames, NONE_CLIPPED, np.array([[0, 1]]))
    assert np.abs(np.median(found[0, 20:44, 34:58], axis=(0, 1)) - [6, 0]).max() < 0.2
    assert valid[0, 20:44, 63:67].mean() < 0.2
    assert valid[0, 20:44, 75:90].mean() > 0.95


def test_frames_that_are_clipped_everywhere_have_no_valid_flow():
    video = np.ones((2, H, W, 3), np.float32)
    found, valid = dense_flow(video, np.ones((2, H, W), bool), np.array([[0, 1]]))
    assert np.isfinite(found).all() and not valid.any()
