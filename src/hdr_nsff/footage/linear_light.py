"""Linear light as recorded values: scaled into [0, 1] and encoded as x^(1/2.2), so that
what follows sees one kind of recording.

EXR and DNG are linear; they are scaled by one constant for the whole footage. HLG, PQ,
log and linear video is brought to linear light first, by its tags.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import assert_never

import numpy as np

from hdr_nsff.core.exr import REC709
from hdr_nsff.footage.footage import TaggedTransfer
from hdr_nsff.footage.still_frames import read_frame
from hdr_nsff.maths.hdr_signal import (
    PEAK_NITS,
    REC2020,
    hlg_inverse_oetf,
    pq_decode,
    rgb_to_xyz,
)

GAMMA = 2.2  # linear footage is encoded as x^(1 / GAMMA)
WHITE_PERCENTILE = 99.9  # of linear radiance, becomes 1 (hand-chosen)


def encode_light(light: np.ndarray) -> np.ndarray:
    """Linear light, clipped to [0, 1], as recorded values."""
    return np.clip(light, 0, 1) ** np.float32(1 / GAMMA)


def encode_signal(signal: np.ndarray, transfer: TaggedTransfer, rec2020: bool) -> np.ndarray:
    """Signals (H, W, 3) in [0, 1] as linear Rec. 709 light, encoded as x^(1/2.2).

    1 is the brightest light of HLG, log and linear signals, and 1000 nits of PQ. Colors
    outside Rec. 709 are clipped.
    """
    codes = np.rint(np.clip(signal, 0, 1) * 65535).astype(np.uint16)  # as decoded
    light = light_table(transfer)[codes]
    if rec2020:
        matrix = np.linalg.solve(rgb_to_xyz(REC709), rgb_to_xyz(REC2020))
        light = light @ matrix.T.astype(np.float32)
    return encode_light(light)


@functools.cache
def light_table(transfer: TaggedTransfer) -> np.ndarray:
    """Light (65536,) float32 of the signals of 16 bits, 1 is the peak."""
    signal = np.linspace(0, 1, 65536)
    match transfer:
        case "pq":
            light = pq_decode(signal) / PEAK_NITS
        case "hlg":
            light = hlg_inverse_oetf(signal)
        case "log100":
            light = log_light(signal, 2.0)
        case "log316":
            light = log_light(signal, 2.5)
        case "linear":
            light = signal
        case _:
            assert_never(transfer)
    return light.astype(np.float32)


def log_light(signal: np.ndarray, decades: float) -> np.ndarray:
    """Light of a logarithmic signal 1 + log10(light) / `decades` (H.273, table 3); the
    signal 0 is all that is darker, and becomes 0.
    """
    return np.where(signal > 0, 10.0 ** (decades * (signal - 1)), 0.0)


def linear_scale(files: list[Path]) -> float:
    """The constant that brings linear frames into [0, 1].

    1 where nothing is brighter than 1, as in DNG, else 1 / the 99.9th percentile. The
    same for all frames, so that their exposures keep their ratios; what is brighter is
    saturated, as on a sensor.
    """
    if all(f.suffix.lower() == ".dng" for f in files):
        return 1.0
    maxima, samples = zip(*(maximum_and_sample(f) for f in files), strict=True)
    if max(maxima) <= 1:
        return 1.0
    sampled = np.concatenate(samples)
    white = float(np.percentile(sampled, WHITE_PERCENTILE, overwrite_input=True))
    return 1 / max(white, 1e-12)


def maximum_and_sample(path: Path) -> tuple[float, np.ndarray]:
    """The largest value of a frame, and the values (N,) of every fourth pixel of every
    fourth row. The frame itself is let go, since all of a clip would fill the memory.
    """
    image = read_frame(path)
    return float(image.max()), image[::4, ::4].flatten()
