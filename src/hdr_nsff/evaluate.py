"""A run against what it has never seen: held-out views with exact radiance (a truth folder), else held-out frames of the clip,
else, named as such, its own training frames. Writes `metrics.json` and pictures of prediction | truth | error.

Recorded rgb is compared at the view's own exposure (the headline) and at all exposures of the clip; radiance after one scale
for all views (METHOD.md 7): LDR recordings alone leave it free. Moving-only numbers average over the moving mask."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor

from hdr_nsff import alignment, color, io, metrics
from hdr_nsff.camera import Camera
from hdr_nsff.errors import InputError
from hdr_nsff.paths import View
from hdr_nsff.progress import say, track
from hdr_nsff.run import Run
from hdr_nsff.scene import inside
from hdr_nsff.shots import fingerprint, take
from hdr_nsff.tonemap import informative
from hdr_nsff.truth import Truth, TruthView

SMALLEST_LPIPS = 64  # pixels


@dataclass(frozen=True)
class EvaluateConfig:
    """Measure a run on held-out views; writes RUN/metrics.json and RUN/evaluation/."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    truth: Path | None = None
    """Truth folder, as `synth` and `reexpose` write it; default: the frames that `prepare` held out."""
    lpips: str | None = None
    """LPIPS: a file with AlexNet weights, or `hub` to download them."""
    device: str = "auto"
    """auto, cpu or cuda."""


@dataclass(frozen=True)
class Target:
    """One view to be met."""

    name: str
    group: str
    view: View
    bracket: int
    camera_id: int
    rgb: dict[int, Tensor]  # {bracket: (H, W, 3)} what the camera would record (or did) in [0, 1]
    radiance: Tensor | None  # (H, W, 3) exact, where known, in the camera's white balance: the unit of a run's radiance
    moving: Tensor | None  # (H, W) bool


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """The verb: what `metrics.json` holds."""
    with io.writing_to(config.run):
        return evaluate_run(Run.open(config.run, config.device), config.truth, config.lpips)


def check_truth(folder: Path) -> None:
    """InputError where `folder` is no truth folder, for those who will need it later."""
    Truth.open(folder)


def evaluate_run(run: Run, truth_folder: Path | None, lpips: str | None = None) -> dict[str, Any]:
    """Measure, write `metrics.json` and `evaluation/*.png` into the run folder, and give back what was written."""
    start = time.monotonic()
    perceptual = metrics.Lpips(lpips) if lpips else None
    truth = Truth.open(truth_folder) if truth_folder else None
    kind, targets, notes = choose_targets(run, truth, truth_folder)
    say(f"evaluating on {len(targets)} {kind}")
    folder = run.folder / "evaluation"
    radiance = predict(run, targets, folder)
    gauge = find_gauge(targets, radiance) if truth else None
    views = []
    for target, predicted in zip(targets, track(radiance, "measuring"), strict=True):
        scores = score_rgb(run, target, predicted, perceptual)
        views.append(scores | (score_radiance(target, predicted, gauge) if gauge else {}))
    write_pictures(run, targets, radiance, gauge, folder)
    groups = {g: mean_of([v for v in views if v["group"] == g]) for g in dict.fromkeys(t.group for t in targets)}
    result: dict[str, Any] = {"step": run.step, "kind": kind, "notes": notes, "headline": mean_of(views), "groups": groups}
    if truth is not None and gauge is not None:
        result |= {"hdr_scores": HDR_SCORES, "scale": float(gauge.scale), "scale_per_channel": gauge.scales.tolist()}
        result |= {"peak": gauge.peak, "recordable_peak": gauge.recordable_peak}
        result |= {"camera": camera_errors(run, truth), "poses": trajectory_errors(run, truth, targets)}
        if result["headline"].get("hdr_flip") is None:
            notes.append("HDR-FLIP: absent, flip-evaluator is not installed (`pip install flip-evaluator`)")
    result |= {"lpips": lpips_note(lpips, views), "views": views, "seconds": round(time.monotonic() - start, 2)}
    io.write_json(run.folder / "metrics.json", result)
    tell(result)
    return result


def lpips_note(weights: str | None, views: Sequence[dict[str, Any]]) -> str:
    """What there is to say about LPIPS."""
    if weights is None:
        return "absent; give --lpips FILE (AlexNet weights) or --lpips hub"
    return f"AlexNet v0.1, {weights}" if "lpips" in views[0] else f"absent; the pictures are smaller than {SMALLEST_LPIPS} pixels"


def tell(result: dict[str, Any]) -> None:
    """The headline for the person at the terminal."""
    h = result["headline"]
    names = (
        ("psnr", "PSNR", "dB"),
        ("psnr_moving", "moving only", "dB"),
        ("ssim", "SSIM", ""),
        ("mu5000", "HDR mu-law(5000)", "dB"),
    )
    say("; ".join(f"{label} {h[key]:.{3 if key == 'ssim' else 2}f} {unit}".rstrip() for key, label, unit in names if key in h))


