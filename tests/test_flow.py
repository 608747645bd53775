"""Optical flow: exact on a plane that slides, invalid where it cannot be known, and a
folder of maps as another source.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_npy, write_png
from hdr_nsff.footage.flow_files import read_flow
from hdr_nsff.geometry.round_trip import agreement, follow
from hdr_nsff.priors.flow.dense import flow, halfway
from hdr_nsff.radiometry.common_range import common_gray, recorded_range

H, W = 64, 96
NOTHING = np.zeros((H, W), bool)


def texture(seed: int = 0, size: tuple[int, int] = (H + 40, W + 40)) -> np.ndarray:
    """Smooth noise (H, W, 3) in [0.1, 0.9]."""
    noise = cv2.GaussianBlur(
        np.random.default_rng(seed).random((*size, 3)).astype(np.float32), (0, 0), 1.5
    )
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def sliding(dx: float, dy: float) -> np.ndarray:
    """Two frames (2, H, W, 3) of a plane that moves by (dx, dy) pixels."""
    shifts = [np.float32([[1, 0, x - 20], [0, 1, y - 20]]) for x, y in ((0, 0), (dx, dy))]
    return np.stack([cv2.warpAffine(texture(), m, (W, H), flags=cv2.INTER_CUBIC) for m in shifts])


def constant(dx: float, dy: float) -> np.ndarray:
    """A flow (H, W, 2) that is the same everywhere."""
    return np.broadcast_to(np.float32([dx, dy]), (H, W, 2)).copy()


def test_a_sliding_plane_gives_its_motion_everywhere():
    found, valid = flow(sliding(2.5, -1.25), np.stack([NOTHING] * 2), np.array([[0, 1]]))
    inner = found[0, 8:-8, 8:-8]
    assert np.abs(inner - [2.5, -1.25]).max() < 0.15
    assert valid[0, 8:-8, 8:-8].mean() > 0.99


def test_another_exposure_of_the_same_plane_gives_the_same_motion():
    frames = sliding(2.5, -1.25)
    frames[1] = np.minimum(frames[1], 0.5)  # the second frame saturates at half
    found, _ = flow(frames, frames.min(-1) >= 0.5, np.array([[0, 1]]))
    assert np.median(np.abs(found[0, 8:-8, 8:-8] - [2.5, -1.25])) < 0.1


def test_the_reverse_pair_is_the_opposite_motion():
    found, _ = flow(sliding(3, 0), np.stack([NOTHING] * 2), np.array([[0, 1], [1, 0]]))
    assert np.abs(found[0] + found[1])[8:-8, 8:-8].max() < 0.15


def test_order_of_pairs_does_not_change_the_answer():
    frames = np.concatenate([sliding(1, 0), sliding(2, 2)])
    clipped = np.zeros(frames.shape[:3], bool)
    pairs = np.array([[0, 1], [1, 3], [3, 0]])
    forward, reverse = flow(frames, clipped, pairs), flow(frames, clipped, pairs[::-1])
    assert np.array_equal(forward[0], reverse[0][::-1]) and np.array_equal(
        forward[1], reverse[1][::-1]
    )


def test_pixels_clipped_at_either_end_are_invalid():
    clipped_from, clipped_to = NOTHING.copy(), NOTHING.copy()
    clipped_from[10, 20], clipped_to[30, 43] = True, True
    valid = agreement(constant(3, 0), constant(-3, 0), clipped_from, clipped_to)
    assert not valid[10, 20] and not valid[30, 40]  # (40 + 3, 30) is clipped
    assert valid[10, 21] and valid[30, 41]


def test_flow_out_of_the_frame_is_invalid():
    valid = agreement(constant(3, 0), constant(-3, 0), NOTHING, NOTHING)
    assert valid[:, : W - 3].all() and not valid[:, W - 3 :].any()


def test_round_trips_beyond_half_a_pixel_are_rejected():
    """Tolerance is 0.5 px + 1 % of the length: 0.53 px for a motion of 3 px."""
    assert agreement(constant(3, 0), constant(-3.5, 0), NOTHING, NOTHING)[:, :-4].all()
    assert not agreement(constant(3, 0), constant(-3.6, 0), NOTHING, NOTHING).any()


def test_both_ways_meet_halfway_where_they_agree_and_nowhere_else():
    shape = (20, 30, 2)
    there, back = np.full(shape, 2.0, np.float32), np.full(shape, -1.8, np.float32)
    assert np.allclose(halfway(there, back), 1.9) and np.allclose(halfway(back, there), -1.9)
    assert np.array_equal(halfway(there, -there), there)
    assert np.array_equal(
        halfway(there, -there + 1), there
    )  # one of them is wrong, nobody knows which
    rng = np.random.default_rng(0)
    noisy = [flow + rng.normal(0, 0.05, shape).astype(np.float32) for flow in (there, -there)]
    assert np.std(halfway(*noisy) - there) < 0.85 * np.std(noisy[0] - there)


def test_what_an_occluder_hides_fails_the_check():
    """A patch slides 6 px to the right over a still background; 6 columns right of it
    are hidden next.
    """
    background, patch = texture(1)[:H, :W], texture(2)[:32, :32]
    frames = np.stack([background, background])
    frames[0, 16:48, 30:62], frames[1, 16:48, 36:68] = patch, patch
    found, valid = flow(frames, np.stack([NOTHING] * 2), np.array([[0, 1]]))
    assert np.abs(np.median(found[0, 20:44, 34:58], axis=(0, 1)) - [6, 0]).max() < 0.2
    assert valid[0, 20:44, 63:67].mean() < 0.2
    assert valid[0, 20:44, 75:90].mean() > 0.95


def test_both_frames_are_cut_to_what_both_recorded():
    """Frame 0 holds grays 0.2 to 1, frame 1 only up to 0.5: white is 0.5 in both, black
    0.2.
    """
    ramp = np.repeat(np.linspace(0.2, 1, W, dtype=np.float32)[None, :, None], H, 0).repeat(3, -1)
    video = np.stack([ramp, np.minimum(ramp, 0.5)])
    clipped = np.stack([NOTHING, video[1, ..., 0] >= 0.5])
    ranges = [recorded_range(f, c) for f, c in zip(video, clipped, strict=True)]
    a, b = common_gray(video, ranges, 0, 1)
    assert np.abs(a.astype(int) - b).max() <= 1
    assert a.min() == 0 and a.max() == 255


def test_wholly_clipped_frames_have_no_valid_flow():
    video = np.ones((2, H, W, 3), np.float32)
    found, valid = flow(video, np.ones((2, H, W), bool), np.array([[0, 1]]))
    assert np.isfinite(found).all() and not valid.any()


def test_following_a_flow_reads_between_pixels():
    ramp = np.broadcast_to(np.arange(W, dtype=np.float32), (H, W)).copy()
    assert np.allclose(follow(ramp, constant(1.5, 0))[:, :-2], ramp[:, :-2] + 1.5)


def test_a_folder_of_maps_is_checked_against_its_reverse(tmp_path):
    write_npy(tmp_path / "00004_00005.npy", constant(2, 0))
    write_npy(
        tmp_path / "00005_00004.npy",
        np.where(np.arange(W)[:, None] < 40, constant(-2, 0), constant(0, 0)),
    )
    found, valid = read_flow(tmp_path, [(4, 5)], (H, W))
    assert np.allclose(found[0], [2, 0])
    assert (
        valid[0, :, :37].all() and not valid[0, :, 39:].any()
    )  # column 38 lands on column 40, where the reverse disagrees


def test_a_folder_in_the_public_layout_is_read(tmp_path):
    mask = np.zeros((H, W))
    mask[:5] = 1
    np.savez(tmp_path / "00007_fwd.npz", flow=constant(1, 2), mask=mask)
    np.savez(tmp_path / "00008_bwd.npz", flow=constant(-1, -2), mask=mask)
    found, valid = read_flow(tmp_path, [(7, 8), (8, 7)], (H, W))
    assert np.allclose(found[0], [1, 2]) and np.allclose(found[1], [-1, -2])
    assert valid[:, :5].all() and not valid[:, 5:].any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda d: None, "no flow from frame 0 to frame 1"),
        (lambda d: write_npy(d / "00000_00001.npy", np.zeros((H, W - 1, 2))), "shape"),
        (lambda d: write_npy(d / "00000_00001.npy", np.full((H, W, 2), np.nan)), "NaN"),
        (lambda d: (d / "00000_00001.npy").write_text("no array"), "not a readable"),
        (lambda d: (d / "00000_fwd.npz").write_text("no archive"), "not a flow file"),
        (
            lambda d: (
                write_npy(d / "00000_00001.npy", constant(0, 0)),
                write_png(d / "00000_00001_valid.png", np.ones((3, 3), bool)),
            ),
            "its mask",
        ),
    ],
)
def test_a_bad_flow_folder_is_one_sentence(tmp_path, make, words):
    make(tmp_path)
    with pytest.raises(InputError, match=words):
        read_flow(tmp_path, [(0, 1)], (H, W))


def test_a_missing_flow_folder_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_flow(tmp_path / "nowhere", [(0, 1)], (H, W))
