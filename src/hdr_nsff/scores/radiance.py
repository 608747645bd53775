"""Linear radiance against the exact one, after one scale for all views (METHOD.md 7): LDR recordings alone leave it free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff import metrics
from hdr_nsff.scores.targets import Target, exact_of, moving_of, recordable


@dataclass(frozen=True)
class Gauge:
    """What makes radiance of the run and exact radiance comparable, for all views at once."""

    scale: Tensor  # () by which predicted radiance is multiplied
    scales: Tensor  # (3,) the same per channel
    peak: float  # largest exact radiance
    recordable_peak: float  # the same of pixels that at least one exposure records unclipped
    flip: tuple[float, float]  # exposure range of HDR-FLIP, log2


def find_gauge(targets: Sequence[Target], radiance: Sequence[Tensor]) -> Gauge:
    """One gauge for all views: median ratios on recordable pixels."""
    truths = [exact_of(t) for t in targets]
    known = torch.cat([recordable(t).flatten() for t in targets])
    predicted, exact = (torch.cat([x.reshape(-1, 3) for x in maps]) for maps in (radiance, truths))
    return Gauge(
        scale=metrics.align(predicted, exact, known),
        scales=metrics.align(predicted, exact, known, per_channel=True),
        peak=float(exact.max()),
        recordable_peak=float(exact[known].max() if known.any() else exact.max()),
        flip=metrics.flip_exposures(truths),
    )


HDR_SCORES = {  # what they are called, and digits after the point
    "mu5000": ["μ-law 5000 PSNR, dB", 2],
    "mu5000_moving": ["μ-law 5000 moving, dB", 2],
    "mu5000_recordable": ["μ-law 5000, recordable pixels, dB", 2],
    "mu5000_per_channel": ["μ-law 5000, one scale per channel, dB", 2],
    "mu5000_unaligned": ["μ-law 5000, unaligned, dB", 2],
    "mu50": ["μ-law 50 PSNR, dB", 2],
    "mu50_moving": ["μ-law 50 moving, dB", 2],
    "mu50_recordable": ["μ-law 50, recordable pixels, dB", 2],
    "mu50_per_channel": ["μ-law 50, one scale per channel, dB", 2],
    "mu50_unaligned": ["μ-law 50, unaligned, dB", 2],
    "hdr_flip": ["HDR-FLIP", 4],
}


def score_radiance(target: Target, radiance: Tensor, gauge: Gauge) -> dict[str, float | None]:
    """Linear radiance (H, W, 3) against the exact one; names as in `HDR_SCORES`. Normalised by the largest exact radiance of all
    views; `recordable`: over recordable pixels only, normalised by the largest of them."""
    exact, known, moving = exact_of(target), recordable(target), moving_of(target)
    aligned = radiance * gauge.scale
    scores: dict[str, float | None] = {}
    for mu in (5000, 50):
        scores[f"mu{mu}"] = metrics.mu_law_psnr(aligned, exact, gauge.peak, mu)
        scores[f"mu{mu}_per_channel"] = metrics.mu_law_psnr(radiance * gauge.scales, exact, gauge.peak, mu)
        scores[f"mu{mu}_unaligned"] = metrics.mu_law_psnr(radiance, exact, gauge.peak, mu)
        if moving is not None:
            scores[f"mu{mu}_moving"] = metrics.mu_law_psnr(aligned, exact, gauge.peak, mu, moving)
        if known.any():
            scores[f"mu{mu}_recordable"] = metrics.mu_law_psnr(aligned, exact, gauge.recordable_peak, mu, known)
    scores["hdr_flip"] = metrics.hdr_flip(aligned, exact, gauge.flip)
    return scores
