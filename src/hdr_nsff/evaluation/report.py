"""report.html: one file that opens offline and shows what a run made, how good it is,
and what it rests on. Pictures, plots and short videos are inside the file; what is
missing is named, with the command that makes it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
import tyro

from hdr_nsff import __version__
from hdr_nsff.core import io, notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.page import (
    COLORS,
    GRAY,
    details,
    document,
    figure,
    legend,
    missing,
    number,
    plot,
    svg,
    table,
    video,
)
from hdr_nsff.core.progress import say
from hdr_nsff.training.run_folder import Run

EMBED = 8_000_000  # bytes: larger videos are linked, not embedded


@dataclass(frozen=True)
class ReportConfig:
    """Write report.html for a run from what `render` and `evaluate` have left in it."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    out: Path | None = None
    """The file; default: RUN/report.html."""
    renders: Path | None = None
    """Where `render` wrote; default: RUN/render."""


def report(config: ReportConfig) -> Path:
    """The verb: the path of the report."""
    out = config.out or config.run / "report.html"
    if config.renders is not None and not config.renders.is_dir():
        raise InputError(
            f"--renders {config.renders}: no such folder; mend the path, or leave the option out for RUN/render"
        )
    with io.writing_to(out):
        path = write_report(Run.open(config.run), out, config.renders or config.run / "render")
    say(f"report: {path}")
    return path


def write_report(run: Run, path: Path, renders: Path) -> Path:
    """Write the report of `run` with the pictures in `renders` to `path`."""
    check_place(path)
    found = notes.read(run.folder / "metrics.json", notes.Metrics)
    metrics = None if found is None else notes.to_dict(found)
    log = run.log()
    sections = [
        ("Results", headline(metrics)),
        ("Videos", videos(renders, path.parent)),
        ("Side by side", side_by_side(run, renders)),
        ("Held-out views", comparisons(run.folder / "evaluation", metrics)),
        ("Quality", quality(metrics)),
        ("Response curves and gains", camera_model(run, metrics)),
        ("Radiance", radiance(run, renders)),
        ("Training", training(run, log)),
        ("Timings", timings(run, log, metrics, renders)),
        ("What was estimated, what was given", provenance(run)),
        (
            "Settings",
            details("config.json", f"<pre>{escape(json.dumps(settings(run), indent=1))}</pre>"),
        ),
    ]
    body = "\n".join(
        f"<section><h2>{escape(title)}</h2>\n{content}</section>" for title, content in sections
    )
    m = run.scene.manifest
    title = Path(m.source).name or m.source
    facts = f"{len(m.frames)} frames, {m.width} × {m.height} pixels, {cycle_text(run)}; step {run.step}; hdr-nsff {__version__}"
    io.write_text(path, document(title, facts, body))
    return path


def check_place(path: Path) -> None:
    """InputError where `path` is a folder, or a file that is no report, so that writing
    one would destroy it.
    """
    if path.is_dir():
        raise InputError(
            f"{path}: is a folder; name the file to write, such as {path / 'report.html'}"
        )
    if path.is_file() and b"HDR-NSFF report" not in path.read_bytes()[:1000]:
        raise InputError(
            f"{path}: is there already and is no report; choose another place for the report"
        )


def headline(metrics: dict[str, Any] | None) -> str:
    """The numbers that count, in tiles."""
    if metrics is None:
        return missing("No metrics yet: `hdr-nsff evaluate RUN` writes metrics.json.")
    h = metrics["headline"]
    tiles = [
        ("PSNR", number(h.get("psnr"), 2, " dB")),
        ("PSNR, moving only", number(h.get("psnr_moving"), 2, " dB")),
    ]
    tiles += [
        ("SSIM", number(h.get("ssim"), 3)),
        ("SSIM, moving only", number(h.get("ssim_moving"), 3)),
    ]
    if "mu5000" in h:
        tiles += [("HDR PSNR, μ-law 5000", number(h["mu5000"], 2, " dB"))]
        tiles += [("the same, recordable pixels", number(h.get("mu5000_recordable"), 2, " dB"))]
    if "lpips" in h:
        tiles += [("LPIPS", number(h["lpips"], 3))]
    cells = "".join(
        f'<div class="tile"><b>{escape(v)}</b><span>{escape(n)}</span></div>' for n, v in tiles
    )
    notes = "".join(f'<p class="note">{escape(n)}</p>' for n in metrics["notes"])
    protocol = f", protocol {escape(metrics['protocol'])}" if metrics.get("protocol") else ""
    return f'<p>Mean over {h["views"]} {escape(metrics["kind"])}{protocol}.</p><div class="tiles">{cells}</div>{notes}'


