"""Quality over training time, on a few of the held-out views.

The snapshots of a run are scored, and pictures of the views are kept. The views are
spread evenly over those of the headline, so every method on a scene is measured on the
same ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from hdr_nsff.core.images import write_png
from hdr_nsff.core.notes import CurvePoint, ShownView
from hdr_nsff.evaluation.evaluate import headline_targets, mean_of
from hdr_nsff.evaluation.predictions import predict, radiance_of, recordings
from hdr_nsff.evaluation.scores.radiance import find_gauge, score_radiance
from hdr_nsff.evaluation.scores.rgb import score_rgb
from hdr_nsff.evaluation.targets import Target, moving_of
from hdr_nsff.training.run_folder import Run, snapshots

SHARES = (0.125, 0.25, 0.5, 0.8)  # of the training; its end is measured anyway
CURVE_SCORES = ("psnr", "psnr_moving", "ssim", "ssim_moving", "mu5000", "mu5000_moving")

Scores = dict[str, Any]


def curve_of(run: Run, truth: Path | None, count: int) -> tuple[list[CurvePoint], list[ShownView]]:
    """The curve of a trained and evaluated run over `count` views, and those views.

    Pictures of the views go to RUN/shown.
    """
    targets = spread(headline_targets(run, truth), count)
    curve = []
    for share, file in snapshots(run.folder).items():
        snapshot = Run.open(run.folder, run.config.device, at=file)
        scores = score_views(snapshot, targets, predict_snapshot(snapshot, targets, share, file))
        curve.append(curve_point(snapshot, share, scores))
    radiance = [radiance_of(evaluation_file(run, target)) for target in targets]
    final = score_views(run, targets, radiance)
    curve.append(curve_point(run, 1.0, final))
    shown = []
    for target, scores_of_view in zip(targets, final, strict=True):
        write_shown(run, target)
        scores_shown = curve_scores(scores_of_view)
        shown.append(ShownView(name=target.name, time=target.view.time, scores=scores_shown))
    return curve, shown


def spread(targets: Sequence[Target], count: int) -> list[Target]:
    """At most `count` of them, evenly from the first to the last."""
    positions = np.linspace(0, len(targets) - 1, min(count, len(targets)))
    return [targets[i] for i in positions.round().astype(int)]


def predict_snapshot(
    snapshot: Run, targets: Sequence[Target], share: float, file: Path
) -> list[Tensor]:
    """Radiance (H, W, 3) of every view as the snapshot in `file` renders it."""
    views = {target.name: target.view for target in targets}
    folder = snapshot.folder / "snapshots" / file.stem
    description = f"views after {share:.0%} of the training"
    files = predict(snapshot, views, folder, description, motion=False)
    return [radiance_of(f) for f in files]


def evaluation_file(run: Run, target: Target) -> Path:
    """The prediction that `evaluate` has kept."""
    return run.folder / "evaluation" / f"{target.name}.exr"


def score_views(run: Run, targets: Sequence[Target], radiance: Sequence[Tensor]) -> list[Scores]:
    """The scores of predictions, view by view; radiance takes one scale for all."""
    gauge = find_gauge(targets, radiance)
    scores = []
    for target, predicted in zip(targets, radiance, strict=True):
        own = at_own_exposure(target)
        of_view: Scores = score_rgb(run, own, predicted, recordings(run, own, predicted), None)
        if gauge is not None:
            of_view |= score_radiance(own, predicted, gauge)
        scores.append(of_view)
    return scores


def at_own_exposure(target: Target) -> Target:
    """The target at its own exposure alone, which is the one that is shown."""
    return replace(target, rgb={target.bracket: target.rgb[target.bracket]}, novel={})


def curve_scores(scores: Scores) -> dict[str, float]:
    """Of all scores those that the page shows."""
    return {name: scores[name] for name in CURVE_SCORES if scores.get(name) is not None}


def curve_point(run: Run, share: float, views: Sequence[Scores]) -> CurvePoint:
    """A point of the curve: means over the views."""
    scores = curve_scores(mean_of(views))
    return CurvePoint(share=share, step=run.step, seconds=round(run.seconds, 3), scores=scores)


def write_shown(run: Run, target: Target) -> None:
    """Write pictures of a view, as recorded at its own exposure, into RUN/shown.

    NAME_run.png, NAME_truth.png and, where some pixels move, NAME_moving.png.
    """
    folder = run.folder / "shown"
    radiance = radiance_of(evaluation_file(run, target))
    own = recordings(run, at_own_exposure(target), radiance)[target.bracket]
    write_png(folder / f"{target.name}_run.png", own.numpy())
    write_png(folder / f"{target.name}_truth.png", target.rgb[target.bracket].numpy())
    moving = moving_of(target)
    if moving is not None:
        write_png(folder / f"{target.name}_moving.png", moving.numpy())
