"""Recorded rgb against what the camera would record, or did."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from hdr_nsff.evaluation.predictions import developed
from hdr_nsff.evaluation.targets import Target, moving_of
from hdr_nsff.maths import metrics
from hdr_nsff.training.run_folder import Run

SMALLEST_LPIPS = 64  # pixels


def score_rgb(
    run: Run,
    target: Target,
    radiance: Tensor,
    at: dict[int, Tensor],
    perceptual: metrics.Lpips | None,
) -> dict[str, float]:
    """What is recorded `at` each bracket, {bracket: (H, W, 3)}: at the view's own
    exposure, and PSNR averaged over all exposures of the clip at which the view is
    known, and over those that no frame of the clip has; moving-only numbers where there
    is a mask with something in it.
    """
    moving = moving_of(target)
    own, truth = at[target.bracket], target.rgb[target.bracket]
    scores: dict[str, float] = {"psnr": metrics.psnr(own, truth), "ssim": metrics.ssim(own, truth)}
    if moving is not None:
        scores |= {
            "psnr_moving": metrics.psnr(own, truth, moving),
            "ssim_moving": metrics.ssim(own, truth, moving),
        }
    if perceptual is not None and min(own.shape[:2]) >= SMALLEST_LPIPS:
        scores["lpips"] = perceptual(own, truth)
        if moving is not None:
            scores["lpips_moving"] = perceptual.on_mask(own, truth, moving)
    every = [(at[b], rgb) for b, rgb in target.rgb.items()]
    novel = list(
        zip(
            developed(run, target, radiance, list(target.novel)), target.novel.values(), strict=True
        )
    )
    for name, pairs in (("all_exposures", every), ("novel_exposures", novel)):
        if pairs:
            scores[f"psnr_{name}"] = float(np.mean([metrics.psnr(p, t) for p, t in pairs]))
            if moving is not None:
                scores[f"psnr_moving_{name}"] = float(
                    np.mean([metrics.psnr(p, t, moving) for p, t in pairs])
                )
    return scores
