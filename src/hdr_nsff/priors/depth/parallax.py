"""What known poses say about depth before any pixel is compared: how pixels move
between two frames as a function of disparity, which frames tell each other's depth
best, which disparities occur, and points triangulated from flow.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.scene.posed_video import PosedVideo

# parallax of the middle of the scene between two frames, in image widths, that matches
# best
GOOD_PARALLAX = 0.05
NUM_POINTS = 3000  # triangulated from flow where structure from motion gave none
REPROJECTION = 1.0  # pixels a triangulated point may miss its flow by


def disparity_range(clip: PosedVideo, points: np.ndarray) -> tuple[float, float]:
    """Lowest and highest disparity to try: what static `points` (P, 3) show in the
    frames, with room for what they miss.
    """
    seen = []
    for i in range(len(clip.c2w)):
        _, z, inside = clip.project(i, points)
        seen.append(1 / z[inside])
    low, high = np.percentile(np.concatenate(seen), [1, 99])
    return 0.6 * float(low), 1.4 * float(high)


def parallax(clip: PosedVideo, i: int, j: int, points: np.ndarray) -> tuple[float, float]:
    """Median distance in pixels of frame `j` between `points` (P, 3) and the same
    directions seen from `i` infinitely far away; and the share of the points that `j`
    sees.
    """
    pixels, _, inside = clip.project(j, points)
    eye = clip.c2w[i, :, 3]
    at_infinity, _, _ = clip.project(j, eye + (points - eye) * 1e6)
    if not inside.any():
        return 0.0, 0.0
    return float(np.median(np.linalg.norm(pixels - at_infinity, axis=-1)[inside])), float(
        inside.mean()
    )


def choose_views(clip: PosedVideo, points: np.ndarray, most: int) -> tuple[list[list[int]], float]:
    """For each frame the up to `most` frames that tell its depth best, best first; and
    the largest parallax of all pairs, in pixels.

    Good views share most of the picture and have moved by about `GOOD_PARALLAX`; near
    in time is better (light changes).
    """
    chosen, largest, count = [], 0.0, len(clip.c2w)
    for i in range(count):
        mine = points[clip.project(i, points)[2]]
        scores = np.zeros(count)
        for j in (j for j in range(count) if j != i and len(mine)):
            moved, share = parallax(clip, i, j, mine)
            ratio = max(moved / (GOOD_PARALLAX * clip.size[1]), 1e-9)
            scores[j] = (
                share
                * min(ratio, ratio**-0.5)
                * max(0.3, 1 - 0.02 * abs(clip.times[i] - clip.times[j]))
            )
            largest = max(largest, moved)
        best = np.argsort(-scores, kind="stable")[:most]
        chosen.append([int(j) for j in best if scores[j] > 1e-6])
    return chosen, largest


def triangulate(
    clip: PosedVideo, flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """Static world points (P, 3) from flow (N, H, W, 2) px of `pairs` (N, 2): the
    least-squares disparity of a spread of pixels, kept where the flow is valid, the
    point lies in front and reprojects within `REPROJECTION`.
    """
    h, w = clip.size
    stride = max(1, int(np.sqrt(h * w * len(pairs) / NUM_POINTS)))
    y, x = (a.reshape(-1) for a in np.mgrid[stride // 2 : h : stride, stride // 2 : w : stride])
    pixels = np.stack([x, y], -1) + 0.5
    points = []
    for k, (i, j) in enumerate(pairs):
        turn, shift = clip.transfer(i, j)
        target = pixels + flow[k, y, x]
        start = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ turn.T
        miss = start[:, :2] - target * start[:, 2:]  # + d slope = 0, both coordinates
        slope = shift[:2] - target * shift[2]
        disparity = -(miss * slope).sum(-1) / np.maximum((slope**2).sum(-1), 1e-12)
        moved = start + disparity[:, None] * shift
        error = np.linalg.norm(
            moved[:, :2] / np.where(np.abs(moved[:, 2:]) < 1e-9, 1e-9, moved[:, 2:]) - target,
            axis=-1,
        )
        parallax_px = (
            np.abs(disparity)
            * np.linalg.norm(slope, axis=-1)
            / np.maximum(np.abs(start[:, 2]), 1e-9)
        )
        good = (
            valid[k, y, x]
            & ~clip.moving[i, y, x]
            & (disparity > 1e-6)
            & (error < REPROJECTION)
            & (parallax_px > 0.5)
        )
        points.append(clip.unproject(i, pixels[good], disparity[good]))
    return np.concatenate(points) if points else np.zeros((0, 3))
