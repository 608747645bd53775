"""Flow by features: right across exposures and beyond the reach of plain matching,
clean at edges; features here are colors.
"""

import cv2
import numpy as np
import torch

from hdr_nsff.priors.flow.adapt import colors
from hdr_nsff.priors.flow.dense import flow
from hdr_nsff.priors.flow.features import Features
from hdr_nsff.priors.flow.semantic import SemanticFlow, coarse, equal_tracks, fill, matched, spread

H, W = 64, 96


def texture(seed: int, size: tuple[int, int], blur: float) -> np.ndarray:
    """Smooth noise (H, W, 3) in [0, 1]."""
    noise = cv2.GaussianBlur(
        np.random.default_rng(seed).random((*size, 3)).astype(np.float32), (0, 0), blur
    )
    return (noise - noise.min()) / np.ptp(noise)


def source(video: np.ndarray) -> Features:
    """What each cell of 4 pixels shows, its mean over the cells around taken off: alike
    under any gain and offset.
    """
    bare = Features(torch.zeros(1, 1, H // 4, W // 4), 4.0, 2.0)
    seen = colors(video, bare, 2)
    return Features(
        seen - torch.nn.functional.avg_pool2d(seen, 5, 1, 2, count_include_pad=False), 4.0, 2.0
    )


def passing(step: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """Frames (3, H, W, 3) in which a patch of 20 pixels leaps by `step` to the right
    before a background at rest, and where it is.
    """
    background, patch = texture(0, (H, W), 1.5), texture(1, (20, 20), 1.5)
    video, where = np.stack([background] * 3), np.zeros((3, H, W), bool)
    for t in range(3):
        x = 12 + step * t
        video[t, 22:42, x : x + 20], where[t, 22:42, x : x + 20] = patch, True
    return video, where


def translated() -> np.ndarray:
    """Two frames (2, H, W, 3) of a texture that moves by 6 pixels to the right, the
    second one of another exposure.
    """
    wide = texture(0, (H, W + 20), 1.5)
    return np.stack([wide[:, 10 : 10 + W], 0.5 * wide[:, 4 : 4 + W] ** 0.8 + 0.1])


def nothing(video: np.ndarray) -> np.ndarray:
    """No clipped pixel."""
    return np.zeros(video.shape[:3], bool)


def test_a_translated_texture_is_followed_across_exposures():
    video = translated()
    found, valid = SemanticFlow(source)(video, nothing(video), np.array([[0, 1], [1, 0]]))
    inner = np.s_[8:-8, 16:-16]
    assert np.abs(np.median(found[0][inner], (0, 1)) - [6, 0]).max() < 0.1
    assert np.abs(np.median(-found[1][inner], (0, 1)) - [6, 0]).max() < 0.1
    assert valid[0][inner].mean() > 0.9


def test_a_small_thing_that_leaps_is_followed_where_plain_matching_loses_it():
    video, where = passing()
    pairs = np.array([[0, 1]])
    found = SemanticFlow(source)(video, nothing(video), pairs)[0][0]
    plain = flow(video, nothing(video), pairs, report=None)[0][0]
    error, lost = (np.linalg.norm(f - [14, 0], axis=-1)[where[0]] for f in (found, plain))
    assert np.median(error) < 0.2 and np.median(lost) > 3
    assert np.median(np.linalg.norm(found[~where[0] & ~where[1]], axis=-1)) < 0.1


def test_flow_is_not_rounded_to_cells_or_pixels():
    wide = cv2.resize(texture(0, (H, W + 20), 1.5), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    video = np.stack(
        [cv2.resize(wide[:, x : x + 4 * W], (W, H), interpolation=cv2.INTER_AREA) for x in (40, 30)]
    )  # 2.5 px
    found = SemanticFlow(source)(video, nothing(video), np.array([[0, 1]]))[0][0]
    assert abs(np.median(found[8:-8, 12:-12, 0]) - 2.5) < 0.1


def test_what_lies_beyond_an_edge_is_not_mixed_in():
    """Unsure cells hold nonsense, cells of another color another motion: neither shows
    within the edge.
    """
    values, sure, rgb = (
        np.zeros((6, 8, 2), np.float32),
        np.ones((6, 8), bool),
        np.zeros((6, 8, 3), np.float32),
    )
    values[:, :4], values[:, 4:], rgb[:, 4:] = 3, -50, 1
    values[2, 2], sure[2, 2] = np.nan, False
    assert np.allclose(fill(values, sure, rgb)[:, :4], 3, atol=1e-3)
    at = np.stack(np.meshgrid(np.linspace(0, 3.4, 30), np.linspace(0, 5, 20)), -1)
    inside, weight = spread(values, sure, rgb, at, np.zeros((20, 30, 3)), 1)
    assert np.allclose(inside[weight > 0], 3, atol=1e-2) and (weight > 0).mean() > 0.9


def test_all_cells_are_filled_however_far_the_next_sure_one_is():
    values, sure = np.zeros((3, 40, 2), np.float32), np.zeros((3, 40), bool)
    values[1, 0], sure[1, 0] = (2, -1), True
    assert np.allclose(fill(values, sure, np.zeros((3, 40, 3), np.float32)), [2, -1], atol=1e-4)


def test_nothing_sure_leaves_the_motion_as_it_was():
    values = np.random.default_rng(0).random((3, 4, 2)).astype(np.float32)
    assert np.array_equal(fill(values, np.zeros((3, 4), bool), np.zeros((3, 4, 3))), values)


def test_points_of_equal_exposure_are_followed_over_two_cycles():
    """A patch that goes 6 pixels per cycle goes 3 cells of 4 pixels in two."""
    video, where = passing(6)
    tracks = {
        t.frames: t for t in equal_tracks(source(video), video, nothing(video), [(0, 1), (1, 2)])
    }
    assert set(tracks) == {(0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)}
    track = tracks[0, 2]
    pixel = (track.start * 4 + 2 - 0.5).round().int().numpy()
    on_patch = where[0][pixel[:, 1], pixel[:, 0]]
    assert np.allclose(np.median((track.end - track.start)[on_patch], 0), [3, 0], atol=0.1)


def test_fitting_to_the_clip_repeats_itself_and_keeps_flow_right():
    video, where = passing()
    prior = SemanticFlow(source, [(0, 1), (1, 2)], [(0, 2)], steps=20)
    found, valid = prior(video, nothing(video), np.array([[0, 1]]))
    again = SemanticFlow(source, [(0, 1), (1, 2)], [(0, 2)], steps=20)(
        video, nothing(video), np.array([[0, 1]])
    )
    assert np.array_equal(found, again[0]) and np.array_equal(valid, again[1])
    assert np.median(np.linalg.norm(found[0] - [14, 0], axis=-1)[where[0]]) < 0.2
    assert not torch.equal(prior.features.maps, source(video).maps)


def test_only_frames_to_learn_from_shape_the_features():
    """A frame that is in no pair changes no other frame's flow."""
    video, _ = passing()
    other = video.copy()
    other[2] = texture(9, (H, W), 1.5)
    one, two = (
        SemanticFlow(source, [(0, 1)], steps=5)(v, nothing(v), np.array([[0, 1]]))[0]
        for v in (video, other)
    )
    assert np.array_equal(one, two)


def test_clipped_pixels_are_not_believed():
    video, _ = passing()
    clipped = nothing(video)
    clipped[0, 50:60, 70:90] = True
    assert not matched(source(video), video, clipped, np.array([[0, 1]]))[1][0, 50:60, 70:90].any()


def test_coarse_flow_is_in_pixels_of_the_frame():
    video = translated()
    there, back = coarse(source(video), video, 0, 1)
    assert there.shape == back.shape == (H, W, 2)
    assert np.abs(np.median(there[8:-8, 16:-16], (0, 1)) - [6, 0]).max() < 1
    assert np.abs(np.median(-back[8:-8, 16:-16], (0, 1)) - [6, 0]).max() < 1
