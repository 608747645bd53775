"""What the page shows of rendered maps, in numpy, for browsers that do not draw.

It is the twin of `page/develop.frag`.
"""

from __future__ import annotations

import cv2
import numpy as np

from hdr_nsff.maths import color
from hdr_nsff.maths.tone_curves import agx, pbr_neutral

MID_GRAY = 0.18
# Stops from mid gray up to which a color of `false_color` reaches, and the colors
BAND_ENDS = (-6.0, -4.0, -2.0, -0.5, 0.5, 2.0, 4.0, 6.0)
BAND_COLORS = np.array(
    [
        [0.16, 0.0, 0.3],
        [0.1, 0.25, 0.75],
        [0.1, 0.6, 0.8],
        [0.35, 0.45, 0.4],
        [0.35, 0.75, 0.3],
        [0.75, 0.72, 0.6],
        [0.98, 0.85, 0.2],
        [0.95, 0.5, 0.1],
        [0.9, 0.1, 0.1],
    ]
)
STRIPE_PX = 6  # width of the stripes over clipped pixels
BURNT_OUT, BLACK = 0.997, 0.004  # the brightest channel above or below is clipped
BURNT_OUT_COLOR, BLACK_COLOR = (0.95, 0.1, 0.15), (0.15, 0.3, 1.0)
MOTION_COLOR = (1.0, 0.62, 0.15)  # of moving content
STILL_COLOR = 0.07
MAX_FLOW_SHARE = 0.02  # of the picture's width: flow shown in full color


def develop(exposed: np.ndarray, curve: str) -> np.ndarray:
    """Exposed linear light (H, W, 3) through a curve, as sRGB in [0, 1].

    `curve`: agx, neutral, reinhard or clip.
    """
    match curve:
        case "agx":
            return color.srgb_encode(agx(exposed))
        case "neutral":
            return color.srgb_encode(pbr_neutral(exposed))
        case "reinhard":
            return color.display(exposed)
    return color.srgb_encode(exposed)


def false_color(exposed: np.ndarray) -> np.ndarray:
    """Stops of exposed light (H, W, 3) from mid gray as rgb (H, W, 3)."""
    stops = np.log2(color.luminance(exposed).clip(min=1e-9) / MID_GRAY)
    return BAND_COLORS[np.digitize(stops, BAND_ENDS)]


def mark_clipping(rgb: np.ndarray) -> np.ndarray:
    """A picture (H, W, 3) in [0, 1] with stripes over burnt out and black pixels."""
    height, width = rgb.shape[:2]
    x, y = np.meshgrid(np.arange(width), np.arange(height)[::-1])
    striped = (x + y + 1) % (2 * STRIPE_PX) < STRIPE_PX
    brightest = rgb.max(-1)
    marked = np.where((striped & (brightest > BURNT_OUT))[..., None], BURNT_OUT_COLOR, rgb)
    return np.where((striped & (brightest < BLACK))[..., None], BLACK_COLOR, marked)


def motion_color(motion: np.ndarray) -> np.ndarray:
    """The share of dynamic content (H, W) as rgb (H, W, 3)."""
    return STILL_COLOR + motion[..., None].clip(0, 1) * (np.array(MOTION_COLOR) - STILL_COLOR)


def flow_color(flow: np.ndarray) -> np.ndarray:
    """Motion (H, W, 2) in pixels, y down, as rgb: hue is its direction, brightness its
    length.
    """
    hue = np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi) + 0.5
    around = (6 * hue[..., None] + np.array([0.0, 4.0, 2.0])) % 6
    wheel = (np.abs(around - 3) - 1).clip(0, 1)
    length = np.linalg.norm(flow, axis=-1, keepdims=True)
    return wheel * (length / (MAX_FLOW_SHARE * flow.shape[1])).clip(0, 1)


def png(rgb: np.ndarray, bits: int) -> bytes:
    """A PNG file of 8 or 16 bits of rgb (H, W, 3) in [0, 1]."""
    codes = np.rint(rgb[..., ::-1].clip(0, 1) * (2**bits - 1))
    ok, buffer = cv2.imencode(".png", codes.astype(np.uint8 if bits == 8 else np.uint16))
    assert ok
    return buffer.tobytes()
