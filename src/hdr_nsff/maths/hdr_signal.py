"""The signal of an HDR screen: BT.2100 (PQ and HLG) of linear radiance, in numpy.

Light is rgb (..., 3) in cd/m^2 (nits) at the display, BT.2020 primaries; signals are in
[0, 1]. Both signals show the same light on a display of 1000 nits: PQ names nits, HLG
names scene light, and the display applies the system gamma of 1.2 (BT.2100 note 5f).
Radiance 1 after exposure is diffuse white, 203 nits (BT.2408).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from hdr_nsff.core.exr import REC709

Transfer = Literal["hlg", "pq"]

WHITE_NITS = 203.0  # diffuse white (BT.2408)
PEAK_NITS = 1000.0  # of the display that HLG's gamma of 1.2 belongs to (BT.2100)
# Light below this is shown as it is (hand-chosen: 1.3 stops above diffuse white; twice
# of it leaves no room for highlights, half of it dims whites)
KNEE_NITS = 500.0

REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)  # as core.exr.REC709
REC2020_LUMINANCE = (0.2627, 0.6780, 0.0593)  # BT.2020: weights of r, g, b

PQ_NITS = 10000.0  # SMPTE ST 2084: signal 1
PQ_M1 = 2610 / 16384
PQ_M2 = 2523 / 4096 * 128
PQ_C1 = 3424 / 4096
PQ_C2 = 2413 / 4096 * 32
PQ_C3 = 2392 / 4096 * 32

HLG_A = 0.17883277  # BT.2100 table 5
HLG_B = 1 - 4 * HLG_A
HLG_C = 0.5 - HLG_A * np.log(4 * HLG_A)
HLG_GAMMA = 1.2  # system gamma of a display with PEAK_NITS

LUMA_BLACK, LUMA_RANGE = 64, 876  # 10 bits, limited range (BT.2100 table 9)
CHROMA_ZERO, CHROMA_RANGE = 512, 896


def rgb_to_xyz(chromaticities: tuple[float, ...]) -> np.ndarray:
    """The matrix (3, 3) from linear rgb to CIE XYZ (SMPTE RP 177).

    `chromaticities` are x, y of red, green, blue and white.
    """
    xy = np.reshape(chromaticities, (4, 2))
    xyz = np.column_stack([xy, 1 - xy.sum(1)]) / xy[:, 1:]  # luminance 1
    primaries, white = xyz[:3].T, xyz[3]
    return primaries * np.linalg.solve(primaries, white)


def rec709_to_rec2020(rgb: np.ndarray) -> np.ndarray:
    """Linear rgb (..., 3) of Rec. 709 in BT.2020 primaries (BT.2087), float64."""
    matrix = np.linalg.solve(rgb_to_xyz(REC2020), rgb_to_xyz(REC709))
    return np.asarray(rgb, np.float64) @ matrix.T


def display_light(radiance: np.ndarray, exposure: float, transfer: Transfer) -> np.ndarray:
    """Display light (..., 3) in nits of linear Rec. 709 radiance (..., 3).

    `exposure` is a factor: one per shot. Highlights roll off into the peak by one
    factor per pixel: hue is kept, nothing is clipped, signals stay within [0, 1].
    """
    nits = rec709_to_rec2020(np.maximum(radiance, 0)) * (exposure * WHITE_NITS)
    level = nits.max(-1, keepdims=True)
    if transfer == "hlg":  # what the largest signal would show on a gray
        scene = hlg_scene_light(nits).max(-1, keepdims=True)
        level = PEAK_NITS * scene**HLG_GAMMA
    return nits * (roll_off(level) / np.maximum(level, 1e-9))


def roll_off(nits: np.ndarray) -> np.ndarray:
    """Light as it is below the knee; above, it approaches the peak but stays below.

    A hyperbola whose slope at the knee is 1.
    """
    room = PEAK_NITS - KNEE_NITS
    excess = np.maximum(nits - KNEE_NITS, 0) / room
    return np.minimum(nits, KNEE_NITS) + room * excess / (1 + excess)


def encode(nits: np.ndarray, transfer: Transfer) -> np.ndarray:
    """The signal (..., 3) in [0, 1] of display light (..., 3)."""
    if transfer == "pq":
        return pq_encode(nits)
    return hlg_oetf(hlg_scene_light(nits))


def decode(signal: np.ndarray, transfer: Transfer) -> np.ndarray:
    """The inverse of `encode`."""
    if transfer == "pq":
        return pq_decode(signal)
    return hlg_display_light(hlg_inverse_oetf(signal))


def pq_encode(nits: np.ndarray) -> np.ndarray:
    """PQ, the inverse EOTF of ST 2084, of light clipped to [0, 10000] nits."""
    power = (np.clip(nits, 0, PQ_NITS) / PQ_NITS) ** PQ_M1
    return ((PQ_C1 + PQ_C2 * power) / (1 + PQ_C3 * power)) ** PQ_M2


def pq_decode(signal: np.ndarray) -> np.ndarray:
    """Nits of a PQ signal: the EOTF of ST 2084."""
    power = np.clip(signal, 0, 1) ** (1 / PQ_M2)
    ratio = np.maximum(power - PQ_C1, 0) / (PQ_C2 - PQ_C3 * power)
    return PQ_NITS * ratio ** (1 / PQ_M1)


def hlg_oetf(scene: np.ndarray) -> np.ndarray:
    """HLG of scene light, clipped to [0, 1]."""
    light = np.clip(scene, 0, 1)
    logarithm = HLG_A * np.log(np.maximum(12 * light, 1) - HLG_B) + HLG_C
    return np.where(light <= 1 / 12, np.sqrt(3 * light), logarithm)


def hlg_inverse_oetf(signal: np.ndarray) -> np.ndarray:
    """Scene light in [0, 1] of an HLG signal."""
    value = np.clip(signal, 0, 1)
    exponential = (np.exp((value - HLG_C) / HLG_A) + HLG_B) / 12
    return np.where(value <= 0.5, value**2 / 3, exponential)


def hlg_display_light(scene: np.ndarray) -> np.ndarray:
    """Nits (..., 3) that a display of `PEAK_NITS` shows of scene light: HLG's OOTF."""
    luminance = scene @ np.array(REC2020_LUMINANCE)
    return PEAK_NITS * scene * luminance[..., None] ** (HLG_GAMMA - 1)


