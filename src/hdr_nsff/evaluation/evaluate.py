"""A run against what it has never seen: held-out views with exact radiance or as
recorded (a truth folder), else held-out frames of the clip, else, named as such, its
own training frames. Writes `metrics.json` and pictures of prediction | truth | error.

Recorded rgb is compared at the view's own exposure (the headline) and at all exposures
of the clip; radiance after one scale for all views: LDR recordings alone leave it free.
Moving-only numbers average over the moving mask. Every score has its definition, range
and source in docs/metrics.md and at the function that computes it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
import tyro
from torch import Tensor

from hdr_nsff.core import io
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.evaluation.predictions import predict, radiance_of, recordings
from hdr_nsff.evaluation.scores.camera import camera_errors, trajectory_errors
from hdr_nsff.evaluation.scores.geometry import GEOMETRY_SCORES, Units, find_units, score_geometry
from hdr_nsff.evaluation.scores.radiance import HDR_SCORES, Gauge, find_gauge, score_radiance
from hdr_nsff.evaluation.scores.rgb import SMALLEST_LPIPS, score_rgb
from hdr_nsff.evaluation.scores.stability import stability
from hdr_nsff.evaluation.targets import Target, choose_targets, world_scale
from hdr_nsff.maths import color, metrics
from hdr_nsff.priors.weights import find
from hdr_nsff.scene.manifest import Protocol
from hdr_nsff.scene.truth import Truth
from hdr_nsff.training.run_folder import Run


@dataclass(frozen=True)
class EvaluateConfig:
    """Measure a run on held-out views; writes RUN/metrics.json and RUN/evaluation/."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    truth: Path | None = None
    """Truth folder, as `synth`, `reexpose`, and `prepare` of a public data set write
    it; default: the frames that `prepare` held out.
    """
    lpips: str | None = None
    """LPIPS: a file with AlexNet weights, or `hub` for those that `hdr-nsff weights`
    lists, downloaded where they are not here yet.
    """
    device: str = "auto"
    """auto, cpu or cuda."""


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """The verb: what `metrics.json` holds."""
    with io.writing_to(config.run), lock_output(config.run / "evaluation"):
        return evaluate_run(Run.open(config.run, config.device), config.truth, config.lpips)


def views_of_clip(folder: Path) -> list[int]:
    """Which frames of the clip the views of a truth folder are, for those who keep them
    out of training; none where any view is of another place or time. InputError where
    `folder` is no truth folder.
    """
    views = Truth.open(folder).views
    own = all(v.c2w is None and v.time == v.anchor for v in views)
    return sorted({v.anchor for v in views}) if own else []


def evaluate_run(run: Run, truth_folder: Path | None, lpips: str | None = None) -> dict[str, Any]:
    """Measure, write `metrics.json` and `evaluation/*.png` into the run folder, and
    give back what was written.
    """
    start = time.monotonic()
    perceptual = (
        metrics.Lpips([find("alexnet"), find("lpips")] if lpips == "hub" else lpips)
        if lpips
        else None
    )
    truth = Truth.open(truth_folder) if truth_folder else None
    kind, targets, notes = choose_targets(run, truth, truth_folder)
    say(f"evaluating on {len(targets)} {kind}")
    folder, views = run.folder / "evaluation", {t.name: t.view for t in targets}
    with_motion = any(t.geometry is not None for t in targets)
    files = predict(run, views, folder, "rendering held-out views", with_motion)
    radiance = [radiance_of(f) for f in files]
    gauge = find_gauge(targets, radiance)
    units = find_units(targets, files, world_scale(run, truth)) if truth else None
    known = [t.radiance.reshape(-1, 3) for t in targets if t.radiance is not None]
    scores, exposure = [], color.auto_exposure(torch.cat(known)) if known else 1.0
    for target, predicted, file in zip(targets, track(radiance, "measuring"), files, strict=True):
        at = recordings(run, target, predicted)
        of_view = describe(run, target) | score_rgb(run, target, predicted, at, perceptual)
        of_view |= score_radiance(target, predicted, gauge) if gauge else {}
        scores.append(of_view | (score_geometry(target, file, units) if units else {}))
        write_picture(target, predicted, at[target.bracket], gauge, exposure, folder)
    result: dict[str, Any] = {"step": run.step, "kind": kind, "notes": notes} | summary(
        run, scores, notes
    )
    result |= told_of_radiance(gauge) | told_of_geometry(units)
    if truth is not None:
        result |= {
            "camera": camera_errors(run, truth),
            "poses": trajectory_errors(run, truth, targets),
        }
        notes += absences(result["headline"], gauge, units)
    result |= {"stability": stability(run, folder / "path"), "lpips": lpips_note(lpips, scores)}
    if not result["stability"]:
        notes.append("HDR-TAE: absent, the scene has no optical flow between training frames")
    result |= {"views": scores, "seconds": round(time.monotonic() - start, 2)}
    io.write_json(run.folder / "metrics.json", result)
    tell(result)
    return result


def describe(run: Run, target: Target) -> dict[str, Any]:
    """What a view is."""
    protocol = target.protocol(run.scene.times.tolist())
    return {
        "name": target.name,
        "group": target.group,
        "protocol": protocol,
        "time": target.view.time,
        "bracket": target.bracket,
    }


NOT_SCORES = ("name", "group", "protocol", "time", "bracket")


