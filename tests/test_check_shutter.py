"""The shake of a picture and the readout of a rolling shutter, from pictures warped
row by row.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.check.picture_motion import affine_motions, measure_shake
from hdr_nsff.check.shutter import measure_readout
from hdr_nsff.priors.poses.matching import PairMatches, detect_keypoints, match_pairs

FRAMES, H, W = 40, 144, 256


def shake(seed: int, amplitude: float) -> np.ndarray:
    """Frequencies, phases and amplitudes (3, 2, 6) of a hand's shake along x and y."""
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.03, 0.18, (2, 6))
    phase = rng.uniform(0, 2 * np.pi, (2, 6))
    return np.stack([frequency, phase, amplitude * rng.normal(size=(2, 6)) / frequency / 30])


def shaken_clip(readout: float, amplitude: float = 6.0, seed: int = 0) -> np.ndarray:
    """Frames (T, H, W, 3) of a texture before a shaking camera; row y of frame t at
    t + readout (y / H - 1/2).
    """
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(3 * H, 3 * W)).astype(np.float32)
    texture = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3, 6))
    texture = (texture - texture.min()) / np.ptp(texture)
    frequency, phase, strength = shake(seed, amplitude)
    y, x = np.mgrid[:H, :W].astype(np.float32)
    frames = []
    for t in range(FRAMES):
        time = t + readout * ((np.arange(H) + 0.5) / H - 0.5)
        angles = 2 * np.pi * frequency[..., None] * time + phase[..., None]
        right, down = (strength[..., None] * np.sin(angles)).sum(1).astype(np.float32)  # (H,)
        columns, rows = x + W + right[:, None], y + H + down[:, None]
        gray = cv2.remap(texture, columns, rows, cv2.INTER_CUBIC)
        frames.append(np.repeat(gray.clip(0, 1)[..., None], 3, -1))
    return np.stack(frames)


def matches(video: np.ndarray) -> list[PairMatches]:
    keypoints = detect_keypoints(video, np.zeros(video.shape[:3], bool))
    return match_pairs(keypoints, [(t, t + 1) for t in range(len(video) - 1)])


@pytest.mark.parametrize("readout", [0.0, 0.5])
def test_shake_shows_the_readout(readout: float) -> None:
    found = measure_readout(matches(shaken_clip(readout)), (H, W))
    assert found is not None and found[0] == pytest.approx(readout, abs=0.04)
    assert found[1] < 0.03


def test_columns_of_a_portrait_are_rows_of_the_sensor() -> None:
    turned = np.rot90(shaken_clip(0.5), axes=(1, 2))
    found = measure_readout(matches(turned), (W, H), portrait=True)
    assert found is not None and found[0] == pytest.approx(0.5, abs=0.04)


def steady_pan(step: tuple[float, float]) -> list[PairMatches]:
    """Noisy matches of a picture that moves by one step in every frame."""
    places = np.random.default_rng(0).uniform(0, W, (200, 2))
    rng = np.random.default_rng(1)
    moved = places + np.array(step)
    noise = rng.normal(0, 0.2, (FRAMES, *places.shape))
    return [PairMatches(t, t + 1, places, moved + noise[t]) for t in range(FRAMES)]


def test_a_steady_pan_does_not_determine_it() -> None:
    assert measure_readout(steady_pan((3, 0)), (H, W)) is None


def true_shake(seed: int = 0, amplitude: float = 6.0) -> tuple[float, float]:
    """Shake and speed of `shaken_clip` from its frequencies, px."""
    frequency, phase, strength = shake(seed, amplitude)
    time = np.linspace(2, FRAMES - 3, 500)
    turn = 2 * np.pi * frequency[..., None]
    angles = turn * time + phase[..., None]
    acceleration = -(turn**2 * strength[..., None] * np.sin(angles)).sum(1)  # (2, 500)
    velocity = (turn * strength[..., None] * np.cos(angles)).sum(1)
    found = 1.4826 * np.linalg.norm(np.median(np.abs(acceleration), axis=1))
    return float(found), float(np.median(np.linalg.norm(velocity, axis=0)))


def test_shake_is_the_acceleration_of_the_picture() -> None:
    found = measure_shake(affine_motions(matches(shaken_clip(0.0)), (H, W)))
    assert found == pytest.approx(true_shake(), rel=0.25)


def test_a_steady_pan_does_not_shake() -> None:
    pan = steady_pan((3, 1))
    found = measure_shake(affine_motions(pan, (H, W)))
    assert found is not None
    assert found[0] < 0.03 and found[1] == pytest.approx(np.hypot(3, 1), abs=0.05)
    assert measure_shake(affine_motions(pan[:18], (H, W))) is None
