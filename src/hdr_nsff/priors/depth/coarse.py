"""Depth found on a coarser grid than the frames', and brought back to their pixels.

Time and memory of the plane sweep grow with pixels times candidates, but disparity is
smooth inside objects. Above `working_pixels` it is found on shrunk frames, and every
pixel of the frame takes it from the cells around that look like it (joint bilateral
upsampling, Kopf et al. 2007; here only values of the best cell's surface are averaged,
so that no depth between two surfaces appears).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from hdr_nsff.core.jit import jit
from hdr_nsff.core.stack import RecentArrays, Stack
from hdr_nsff.scene.posed_video import PosedVideo

FRAME_MEMORY = 256 << 20  # bytes of shrunk frames that are kept; others are made again


@dataclass(frozen=True)
class CoarseTuning:
    """When frames are shrunk, and how depth returns to their pixels (hand-chosen on
    rendered scenes).
    """

    working_pixels: int = 150_000  # of a frame; larger ones are shrunk
    # share of a cell's pixels that move, or are clipped, from which on the cell is so
    min_moving_share: float = 0.25
    min_clipped_share: float = 0.5
    rgb_scale: float = 0.06  # sum of rgb differences at which a cell's weight is 1 / e
    max_disparity_difference: float = 0.03  # share: values of one surface


def coarseness(size: tuple[int, int], tuning: CoarseTuning = CoarseTuning()) -> int:
    """Pixels of a frame of `size` (height, width) per cell, in x and in y."""
    return int(np.ceil(np.sqrt(size[0] * size[1] / tuning.working_pixels)))


def shrink(clip: PosedVideo, factor: int, tuning: CoarseTuning = CoarseTuning()) -> PosedVideo:
    """The clip with frames that are `factor` times smaller in x and in y."""
    height, width = clip.size
    small = -(-height // factor), -(-width // factor)
    count = len(clip.video)

    def cells(image: np.ndarray) -> np.ndarray:
        shrunk = cv2.resize(image.astype(np.float32), small[::-1], interpolation=cv2.INTER_AREA)
        return np.asarray(shrunk, np.float32)

    recent = RecentArrays(FRAME_MEMORY)
    video = Stack(lambda t: recent.get(t, lambda: cells(clip.video[t])), (count, *small, 3))
    clipped = [cells(mask) > tuning.min_clipped_share for mask in clip.clipped]
    moving = [cells(mask) > tuning.min_moving_share for mask in clip.moving]
    scale = np.array([small[1] / width, small[0] / height, 1.0])[:, None]
    K = np.broadcast_to(clip.K, (count, 3, 3)) * scale
    return replace(clip, K=K, video=video, clipped=np.stack(clipped), moving=np.stack(moving))


@jit(nogil=True, fastmath=True)
def upsample(disparity, confidence, cell_rgb, rgb, rgb_scale, max_difference):
    """Disparity and confidence (H, W) of the pixels `rgb` (H, W, 3), from those of
    cells (h, w) of color `cell_rgb` (h, w, 3).

    Of the 3 x 3 cells around a pixel the one that is most alike, in place and color,
    decides; the others count where their disparity is within the share `max_difference`
    of it.
    """
    height, width = rgb.shape[:2]
    h, w = disparity.shape
    result = np.empty((height, width), np.float32)
    trust = np.empty((height, width), np.float32)
    weights = np.empty(9, np.float32)
    for y in range(height):
        v = (y + 0.5) * h / height - 0.5
        row = min(max(int(np.floor(v + 0.5)), 0), h - 1)
        for x in range(width):
            u = (x + 0.5) * w / width - 0.5
            column = min(max(int(np.floor(u + 0.5)), 0), w - 1)
            best, best_weight = np.float32(0), np.float32(-1)
            for n in range(9):
                i = min(max(row + n // 3 - 1, 0), h - 1)
                j = min(max(column + n % 3 - 1, 0), w - 1)
                difference = np.float32(0)
                for c in range(3):
                    difference += abs(rgb[y, x, c] - cell_rgb[i, j, c])
                distance = (i - v) ** 2 + (j - u) ** 2
                weights[n] = np.exp(-difference / rgb_scale - distance)
                if weights[n] > best_weight:
                    best_weight = weights[n]
                    best = disparity[i, j]
            total, mean, mean_trust = np.float32(0), np.float32(0), np.float32(0)
            for n in range(9):
                i = min(max(row + n // 3 - 1, 0), h - 1)
                j = min(max(column + n % 3 - 1, 0), w - 1)
                if abs(disparity[i, j] - best) <= max_difference * best:
                    total += weights[n]
                    mean += weights[n] * disparity[i, j]
                    mean_trust += weights[n] * confidence[i, j]
            result[y, x] = mean / total
            trust[y, x] = mean_trust / total
    return result, trust


def at_pixels(
    clip: PosedVideo,
    small: PosedVideo,
    disparity: np.ndarray,
    confidence: np.ndarray,
    tuning: CoarseTuning = CoarseTuning(),
) -> tuple[Stack, Stack]:
    """Disparity and confidence (T, H, W) of the clip's pixels from those (T, h, w) of
    the cells of the shrunk clip, made when asked for.
    """
    recent = RecentArrays(FRAME_MEMORY)

    def both(t: int) -> np.ndarray:
        rgb = np.ascontiguousarray(clip.video[t], np.float32)
        cell_rgb = np.ascontiguousarray(small.video[t], np.float32)
        maps = upsample(
            disparity[t],
            confidence[t],
            cell_rgb,
            rgb,
            tuning.rgb_scale,
            tuning.max_disparity_difference,
        )
        return np.stack(maps)

    shape = (len(clip.video), *clip.size)
    return (
        Stack(lambda t: recent.get(t, lambda: both(t))[0], shape),
        Stack(lambda t: recent.get(t, lambda: both(t))[1], shape),
    )


def mask_at_pixels(mask: np.ndarray, size: tuple[int, int]) -> Stack:
    """Masks (T, H, W) of frames of `size` from those of cells (T, h, w)."""

    def enlarge(t: int) -> np.ndarray:
        cells = mask[t].astype(np.uint8)
        return cv2.resize(cells, size[::-1], interpolation=cv2.INTER_NEAREST) > 0

    return Stack(enlarge, (len(mask), *size))
