"""Flow of what moves, told by what moves alone: a disc that slides over a wall that
slides another way.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.priors.flow.masked_least_squares import MOST, mended

H, W = 64, 96
DISC, WALL = np.float32([2.4, 0.6]), np.float32([-0.8, 0.3])


def texture(seed: int) -> np.ndarray:
    """Smooth noise (H + 40, W + 40, 3) in [0.1, 0.9]."""
    noise = cv2.GaussianBlur(
        np.random.default_rng(seed).random((H + 40, W + 40, 3)).astype(np.float32), (0, 0), 1.5
    )
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def slid(picture: np.ndarray, by: np.ndarray) -> np.ndarray:
    """The middle of a picture after it slid by so many pixels."""
    return cv2.warpAffine(
        picture, np.float32([[1, 0, by[0] - 20], [0, 1, by[1] - 20]]), (W, H), flags=cv2.INTER_CUBIC
    )


def disc(at: np.ndarray, radius: float = 14.0) -> np.ndarray:
    """(H, W) bool."""
    y, x = np.mgrid[:H, :W]
    return np.hypot(x - 45 - at[0], y - 32 - at[1]) < radius


def frames() -> tuple[np.ndarray, np.ndarray]:
    """The disc over the wall, and both a time later."""
    shots = [
        np.where(disc(k * DISC)[..., None], slid(texture(1), k * DISC), slid(texture(2), k * WALL))
        for k in (0, 1)
    ]
    return shots[0], shots[1]


def blurred() -> np.ndarray:
    """The flow (H, W, 2) as windows across the outline see it."""
    return cv2.GaussianBlur(exact(), (0, 0), 3.0)


def exact() -> np.ndarray:
    return np.where(disc(0 * DISC)[..., None], DISC, WALL).astype(np.float32)


def error(flow: np.ndarray) -> float:
    """Mean end-point error of the disc."""
    return float(np.linalg.norm(flow - exact(), axis=-1)[disc(0 * DISC)].mean())


def test_flow_of_a_disc_is_no_longer_mixed_with_that_of_the_wall() -> None:
    found = mended(*frames(), blurred(), disc(0 * DISC))
    assert error(found) < 0.6 * error(blurred())
    along = (DISC - WALL) / np.linalg.norm(DISC - WALL)
    before, after = (((f - exact())[disc(0 * DISC)] @ along).mean() for f in (blurred(), found))
    assert before < -0.5 and after > -0.1  # pixels too slow


def test_masks_that_are_a_little_too_wide_do() -> None:
    assert error(mended(*frames(), blurred(), disc(0 * DISC, 15.5))) < 0.7 * error(blurred())


@pytest.mark.parametrize("change", [lambda p: p * 0.9 + 0.05, lambda p: p + 0.05])
def test_what_is_left_of_another_exposure_does_no_harm(change) -> None:
    here, there = frames()
    assert error(
        mended(here, change(there).astype(np.float32), blurred(), disc(0 * DISC))
    ) < 0.65 * error(blurred())


def test_what_does_not_move_is_left_alone() -> None:
    found, moving = mended(*frames(), blurred(), disc(0 * DISC)), disc(0 * DISC)
    assert np.array_equal(found[~moving], blurred()[~moving])
    assert np.array_equal(mended(*frames(), blurred(), np.zeros((H, W), bool)), blurred())


def test_exact_flow_stays_as_it_is() -> None:
    assert error(mended(*frames(), exact(), disc(0 * DISC))) < 0.05


def test_where_nothing_shows_nothing_is_corrected() -> None:
    gray = np.full((H, W, 3), 0.5, np.float32)
    assert np.abs(mended(gray, gray, blurred(), disc(0 * DISC)) - blurred()).max() < 1e-4


def test_what_would_go_far_was_wrong_otherwise_and_is_left() -> None:
    start = exact() + np.float32([0, 9])
    found = mended(*frames(), start, disc(0 * DISC))
    assert np.linalg.norm(found - start, axis=-1).max() < MOST and np.isfinite(found).all()