def summary(run: Run, views: Sequence[dict[str, Any]], notes: list[str]) -> dict[str, Any]:
    """Means of the views: `headline`, `groups`, `protocols`. The headline is that of
    the protocol the scene was prepared for, else of all views the run was not trained
    on, else of all.
    """
    protocol = run.scene.manifest.protocol
    if protocol is not None and not any(v["protocol"] == protocol for v in views):
        notes.append(
            f"no view to be compared belongs to the protocol {protocol} that the scene was prepared for; the headline is of others"
        )
    return {
        "protocol": protocol,
        "headline": mean_of(headline_views(run, views)),
        "groups": {
            g: mean_of([v for v in views if v["group"] == g])
            for g in dict.fromkeys(v["group"] for v in views)
        },
        "protocols": {
            p: mean_of([v for v in views if v["protocol"] == p])
            for p in get_args(Protocol)
            if any(v["protocol"] == p for v in views)
        },
    }


def headline_views(run: Run, views: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those of the described views that the headline is of."""
    protocol = run.scene.manifest.protocol
    wanted = [
        v
        for v in views
        if v["protocol"] is not None and v["protocol"] == (protocol or v["protocol"])
    ]
    return wanted or [v for v in views if v["protocol"] is not None] or list(views)


def headline_targets(run: Run, truth_folder: Path | None) -> list[Target]:
    """The views that the headline is of: the same, in the same order, for every run on
    a scene.
    """
    truth = Truth.open(truth_folder) if truth_folder else None
    targets = choose_targets(run, truth, truth_folder)[1]
    names = {v["name"] for v in headline_views(run, [describe(run, t) for t in targets])}
    return [t for t in targets if t.name in names]


def told_of_radiance(gauge: Gauge | None) -> dict[str, Any]:
    """What belongs beside the scores of radiance."""
    if gauge is None:
        return {}
    return {
        "hdr_scores": HDR_SCORES,
        "scale": float(gauge.scale),
        "scale_per_channel": gauge.scales.tolist(),
        "peak": gauge.peak,
        "recordable_peak": gauge.recordable_peak,
        "pu21": {"white": gauge.white, "nits": metrics.PU21_NITS},
        "flip_exposures": list(gauge.flip),
    }


def told_of_geometry(units: Units | None) -> dict[str, Any]:
    """What belongs beside the scores of depth and motion."""
    if units is None:
        return {}
    return {
        "geometry_scores": GEOMETRY_SCORES,
        "depth_scale": units.depth,
        "world_scale": units.world,
    }


def absences(headline: dict[str, Any], gauge: Gauge | None, units: Units | None) -> list[str]:
    """Sentences about scores that a truth folder could have, and this one or this run
    has not.
    """
    notes = []
    if gauge is None:
        notes.append("radiance: absent, this truth folder holds what a camera recorded alone")
    elif "hdr_flip" not in headline:
        notes.append(
            "HDR-FLIP: absent, flip-evaluator is not installed (`pip install flip-evaluator`)"
        )
    if units is None:
        notes.append("depth and motion: absent, this truth folder holds none (`synth` writes them)")
    elif "flow_epe" not in headline:
        notes.append("motion: absent, this field tells no scene flow")
    elif units.world is None:
        notes.append("scene flow in three dimensions: absent, the estimated cameras fix no scale")
    return notes


def lpips_note(weights: str | None, views: Sequence[dict[str, Any]]) -> str:
    """What there is to say about LPIPS."""
    if weights is None:
        return "absent; give --lpips FILE (AlexNet weights) or --lpips hub"
    return (
        f"AlexNet v0.1, {weights}"
        if "lpips" in views[0]
        else f"absent; the pictures are smaller than {SMALLEST_LPIPS} pixels"
    )


def tell(result: dict[str, Any]) -> None:
    """The headline for the person at the terminal."""
    h = result["headline"]
    names = (
        ("psnr", "PSNR", "dB"),
        ("psnr_moving", "moving only", "dB"),
        ("ssim", "SSIM", ""),
        ("mu5000", "HDR mu-law(5000)", "dB"),
    )
    say(
        "; ".join(
            f"{label} {h[key]:.{3 if key == 'ssim' else 2}f} {unit}".rstrip()
            for key, label, unit in names
            if key in h
        )
    )


def mean_of(views: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means of every score over the views that have it, and their number."""
    names = dict.fromkeys(k for v in views for k in v if k not in NOT_SCORES)
    means = {k: [v[k] for v in views if v.get(k) is not None] for k in names}
    return {"views": len(views)} | {k: float(np.mean(x)) for k, x in means.items() if x}


def write_picture(
    target: Target,
    predicted: Tensor,
    own: Tensor,
    gauge: Gauge | None,
    exposure: float,
    folder: Path,
) -> None:
    """Prediction | truth | 4 x error, as recorded (`own`) and, where the radiance is
    known, tone-mapped for a display at `exposure`.
    """
    pairs = [(own, target.rgb[target.bracket])]
    if gauge is not None and target.radiance is not None:
        pairs.append(
            (
                color.display(predicted * gauge.scale, exposure),
                color.display(target.radiance, exposure),
            )
        )
    rows = [[p.numpy(), t.numpy(), (4 * (p - t).abs()).clip(0, 1).numpy()] for p, t in pairs]
    io.write_png(folder / f"{target.name}.png", io.contact_sheet(rows))
