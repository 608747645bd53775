"""Frames brought to one exposure through the camera's response, which the frames tell
themselves as soon as flow is there.

Equalizing by brightness (`exposure.equalize`) assumes that all exposures saw the same
things, equally often; whatever moves in or out bends it. Pixels that flow has found in
two exposures assume nothing: from those at rest the response and the steps are
estimated (`response.debevec`), and what is matched from then on is equalized through
them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hdr_nsff.radiometry.debevec import (
    MAX_MISFIT,
    ResponseFit,
    Samples,
    debevec,
    linked,
)
from hdr_nsff.radiometry.static_samples import PatchStatistics, smooth, spread_over_levels

POINTS = 4000
LEVELS = 1025  # recorded values that are tabulated


def response_from_flow(
    video: np.ndarray,
    brackets: np.ndarray,
    ev: Sequence[float | None],
    reference: int,
    flows: tuple[np.ndarray, np.ndarray, np.ndarray],
    moving: np.ndarray,
) -> ResponseFit | None:
    """Response and exposures of one camera; None where too few pixels at rest are found
    in several exposures, or they do not agree.

    `video` (T, H, W, 3) as recorded in [0, 1]; `brackets` (T,) int; `ev` per bracket
    the log2 exposures that are known; `flows`: flow (P, H, W, 2) px, where it is
    believed (P, H, W) bool, and pairs (P, 2) of frames of the video; `moving` (T, H, W)
    bool.
    """
    occurring = {int(b) for b in brackets}
    if len(occurring) < 2:
        return None
    samples = matched_samples(video, brackets, len(ev), flows, moving)
    if not linked(samples, occurring):
        return None
    fit = debevec(samples, ev, reference if reference in occurring else min(occurring))
    return fit if fit.misfit < MAX_MISFIT else None


def matched_samples(
    video: np.ndarray,
    brackets: np.ndarray,
    num: int,
    flows: tuple[np.ndarray, np.ndarray, np.ndarray],
    moving: np.ndarray,
) -> Samples:
    """Pixels at rest on smooth surface, spread over the recorded levels, and what they
    became where believed flow leads them.
    """
    flow, valid, pairs = flows
    maps = [smooth(frame, ~mask) for frame, mask in zip(video, moving, strict=True)]
    height, width = moving.shape[1:]
    rng, parts = np.random.default_rng(0), []
    for i, bracket in enumerate(brackets):
        onward = [
            (int(j), flow[k], valid[k])
            for k, (a, j) in enumerate(pairs)
            if a == i and brackets[j] != bracket
        ]
        believed = (
            np.any([v for _, _, v in onward], axis=0) if onward else np.zeros((height, width), bool)
        )
        x, y = spread_over_levels(
            video[i], maps[i].good & believed, max(1, POINTS // len(brackets)), rng
        ).T
        found = Samples(np.zeros((len(x), num, 3)), *np.zeros((2, len(x), num, 3), bool))
        read(found, bracket, maps[i], y, x, np.ones(len(x), bool))
        for j, there, sure in onward:
            to_x, to_y = np.rint(there[y, x] + np.stack([x, y], -1)).astype(int).T
            inside = (to_x >= 0) & (to_x < width) & (to_y >= 0) & (to_y < height)
            to_x, to_y = to_x.clip(0, width - 1), to_y.clip(0, height - 1)
            read(
                found,
                brackets[j],
                maps[j],
                to_y,
                to_x,
                inside & sure[y, x] & maps[j].good[to_y, to_x],
            )
        parts.append(found)
    return Samples(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("rgb", "valid", "saturated")
        )
    )


def read(
    found: Samples,
    bracket: int,
    maps: PatchStatistics,
    y: np.ndarray,
    x: np.ndarray,
    some: np.ndarray,
) -> None:
    """Enter what `some` (P,) of the points are at pixels `y`, `x` (P,) of a frame,
    where nothing is entered for its bracket.
    """
    some = some & ~(found.valid | found.saturated)[:, bracket].any(-1)
    found.rgb[some, bracket] = maps.mean[y, x][some]
    found.valid[some, bracket] = maps.unclipped[y, x][some]
    found.saturated[some, bracket] = maps.saturated[y, x][some]


def at_one_exposure(video: np.ndarray, brackets: np.ndarray, fit: ResponseFit) -> np.ndarray:
    """`video` (T, H, W, 3) recorded in [0, 1] at one brightness, in [0, 1]: every pixel
    the mean of what it would be in all brackets that occur, which keeps contrast
    wherever any of them has some.
    """
    result, value = np.empty(video.shape, np.float32), np.linspace(0, 1, LEVELS)
    for t, own in enumerate(brackets):
        for c in range(3):
            exposure = np.interp(value, fit.y[c], fit.x)
            images = [
                np.interp(exposure * 2 ** (fit.ev[b] - fit.ev[own]), fit.x, fit.y[c])
                for b in np.unique(brackets)
            ]
            result[t, ..., c] = np.interp(video[t, ..., c], value, np.mean(images, axis=0))
    return result