VIDEOS = (
    ("training", "As filmed, in HDR"), ("fixed", "Fixed camera"), ("bullet", "Bullet time: time stands still"), ("slowmo", "Slow motion")
)  # fmt: skip


def videos(renders: Path, beside: Path) -> str:
    """The videos that are there (embedded if short), the others named."""
    cells, absent = [], []
    for name, caption in VIDEOS:
        path = renders / f"{name}.mp4"
        if not path.is_file():
            absent.append(caption.split(":")[0].lower())
        elif path.stat().st_size <= EMBED:
            cells.append(video(path.read_bytes(), caption))
        else:
            link = Path(os.path.relpath(path, beside)).as_posix()
            cells.append(
                f'<p><a href="{escape(quote(link))}">{caption}</a> ({path.stat().st_size / 1e6:.0f} MB, beside this file)</p>'
            )
    note = missing(f"Not made: {', '.join(absent)}. {why_absent(renders)}") if absent else ""
    return f'<div class="grid">{"".join(cells)}</div>{note}'


def why_absent(renders: Path) -> str:
    """Why videos are missing, as far as the renders tell."""
    plan = notes.read(renders / "plan.json", notes.RenderPlan)
    return (
        " ".join(plan.refused)
        if plan is not None and plan.refused
        else "`hdr-nsff render RUN` makes the standard set."
    )


def side_by_side(run: Run, renders: Path) -> str:
    """Rows of recorded frame, tone-mapped HDR, three exposures, depth, scene flow."""
    colored = notes.read(renders / "views.json", notes.PictureRanges)
    sequence = notes.read(renders / "training" / "sequence.json", notes.Sequence)
    if colored is None or sequence is None:
        return missing("No pictures yet: `hdr-nsff render RUN` makes the standard set.")
    near, far = colored.depth_range
    columns = [
        ("training", "HDR, tone-mapped"),
        ("depth", f"depth, {near:.2g} (red) to {far:.2g} (blue)"),
    ]
    columns += (
        [("scene_flow", f"motion until the next frame, up to {colored.fastest:.2g} px")]
        if colored.moves
        else []
    )
    columns += [(f"ldr/ev{ev:+.1f}", f"developed at EV {ev:+.1f}") for ev in colored.exposures]
    rows = []
    count = len(sequence.views)
    for i in sorted({round(x) for x in np.linspace(0, count - 1, min(3, count)).tolist()}):
        time = sequence.views[i].time
        frame = min(run.scene.train, key=lambda f: abs(f.time - time))
        ev = run.tonemapper.exposures()[frame.bracket].item()
        cells = [figure(frame.image.cpu().numpy(), f"recorded, frame {frame.index}, EV {ev:+.1f}")]
        cells += [
            figure(io.read_image(renders / folder / f"{i:05d}.png"), caption)
            for folder, caption in columns
        ]
        rows.append(f'<div class="grid">{"".join(cells)}</div>')
    absent = "" if colored.moves else missing("No scene flow: this field tells none.")
    return "".join(rows) + absent


