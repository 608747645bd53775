"""Linear radiance against the exact one, where that is known, after one scale for all
views: LDR recordings alone leave it free.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.evaluation.targets import Target, exact_of, moving_of, recordable
from hdr_nsff.maths import metrics


@dataclass(frozen=True)
class Gauge:
    """What makes radiance of the run and exact radiance comparable, for all views at
    once.
    """

    scale: Tensor  # () by which predicted radiance is multiplied
    scales: Tensor  # (3,) the same per channel
    peak: float  # largest exact radiance
    recordable_peak: float  # the same of pixels that at least one exposure records unclipped
    white: float  # luminance that PU21 takes for 1000 cd/m^2
    flip: tuple[float, float]  # exposure range of HDR-FLIP, log2


def find_gauge(targets: Sequence[Target], radiance: Sequence[Tensor]) -> Gauge | None:
    """One gauge for all views: median ratios on recordable pixels. None where no view
    has exact radiance.
    """
    pairs = [(t, r) for t, r in zip(targets, radiance, strict=True) if t.radiance is not None]
    if not pairs:
        return None
    truths = [exact_of(t) for t, _ in pairs]
    known = torch.cat([recordable(t).flatten() for t, _ in pairs])
    predicted, exact = (
        torch.cat([x.reshape(-1, 3) for x in maps]) for maps in ([r for _, r in pairs], truths)
    )
    return Gauge(
        scale=metrics.align(predicted, exact, known),
        scales=metrics.align(predicted, exact, known, per_channel=True),
        peak=float(exact.max()),
        recordable_peak=float(exact[known].max() if known.any() else exact.max()),
        white=metrics.pu21_white(truths),
        flip=metrics.flip_exposures(truths),
    )


HDR_SCORES = {  # what they are called, and digits after the point
    f"mu{mu}{key}": [f"μ-law {mu} PSNR{label}, dB", 2]
    for mu in (5000, 50)
    for key, label in {
        "": "",
        "_moving": " moving",
        "_recordable": ", recordable pixels",
        "_recordable_moving": " moving, recordable pixels",
        "_per_channel": ", one scale per channel",
        "_per_channel_moving": " moving, one scale per channel",
        "_unaligned": ", unaligned",
        "_unaligned_moving": " moving, unaligned",
    }.items()
} | {
    "pu21": ["PU21 PSNR, dB", 2],
    "pu21_moving": ["PU21 PSNR moving, dB", 2],
    "hdr_flip": ["HDR-FLIP", 4],
    "hdr_flip_moving": ["HDR-FLIP moving", 4],
}


def score_radiance(target: Target, radiance: Tensor, gauge: Gauge) -> dict[str, float]:
    """Linear radiance (H, W, 3) against the exact one; names as in `HDR_SCORES`.
    Normalized by the largest exact radiance of all views; `recordable`: over recordable
    pixels only, normalized by the largest of them. Empty where the exact one is not
    known.
    """
    if target.radiance is None:
        return {}
    exact, known, moving = exact_of(target), recordable(target), moving_of(target)
    regions = {"": None} | ({} if moving is None else {"_moving": moving})
    ways = {
        "": radiance * gauge.scale,
        "_per_channel": radiance * gauge.scales,
        "_unaligned": radiance,
    }
    scores: dict[str, float] = {}
    for mu, (way, values), (where, mask) in itertools.product(
        (5000, 50), ways.items(), regions.items()
    ):
        scores[f"mu{mu}{way}{where}"] = metrics.mu_law_psnr(values, exact, gauge.peak, mu, mask)
    for mu, (where, mask) in itertools.product((5000, 50), regions.items()):
        region = known if mask is None else known & mask
        if region.any():
            scores[f"mu{mu}_recordable{where}"] = metrics.mu_law_psnr(
                ways[""], exact, gauge.recordable_peak, mu, region
            )
    visible = metrics.hdr_flip_map(ways[""], exact, gauge.flip)
    for where, mask in regions.items():
        scores[f"pu21{where}"] = metrics.pu21_psnr(ways[""], exact, gauge.white, mask)
        if visible is not None:
            scores[f"hdr_flip{where}"] = float(
                visible.mean() if mask is None else visible[mask].mean()
            )
    return scores
