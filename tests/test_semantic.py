"""Flow by features: right across exposures and beyond the reach of plain matching,
clean at edges; features here are colors.
"""

import cv2
import numpy as np
import torch

from hdr_nsff.priors.flow.adapt import cell_colors
from hdr_nsff.priors.flow.dense import dense_flow
from hdr_nsff.priors.flow.features import Features
from hdr_nsff.priors.flow.joint_bilateral import joint_bilateral_mean
from hdr_nsff.priors.flow.semantic import (
    SemanticFlow,
    coarse_flow,
    equal_exposure_tracks,
    fill_cells,
    match_features,
)

H, W = 64, 96
PAIR = np.array([[0, 1]])


def texture(seed: int, size: tuple[int, int], blur: float) -> np.ndarray:
    """Smooth noise (H, W, 3) in [0, 1]."""
    noise = np.random.default_rng(seed).random((*size, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), blur)
    return (noise - noise.min()) / np.ptp(noise)


def source(video: np.ndarray) -> Features:
    """The colors of cells of 4 pixels, minus their mean over the cells around: equal
    under any gain and offset.
    """
    grid = Features(torch.zeros(1, 1, H // 4, W // 4), 4.0, 2.0)
    colors = cell_colors(video, grid, 2)
    mean = torch.nn.functional.avg_pool2d(colors, 5, 1, 2, count_include_pad=False)
    return Features(colors - mean, 4.0, 2.0)


def passing(step: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """Frames (3, H, W, 3) in which a patch of 20 pixels leaps by `step` to the right
    before a background at rest, and its mask.
    """
    background, patch = texture(0, (H, W), 1.5), texture(1, (20, 20), 1.5)
    video, mask = np.stack([background] * 3), np.zeros((3, H, W), bool)
    for t in range(3):
        x = 12 + step * t
        video[t, 22:42, x : x + 20] = patch
        mask[t, 22:42, x : x + 20] = True
    return video, mask


def translated() -> np.ndarray:
    """Two frames (2, H, W, 3) of a texture that moves by 6 pixels to the right, the
    second one of another exposure.
    """
    wide = texture(0, (H, W + 20), 1.5)
    return np.stack([wide[:, 10 : 10 + W], 0.5 * wide[:, 4 : 4 + W] ** 0.8 + 0.1])


def none_clipped(video: np.ndarray) -> np.ndarray:
    """A mask (T, H, W) without clipped pixels."""
    return np.zeros(video.shape[:3], bool)


def test_a_translated_texture_is_followed_across_exposures():
    video = translated()
    found, valid = SemanticFlow(source)(video, none_clipped(video), np.array([[0, 1], [1, 0]]))
    inner = np.s_[8:-8, 16:-16]
    assert np.abs(np.median(found[0][inner], (0, 1)) - [6, 0]).max() < 0.1
    assert np.abs(np.median(-found[1][inner], (0, 1)) - [6, 0]).max() < 0.1
    assert valid[0][inner].mean() > 0.9


def test_a_small_object_that_leaps_is_followed_where_plain_matching_loses_it():
    video, mask = passing()
    found = SemanticFlow(source)(video, none_clipped(video), PAIR)[0][0]
    plain = dense_flow(video, none_clipped(video), PAIR)[0][0]
    error, plain_error = (np.linalg.norm(f - [14, 0], axis=-1)[mask[0]] for f in (found, plain))
    assert np.median(error) < 0.2 and np.median(plain_error) > 3
    assert np.median(np.linalg.norm(found[~mask[0] & ~mask[1]], axis=-1)) < 0.1


def test_flow_is_not_rounded_to_cells_or_pixels():
    """Ten pixels of a texture at four times the size are 2.5 px."""
    wide = cv2.resize(texture(0, (H, W + 20), 1.5), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    video = np.stack(
        [cv2.resize(wide[:, x : x + 4 * W], (W, H), interpolation=cv2.INTER_AREA) for x in (40, 30)]
    )
    found = SemanticFlow(source)(video, none_clipped(video), PAIR)[0][0]
    assert abs(np.median(found[8:-8, 12:-12, 0]) - 2.5) < 0.1


def test_motion_from_beyond_an_edge_is_not_mixed_in():
    """One invalid cell holds NaN, and cells of another color another motion: neither
    shows within the edge.
    """
    motion, valid = np.zeros((6, 8, 2), np.float32), np.ones((6, 8), bool)
    rgb = np.zeros((6, 8, 3), np.float32)
    motion[:, :4], motion[:, 4:], rgb[:, 4:] = 3, -50, 1
    motion[2, 2], valid[2, 2] = np.nan, False
    assert np.allclose(fill_cells(motion, valid, rgb)[:, :4], 3, atol=1e-3)
    positions = np.stack(np.meshgrid(np.linspace(0, 3.4, 30), np.linspace(0, 5, 20)), -1)
    mean, weight = joint_bilateral_mean(
        motion, valid, rgb, positions, np.zeros((20, 30, 3)), 1, 0.05
    )
    assert np.allclose(mean[weight > 0], 3, atol=1e-2) and (weight > 0).mean() > 0.9


def test_all_cells_are_filled_however_far_the_next_valid_one_is():
    motion, valid = np.zeros((3, 40, 2), np.float32), np.zeros((3, 40), bool)
    motion[1, 0], valid[1, 0] = (2, -1), True
    filled = fill_cells(motion, valid, np.zeros((3, 40, 3), np.float32))
    assert np.allclose(filled, [2, -1], atol=1e-4)


def test_without_valid_cells_motion_stays_as_it_was():
    motion = np.random.default_rng(0).random((3, 4, 2)).astype(np.float32)
    filled = fill_cells(motion, np.zeros((3, 4), bool), np.zeros((3, 4, 3)))
    assert np.array_equal(filled, motion)


def test_points_of_equal_exposure_are_followed_over_two_cycles():
    """A patch that moves 6 pixels per cycle moves 3 cells of 4 pixels in two."""
    video, mask = passing(6)
    found = equal_exposure_tracks(source(video), video, none_clipped(video), [(0, 1), (1, 2)])
    tracks = {track.frames: track for track in found}
    assert set(tracks) == {(0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)}
    track = tracks[0, 2]
    pixel = (track.start * 4 + 2 - 0.5).round().int().numpy()
    on_patch = mask[0][pixel[:, 1], pixel[:, 0]]
    assert np.allclose(np.median((track.end - track.start)[on_patch], 0), [3, 0], atol=0.1)


def test_fitting_to_the_clip_is_reproducible_and_keeps_flow_correct():
    video, mask = passing()
    prior, twin = (SemanticFlow(source, [(0, 1), (1, 2)], [(0, 2)], steps=20) for _ in range(2))
    flow, valid = prior(video, none_clipped(video), PAIR)
    twin_flow, twin_valid = twin(video, none_clipped(video), PAIR)
    assert np.array_equal(flow, twin_flow) and np.array_equal(valid, twin_valid)
    assert np.median(np.linalg.norm(flow[0] - [14, 0], axis=-1)[mask[0]]) < 0.2
    assert not torch.equal(prior.features.maps, source(video).maps)


def test_only_frames_to_learn_from_shape_the_features():
    """A frame that is in no pair changes no other frame's flow."""
    video, _ = passing()
    other = video.copy()
    other[2] = texture(9, (H, W), 1.5)
    one, two = (
        SemanticFlow(source, [(0, 1)], steps=5)(v, none_clipped(v), PAIR)[0] for v in (video, other)
    )
    assert np.array_equal(one, two)


def test_clipped_pixels_are_not_valid():
    video, _ = passing()
    clipped = none_clipped(video)
    clipped[0, 50:60, 70:90] = True
    _, valid = match_features(source(video), video, clipped, PAIR)
    assert not valid[0, 50:60, 70:90].any()


def test_coarse_flow_is_in_pixels_of_the_frame():
    video = translated()
    forward, backward = coarse_flow(source(video), video, 0, 1)
    assert forward.shape == backward.shape == (H, W, 2)
    assert np.abs(np.median(forward[8:-8, 16:-16], (0, 1)) - [6, 0]).max() < 1
    assert np.abs(np.median(-backward[8:-8, 16:-16], (0, 1)) - [6, 0]).max() < 1