def comparisons(folder: Path, metrics: dict[str, Any] | None) -> str:
    """Prediction, truth and error of the best, the middle and the worst view of every
    group.
    """
    if metrics is None:
        return missing("Not evaluated yet: `hdr-nsff evaluate RUN`.")
    parts = []
    for group in metrics["groups"]:
        views = sorted(
            (v for v in metrics["views"] if v["group"] == group), key=lambda v: v["psnr"]
        )
        chosen = {views[i]["name"]: views[i] for i in (len(views) - 1, len(views) // 2, 0)}
        words = (
            f"best, middle and worst of {len(views)}" if len(views) > 3 else f"{len(views)} views"
        )
        cells = []
        for name, v in chosen.items():
            path = folder / f"{name}.png"
            caption = f"{name}, time {v['time']:g}: {v['psnr']:.2f} dB"
            cells.append(
                figure(io.read_image(path), caption, 1400)
                if path.is_file()
                else missing(f"{path.name} is missing.")
            )
        parts.append(f'<h3>{escape(group)}: {words}</h3><div class="pairs">{"".join(cells)}</div>')
    rows = (
        "; first row as recorded, second row tone-mapped radiance"
        if metrics.get("hdr_scores")
        else ""
    )
    return f'<p class="note">Prediction | truth | 4 × error{rows}.</p>' + "".join(parts)


SCORES = (
    ("psnr", "PSNR, dB", 2), ("psnr_moving", "PSNR moving, dB", 2), ("ssim", "SSIM", 3), ("ssim_moving", "SSIM moving", 3),
    ("lpips", "LPIPS", 3), ("lpips_moving", "LPIPS moving", 3), ("psnr_all_exposures", "PSNR over all exposures, dB", 2),
    ("psnr_moving_all_exposures", "PSNR moving over all exposures, dB", 2),
    ("psnr_novel_exposures", "PSNR at exposures that the clip has not, dB", 2),
    ("psnr_moving_novel_exposures", "PSNR moving at those, dB", 2),
)  # fmt: skip


ERRORS = {
    "camera": {
        "response_rmse": "response curve, RMS error of the recorded value",
        "power": "learned exposures are the true ones times",
        "response_rmse_after_power": "response curve, RMS error once that is undone",
        "power_of_response": "the curves agree best if learned exposures are the true ones times",
        "true_ev": "true exposures, EV",
        "learned_ev": "learned exposures, EV",
        "largest_ev_error": "largest error of an exposure, EV",
        "largest_step_error": "largest error of a step between exposures, EV",
        "largest_step_error_after_power": "the same once the power of the curves is undone",
    },
    "poses": {
        "ate": "camera centers, RMS error after alignment, true units",
        "ate_share": "the same as a share of the path's extent",
        "rotation_degrees": "rotation, mean error in degrees",
        "focal": "focal length, pixels",
        "true_focal": "true focal length, pixels",
        "focal_error": "focal length, relative error",
    },
    "stability": {
        "hdr_tae": "HDR-TAE",
        "hdr_tae_moving": "HDR-TAE moving",
        "pairs": "pairs of training frames, along the clip's own flow",
    },
}


def text(value: Any) -> str:
    """A count as it is, a number with four digits after the point, a list of numbers
    with three.
    """
    if isinstance(value, int):
        return str(value)
    return ", ".join(f"{v:+.3f}" for v in value) if isinstance(value, list) else number(value, 4)


def quality(metrics: dict[str, Any] | None) -> str:
    """All metrics in tables."""
    if metrics is None:
        return missing("Not evaluated yet: `hdr-nsff evaluate RUN`.")
    groups = {**metrics["groups"], **metrics.get("protocols", {}), "headline": metrics["headline"]}
    parts = ["<h3>Recorded rgb</h3>", score_table(groups, SCORES)]
    if (hdr := metrics.get("hdr_scores")) is not None:
        peaks = f"Normalized by the largest exact radiance, {metrics['peak']:.3g}; recordable pixels by theirs, {metrics['recordable_peak']:.3g}. "
        scale = f"Predicted radiance was multiplied by {metrics['scale']:.4f} for all views (per channel: {', '.join(f'{x:.4f}' for x in metrics['scale_per_channel'])})."
        parts += [
            "<h3>Linear radiance</h3>",
            score_table(groups, tuple((k, *v) for k, v in hdr.items())),
        ]
        shown = (
            f" PU21 takes luminance {metrics['pu21']['white']:.3g} for {metrics['pu21']['nits']:g} cd/m²."
            if "pu21" in metrics
            else ""
        )
        parts += [f'<p class="note">{escape(peaks + scale + shown)}</p>']
    if (geometry := metrics.get("geometry_scores")) is not None:
        parts += [
            "<h3>Depth and motion</h3>",
            score_table(groups, tuple((k, *v) for k, v in geometry.items())),
        ]
        units = f"Predicted depth was multiplied by {metrics['depth_scale']:.4f} for all views"
        world = f", scene flow by {metrics['world_scale']:.4f}" if "world_scale" in metrics else ""
        parts += [f'<p class="note">{units}{world}.</p>']
    titles = {
        "stability": "Stability along the training path",
        "camera": "Learned camera against the true one",
    }
    for part, title in {**titles, "poses": "Poses of the scene against the true ones"}.items():
        found = metrics.get(part) or {}
        rows = [(label, text(found[key])) for key, label in ERRORS[part].items() if key in found]
        parts += [f"<h3>{title}</h3>", table(("", ""), rows)] if rows else []
    parts.append(f'<p class="note">LPIPS: {escape(metrics["lpips"])}.</p>')
    return "".join(parts)


def score_table(groups: dict[str, dict[str, Any]], scores: Sequence[tuple[str, str, int]]) -> str:
    """Rows of scores, columns of groups; scores that no group has are left out."""
    used = [s for s in scores if any(g.get(s[0]) is not None for g in groups.values())]
    rows = [
        [label, *(number(g.get(key), digits) for g in groups.values())]
        for key, label, digits in used
    ]
    return table(("", *(f"{name} ({g['views']})" for name, g in groups.items())), rows)


def cycle_text(run: Run) -> str:
    """The exposure cycle in words."""
    m = run.scene.manifest
    ev = ", ".join(f"{e:+.1f}" for e in run.tonemapper.exposures().tolist())
    return (
        f"exposure cycle of {m.cycle} (EV {ev}, {'given' if m.exposure_given else 'learned'})"
        if m.cycle > 1
        else "one exposure"
    )


def camera_model(run: Run, metrics: dict[str, Any] | None) -> str:
    """The response curve of every camera and the gain of every frame."""
    plots = []
    true = ((metrics or {}).get("camera") or {}).get("true_response")
    for camera in range(min(run.tonemapper.num_cameras, 9)):
        drawing, axes = plot(4.2, 3.2)
        x, y = (t.cpu().numpy() for t in run.tonemapper.curve(camera))
        axes.plot(x, x ** (1 / 2.2), "--", color=GRAY, linewidth=1, label="gamma 2.2")
        for channel, color, name in zip(range(3), COLORS, ("red", "green", "blue"), strict=True):
            axes.plot(x, y[channel], color=color, linewidth=1.4, label=name)
            if true is not None:
                axes.plot(
                    true["x"], true["y"][channel], ":", color=color, linewidth=1.6, label=None
                )
        if true is not None:
            axes.plot([], [], ":", color=GRAY, label="true")
        axes.set(
            xlabel="exposure (1 saturates)",
            ylabel="recorded value",
            title=f"response of camera {camera}",
        )
        legend(axes)
        plots.append(svg(drawing))
    drawing, axes = plot(5.6, 3.2)
    gains = run.tonemapper.gains().cpu().numpy()
    times = [f.time for f in run.scene.train]
    for channel, color in enumerate(COLORS):
        axes.plot(
            np.array(times) + 0.2 * (channel - 1), gains[:, channel], ".", color=color, markersize=4
        )
    for ev in run.scene.manifest.bracket_ev:
        if ev is not None:
            axes.axhline(ev, color=GRAY, linewidth=0.7, linestyle="--")
    given = "dashed: given" if run.scene.manifest.exposure_given else "none given"
    axes.set(
        xlabel="time (frames)",
        ylabel="gain (EV)",
        title=f"gain of every frame and channel ({given})",
    )
    plots.append(svg(drawing))
    return f'<div class="plots">{"".join(plots)}</div>'


def radiance(run: Run, renders: Path) -> str:
    """Histogram of rendered radiance on a log axis, with what each exposure of the clip
    can record.
    """
    files = sorted((renders / "training").glob("*.exr"))
    if not files:
        return missing("No EXR sequence yet: `hdr-nsff render RUN` makes it.")
    chosen = files[:: max(1, len(files) // 12)]
    pixels = np.concatenate([io.read_exr(f)["RGB"].reshape(-1, 3) for f in chosen])
    log = np.log10(pixels.clip(1e-7))
    drawing, axes = plot(9.6, 3.2)
    low, high = np.percentile(log, [0.05, 100]).tolist()
    edges = np.linspace(low, high, 120)
    for channel, color, name in zip(range(3), COLORS, ("red", "green", "blue"), strict=True):
        axes.hist(
            10 ** log[:, channel],
            bins=10**edges,
            histtype="step",
            color=color,
            linewidth=1.2,
            label=name,
        )
    x, y = (t.cpu() for t in run.tonemapper.curve(0))
    dark = float(
        x[
            int(
                torch.searchsorted(y.mean(0).contiguous(), torch.tensor(3 / 255)).clamp(
                    1, len(x) - 1
                )
            )
        ]
    )
    exposures = sorted(run.tonemapper.exposures().tolist())
    axes.set_xlim(left=min(10**low, dark / 2 ** exposures[-1]) / 20)  # room for the words
    top = axes.get_ylim()[1]
    for i, ev in enumerate(exposures):
        axes.plot(
            [dark / 2**ev, 1 / 2**ev],
            [top * (1.04 + 0.06 * i)] * 2,
            color=GRAY,
            linewidth=3,
            solid_capstyle="butt",
        )
        axes.text(
            dark / 2**ev,
            top * (1.04 + 0.06 * i),
            f"EV {ev:+.1f} records  ",
            fontsize=7,
            va="center",
            ha="right",
            color=GRAY,
        )
    axes.set(
        xscale="log",
        xlabel="linear radiance (1 saturates at the reference exposure)",
        ylabel="pixels",
    )
    legend(axes)
    low, high = np.percentile(pixels.max(-1), [0.1, 99.9]).tolist()
    stops = math.log2(max(high, 1e-7) / max(low, 1e-7))
    note = f"{len(chosen)} views of the training path; 0.1 to 99.9 percentile: {stops:.1f} stops; brightest pixel {pixels.max():.3g}."
    return f'<div class="plots">{svg(drawing)}</div><p class="note">{note}</p>'


def training(run: Run, log: list[notes.LogLine]) -> str:
    """PSNR on training pixels, and every loss term on a log axis, against time."""
    if len(log) < 2:
        return missing("No training log (log.jsonl) in the run folder.")
    minutes = [line.seconds / 60 for line in log]
    drawing, axes = plot(4.6, 3.2)
    axes.plot(minutes, [line.psnr for line in log], color="#3d7fc4", linewidth=0.5, alpha=0.5)
    axes.plot(minutes, smoothed([line.psnr for line in log]), color="#3d7fc4", linewidth=1.6)
    axes.set(xlabel="minutes", ylabel="dB", title="PSNR of training batches")
    plots = [svg(drawing)]
    drawing, axes = plot(6.4, 3.2)
    names = sorted({n for line in log for n in line.losses})
    for i, name in enumerate(names):
        points = [
            (m, line.losses[name])
            for m, line in zip(minutes, log, strict=True)
            if line.losses.get(name, 0) > 0
        ]
        if points:
            axes.plot(
                [m for m, _ in points],
                smoothed([v for _, v in points]),
                linewidth=1.2,
                label=name.replace("_", " "),
                color=f"C{i % 10}",
                linestyle="-" if i < 10 else "--",
            )
    axes.set(xlabel="minutes", yscale="log", title="loss terms, unweighted")
    legend(axes, loc="center left", bbox_to_anchor=(1, 0.5))
    plots.append(svg(drawing))
    speed = f"{log[-1].step} steps, {log[-1].rays_per_second:,.0f} rays per second."
    return f'<div class="plots">{"".join(plots)}</div><p class="note">{speed}</p>'


def smoothed(values: Sequence[float]) -> np.ndarray:
    """Values (N,) after a moving average over a fortieth of them, as long as the input."""
    width = max(1, len(values) // 40)
    padded = np.pad(
        np.asarray(values, dtype=float), (width // 2, width - 1 - width // 2), mode="edge"
    )
    return np.convolve(padded, np.ones(width) / width, mode="valid")


def timings(
    run: Run, log: list[notes.LogLine], metrics: dict[str, Any] | None, renders: Path
) -> str:
    """How long everything took."""
    rows = [
        (f"prepare: {name}", number(step.seconds, 1, " s"))
        for name, step in run.scene.manifest.steps.items()
    ]
    rows.append(("train", number(run.seconds, 1, " s")))
    for note in sorted(renders.glob("*/sequence.json")):
        if (found := notes.read(note, notes.Sequence)) is not None:
            rows.append(
                (
                    f"render: {note.parent.name}, {len(found.views)} views",
                    number(found.seconds, 1, " s"),
                )
            )
    rows.append(("evaluate", number((metrics or {}).get("seconds"), 1, " s")))
    return table(("", ""), rows)


def provenance(run: Run) -> str:
    """Every step of `prepare`: estimated, given or absent, and what it found."""
    m = run.scene.manifest
    rows: list[tuple[str, str, str]] = [
        (name, step.provenance, step.note) for name, step in m.steps.items()
    ]
    learned = [i for i, ev in enumerate(m.bracket_ev) if ev is None]
    rows.append(
        (
            "exposure values",
            "estimated" if learned else "given" if m.exposure_given else "reference only",
            cycle_text(run),
        )
    )
    rows.append(
        (
            "response curve",
            "estimated" if run.config.tonemap.kind in ("shared", "per_image", "mlp") else "given",
            f"tone map: {run.config.tonemap.kind}",
        )
    )
    parallax = {
        "full": "the camera moved",
        "rotation": "the camera only turned",
        "none": "the camera stood still",
    }[m.parallax]
    rows.append(
        (
            "parallax",
            "estimated",
            parallax + ("" if m.parallax == "full" else ": no depth, no novel viewpoints"),
        )
    )
    return table(("", "", ""), rows, numeric=False)


def settings(run: Run) -> dict[str, Any]:
    """The training config as plain data."""
    return run.config.to_json()
