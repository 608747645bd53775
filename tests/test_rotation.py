"""Cameras without parallax: turns, their focal length, and what is no turn."""

import numpy as np
import pytest
from posed_clips import H, W, seen, texture
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.poses.matching import PairMatches, detect_keypoints, match_pairs, view_pairs
from hdr_nsff.priors.poses.rotation import (
    default_focal,
    field_of_view,
    fit_panorama,
    max_displacement,
    rotation_share,
    rotation_up_to_scale,
)
from hdr_nsff.priors.poses.rotation_adjustment import rotate_pixels


def test_a_slide_past_a_flat_wall_is_a_turn_behind_a_long_lens() -> None:
    """Every match is explained, but not by the default lens."""
    wall = texture(0, 400, 240)
    slide = np.stack(
        [seen(wall, np.array([[1, 0, -200 + 8.0 * t], [0, 1, -70], [0, 0, 1]])) for t in range(8)]
    )
    keypoints = detect_keypoints(slide, np.zeros((8, H, W), bool))
    matches = match_pairs(keypoints, view_pairs([list(range(8))]))
    panorama = fit_panorama(matches, 8, W, H)
    assert panorama is not None and panorama.long_lens and not panorama.focal_known
    assert field_of_view(panorama.focal, W, H) == pytest.approx(10)
    assert rotation_share(matches, panorama, W, H) == pytest.approx(1, abs=0.02)


def turn_of(focal: float, width: int, height: int, degrees: float = 24) -> list[PairMatches]:
    """Matches of 8 frames of a camera that turns along its longer side."""
    rng = np.random.default_rng(0)
    axis = "y" if width > height else "x"
    turns = Rotation.from_euler(axis, np.linspace(0, degrees, 8)[:, None], degrees=True).as_matrix()
    size = np.array([width, height])
    matches = []
    for i in range(8):
        for j in range(i + 1, 8):
            p = rng.uniform(-0.5, 0.5, (200, 2)) * size
            q, _ = rotate_pixels(turns, focal, np.tile([i, j], (200, 1)), p)
            q = q + rng.normal(size=q.shape) * 0.1
            seen = (np.abs(q) < size / 2).all(1)
            matches.append(PairMatches(i, j, p[seen] + size / 2, q[seen] + size / 2))
    return matches


@pytest.mark.parametrize(("width", "height"), [(320, 180), (180, 320)])
def test_a_long_lens_is_plausible_however_the_camera_is_held(width: int, height: int) -> None:
    focal = 500.0  # 35 degrees across the longer side, 20 across the other
    panorama = fit_panorama(turn_of(focal, width, height), 8, width, height)
    assert panorama is not None and panorama.focal_known and not panorama.long_lens
    assert panorama.focal == pytest.approx(focal, rel=0.01)


def test_a_small_turn_of_a_telephoto_lens_is_one_of_a_long_lens() -> None:
    """Of 18 degrees: the turn is too small to tell it from longer ones."""
    matches = turn_of(1000.0, 320, 180, 2)
    panorama = fit_panorama(matches, 8, 320, 180)
    assert panorama is not None and panorama.long_lens and panorama.explained > 0.99
    share = rotation_share(matches, panorama, 320, 180)
    assert share is not None and share > 0.99


@pytest.mark.parametrize(("width", "height"), [(320, 180), (180, 320)])
def test_the_default_field_of_view_is_across_the_longer_side(width: int, height: int) -> None:
    focal = default_focal(max(width, height))
    assert focal == pytest.approx(160 / np.tan(np.radians(30)))
    panorama = fit_panorama(turn_of(200.0, width, height, 0.3), 8, width, height)
    assert panorama is not None and not panorama.focal_known and panorama.focal == focal
    assert not panorama.long_lens
    assert field_of_view(focal, width, height) == pytest.approx(60)


def pan(degrees: float) -> np.ndarray:
    """The rotations of a camera that turns by so much, the middle one of which is 1."""
    angles = np.linspace(-degrees / 2, degrees / 2, 41)[:, None]
    return Rotation.from_euler("y", angles, degrees=True).as_matrix()


def test_the_displacement_of_a_pan_is_in_pixels_that_pictures_may_have() -> None:
    focal = default_focal(640)  # 60 degrees
    edge = focal * np.tan(np.radians(30 + 30)) - 320
    assert edge < max_displacement(pan(60), focal, 640, 360) < 1.1 * edge
    for degrees in (120, 180, 360):
        assert 640 <= max_displacement(pan(degrees), focal, 640, 360) < 10 * 640
    turned = np.tile(np.diag([-1.0, 1.0, -1.0]), (3, 1, 1))
    turned[1] = np.eye(3)
    assert max_displacement(turned, focal, 640, 360) == 640  # all of it is behind the camera


def test_random_matches_give_no_panorama():
    rng = np.random.default_rng(0)
    noise = PairMatches(0, 1, rng.uniform(0, 90, (50, 2)), rng.uniform(0, 90, (50, 2)))
    assert fit_panorama([noise], 2, W, H) is None


def test_the_nearest_rotation_ignores_scale_sign_and_a_little_noise():
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    noise = 1e-3 * np.random.default_rng(0).normal(size=(3, 3))
    for factor in (1.0, -4.0, 0.01):
        found = rotation_up_to_scale(factor * (turn + noise))
        assert np.allclose(found, turn, atol=3e-3)
        assert np.allclose(found @ found.T, np.eye(3)) and np.linalg.det(found) > 0
