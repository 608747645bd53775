"""Display tone curves by others, in numpy: AgX and Khronos PBR Neutral.

Both take linear Rec. 709 light (..., 3), where 1 is white in the exposure that was
chosen, and give linear light of a display in [0, 1]. `viewer/page/develop.frag` has the
same formulas.
"""

from __future__ import annotations

import numpy as np

# AgX by Troy Sobotka, in the polynomial form of Benjamin Wrensch with the Rec. 2020
# matrices of Filament and three.js
AGX_TO_REC2020 = np.array(
    [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0113], [0.0164, 0.0880, 0.8956]], np.float32
)
AGX_FROM_REC2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    np.float32,
)
AGX_INSET = np.array(
    [
        [0.856627153315983, 0.0951212405381588, 0.0482516061458583],
        [0.137318972929847, 0.761241990602591, 0.101439036467562],
        [0.11189821299995, 0.0767994186031903, 0.811302368396859],
    ],
    np.float32,
)
AGX_OUTSET = np.array(
    [
        [1.1271005818144368, -0.11060664309660323, -0.016493938717834573],
        [-0.1413297634984383, 1.157823702216272, -0.016493938717834257],
        [-0.14132976349843826, -0.11060664309660294, 1.2519364065950405],
    ],
    np.float32,
)
AGX_MIN_EV, AGX_MAX_EV = -12.47393, 4.026069  # log2 of light
AGX_CONTRAST = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)  # a polynomial's
AGX_GAMMA = 2.2

NEUTRAL_START = 0.8 - 0.04  # of compression
NEUTRAL_DESATURATION = 0.15
NEUTRAL_FRESNEL = 0.04  # light that a dielectric reflects, which is taken away


def agx(light: np.ndarray) -> np.ndarray:
    """AgX of linear light (..., 3), without a look."""
    x = light.clip(min=0) @ (AGX_INSET @ AGX_TO_REC2020).T
    stops = np.log2(x.clip(min=1e-10))
    share = ((stops - AGX_MIN_EV) / (AGX_MAX_EV - AGX_MIN_EV)).clip(0, 1)
    encoded = np.polyval(AGX_CONTRAST, share)
    display = (encoded @ AGX_OUTSET.T).clip(min=0) ** AGX_GAMMA
    return (display @ AGX_FROM_REC2020.T).clip(0, 1)


def pbr_neutral(light: np.ndarray) -> np.ndarray:
    """The Khronos PBR Neutral tone mapper, version 1.0, of linear light (..., 3)."""
    darkest = light.min(-1, keepdims=True)
    toe = darkest - darkest**2 / (4 * NEUTRAL_FRESNEL)
    light = light - np.where(darkest < 2 * NEUTRAL_FRESNEL, toe, NEUTRAL_FRESNEL)
    peak = light.max(-1, keepdims=True)
    room = 1 - NEUTRAL_START
    new_peak = 1 - room**2 / (peak.clip(min=NEUTRAL_START) + room - NEUTRAL_START)
    scaled = light * (new_peak / peak.clip(min=NEUTRAL_START))
    gray_share = 1 - 1 / (NEUTRAL_DESATURATION * (peak - new_peak) + 1)
    compressed = scaled + gray_share * (new_peak - scaled)
    return np.where(peak < NEUTRAL_START, light, compressed)
