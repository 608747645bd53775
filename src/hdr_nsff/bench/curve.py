"""Quality over training time: what a run was after a part of its training, on a few of
the held-out views, and pictures of those views.

The views are spread evenly over those that the headline is of, so every method on a
scene is asked for the same ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core import io
from hdr_nsff.core.notes import CurvePoint, ShownView
from hdr_nsff.evaluation.evaluate import headline_targets, mean_of
from hdr_nsff.evaluation.predictions import predict, radiance_of, recordings
from hdr_nsff.evaluation.scores.radiance import find_gauge, score_radiance
from hdr_nsff.evaluation.scores.rgb import score_rgb
from hdr_nsff.evaluation.targets import Target, moving_of
from hdr_nsff.training.run_folder import Run, snapshots

SHARES = (0.125, 0.25, 0.5)  # of the training; the end is measured anyway
SCORES = ("psnr", "psnr_moving", "ssim", "ssim_moving", "mu5000", "mu5000_moving")


def curve_of(run: Run, truth: Path | None, count: int) -> tuple[list[CurvePoint], list[ShownView]]:
    """The curve of a trained and evaluated run over `count` views, and those views;
    pictures of them go to RUN/shown.
    """
    targets = spread(headline_targets(run, truth), count)
    curve = []
    for share, file in snapshots(run.folder).items():
        then = Run.open(run.folder, run.config.device, at=file)
        place = run.folder / "snapshots" / file.stem
        files = predict(
            then,
            {t.name: t.view for t in targets},
            place,
            f"views after {share:.0%} of the training",
            False,
        )
        curve.append(point(then, share, scores(then, targets, files)))
    final = scores(run, targets, [run.folder / "evaluation" / f"{t.name}.exr" for t in targets])
    curve.append(point(run, 1.0, final))
    for target in targets:
        show(run, target)
    names = zip(targets, final, strict=True)
    return curve, [
        ShownView(name=t.name, time=t.view.time, scores=kept(of_view)) for t, of_view in names
    ]


def spread(targets: Sequence[Target], count: int) -> list[Target]:
    """At most `count` of them, evenly from the first to the last."""
    places = np.linspace(0, len(targets) - 1, min(count, len(targets))).round().astype(int)
    return [targets[i] for i in places]


def scores(run: Run, targets: Sequence[Target], files: Sequence[Path]) -> list[dict[str, Any]]:
    """The scores of predictions, view by view; radiance after one scale for these
    views.
    """
    radiance = [radiance_of(f) for f in files]
    gauge = find_gauge(targets, radiance)
    found = []
    for target, predicted in zip(map(of_its_exposure, targets), radiance, strict=True):
        of_view = score_rgb(run, target, predicted, recordings(run, target, predicted), None)
        found.append(of_view | (score_radiance(target, predicted, gauge) if gauge else {}))
    return found


def of_its_exposure(target: Target) -> Target:
    """The target at its own exposure alone, which is all that is shown."""
    return replace(target, rgb={target.bracket: target.rgb[target.bracket]}, novel={})


def kept(of_view: dict[str, Any]) -> dict[str, float]:
    """Of all scores those that are shown."""
    return {k: of_view[k] for k in SCORES if of_view.get(k) is not None}


def point(run: Run, share: float, views: Sequence[dict[str, Any]]) -> CurvePoint:
    """A point of the curve: means over the views."""
    return CurvePoint(
        share=share, step=run.step, seconds=round(run.seconds, 3), scores=kept(mean_of(views))
    )


def show(run: Run, target: Target) -> None:
    """Write RUN/shown/NAME_run.png, NAME_truth.png and, where something moves,
    NAME_moving.png, as recorded at the view's own exposure.
    """
    folder, moving = run.folder / "shown", moving_of(target)
    predicted = radiance_of(run.folder / "evaluation" / f"{target.name}.exr")
    io.write_png(
        folder / f"{target.name}_run.png",
        recordings(run, of_its_exposure(target), predicted)[target.bracket].numpy(),
    )
    io.write_png(folder / f"{target.name}_truth.png", target.rgb[target.bracket].numpy())
    if moving is not None:
        io.write_png(folder / f"{target.name}_moving.png", moving.numpy())
