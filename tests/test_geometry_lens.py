"""Laws of lens distortion: there and back, no pixel from outside, pinhole is
nothing.
"""

from itertools import product

import numpy as np
import pytest

from hdr_nsff.geometry.lens import Lens, distorted_picture, undistorted_picture
from hdr_nsff.geometry.pinhole import camera_rays, intrinsics, pixel_centers

W, H = 96, 64
K = intrinsics(80.0, W, H)
BARREL = Lens(K, (-0.2, 0.05, 0.002, -0.001), W, H)
PINCUSHION = Lens(K, (0.2, 0.0, 0.0, 0.0), W, H)
NONE = Lens(K, (0.0, 0.0, 0.0, 0.0), W, H)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_undistorting_is_the_inverse_of_distorting(lens):
    pixels = pixel_centers(H, W)
    there = lens.distort(pixels, lens.pinhole())
    assert np.abs(lens.undistort(there, lens.pinhole()) - pixels).max() < 1e-5
    assert np.abs(there - pixels).max() > 1


def test_every_lens_that_is_one_to_one_is_undistorted_as_far_as_it_records():
    centers, accepted = pixel_centers(9, 16), 0
    numbers = product((40, 80, 108), np.linspace(-0.3, 0.3, 11), np.linspace(-0.1, 0.1, 5))
    for fov, k1, k2 in numbers:
        pinhole = intrinsics(8 / np.tan(np.radians(fov / 2)), 16, 9)
        lens = Lens(pinhole, (k1, k2, 0.0, 0.0), 16, 9)
        if lens.is_one_to_one():
            accepted += 1
            seen = lens.undistort(centers, pinhole)
            missed = np.linalg.norm(lens.distort(seen, pinhole) - centers, axis=-1) > 1e-6
            radius = np.linalg.norm(camera_rays(seen, pinhole)[missed, :2], axis=-1)
            assert radius == pytest.approx(np.sqrt(lens.rising_square())), (fov, k1, k2)
            assert missed.sum() <= 4  # corners that nothing is recorded in
    assert accepted > 80


def test_distortion_is_that_of_opencv_to_the_digit():
    x, y = 0.3, -0.2  # r^2 = 0.13
    radial = 1 - 0.2 * 0.13 + 0.05 * 0.13**2
    bent_x = x * radial + 2 * 0.002 * x * y - 0.001 * (0.13 + 2 * x * x)
    bent_y = y * radial + 0.002 * (0.13 + 2 * y * y) - 2 * 0.001 * x * y
    assert BARREL.bend(np.array([x, y])) == pytest.approx([bent_x, bent_y], abs=1e-12)


@pytest.mark.parametrize("lens", [BARREL, PINCUSHION])
def test_an_undistorted_picture_shows_recorded_pixels_only_and_as_many_as_it_can(lens):
    recorded = lens.distort(lens.border(), lens.pinhole())
    beyond = np.maximum(-recorded, recorded - [W, H]).max()
    assert -0.01 < beyond <= 1e-6


def test_a_picture_comes_back_through_its_lens():
    x, y = np.moveaxis(pixel_centers(H, W), -1, 0)
    picture = 0.5 + 0.3 * np.sin(x / 9) * np.cos(y / 7)
    straight = undistorted_picture(picture, BARREL)
    back = distorted_picture(straight, BARREL.pinhole(), BARREL)
    assert np.abs(back - picture)[12:-12, 20:-20].max() < 2e-3  # corners were cropped


def test_a_lens_without_distortion_changes_nothing():
    assert NONE.pinhole() == pytest.approx(K) and NONE.max_displacement_px() < 1e-9
    picture = np.random.default_rng(0).random((H, W, 3)).astype(np.float32)
    assert np.abs(undistorted_picture(picture, NONE) - picture).max() < 1e-5


def test_a_lens_of_another_size_moves_pixels_in_proportion():
    twice = BARREL.resized(2 * W, 2 * H)
    assert twice.max_displacement_px() == pytest.approx(2 * BARREL.max_displacement_px())


def test_the_wide_pinhole_sees_all_that_the_lens_records():
    wide_K, width, height = BARREL.wide_pinhole()
    outline = BARREL.undistort(BARREL.border(), wide_K)
    assert (outline >= 0).all() and (outline <= [width, height]).all() and width > W


def test_a_lens_that_folds_the_picture_is_recognized():
    assert BARREL.is_one_to_one() and PINCUSHION.is_one_to_one()
    assert not Lens(K, (-1.0, 0.0, 0.0, 0.0), W, H).is_one_to_one()
