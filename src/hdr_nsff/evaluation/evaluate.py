"""The verb `evaluate`: a run against views it was not trained on.

The views are those of a truth folder, with exact radiance or as recorded, else held-out
frames of the clip, else, named as such, training frames. The results are `metrics.json`
and pictures of prediction | truth | error.

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

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import contact_sheet, write_png
from hdr_nsff.core.io import write_json, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.evaluation.predictions import predict, radiance_of, recordings
from hdr_nsff.evaluation.scores.camera import camera_errors, trajectory_errors
from hdr_nsff.evaluation.scores.geometry import GEOMETRY_SCORES, Units, find_units, score_geometry
from hdr_nsff.evaluation.scores.radiance import HDR_SCORES, Gauge, find_gauge, score_radiance
from hdr_nsff.evaluation.scores.rgb import MIN_LPIPS_SIDE, score_rgb
from hdr_nsff.evaluation.scores.stability import stability
from hdr_nsff.evaluation.targets import Target, choose_targets, world_scale
from hdr_nsff.maths import color, metrics
from hdr_nsff.priors.weights import find
from hdr_nsff.scene.manifest import Protocol
from hdr_nsff.scene.truth import Truth
from hdr_nsff.training.run_folder import Run

ERROR_GAIN = 4  # of the pictures of errors
NOT_SCORES = ("name", "group", "protocol", "time", "bracket")


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
    """The verb: the content of `metrics.json`."""
    with writing_to(config.run), lock_output(config.run / "evaluation"):
        return evaluate_run(Run.open(config.run, config.device), config.truth, config.lpips)


def views_of_clip(folder: Path) -> list[int]:
    """The frames of the clip that the views of a truth folder are, by index.

    They are to be kept out of training. None where any view is of another place or
    time. InputError where `folder` is no truth folder.
    """
    views = Truth.open(folder).views
    own = all(v.c2w is None and v.time == v.anchor for v in views)
    return sorted({v.anchor for v in views}) if own else []


def evaluate_run(run: Run, truth_folder: Path | None, lpips: str | None = None) -> dict[str, Any]:
    """Measure a run; return and write the content of `metrics.json`.

    Pictures of the comparisons go to `evaluation/` in the run folder.
    """
    start = time.monotonic()
    perceptual = load_lpips(lpips)
    truth = Truth.open(truth_folder) if truth_folder else None
    kind, targets, notes = choose_targets(run, truth, truth_folder)
    say(f"evaluating on {len(targets)} {kind}")
    folder = run.folder / "evaluation"
    views = {t.name: t.view for t in targets}
    with_motion = any(t.geometry is not None for t in targets)
    files = predict(run, views, folder, "rendering held-out views", with_motion)
    radiance = [radiance_of(f) for f in files]
    gauge = find_gauge(targets, radiance)
    units = find_units(targets, files, world_scale(run, truth)) if truth else None
    exposure = exposure_of(targets)
    scores = []
    for target, predicted, file in zip(targets, track(radiance, "measuring"), files, strict=True):
        at_brackets = recordings(run, target, predicted)
        of_view = describe_view(run, target)
        of_view |= score_rgb(run, target, predicted, at_brackets, perceptual)
        if gauge is not None:
            of_view |= score_radiance(target, predicted, gauge)
        if units is not None:
            of_view |= score_geometry(target, file, units)
        scores.append(of_view)
        write_picture(target, predicted, at_brackets[target.bracket], gauge, exposure, folder)
    result: dict[str, Any] = {"step": run.step, "kind": kind, "notes": notes}
    result |= summarize(run, scores, notes)
    result |= describe_radiance(gauge) | describe_geometry(units)
    if truth is not None:
        result["camera"] = camera_errors(run, truth)
        result["poses"] = trajectory_errors(run, truth, targets)
        notes += absences(result["headline"], gauge, units)
    result["stability"] = stability(run, folder / "path")
    if not result["stability"]:
        notes.append("HDR-TAE: absent, the scene has no optical flow between training frames")
    result["lpips"] = lpips_note(lpips, scores)
    result["views"] = scores
    result["seconds"] = round(time.monotonic() - start, 2)
    write_json(run.folder / "metrics.json", result)
    report_headline(result["headline"])
    return result


def load_lpips(weights: str | None) -> metrics.Lpips | None:
    """LPIPS with the weights of a file or of the hub; None without weights."""
    if not weights:
        return None
    if weights == "hub":
        return metrics.Lpips([find("alexnet"), find("lpips")])
    try:
        return metrics.Lpips(weights)
    except InputError as error:
        advice = "give a file with AlexNet weights, or `hub`"
        raise InputError(f"--lpips {error}; {advice}") from error


def exposure_of(targets: Sequence[Target]) -> float:
    """The display exposure of the exact radiance of all views; 1 if there is none."""
    known = [t.radiance.reshape(-1, 3) for t in targets if t.radiance is not None]
    return color.auto_exposure(torch.cat(known)) if known else 1.0


def describe_view(run: Run, target: Target) -> dict[str, Any]:
    """The entries of a view in `metrics.json` that are no scores."""
    return {
        "name": target.name,
        "group": target.group,
        "protocol": target.protocol(run.scene.times.tolist()),
        "time": target.view.time,
        "bracket": target.bracket,
    }


def summarize(run: Run, views: Sequence[dict[str, Any]], notes: list[str]) -> dict[str, Any]:
    """Means of the views: `headline`, `groups`, `protocols`.

    The headline is that of the protocol the scene was prepared for, else of all views
    the run was not trained on, else of all. A sentence about a protocol without views
    is appended to `notes`.
    """
    protocol = run.scene.manifest.protocol
    if protocol is not None and not any(v["protocol"] == protocol for v in views):
        problem = f"no view belongs to the protocol {protocol} that the scene was prepared for"
        notes.append(f"{problem}; the headline is of others")
    groups = {}
    for group in dict.fromkeys(v["group"] for v in views):
        groups[group] = mean_of([v for v in views if v["group"] == group])
    protocols = {}
    for name in get_args(Protocol):
        members = [v for v in views if v["protocol"] == name]
        if members:
            protocols[name] = mean_of(members)
    headline = mean_of(headline_views(run, views))
    return {"protocol": protocol, "headline": headline, "groups": groups, "protocols": protocols}


def headline_views(run: Run, views: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The views, as `describe_view` describes them, that the headline averages."""
    held_out = [v for v in views if v["protocol"] is not None]
    protocol = run.scene.manifest.protocol
    if protocol is None:
        return held_out or list(views)
    wanted = [v for v in held_out if v["protocol"] == protocol]
    return wanted or held_out or list(views)


