"""Linear radiance against the exact one, where that is known.

All views take one scale first, because LDR recordings alone leave the scale free.
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
    """The scales that make predicted and exact radiance comparable, for all views."""

    scale: Tensor  # () factor of predicted radiance
    scales: Tensor  # (3,) the same per channel
    peak: float  # largest exact radiance
    recordable_peak: float  # the same of pixels that at least one exposure records unclipped
    white: float  # luminance that counts as 1000 cd/m^2 in PU21
    flip: tuple[float, float]  # exposure range of HDR-FLIP, log2


def find_gauge(targets: Sequence[Target], radiance: Sequence[Tensor]) -> Gauge | None:
    """One gauge for all views: median ratios on recordable pixels.

    None where no view has exact radiance.
    """
    pairs = [(t, r) for t, r in zip(targets, radiance, strict=True) if t.radiance is not None]
    if not pairs:
        return None
    truths = [exact_of(target) for target, _ in pairs]
    in_range = torch.cat([recordable(target).flatten() for target, _ in pairs])
    predicted = torch.cat([values.reshape(-1, 3) for _, values in pairs])
    exact = torch.cat([values.reshape(-1, 3) for values in truths])
    recorded = exact[in_range] if in_range.any() else exact
    return Gauge(
        scale=metrics.align(predicted, exact, in_range),
        scales=metrics.align(predicted, exact, in_range, per_channel=True),
        peak=float(exact.max()),
        recordable_peak=float(recorded.max()),
        white=metrics.pu21_white(truths),
        flip=metrics.flip_exposures(truths),
    )


VARIANTS = {  # of the mu-law scores: suffix of the name, and of the label
    "": "",
    "_moving": " moving",
    "_recordable": ", recordable pixels",
    "_recordable_moving": " moving, recordable pixels",
    "_per_channel": ", one scale per channel",
    "_per_channel_moving": " moving, one scale per channel",
    "_unaligned": ", unaligned",
    "_unaligned_moving": " moving, unaligned",
}
MU_SCORES = {
    f"mu{mu}{suffix}": [f"μ-law {mu} PSNR{label}, dB", 2]
    for mu in (5000, 50)
    for suffix, label in VARIANTS.items()
}
HDR_SCORES = {  # label, and digits after the point
    **MU_SCORES,
    "pu21": ["PU21 PSNR, dB", 2],
    "pu21_moving": ["PU21 PSNR moving, dB", 2],
    "hdr_flip": ["HDR-FLIP", 4],
    "hdr_flip_moving": ["HDR-FLIP moving", 4],
}


def score_radiance(target: Target, radiance: Tensor, gauge: Gauge) -> dict[str, float]:
    """Linear radiance (H, W, 3) against the exact one; names as in `HDR_SCORES`.

    Empty where the exact one is not known. Normalized by the largest exact radiance
    of all views; `recordable`: over recordable pixels only, normalized by the largest
    of them.
    """
    if target.radiance is None:
        return {}
    exact, moving = exact_of(target), moving_of(target)
    regions: dict[str, Tensor | None] = {"": None}
    if moving is not None:
        regions["_moving"] = moving
    aligned = radiance * gauge.scale
    scores: dict[str, float] = {}
    for mu in (5000, 50):
        scores |= mu_law_scores(target, radiance, gauge, mu, regions)
    for mu in (5000, 50):
        scores |= recordable_scores(target, aligned, gauge, mu, regions)
    flip = metrics.hdr_flip_map(aligned, exact, gauge.flip)
    for suffix, mask in regions.items():
        scores[f"pu21{suffix}"] = metrics.pu21_psnr(aligned, exact, gauge.white, mask)
        if flip is not None:
            values = flip if mask is None else flip[mask]
            scores[f"hdr_flip{suffix}"] = float(values.mean())
    return scores


def mu_law_scores(
    target: Target, radiance: Tensor, gauge: Gauge, mu: int, regions: dict[str, Tensor | None]
) -> dict[str, float]:
    """PSNR after the mu-law, with one scale, one per channel and none, by region."""
    alignments = {
        "": radiance * gauge.scale,
        "_per_channel": radiance * gauge.scales,
        "_unaligned": radiance,
    }
    exact = exact_of(target)
    scores = {}
    for (alignment, values), (suffix, mask) in itertools.product(
        alignments.items(), regions.items()
    ):
        score = metrics.mu_law_psnr(values, exact, gauge.peak, mu, mask)
        scores[f"mu{mu}{alignment}{suffix}"] = score
    return scores


def recordable_scores(
    target: Target, aligned: Tensor, gauge: Gauge, mu: int, regions: dict[str, Tensor | None]
) -> dict[str, float]:
    """PSNR after the mu-law over recordable pixels, by region."""
    in_range = recordable(target)
    scores = {}
    for suffix, mask in regions.items():
        region = in_range if mask is None else in_range & mask
        if region.any():
            peak = gauge.recordable_peak
            score = metrics.mu_law_psnr(aligned, exact_of(target), peak, mu, region)
            scores[f"mu{mu}_recordable{suffix}"] = score
    return scores
