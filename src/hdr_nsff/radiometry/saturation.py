"""At which exposure the channels of a camera saturate, from points that clip."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from hdr_nsff.radiometry.log_curve import HIGH, LN2, LOW, Top, basis, log_exposures
from hdr_nsff.radiometry.samples import Samples


@dataclass(frozen=True)
class SaturationTuning:
    """What shows where a channel saturates (hand-chosen on simulated cameras)."""

    min_points: int = 30  # saturated and unsaturated ones
    # median misfits: points farther off fell into shadow between two frames
    max_misfit: float = 3.0
    # share of the linked values of a channel below the value up to which its curve
    # counts where its saturation is not seen (hand-chosen on recorded clips)
    shown_share: float = 0.9


def saturation(
    samples: Samples,
    curves: np.ndarray,
    log_exposure: np.ndarray,
    tuning: SaturationTuning = SaturationTuning(),
) -> Top:
    """Where channels with `curves` (3, 42) saturate, brackets at `log_exposure` (B,).

    It is the level that best separates saturated from unsaturated recordings of points
    whose exposure is known from a darker bracket. A channel that has too few of either
    kind rises from the highest values that it shows as the median channel does: by
    itself it would be extrapolated, and whites get a color.
    """
    levels, shown = extrapolated(curves), np.ones(3)
    for c in range(3):
        lowest = float(basis(np.array(HIGH)) @ curves[c])
        saturated, unsaturated = levels_from_darker(samples, c, curves[c], log_exposure, tuning)
        if min(len(saturated), len(unsaturated)) < tuning.min_points:
            shown[c] = highest_shown(samples, c, tuning)
        else:
            candidates = np.linspace(lowest - 0.5, levels[c] + 1.0, 301)
            levels[c] = max(separation(saturated, unsaturated, candidates), lowest + 1e-3)
    rises = levels[:, None] - (basis(shown) @ curves.T).T  # (3 curves, 3 starts)
    followed = np.diag(basis(shown) @ curves.T) + np.median(rises, axis=0)
    highest = log_exposures(np.array([HIGH]), curves, shown)[:, 0]
    return Top(np.where(shown < 1, np.maximum(followed, highest), levels), shown)


def own_tops(curves: np.ndarray, top: Top) -> Top:
    """The same where every channel keeps its own of `curves` (3, 42) to the end, as the
    noise of single channels needs it.
    """
    return Top(np.where(top.shown < 1, extrapolated(curves), top.level), np.ones(3))


def extrapolated(curves: np.ndarray) -> np.ndarray:
    """G(1) (3,) by the `curves` (3, 42) themselves, above all that is recorded."""
    return (basis(np.array([HIGH, 1.0])) @ curves.T).max(0)


def highest_shown(samples: Samples, channel: int, tuning: SaturationTuning) -> float:
    """The recorded value below which `shown_share` of a channel's linked ones lie."""
    valid = samples.valid[..., channel]
    linked = samples.rgb[..., channel][valid & (valid.sum(1, keepdims=True) >= 2)]
    return float(np.quantile(linked, tuning.shown_share)) if linked.size else LOW


def separation(saturated: np.ndarray, unsaturated: np.ndarray, candidates: np.ndarray) -> float:
    """The mean of the `candidates` (K,) that put the fewest levels on the wrong side:
    those of saturated recordings (N,) lie above, those of unsaturated (M,) below.
    """
    saturated_below = np.searchsorted(np.sort(saturated), candidates)
    unsaturated_below = np.searchsorted(np.sort(unsaturated), candidates)
    num_wrong = saturated_below + len(unsaturated) - unsaturated_below
    return float(candidates[num_wrong == num_wrong.min()].mean())


def levels_from_darker(
    samples: Samples,
    channel: int,
    curve: np.ndarray,
    log_exposure: np.ndarray,
    tuning: SaturationTuning,
) -> tuple[np.ndarray, np.ndarray]:
    """Log exposures of recordings, predicted from a darker bracket: those of saturated
    (N,) and of unsaturated recordings (M,), without points that fell into shadow.
    """
    valid, is_saturated = samples.valid[..., channel], samples.saturated[..., channel]
    recorded = np.where(valid, basis(samples.rgb[..., channel]) @ curve, np.nan)  # (P, B)
    saturated, unsaturated = [np.zeros(0)], [np.zeros(0)]
    misfits = [np.zeros(0)]
    levels = np.broadcast_to(log_exposure, valid.shape)  # (P, B)
    if samples.offset is not None:
        levels = levels + LN2 * samples.offset
    for dark, light in itertools.permutations(range(valid.shape[1]), 2):
        is_darker = levels[:, dark] < levels[:, light]
        predicted = recorded[:, dark] - levels[:, dark] + levels[:, light]
        both = valid[:, dark] & valid[:, light] & is_darker
        saturated.append(predicted[valid[:, dark] & is_saturated[:, light] & is_darker])
        unsaturated.append(predicted[both])
        misfits.append(np.abs(predicted - recorded[:, light])[both])
    misfit = np.concatenate(misfits)
    if not misfit.size:
        return np.concatenate(saturated), np.zeros(0)
    same_light = misfit <= tuning.max_misfit * np.median(misfit)
    return np.concatenate(saturated), np.concatenate(unsaturated)[same_light]