def headline_targets(run: Run, truth_folder: Path | None) -> list[Target]:
    """The views that the headline averages.

    They are the same, in the same order, for every run on a scene.
    """
    truth = Truth.open(truth_folder) if truth_folder else None
    targets = choose_targets(run, truth, truth_folder)[1]
    described = [describe_view(run, t) for t in targets]
    names = {v["name"] for v in headline_views(run, described)}
    return [t for t in targets if t.name in names]


def describe_radiance(gauge: Gauge | None) -> dict[str, Any]:
    """Labels of the radiance scores and the scales they were taken with."""
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


def describe_geometry(units: Units | None) -> dict[str, Any]:
    """Labels of the scores of depth and motion and the scales they were taken with."""
    if units is None:
        return {}
    return {
        "geometry_scores": GEOMETRY_SCORES,
        "depth_scale": units.depth,
        "world_scale": units.world,
    }


def absences(headline: dict[str, Any], gauge: Gauge | None, units: Units | None) -> list[str]:
    """Sentences about scores that this truth folder or run lacks, but others have."""
    notes = []
    if gauge is None:
        notes.append("radiance: absent, this truth folder has recordings only")
    elif "hdr_flip" not in headline:
        advice = "flip-evaluator is not installed (`pip install flip-evaluator`)"
        notes.append(f"HDR-FLIP: absent, {advice}")
    if units is None:
        notes.append("depth and motion: absent, this truth folder has none (`synth` writes them)")
    elif "flow_epe" not in headline:
        notes.append("motion: absent, this field has no scene flow")
    elif units.world is None:
        notes.append("scene flow in three dimensions: absent, the estimated cameras fix no scale")
    return notes


def lpips_note(weights: str | None, views: Sequence[dict[str, Any]]) -> str:
    """The weights of LPIPS, or why it is absent."""
    if not weights:
        return "absent; give --lpips FILE (AlexNet weights) or --lpips hub"
    if "lpips" in views[0]:
        return f"AlexNet v0.1, {weights}"
    return f"absent; the pictures are smaller than {MIN_LPIPS_SIDE} pixels"


def report_headline(headline: dict[str, Any]) -> None:
    """Print the headline in one line."""
    shown = (
        ("psnr", "PSNR {:.2f} dB"),
        ("psnr_moving", "moving only {:.2f} dB"),
        ("ssim", "SSIM {:.3f}"),
        ("mu5000", "HDR mu-law(5000) {:.2f} dB"),
    )
    parts = [words.format(headline[key]) for key, words in shown if key in headline]
    say("; ".join(parts))


def mean_of(views: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means of every score over the views that have it, and the number of `views`."""
    result: dict[str, Any] = {"views": len(views)}
    for name in dict.fromkeys(key for view in views for key in view):
        values = [view[name] for view in views if view.get(name) is not None]
        if name not in NOT_SCORES and values:
            result[name] = float(np.mean(values))
    return result


def write_picture(
    target: Target,
    predicted: Tensor,
    own: Tensor,
    gauge: Gauge | None,
    exposure: float,
    folder: Path,
) -> None:
    """Write prediction | truth | 4 x error of a view.

    As recorded (`own`) and, where the radiance is known, tone-mapped for a display
    at `exposure`.
    """
    pairs = [(own, target.rgb[target.bracket])]
    if gauge is not None and target.radiance is not None:
        shown = color.display(predicted * gauge.scale, exposure)
        pairs.append((shown, color.display(target.radiance, exposure)))
    rows = []
    for prediction, truth in pairs:
        error = (ERROR_GAIN * (prediction - truth).abs()).clip(0, 1)
        rows.append([prediction.numpy(), truth.numpy(), error.numpy()])
    write_png(folder / f"{target.name}.png", contact_sheet(rows))
