"""Depth Anything's predictions are aligned to static points: known scales and shifts
come back, in spite of outliers and gaps; a tiny network runs.
"""

import tracemalloc

import numpy as np
import pytest
import torch
from tiny_networks import tiny_depth_anything

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.depth.depth_anything import (
    align,
    anchored_depth,
    network_disparity,
    network_input,
    ransac_line,
)
from hdr_nsff.priors.pretrained import pretrained
from hdr_nsff.scene.posed_video import PosedVideo

H, W, F = 48, 64, 60.0
K = np.array([[F, 0, W / 2], [0, F, H / 2], [0, 0, 1.0]])
NONE = (np.zeros((0, H, W, 2), np.float32), np.zeros((0, H, W), bool), np.zeros((0, 2), int))


def frames_of(
    lines: np.ndarray, number: int = 200, outliers: float = 0.0, noise: float = 0.0
) -> list[np.ndarray]:
    """Predictions and their disparities by the lines (T, 2), some of them random."""
    rng = np.random.default_rng(3)
    seen = []
    for scale, shift in lines:
        predictions = rng.uniform(1, 9, number)
        disparity = scale * predictions + shift + noise * rng.normal(size=number)
        wrong = rng.random(number) < outliers
        seen.append(
            np.stack([predictions, np.where(wrong, rng.uniform(0.05, 3, number), disparity)], 1)
        )
    return seen


CHANGING = np.stack([0.1 + 0.01 * np.arange(6), 0.05 + 0.02 * np.sin(np.arange(6))], 1)


def test_scale_and_shift_of_every_frame_are_recovered_exactly():
    lines, errors = align(frames_of(CHANGING), with_shift=True)
    np.testing.assert_allclose(lines, CHANGING, rtol=1e-6)
    assert errors.max() < 1e-6


def test_thirty_percent_outliers_hardly_change_the_fit():
    lines, _ = align(frames_of(CHANGING, outliers=0.3, noise=0.005), with_shift=True)
    at = np.linspace(1, 9, 5)[:, None]
    made, true = (x[:, 0] * at + x[:, 1] for x in (lines, CHANGING))
    assert np.abs(made / true - 1).max() < 0.02


def test_a_metric_network_needs_one_scale_per_frame_and_gets_no_shift():
    scales = CHANGING * [1, 0]
    lines, _ = align(frames_of(scales, outliers=0.3, noise=0.003), with_shift=False)
    assert (lines[:, 1] == 0).all()
    np.testing.assert_allclose(lines[:, 0], scales[:, 0], rtol=0.01)


