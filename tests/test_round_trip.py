"""Reading along flow, and the forward-backward check, on constant flow."""

import numpy as np

from hdr_nsff.geometry.round_trip import flow_at, follow, valid_flow

H, W = 64, 96
NONE_CLIPPED = np.zeros((H, W), bool)


def constant(dx: float, dy: float) -> np.ndarray:
    """A flow (H, W, 2) that is the same everywhere."""
    return np.broadcast_to(np.float32([dx, dy]), (H, W, 2)).copy()


def test_pixels_clipped_at_either_end_are_invalid():
    clipped_from = NONE_CLIPPED.copy()
    clipped_to = NONE_CLIPPED.copy()
    clipped_from[10, 20] = True
    clipped_to[30, 43] = True
    valid = valid_flow(constant(3, 0), constant(-3, 0), clipped_from, clipped_to)
    assert not valid[10, 20] and not valid[30, 40]  # (40 + 3, 30) is clipped
    assert valid[10, 21] and valid[30, 41]


def test_flow_out_of_the_frame_is_invalid():
    valid = valid_flow(constant(3, 0), constant(-3, 0), NONE_CLIPPED, NONE_CLIPPED)
    assert valid[:, : W - 3].all() and not valid[:, W - 3 :].any()


def test_round_trips_beyond_half_a_pixel_are_rejected():
    """Tolerance is 0.5 px + 1 % of the length: 0.53 px for a motion of 3 px."""
    within = valid_flow(constant(3, 0), constant(-3.5, 0), NONE_CLIPPED, NONE_CLIPPED)
    beyond = valid_flow(constant(3, 0), constant(-3.6, 0), NONE_CLIPPED, NONE_CLIPPED)
    assert within[:, :-4].all()
    assert not beyond.any()


def test_following_a_flow_reads_between_pixels():
    ramp = np.broadcast_to(np.arange(W, dtype=np.float32), (H, W)).copy()
    assert np.allclose(follow(ramp, constant(1.5, 0))[:, :-2], ramp[:, :-2] + 1.5)


def test_flow_is_read_between_pixel_centers_and_held_outside():
    flow = np.zeros((4, 6, 2), np.float32)
    flow[..., 0] = np.arange(6) + 0.5  # x of the pixel centers
    found = flow_at(flow, np.array([[2.5, 1.5], [2.75, 2.0], [9.0, 1.0]]))
    assert found.tolist() == [[2.5, 0], [2.75, 0], [5.5, 0]]


def test_unknown_pixels_and_unknown_flow_have_no_flow():
    flow = np.zeros((4, 6, 2), np.float32)
    flow[1, 2] = np.nan
    found = flow_at(flow, np.array([[np.nan, np.nan], [2.5, 1.5], [4.5, 3.5]]))
    assert np.isnan(found[:2]).all() and found[2].tolist() == [0, 0]
