"""Flow of movers from their own pixels: a disc that slides over a wall that slides
another way.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from hdr_nsff.core.io import write_npy
from hdr_nsff.prepare.steps.refined_flow import Refiner
from hdr_nsff.priors.flow.masked_least_squares import (
    MASKED_LEAST_SQUARES_TUNING,
    refine_mover_flow,
)

H, W = 64, 96
DISC, WALL = np.float32([2.4, 0.6]), np.float32([-0.8, 0.3])  # motions, px


def texture(seed: int) -> np.ndarray:
    """Smooth noise (H + 40, W + 40, 3) in [0.1, 0.9]."""
    noise = np.random.default_rng(seed).random((H + 40, W + 40, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def slide(picture: np.ndarray, by: np.ndarray) -> np.ndarray:
    """The middle of a picture after it slid `by` (2,) pixels."""
    matrix = np.float32([[1, 0, by[0] - 20], [0, 1, by[1] - 20]])
    return cv2.warpAffine(picture, matrix, (W, H), flags=cv2.INTER_CUBIC)


def disc(offset: np.ndarray, radius: float = 14.0) -> np.ndarray:
    """A disc (H, W) bool, moved by `offset` (2,) pixels."""
    y, x = np.mgrid[:H, :W]
    return np.hypot(x - 45 - offset[0], y - 32 - offset[1]) < radius


def frames() -> tuple[np.ndarray, np.ndarray]:
    """The disc over the wall, and both one frame later."""
    shots = []
    for k in (0, 1):
        mask = disc(k * DISC)[..., None]
        shots.append(np.where(mask, slide(texture(1), k * DISC), slide(texture(2), k * WALL)))
    return shots[0], shots[1]


MASK = disc(np.zeros(2))


def exact() -> np.ndarray:
    """The true flow (H, W, 2)."""
    return np.where(MASK[..., None], DISC, WALL).astype(np.float32)


def blurred() -> np.ndarray:
    """The flow (H, W, 2) as windows across the outline see it."""
    return cv2.GaussianBlur(exact(), (0, 0), 3.0)


def error(flow: np.ndarray) -> float:
    """Mean end-point error of the disc."""
    return float(np.linalg.norm(flow - exact(), axis=-1)[MASK].mean())


def test_flow_of_a_disc_is_no_longer_mixed_with_that_of_the_wall() -> None:
    found = refine_mover_flow(*frames(), blurred(), MASK)
    assert error(found) < 0.6 * error(blurred())
    along = (DISC - WALL) / np.linalg.norm(DISC - WALL)
    before, after = (((f - exact())[MASK] @ along).mean() for f in (blurred(), found))
    assert before < -0.5 and after > -0.1  # pixels too slow


def test_masks_that_are_a_little_too_wide_work_too() -> None:
    wide = disc(np.zeros(2), 15.5)
    assert error(refine_mover_flow(*frames(), blurred(), wide)) < 0.7 * error(blurred())


@pytest.mark.parametrize("change", [lambda p: p * 0.9 + 0.05, lambda p: p + 0.05])
def test_a_remaining_difference_of_exposure_does_no_harm(change) -> None:
    source, target = frames()
    brighter = change(target).astype(np.float32)
    assert error(refine_mover_flow(source, brighter, blurred(), MASK)) < 0.65 * error(blurred())


def test_pixels_far_from_a_mover_do_not_matter() -> None:
    far = disc(np.float32([-100.0, -100.0]))
    far[0, 0] = far[-1, -1] = True  # the box around the mover is now the whole picture
    alone, beside = (refine_mover_flow(*frames(), blurred(), m) for m in (MASK, MASK | far))
    assert np.abs(alone - beside)[MASK].max() < 1e-4


def test_static_pixels_keep_their_flow() -> None:
    found = refine_mover_flow(*frames(), blurred(), MASK)
    assert np.array_equal(found[~MASK], blurred()[~MASK])
    nothing_moves = np.zeros((H, W), bool)
    assert np.array_equal(refine_mover_flow(*frames(), blurred(), nothing_moves), blurred())


def test_exact_flow_stays_as_it_is() -> None:
    assert error(refine_mover_flow(*frames(), exact(), MASK)) < 0.05


def test_flow_without_texture_is_not_corrected() -> None:
    gray = np.full((H, W, 3), 0.5, np.float32)
    assert np.abs(refine_mover_flow(gray, gray, blurred(), MASK) - blurred()).max() < 1e-4


def test_flow_far_from_the_truth_changes_by_the_largest_steps_at_most() -> None:
    start = exact() + np.float32([0, 9])
    change = refine_mover_flow(*frames(), start, MASK) - start
    tuning = MASKED_LEAST_SQUARES_TUNING
    assert np.abs(change).max() < tuning.iterations * tuning.max_step_px + 1e-3


def test_both_directions_of_a_pair_are_refined_each_in_its_own_mask(tmp_path: Path) -> None:
    video, moving = np.stack(frames()), np.stack([MASK, disc(DISC)])
    truths = [
        np.where(m[..., None], s * DISC, s * WALL) for m, s in zip(moving, (1, -1), strict=True)
    ]
    starts = [cv2.GaussianBlur(truth.astype(np.float32), (0, 0), 3.0) for truth in truths]
    entries = []
    for k, start in enumerate(starts):
        write_npy(tmp_path / f"{k}.npy", start)
        entries.append(SimpleNamespace(raw_flow={1 - k: SimpleNamespace(flow=f"{k}.npy")}))
    work = SimpleNamespace(
        folder=tmp_path,
        manifest=SimpleNamespace(frames=entries),
        masks=moving,
        equalized=(video, np.zeros(moving.shape, bool)),
    )
    found = Refiner(cast(Any, work), video).predict_both_directions(0, 1)
    assert [pair for pair, *_ in found] == [(0, 1), (1, 0)]
    for (_, flow, valid), start, truth, mask in zip(found, starts, truths, moving, strict=True):
        before, after = (np.linalg.norm(f - truth, axis=-1)[mask].mean() for f in (start, flow))
        assert after < 0.5 * before and valid[mask].mean() > 0.5
