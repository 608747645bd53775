"""Auto exposure, simulated: a smooth drift, hunting, and jumps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

# stops of the smooth drift, and how it hunts (hand-chosen)
DRIFT_RANGE = 3.0
NUM_HUNTS = 3
HUNT_EV, HUNT_FRAMES = 0.3, 8
JUMP_EV, JUMP_FRAMES = 1.0, 30  # stops of a jump, and frames for each of them


def auto_exposure(
    count: int, kept: Sequence[int], seed: int, jumps: Mapping[int, float]
) -> np.ndarray:
    """EV by which auto exposure moves every frame (count,), mean 0 over those `kept`.

    A smooth random curve over `DRIFT_RANGE`, and hunting: after a few random frames it
    overshoots and swings in. `jumps`: stops by the frame from which on they hold.
    """
    rng = np.random.default_rng([seed, count])
    time = np.arange(count)
    drift = np.zeros(len(time))
    for waves in range(1, 4):
        phase = rng.uniform(0, 2 * np.pi)
        drift += np.sin(2 * np.pi * waves * time / (1.5 * len(time)) + phase) / waves
    drift *= DRIFT_RANGE / max(float(np.ptp(drift)), 1e-6)
    for start in rng.choice(len(time), min(NUM_HUNTS, len(time)), replace=False):
        since = np.maximum(time - start, 0)
        swing = np.exp(-since / HUNT_FRAMES) * np.sin(2 * np.pi * since / HUNT_FRAMES)
        drift += HUNT_EV * rng.choice([-1, 1]) * swing
    for frame, jump in jumps.items():
        drift[frame:] += jump
    return drift - drift[list(kept)].mean()


def exposure_jumps(count: int, seed: int) -> dict[int, float]:
    """Jumps of auto exposure in a clip of `count` frames: stops by the frame from which
    on they hold. They never add up to more than `JUMP_EV`.
    """
    rng = np.random.default_rng([seed, count, 1])
    frames = rng.choice(np.arange(1, count), max(1, count // JUMP_FRAMES), replace=False)
    jumps, level = {}, 0.0
    for frame in np.sort(frames).tolist():
        jump = JUMP_EV * float(rng.choice([-1, 1]))
        if abs(level + jump) > JUMP_EV:
            jump = -jump
        jumps[frame] = jump
        level += jump
    return jumps
