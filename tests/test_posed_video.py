"""Frames with known poses: transfer of pixels from frame to frame."""

import numpy as np
from posed_planes import cameras_at, posed_video


def test_transfer_is_projection_of_the_unprojected_pixel():
    s = posed_video(cameras_at((0, 0, 0), (0.3, -0.2, 0.5)))
    turn, shift = s.transfer(0, 1)
    pixel, disparity = np.array([[20.5, 11.5]]), np.array([0.4])
    q = turn @ [20.5, 11.5, 1] + disparity * shift
    expected, z, inside = s.project(1, s.unproject(0, pixel, disparity))
    assert np.allclose(q[:2] / q[2], expected[0], atol=1e-4) and inside[0]
    assert np.isclose(q[2] / disparity[0], z[0], atol=1e-4)
