"""Recorded rgb against the recordings of the true camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from hdr_nsff.evaluation.predictions import recordings_at
from hdr_nsff.evaluation.targets import Target, moving_of
from hdr_nsff.maths import metrics
from hdr_nsff.training.run_folder import Run

# Pixels a side: smaller pictures leave fewer than 3 x 3 cells in AlexNet's last layer
# (hand-chosen).
MIN_LPIPS_SIDE = 64


def score_rgb(
    run: Run,
    target: Target,
    radiance: Tensor,
    recorded: dict[int, Tensor],
    perceptual: metrics.Lpips | None,
) -> dict[str, float]:
    """Scores of the recordings {bracket: (H, W, 3)} in [0, 1] of predicted `radiance`.

    At the view's own exposure PSNR, SSIM and, with `perceptual`, LPIPS; and PSNR
    averaged over all exposures of the clip at which the view is known, and over those
    that no frame of the clip has. Moving-only scores where a part of the view moves.
    """
    moving = moving_of(target)
    own, truth = recorded[target.bracket], target.rgb[target.bracket]
    scores: dict[str, float] = {"psnr": metrics.psnr(own, truth), "ssim": metrics.ssim(own, truth)}
    if moving is not None:
        scores["psnr_moving"] = metrics.psnr(own, truth, moving)
        scores["ssim_moving"] = metrics.ssim(own, truth, moving)
    if perceptual is not None and min(own.shape[:2]) >= MIN_LPIPS_SIDE:
        scores["lpips"] = perceptual(own, truth)
        if moving is not None:
            scores["lpips_moving"] = perceptual.on_mask(own, truth, moving)
    novel = recordings_at(run, target, radiance, list(target.novel))
    pairs = {
        "all_exposures": [(recorded[bracket], rgb) for bracket, rgb in target.rgb.items()],
        "novel_exposures": list(zip(novel, target.novel.values(), strict=True)),
    }
    for name, of_exposures in pairs.items():
        if of_exposures:
            scores[f"psnr_{name}"] = mean_psnr(of_exposures, None)
            if moving is not None:
                scores[f"psnr_moving_{name}"] = mean_psnr(of_exposures, moving)
    return scores


def mean_psnr(pairs: Sequence[tuple[Tensor, Tensor]], mask: Tensor | None) -> float:
    """The mean PSNR in dB of pairs of pictures (H, W, 3) over a mask (H, W)."""
    return float(np.mean([metrics.psnr(own, truth, mask) for own, truth in pairs]))
