"""Moving masks of painted clips whose flow is known."""

from dataclasses import replace

import numpy as np
import pytest
from painted_clips import H, K, T, W, cameras, painted_clip
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry import pinhole
from hdr_nsff.priors.masks import geometric
from hdr_nsff.priors.masks.geometric import geometric_mask, rough_mask, texture_confidence
from hdr_nsff.priors.masks.geometric_tuning import GEOMETRIC_MASK_TUNING
from hdr_nsff.priors.masks.static_residuals import chain_flow, working_clip


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / (a | b).sum())


def test_rough_mask_finds_motion_that_no_common_geometry_explains():
    *given, truth = painted_clip("rising")
    assert iou(rough_mask(*given), truth) > 0.75


@pytest.mark.parametrize("kind", ["rising", "along"])
def test_geometric_mask_finds_movers_along_epipolar_lines_too(kind):
    *given, truth = painted_clip(kind)
    assert iou(geometric_mask(*given, K, cameras()), truth) > 0.75


def test_neither_parallax_nor_what_it_uncovers_is_motion():
    *given, _ = painted_clip("near")
    assert geometric_mask(*given, K, cameras()).mean() < 0.005


def test_a_camera_at_rest_needs_no_depth():
    *given, truth = painted_clip("rising", speed=0.0)
    assert iou(geometric_mask(*given, K, cameras(0.0)), truth) > 0.75


def test_flow_that_wanders_over_a_wall_without_texture_is_not_motion():
    flow, valid, pairs, video, _ = painted_clip("near", speed=0.0)
    video[:] = 0.5 + 0.002 * np.random.default_rng(0).normal(size=video.shape)
    flow[:] = 0
    flow[:, 20:50, 20:60] = 3.0
    assert not geometric_mask(flow, valid, pairs, video, K, cameras(0.0)).any()


def test_nothing_moves_in_frames_without_flow():
    flow, valid, pairs, video, truth = painted_clip("rising")
    without = (pairs != 4).all(1)  # frame 4 is held out
    moving = geometric_mask(flow[without], valid[without], pairs[without], video, K, cameras())
    assert not moving[4].any()
    assert iou(moving[1], truth[1]) > 0.6


def test_a_mask_of_most_of_the_frame_is_reported(monkeypatch):
    messages = []
    monkeypatch.setattr(geometric, "say", messages.append)
    high_score = np.full((H, W), 4.0, np.float32)
    monkeypatch.setattr(geometric, "motion_score", lambda *given: high_score)
    *given, _ = painted_clip("rising")
    assert rough_mask(*given).all()
    assert "8 of 8 frames" in messages[0] and "--mask FOLDER" in messages[0]


def test_large_frames_are_judged_on_a_coarser_grid():
    *given, truth = painted_clip("rising")
    tuning = replace(GEOMETRIC_MASK_TUNING, working_pixels=H * W // 3)
    found = geometric_mask(*given, K, cameras(), tuning)
    assert found.shape == truth.shape
    assert iou(found, truth) > 0.6


def test_the_cameras_of_a_coarser_grid_explain_a_static_scene(monkeypatch):
    """A wall before cameras that turn: its flow on the grid has no residuals."""
    turns = Rotation.from_rotvec(0.03 * np.random.default_rng(0).normal(size=(T, 3))).as_matrix()
    c2w = np.concatenate([turns, cameras()[:, :, 3:]], 2)
    pairs = np.array([(i, j) for i in range(T) for j in (i - 1, i + 1) if 0 <= j < T])
    flow = []
    for i, j in pairs:
        rays = pinhole.world_rays(pinhole.pixel_centers(H, W), K, c2w[i])
        wall = c2w[i, :, 3] + rays * (4 / rays[..., 2:])  # at z = 4
        flow.append(pinhole.project(wall, K, c2w[j])[0] - pinhole.pixel_centers(H, W))
    valid, video = np.ones((len(pairs), H, W), bool), np.zeros((T, H, W, 3), np.float32)
    seen = []
    monkeypatch.setattr(geometric, "segment_motion", lambda *given: seen.extend(given))
    tuning = replace(GEOMETRIC_MASK_TUNING, working_pixels=H * W // 4, reach_frames=1)
    geometric_mask(np.array(flow), valid, pairs, video, K, c2w, tuning)
    clip, residuals, *_ = seen
    assert clip.coarseness == 2
    residual = residuals(3, chain_flow(clip, 3, tuning))
    assert residual.shape == (2, H // 2, W // 2, 2) and np.abs(residual).max() < 0.02


def test_the_coarser_grid_of_an_odd_size_shifts_nothing(monkeypatch):
    height, width = 361, 641  # twice 181 and 321, less 1
    video = np.zeros((2, height, width, 3), np.float32)
    video[:, 319:351, 599:631] = 1
    bright = lambda clip, frame, *given: 4.5 * clip.gray[frame]  # noqa: E731
    monkeypatch.setattr(geometric, "motion_score", bright)
    flow, pairs = np.zeros((2, height, width, 2), np.float32), np.array([[0, 1], [1, 0]])
    valid = np.ones((2, height, width), bool)
    mask = rough_mask(flow, valid, pairs, video)[0]
    y, x = (np.nonzero(mask)[k].mean() + 0.5 for k in (0, 1))
    assert (x, y) == pytest.approx((615, 335), abs=0.3)
    clip = working_clip(flow + 1, valid, pairs, video)
    assert np.allclose(clip.flow, (321 / width, 181 / height))


def test_texture_beside_black_has_a_confidence_in_large_frames():
    gray = np.zeros((720, 1280), np.float32)
    gray[:360, :640] = np.random.default_rng(0).random((360, 640)) ** 8
    confidence = texture_confidence(gray)
    assert np.isfinite(confidence).all()
    assert np.median(confidence[:350, :630]) > 0.9 and confidence[400:].max() < 0.01