def hlg_scene_light(nits: np.ndarray) -> np.ndarray:
    """The inverse of `hlg_display_light`; above 1 where HLG has no signal for it."""
    light = nits / PEAK_NITS
    luminance = np.maximum(light @ np.array(REC2020_LUMINANCE), 1e-12)
    return light * luminance[..., None] ** (1 / HLG_GAMMA - 1)


def ycbcr_planes(
    signal: np.ndarray, full_chroma: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """10-bit codes Y (H, W), Cb and Cr (H/2, W/2) uint16 of rgb signals (H, W, 3).

    BT.2020 non-constant luminance, limited range, 4:2:0. H and W are even. Chroma is
    averaged, weights 1-2-1 along rows: its samples lie at the left, where players
    expect them. With `full_chroma` (4:4:4) it is (H, W).
    """
    red_weight, _, blue_weight = REC2020_LUMINANCE
    luma = signal @ np.array(REC2020_LUMINANCE)
    blue = (signal[..., 2] - luma) / (2 * (1 - blue_weight))
    red = (signal[..., 0] - luma) / (2 * (1 - red_weight))
    y = np.rint(LUMA_BLACK + LUMA_RANGE * luma).astype(np.uint16)
    if not full_chroma:
        blue, red = halve_chroma(blue), halve_chroma(red)
    return y, chroma_codes(blue), chroma_codes(red)


def chroma_codes(chroma: np.ndarray) -> np.ndarray:
    """Codes of a color difference in [-0.5, 0.5]."""
    return np.rint(CHROMA_ZERO + CHROMA_RANGE * chroma).astype(np.uint16)


def halve_chroma(chroma: np.ndarray) -> np.ndarray:
    """A color difference (H, W) at half of the size along each side."""
    rows = (chroma[0::2] + chroma[1::2]) / 2
    middle, right = rows[:, 0::2], rows[:, 1::2]
    left = np.concatenate([rows[:, :1], right[:, :-1]], 1)
    return (left + 2 * middle + right) / 4
