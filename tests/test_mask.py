"""Moving masks of painted clips whose flow is known: a textured wall, a textured square
before it, a camera that slides sideways.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.priors.masks import geometric as mask
from hdr_nsff.priors.masks.geometric import (
    epipolar_miss,
    geometric_mask,
    grid,
    rough_mask,
    static_miss,
    steps_from,
)

T, H, W, FOCAL = 8, 72, 96, 80.0
SIZE = 20  # of the square, pixels
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]])
BASE, WALL = (
    0.1,
    4.0,
)  # the camera's step and the wall's depth: the wall moves by 80 * 0.1 / 4 = 2 px per frame to the left
SPEED = FOCAL * BASE / WALL


def cameras(step: float = BASE) -> np.ndarray:
    """A camera that moves `step` to the right per frame: c2w (T, 3, 4)."""
    c2w = np.tile(np.eye(4)[:3], (T, 1, 1))
    c2w[:, 0, 3] = step * np.arange(T)
    return c2w


def texture(seed: int, height: int = H, width: int = 3 * W) -> np.ndarray:
    """Smooth noise (height, width) in [0, 1]."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((height, width)), (0, 0), 1.5)
    return ((noise - noise.min()) / np.ptp(noise)).astype(np.float32)


def corners(kind: str) -> np.ndarray:
    """Where the square's upper left corner is in each frame (T, 2) px: rising, on a
    path along the epipolar lines that no depth has, or standing still in space at half
    the wall's depth.
    """
    t = np.arange(T)
    x = {"rising": 60 - 2.0 * t, "along": 30 + 4.0 * t, "near": 60 - 2 * SPEED * t}[kind]
    return np.stack([x, 40 - 3.0 * t if kind == "rising" else np.full(T, 26.0)], 1).round()


def clip(kind: str, speed: float = SPEED) -> tuple[np.ndarray, ...]:
    """Flow, valid, pairs, video and where the square is (T, H, W)."""
    wall, square, at = texture(0), texture(1, SIZE, SIZE), corners(kind).astype(int)
    video, truth = np.zeros((T, H, W, 3), np.float32), np.zeros((T, H, W), bool)
    for t in range(T):
        shift = np.array([[1, 0, -speed * t], [0, 1, 0]], np.float32)
        video[t] = cv2.warpAffine(wall, shift, (W, H), borderMode=cv2.BORDER_REFLECT)[..., None]
        (x, y), (x0, y0) = at[t], np.maximum(at[t], 0)
        video[t, y0 : y + SIZE, x0 : x + SIZE] = square[
            y0 - y : y0 - y + H - y0, x0 - x : x0 - x + W - x0
        ][..., None]
        truth[t, y0 : y + SIZE, x0 : x + SIZE] = True
    pairs = np.array([(i, j) for i in range(T) for j in (i - 1, i + 1) if 0 <= j < T])
    flow, valid = np.zeros((len(pairs), H, W, 2), np.float32), np.zeros((len(pairs), H, W), bool)
    for p, (i, j) in enumerate(pairs):
        flow[p, ..., 0] = -speed * (j - i)
        flow[p][truth[i]] = at[j] - at[i]
        end = np.floor(grid((H, W)) + flow[p]).astype(int)
        inside = ((end >= 0) & (end < (W, H))).all(-1)
        valid[p] = inside
        valid[p][inside] &= (
            truth[i][inside] == truth[j][end[inside][:, 1], end[inside][:, 0]]
        )  # what gets covered is not valid
    return flow, valid, pairs, video, truth


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / (a | b).sum())


def test_rough_mask_finds_what_no_common_geometry_explains():
    *given, truth = clip("rising")
    assert iou(rough_mask(*given), truth) > 0.75


@pytest.mark.parametrize("kind", ["rising", "along"])
def test_geometric_mask_finds_movers_along_epipolar_lines_too(kind):
    *given, truth = clip(kind)
    assert iou(geometric_mask(*given, K, cameras()), truth) > 0.75


def test_parallax_is_not_motion_nor_is_what_it_uncovers():
    *given, _ = clip("near")
    assert geometric_mask(*given, K, cameras()).mean() < 0.005


def test_a_still_camera_needs_no_depth():
    *given, truth = clip("rising", speed=0.0)
    assert iou(geometric_mask(*given, K, cameras(0.0)), truth) > 0.75


def test_flow_that_wanders_over_a_plain_wall_is_not_motion():
    flow, valid, pairs, video, _ = clip("near", speed=0.0)
    video[:] = 0.5 + 0.002 * np.random.default_rng(0).normal(size=video.shape)
    flow[:] = 0
    flow[:, 20:50, 20:60] = 3.0
    assert not geometric_mask(flow, valid, pairs, video, K, cameras(0.0)).any()


def test_frames_without_flow_have_nothing_moving():
    flow, valid, pairs, video, truth = clip("rising")
    without = (pairs != 4).all(1)  # frame 4 is held out
    moving = geometric_mask(flow[without], valid[without], pairs[without], video, K, cameras())
    assert not moving[4].any()
    assert iou(moving[1], truth[1]) > 0.6


def test_chained_flow_adds_up():
    flow, valid, pairs, video, _ = clip("rising")
    steps = steps_from(mask.prepared(flow, valid, pairs, video), 0)
    assert [s.frame for s in steps] == [1, 2, 3, 4, 5, 6]
    assert np.allclose(steps[3].flow[62:, 20:], (-4 * SPEED, 0), atol=1e-4)  # below the square


def test_static_miss_is_zero_for_static_points_and_the_motion_for_others():
    flow, valid, pairs, video, truth = clip("along")
    steps = [s for s in steps_from(mask.prepared(flow, valid, pairs, video), 0) if s.frame == 1]
    miss = static_miss(0, steps, np.tile(K, (T, 1, 1)), cameras())[0]
    assert np.allclose(miss[~truth[0] & valid[1]], 0, atol=1e-3)
    # the square moves by +4 px against parallax: the best depth >= 0 is infinity, which
    # does not move at all
    assert np.allclose(miss[truth[0]].mean(0), (-4, 0), atol=1e-3)


def test_epipolar_miss_is_the_distance_from_the_line():
    rng = np.random.default_rng(0)
    depth = 2 + 2 * rng.random((H, W))
    flow = np.zeros((H, W, 2), np.float32)
    flow[..., 0] = -FOCAL * 0.2 / depth  # sideways: epipolar lines are rows
    flow[30, 40, 1] = 5.0
    miss = epipolar_miss(flow, np.ones((H, W), bool))
    assert np.allclose(miss[30, 40], (0, -5), atol=0.05)
    assert np.abs(np.delete(miss.reshape(-1, 2), 30 * W + 40, 0)).max() < 0.05


def test_a_mask_of_most_of_the_frame_is_doubted_aloud(monkeypatch):
    said = []
    monkeypatch.setattr(mask, "say", said.append)
    monkeypatch.setattr(
        mask, "score", lambda footage, frame, steps, misses: np.full((H, W), 4.0, np.float32)
    )
    *given, _ = clip("rising")
    assert rough_mask(*given).all()
    assert "8 of 8 frames" in said[0] and "--masks" in said[0]


def test_large_frames_are_judged_on_a_coarser_grid(monkeypatch):
    *given, truth = clip("rising")
    monkeypatch.setattr(mask, "WORKING", H * W // 3)
    found = geometric_mask(*given, K, cameras())
    assert found.shape == truth.shape
    assert iou(found, truth) > 0.6