def test_memory_does_not_grow_with_the_points_of_a_clip():
    (samples,) = frames_of(CHANGING[:1], number=100_000, outliers=0.3)
    tracemalloc.start()
    line = ransac_line(samples, with_shift=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(line, CHANGING[0], rtol=1e-6)
    assert peak < 100e6  # bytes


def test_a_frame_without_points_takes_the_mean_fit_of_its_neighbors():
    seen = frames_of(np.array([[0.1, 0.2], [0.1, 0.2], [0.14, 0.1]]))
    seen[1] = seen[1][:0]
    lines, errors = align(seen, with_shift=True)
    np.testing.assert_allclose(lines, [[0.1, 0.2], [0.12, 0.15], [0.14, 0.1]], rtol=1e-6)
    assert np.isfinite(errors).all()


def test_a_last_frame_without_points_takes_the_fit_of_the_frame_before():
    seen = frames_of(CHANGING[:3])
    seen[2] = seen[2][:0]
    np.testing.assert_allclose(align(seen, with_shift=True)[0][2], CHANGING[1], rtol=1e-4)


def test_two_wrong_points_of_a_frame_are_overruled_by_its_neighbors():
    same = np.tile([0.1, 0.2], (3, 1))
    seen = frames_of(same, noise=0.002)
    seen[1] = np.array([[2.0, 2.5], [8.0, 0.1]])  # near is far
    np.testing.assert_allclose(align(seen, with_shift=True)[0][1], same[1], rtol=0.05)


def test_many_points_are_not_bent_towards_the_neighbors():
    own = np.array([[0.1, 0.0], [0.3, 0.5], [0.1, 0.0]])
    np.testing.assert_allclose(align(frames_of(own, number=40), with_shift=True)[0], own, atol=1e-6)


def slanted(count: int = 3) -> tuple[PosedVideo, np.ndarray, np.ndarray]:
    """Cameras beside each other that see a slanted wall, its disparity (T, H, W), and
    points on it.
    """
    c2w = np.stack([np.concatenate([np.eye(3), [[0.1 * t], [0], [0]]], 1) for t in range(count)])
    _, x = np.indices((H, W)) + 0.5
    rays = (x - W / 2) / F
    disparity = np.stack([(1 - 0.5 * rays) / (2 + 0.5 * e) for e in c2w[:, 0, 3]])  # z = 2 + 0.5 x
    wall = np.random.default_rng(0).uniform([-0.8, -0.6], [0.8, 0.6], (400, 2))
    points = np.stack([wall[:, 0], wall[:, 1], 2 + 0.5 * wall[:, 0]], 1)
    empty = np.zeros((count, H, W), bool)
    clip = PosedVideo(
        np.tile(K, (count, 1, 1)),
        c2w,
        np.arange(count, dtype=float),
        np.zeros((count, H, W, 3), np.float32),
        empty,
        empty.copy(),
    )
    return clip, disparity.astype(np.float32), points


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_predictions_of_a_wall_become_its_disparity_in_scene_units(kind):
    clip, true, points = slanted()
    predicted = 7 * true + (3 if kind == "relative" else 0)
    disparity, confidence, near, far = anchored_depth(predicted, kind, clip, points, *NONE)
    np.testing.assert_allclose(disparity, true, rtol=2e-3)
    assert confidence.min() > 0.95 and near < 1 / true.max() and far > 1 / true.min()


def test_points_behind_a_mover_do_not_count():
    clip, true, points = slanted()
    clip.moving[:, :, : W // 2] = True
    # something near in front of that half
    predicted = np.where(clip.moving, 40, 7 * true + 3).astype(np.float32)
    disparity, _, _, _ = anchored_depth(predicted, "relative", clip, points, *NONE)
    np.testing.assert_allclose(disparity[~clip.moving], true[~clip.moving], rtol=2e-3)
    assert disparity[clip.moving].min() > 1.5 * true.max()


def test_predictions_that_do_not_fit_the_points_have_low_confidence_and_are_never_negative():
    clip, true, points = slanted()
    noise = np.random.default_rng(1).normal(size=true.shape).astype(np.float32)
    predicted = true + 0.3 * true * noise
    predicted[:, 0, 0] = -100
    disparity, confidence, _, _ = anchored_depth(predicted, "relative", clip, points, *NONE)
    assert disparity.min() > 0 and (confidence[:, 0, 0] == 0).all()
    assert confidence.max() < 0.6


def test_without_points_the_network_is_refused_in_a_sentence():
    clip, true, _ = slanted()
    with pytest.raises(InputError, match="static points"):
        anchored_depth(true, "relative", clip, np.zeros((0, 3)), *NONE)


@pytest.mark.parametrize("scale", [0, -7, np.nan])
def test_predictions_without_any_relation_to_the_points_are_refused_in_a_sentence(scale):
    clip, true, points = slanted()
    with pytest.raises(InputError, match="does not rise"):
        anchored_depth(scale * true + 9, "relative", clip, points, *NONE)


@pytest.fixture(scope="module", params=["relative", "metric"])
def tiny(request, tmp_path_factory):
    """A tiny Depth Anything, and its kind."""
    return request.param, tiny_depth_anything(tmp_path_factory.mktemp("depth"), request.param)


def test_a_tiny_network_predicts_every_frame_at_its_size_and_its_kind_is_read(tiny):
    kind, folder = tiny
    network = pretrained("DepthAnythingForDepthEstimation", str(folder))
    video = np.random.default_rng(0).random((2, H, W, 3)).astype(np.float32)
    predicted, found = network_disparity(network, video)
    assert found == kind and predicted.shape == (2, H, W) and np.isfinite(predicted).all()
    assert not np.array_equal(predicted[0], predicted[1])
    if kind == "metric":
        assert (predicted >= 1 / 20 - 1e-6).all()  # within max_depth
    again, _ = network_disparity(network, video[1:])
    np.testing.assert_array_equal(again[0], predicted[1])  # each frame by itself


def test_the_input_has_the_size_of_the_network_and_the_shape_of_the_frame(tiny):
    network = pretrained("DepthAnythingForDepthEstimation", str(tiny[1]))
    values = network_input(network, np.full((90, 160, 3), 0.5, np.float32))
    # shorter side 28, the longer 49.8 to the nearest multiple of 14
    assert values.shape == (1, 3, 28, 56)
    expected = (0.5 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])
    torch.testing.assert_close(values[0, :, 3, 5], expected)
