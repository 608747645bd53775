"""Frames at one exposure, through a response that is estimated from matched pixels.

Equalizing by brightness (`exposure_cycle.equalize`) assumes that all exposures saw the
same surfaces, equally often; anything that enters or leaves the frame biases it. Pixels
that flow matches in two exposures need no such assumption: those at rest give the
response and the exposure steps (`radiometry.debevec`), and frames are equalized through
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hdr_nsff.radiometry.debevec import (
    MAX_MISFIT,
    Neighborhoods,
    ResponseFit,
    Samples,
    debevec,
    linked,
    smooth,
    spread_over_levels,
)

TABLE_SIZE = 1025  # entries of the lookup table from recorded to equalized values
SEED = 0  # of the choice of points


@dataclass(frozen=True)
class OneExposureTuning:
    """Tuning constants of the response from matched pixels."""

    max_points: int = 4000
    """Points in all frames together (hand-chosen on rendered scenes)."""


ONE_EXPOSURE_TUNING = OneExposureTuning()


def response_from_flow(
    video: np.ndarray,
    brackets: np.ndarray,
    ev: Sequence[float | None],
    reference: int,
    flows: tuple[np.ndarray, np.ndarray, np.ndarray],
    moving: np.ndarray,
    tuning: OneExposureTuning = ONE_EXPOSURE_TUNING,
) -> ResponseFit | None:
    """Response and exposures of one camera, or None.

    None where too few pixels at rest are matched in several exposures, or where they do
    not agree. `video` (T, H, W, 3) as recorded in [0, 1]; `brackets` (T,) int; `ev` the
    known log2 exposure of each bracket, None where unknown; `reference` the bracket of
    EV 0; `flows`: flow (P, H, W, 2) px, its validity (P, H, W) bool, and pairs (P, 2)
    of frames of the video; `moving` (T, H, W) bool.
    """
    occurring = {int(b) for b in brackets}
    if len(occurring) < 2:
        return None
    samples = matched_samples(video, brackets, len(ev), flows, moving, tuning)
    if not linked(samples, occurring):
        return None
    if reference not in occurring:
        reference = min(occurring)
    fit = debevec(samples, ev, reference)
    return fit if fit.misfit < MAX_MISFIT else None


def matched_samples(
    video: np.ndarray,
    brackets: np.ndarray,
    num_brackets: int,
    flows: tuple[np.ndarray, np.ndarray, np.ndarray],
    moving: np.ndarray,
    tuning: OneExposureTuning = ONE_EXPOSURE_TUNING,
) -> Samples:
    """Recorded values, in several brackets, of pixels at rest on smooth surfaces.

    The pixels are spread over the recorded levels; valid flow finds them in other
    brackets. The arguments are those of `response_from_flow`.
    """
    flow, valid, pairs = flows
    neighborhoods = [smooth(frame, ~mask) for frame, mask in zip(video, moving, strict=True)]
    points_per_frame = max(1, tuning.max_points // len(brackets))
    rng = np.random.default_rng(SEED)
    parts = []
    for i, bracket in enumerate(brackets):
        onward = [k for k, (a, j) in enumerate(pairs) if a == i and brackets[j] != bracket]
        matched = valid[onward].any(0)
        candidates = neighborhoods[i].good & matched
        x, y = spread_over_levels(video[i], candidates, points_per_frame, rng).T
        samples = Samples(
            rgb=np.zeros((len(x), num_brackets, 3)),
            valid=np.zeros((len(x), num_brackets, 3), bool),
            saturated=np.zeros((len(x), num_brackets, 3), bool),
        )
        enter_samples(samples, bracket, neighborhoods[i], y, x, np.ones(len(x), bool))
        for k in onward:
            j = int(pairs[k, 1])
            end_x, end_y, inside = matched_pixels(flow[k], x, y)
            usable = inside & valid[k][y, x] & neighborhoods[j].good[end_y, end_x]
            enter_samples(samples, brackets[j], neighborhoods[j], end_y, end_x, usable)
        parts.append(samples)
    return Samples(
        rgb=np.concatenate([part.rgb for part in parts]),
        valid=np.concatenate([part.valid for part in parts]),
        saturated=np.concatenate([part.saturated for part in parts]),
    )


def matched_pixels(
    flow: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The columns and rows (P,), (P,) to which `flow` moves the pixels `x`, `y` (P,).

    They are rounded and held inside the frame; the third array (P,) bool tells which
    were inside. `flow` is (H, W, 2) px.
    """
    height, width = flow.shape[:2]
    end_x, end_y = np.rint(flow[y, x] + np.stack([x, y], -1)).astype(int).T
    inside = (end_x >= 0) & (end_x < width) & (end_y >= 0) & (end_y < height)
    return end_x.clip(0, width - 1), end_y.clip(0, height - 1), inside


def enter_samples(
    samples: Samples,
    bracket: int,
    neighborhoods: Neighborhoods,
    y: np.ndarray,
    x: np.ndarray,
    usable: np.ndarray,
) -> None:
    """Enter the recorded values at pixels `y`, `x` (P,) for a `bracket`, in place.

    Only where `usable` (P,) bool, and where nothing was entered before.
    """
    entered = (samples.valid | samples.saturated)[:, bracket].any(-1)
    chosen = usable & ~entered
    samples.rgb[chosen, bracket] = neighborhoods.mean[y, x][chosen]
    samples.valid[chosen, bracket] = neighborhoods.unclipped[y, x][chosen]
    samples.saturated[chosen, bracket] = neighborhoods.saturated[y, x][chosen]


def equalize_through_response(
    video: np.ndarray, brackets: np.ndarray, fit: ResponseFit
) -> np.ndarray:
    """`video` (T, H, W, 3), recorded in [0, 1], at one brightness, in [0, 1].

    Each pixel becomes the mean of its recorded values in all brackets (T,) that occur,
    which keeps contrast wherever one of them has some.
    """
    equalized = np.empty(video.shape, np.float32)
    recorded = np.linspace(0, 1, TABLE_SIZE)
    for t, own_bracket in enumerate(brackets):
        for c in range(3):
            exposure = np.interp(recorded, fit.y[c], fit.x)
            images = []
            for bracket in np.unique(brackets):
                gain = 2 ** (fit.ev[bracket] - fit.ev[own_bracket])
                images.append(np.interp(exposure * gain, fit.x, fit.y[c]))
            table = np.mean(images, axis=0)
            equalized[t, ..., c] = np.interp(video[t, ..., c], recorded, table)
    return equalized