# What to compare with


def choose_targets(run: Run, truth: Truth | None, folder: Path | None) -> tuple[str, list[Target], list[str]]:
    """What the targets are, in words; the targets; sentences about what had to be left out."""
    if truth is not None and folder is not None:
        targets, notes = truth_targets(run, truth, folder)
        return "held-out views with exact radiance", targets, notes
    if run.scene.test:
        return "held-out frames", frame_targets(run, test=True), []
    note = "nothing was held out (`prepare --hold-out 8` does that): these numbers are of frames the field was trained on"
    say(note)
    return "training views (not held out)", frame_targets(run, test=False), [note]


def frame_targets(run: Run, test: bool) -> list[Target]:
    """Recorded frames: those held out, or up to 12 training frames."""
    frames = run.scene.test if test else run.scene.train[:: max(1, -(-len(run.scene.train) // 12))]
    group = "held-out frame" if test else "training view"
    return [
        Target(
            f"{f.index:05d}", group, View(f.camera, f.time), f.bracket, f.camera_id, {f.bracket: f.image.cpu()}, None, f.moving
        )
        for f in frames
    ]


def truth_targets(run: Run, truth: Truth, folder: Path) -> tuple[list[Target], list[str]]:
    """The views of a truth folder, carried over to the estimated poses."""
    entries = run.scene.manifest.frames
    if truth.clip_c2w is not None and len(truth.clip_c2w) != len(entries):
        raise InputError(
            f"{folder}: the truth is of a clip of {len(truth.clip_c2w)} frames, the scene has {len(entries)}; prepare the whole clip"
        )
    scale = world_scale(run, truth)
    times = run.scene.times.tolist()
    targets, notes = [], []
    for view in truth.views:
        if view.c2w is not None and scale is None:
            notes.append(f"{view.name}: left out, its pose is off the clip's path and the estimated cameras fix no scale")
        elif not times[0] <= view.time <= times[-1]:
            notes.append(f"{view.name}: left out, its time {view.time:g} is outside the training frames")
        else:
            targets.append(truth_target(run, truth, view, folder, scale or 1.0))
    for note in notes:
        say(note)
    if not targets:
        raise InputError(
            f"{folder}: no view of this truth can be compared with the run ({notes[0] if notes else 'it lists none'}); "
            "check that it is the truth of this clip"
        )
    if not any(exact_of(t).any() for t in targets):
        raise InputError(f"{folder}: the radiance of every view is 0; make the truth anew")
    return targets, notes


def truth_target(run: Run, truth: Truth, view: TruthView, folder: Path, scale: float) -> Target:
    """One view of a truth folder; InputError where its files do not fit together."""
    exact = io.read_exr(inside(folder, view.radiance)).get("RGB")
    if exact is None:
        raise InputError(f"{folder / view.radiance}: no R, G and B channels in this truth image")
    if exact.min() < 0:
        raise InputError(f"{folder / view.radiance}: negative radiance; clip at zero before writing the truth")
    anchor = next((e for e in run.scene.manifest.frames if e.index == view.anchor), None)
    if anchor is None or anchor.c2w is None or anchor.K is None:
        raise InputError(
            f"{folder}: view {view.name} is anchored at frame {view.anchor}, which the scene does not have; prepare the whole clip"
        )
    pose = np.array(anchor.c2w)
    if view.c2w is not None:
        assert truth.clip_c2w is not None, "world_scale refuses this"
        pose = alignment.carry(pose, np.array(truth.clip_c2w[view.anchor]), np.array(view.c2w), scale)
    height, width = exact.shape[:2]
    m = run.scene.manifest
    match = match_brackets(truth.bracket_ev, run.tonemapper.exposures().tolist())
    camera = Camera(torch.tensor(anchor.K), torch.from_numpy(pose).float(), m.width, m.height).resized(width, height)
    rgb = {match[b]: record(truth, exact, b) for b in range(len(truth.bracket_ev))}
    at_frame = min(abs(view.time - t) for t in run.scene.times.tolist()) < 1e-6
    group = "off-path" if view.c2w is not None else "view" if at_frame else "view+time"
    return Target(
        view.name, group, View(camera, view.time), match[view.bracket], anchor.camera_id, rgb,
        torch.from_numpy(exact * np.array(truth.white_balance, np.float32)),
        moving_mask(run, view, folder, (height, width)),
    )  # fmt: skip


def moving_mask(run: Run, view: TruthView, folder: Path, size: tuple[int, int]) -> Tensor | None:
    """The moving mask (H, W) of a truth view; without one, that of the scene where the view is a frame of the clip."""
    if view.mask is not None:
        mask = io.read_mask(inside(folder, view.mask))
        if mask.shape != size:
            raise InputError(f"{folder / view.mask}: a mask of {mask.shape}, but the radiance of {view.name} is {size}")
        return torch.from_numpy(mask)
    frames = [f for f in run.scene.train + run.scene.test if f.index == view.anchor and f.time == view.time and view.c2w is None]
    own = frames[0].moving if frames else None
    return own if own is not None and own.shape == size else None


def match_brackets(true_ev: Sequence[float], learned_ev: Sequence[float]) -> dict[int, int]:
    """{bracket of the truth: bracket of the scene}, by rank of exposure; where their numbers differ, by distance from the brightest."""
    if len(true_ev) == len(learned_ev):
        order = zip(np.argsort(true_ev, kind="stable"), np.argsort(learned_ev, kind="stable"), strict=True)
        return {int(b): int(s) for b, s in order}
    learned = np.array(learned_ev) - max(learned_ev)
    return {b: int(np.abs(learned - (ev - max(true_ev))).argmin()) for b, ev in enumerate(true_ev)}


def record(truth: Truth, radiance: np.ndarray, bracket: int) -> Tensor:
    """What the true camera records (H, W, 3) of `radiance` (H, W, 3) at a bracket, without noise."""
    exposure = radiance * 2.0 ** truth.bracket_ev[bracket] * np.array(truth.white_balance)
    rgb = np.stack([np.interp(exposure[..., c], truth.response_x, truth.response_y[c]) for c in range(3)], -1)
    return torch.from_numpy(rgb.astype(np.float32))


def trajectories(run: Run, truth: Truth) -> tuple[np.ndarray, np.ndarray] | None:
    """True and estimated poses (T, 3, 4) of the clip's frames; None where the truth has none."""
    if truth.clip_c2w is None:
        return None
    return np.array(truth.clip_c2w), np.array([e.c2w for e in run.scene.manifest.frames], dtype=np.float64)


def world_scale(run: Run, truth: Truth) -> float | None:
    """Estimated scene units per true unit; None where the cameras do not spread."""
    paths = trajectories(run, truth)
    if paths is None:
        if any(v.c2w is not None for v in truth.views):
            raise InputError("truth.json: views have poses of their own, but clip_c2w is missing; they cannot be carried over")
        return None
    fit = alignment.umeyama(paths[0][:, :, 3], paths[1][:, :, 3])
    return None if fit is None else fit.scale


# Predictions


def predict(run: Run, targets: Sequence[Target], folder: Path) -> list[Tensor]:
    """Radiance (H, W, 3) of every target. Kept as EXR, so that a killed evaluation goes on where it was."""
    key = fingerprint(run, [t.view for t in targets])
    note = folder / "predictions.json"
    if not note.is_file() or note.read_text(encoding="utf-8", errors="replace") != json.dumps(key):
        for old in [*folder.glob("*.exr"), *folder.glob("*.png")]:
            old.unlink()
        io.write_text(note, json.dumps(key))
    result = []
    for target in track(targets, "rendering held-out views"):
        path = folder / f"{target.name}.exr"
        if not path.exists():
            io.write_exr(path, {"RGB": take(run, target.view).radiance}, half=False)
        result.append(torch.from_numpy(io.read_exr(path)["RGB"]))
    return result


def recorded(run: Run, target: Target, radiance: Tensor, bracket: int) -> Tensor:
    """What the learned camera records (H, W, 3) of `radiance` (H, W, 3) at a bracket of the scene."""
    with torch.no_grad():
        flat = radiance.reshape(-1, 3).to(run.tonemapper.knots.device)
        return run.tonemapper(flat, bracket, target.camera_id, None, leaky=False).cpu().reshape(radiance.shape)


# Scores


def moving_of(target: Target) -> Tensor | None:
    """The moving mask, None where it is unknown or empty."""
    return target.moving if target.moving is not None and target.moving.any() else None


def score_rgb(run: Run, target: Target, radiance: Tensor, perceptual: Any) -> dict[str, Any]:
    """Recorded rgb at the view's own exposure, and PSNR averaged over all exposures; moving-only numbers where there is a mask with
    something in it."""
    moving = moving_of(target)
    own, truth = recorded(run, target, radiance, target.bracket), target.rgb[target.bracket]
    scores: dict[str, Any] = {"name": target.name, "group": target.group, "time": target.view.time, "bracket": target.bracket}
    scores |= {"psnr": metrics.psnr(own, truth), "ssim": metrics.ssim(own, truth)}
    if moving is not None:
        scores |= {"psnr_moving": metrics.psnr(own, truth, moving), "ssim_moving": metrics.ssim(own, truth, moving)}
    if perceptual is not None and min(own.shape[:2]) >= SMALLEST_LPIPS:
        scores["lpips"] = perceptual(own, truth)
    every = [(recorded(run, target, radiance, b), rgb) for b, rgb in target.rgb.items()]
    scores["psnr_all_exposures"] = float(np.mean([metrics.psnr(p, t) for p, t in every]))
    if moving is not None:
        scores["psnr_moving_all_exposures"] = float(np.mean([metrics.psnr(p, t, moving) for p, t in every]))
    return scores


@dataclass(frozen=True)
class Gauge:
    """What makes radiance of the run and exact radiance comparable, for all views at once."""

    scale: Tensor  # () by which predicted radiance is multiplied
    scales: Tensor  # (3,) the same per channel
    peak: float  # largest exact radiance
    recordable_peak: float  # the same of pixels that at least one exposure records unclipped
    flip: tuple[float, float]  # exposure range of HDR-FLIP, log2


def recordable(target: Target) -> Tensor:
    """True (H, W) where at least one exposure of the clip records all channels unclipped."""
    return (
        torch.stack([informative(rgb.reshape(-1, 3)) for rgb in target.rgb.values()])
        .any(0)
        .view(target.rgb[target.bracket].shape[:2])
    )


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


def exact_of(target: Target) -> Tensor:
    """The exact radiance of a target that has one."""
    assert target.radiance is not None, target.name
    return target.radiance


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


def mean_of(views: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means of every score over the views that have it, and their number."""
    names = dict.fromkeys(k for v in views for k in v if k not in ("name", "group", "time", "bracket"))
    means = {k: [v[k] for v in views if v.get(k) is not None] for k in names}
    return {"views": len(views)} | {k: float(np.mean(x)) for k, x in means.items() if x}


# The camera and its path


def camera_errors(run: Run, truth: Truth) -> dict[str, Any]:
    """The learned response and exposures against the true ones.

    `response_rmse`: recorded value, over exposures evenly spaced in x^(1/2.2). `power` p: where exposures are learned, radiance is known
    up to a power only; p is what the learned exposures are of the true ones, `response_rmse_after_power` the error once it is undone."""
    x, y = (t.cpu().double().numpy() for t in run.tonemapper.curve(0))
    at = np.linspace(0, 1, 256) ** 2.2
    true = np.stack([np.interp(at, truth.response_x, c) for c in truth.response_y])

    def rmse(p: float) -> float:
        return float(np.sqrt(np.mean((np.stack([np.interp(at**p, x, c) for c in y]) - true) ** 2)))

    ev = run.tonemapper.exposures().cpu().double().numpy()
    match = match_brackets(truth.bracket_ev, ev.tolist())
    reference = truth.reference_bracket
    known = np.array(truth.bracket_ev) - truth.bracket_ev[reference]
    learned = np.array([ev[match[b]] - ev[match[reference]] for b in range(len(known))])
    power = float(learned @ known / (known @ known)) if known.any() else 1.0
    power = power if power > 0 else 1.0
    thin = slice(None, None, 5)
    return {
        "response_rmse": rmse(1.0),
        "power": power,
        "response_rmse_after_power": rmse(power),
        "true_ev": [round(float(e), 4) for e in known],
        "learned_ev": [round(float(e), 4) for e in learned],
        "largest_ev_error": float(np.abs(learned - known).max()),
        "true_response": {"x": at[thin].tolist(), "y": true[:, thin].tolist()},
    }


def trajectory_errors(run: Run, truth: Truth, targets: Sequence[Target]) -> dict[str, float]:
    """Errors of poses and focal length; empty where the truth has neither."""
    paths = trajectories(run, truth)
    errors = {} if paths is None else alignment.pose_errors(*paths)
    if truth.K is not None and targets:
        camera = targets[0].view.camera  # at the size of the truth's pictures, which is the size of its K
        errors |= {
            "focal": float(camera.K[0, 0]),
            "true_focal": truth.K[0][0],
            "focal_error": float(camera.K[0, 0]) / truth.K[0][0] - 1,
        }
    return errors


# Pictures


def write_pictures(run: Run, targets: Sequence[Target], radiance: Sequence[Tensor], gauge: Gauge | None, folder: Path) -> None:
    """Per view prediction | truth | 4 x error, as recorded and, where the radiance is known, tone-mapped for a display."""
    exposure = color.auto_exposure(torch.cat([exact_of(t).reshape(-1, 3) for t in targets])) if gauge else 1.0
    for target, predicted in zip(targets, radiance, strict=True):
        pairs = [(recorded(run, target, predicted, target.bracket), target.rgb[target.bracket])]
        if gauge:
            pairs.append((color.display(predicted * gauge.scale, exposure), color.display(exact_of(target), exposure)))
        rows = [[p.numpy(), t.numpy(), (4 * (p - t).abs()).clip(0, 1).numpy()] for p, t in pairs]
        io.write_png(folder / f"{target.name}.png", io.contact_sheet(rows))
