"""index.html of a benchmark: the tables, quality over training time, and crops of the
same views side by side with their errors. One file that opens offline.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from hdr_nsff.bench.plan import Plan
from hdr_nsff.bench.tables import (
    COSTS,
    SCORES,
    Column,
    Row,
    best_cells,
    command,
    machine,
    mean_table,
    mean_title,
    means,
    shown,
    told_of_scenes,
    used,
)
from hdr_nsff.core import io
from hdr_nsff.core.notes import ShownView
from hdr_nsff.core.page import details, document, figure, legend, missing, plot, svg, table

CURVES = (
    ("psnr", "PSNR, dB"),
    ("psnr_moving", "PSNR moving, dB"),
    ("mu5000", "μ-law 5000 PSNR, dB"),
)
NOTES = {
    SCORES: "Means over the held-out views of each run's headline; “moving”: over moving pixels of what stands left of it. PSNR, μ-law and PU21 in dB. "
    "Bold: the best on its scene. Every score is defined in docs/metrics.md.",
    COSTS: "Training is the clock of the training alone. Before it: reading the scene, starting the field, compiling kernels in the first step, and "
    "writing. Measuring is no part of either. Memory is that of the process; a frame is rendered at the size of the scene's.",
}
ERROR_TOP = 0.25  # of the recorded range [0, 1]: where the colors of an error end
MARGIN = 0.3  # around the moving region, of its size
CROP_WIDTH = 300  # pixels of a crop on the page


def write_page(plan: Plan, rows: Sequence[Row]) -> None:
    """index.html."""
    scenes = list(dict.fromkeys(r.cell.scene.name for r in rows))
    sections = [
        ("Quality", runs_table(rows, SCORES)),
        *mean_sections(rows),
        ("Cost", runs_table(rows, COSTS)),
    ]
    if failed := [r for r in rows if r.status != "done"]:
        lines = [[r.cell.name, r.status, r.reason] for r in failed]
        sections.append(("Without a result", table(("run", "", "reason"), lines, numeric=False)))
    sections += [
        (name, of_scene([r for r in rows if r.cell.scene.name == name])) for name in scenes
    ]
    said = "".join(f"<p>{escape(s)}</p>" for s in told_of_scenes(rows))
    sections.append(
        (
            "What the numbers are of",
            said
            + f'<p class="note">{escape(machine(rows))}.</p>'
            + details("command", f"<pre>{escape(command(plan))}</pre>"),
        )
    )
    body = "\n".join(
        f"<section><h2>{escape(title)}</h2>\n{content}</section>" for title, content in sections
    )
    methods = len(dict.fromkeys(r.cell.method for r in rows))
    facts = f"{plural(len(scenes), 'scene')}, {plural(methods, 'method')}, {sum(r.status == 'done' for r in rows)} of {len(rows)} runs done"
    io.write_text(
        plan.config.out / "index.html",
        document(f"Benchmark {plan.config.out.resolve().name}", facts, body),
    )


def runs_table(rows: Sequence[Row], wanted: tuple[Column, ...]) -> str:
    """Every run; the best of each scene bold."""
    columns = used(rows, wanted)
    bold = {(i, j + 2) for i, j in best_cells(rows, columns)}
    lines = [[r.cell.scene.name, r.cell.method, *shown(r, columns)] for r in rows]
    return (
        table(("scene", "method", *(c.label for c in columns)), lines, words=2, bold=bold)
        + f'<p class="note">{NOTES[wanted]}</p>'
    )


def plural(count: int, word: str) -> str:
    """ "1 scene", "2 scenes"."""
    return f"{count} {word}{'s' * (count != 1)}"


def mean_sections(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Means over scenes, oracle runs apart."""
    found = [(oracle, means(rows, oracle)) for oracle in (False, True)]
    return [
        (mean_title(m, oracle), table(*mean_table(m, rows), words=3)) for oracle, m in found if m
    ]


def of_scene(rows: Sequence[Row]) -> str:
    """Curves and crops of one scene."""
    done = [r for r in rows if r.trial is not None and r.trial.shown]
    if not done:
        return missing("No run of this scene has pictures yet.")
    assert done[0].trial is not None
    count = len(done[0].trial.shown)
    note = f'<p class="note">Over {count} of the held-out views, the same for all methods; the last point is the end of the training. Time is training alone, on a log axis.</p>'
    return f'<div class="plots">{"".join(curves(done))}</div>{note}' + "".join(
        crops(done, view) for view in chosen_views(done)
    )


def curves(rows: Sequence[Row]) -> list[str]:
    """Quality against training time, a line per method."""
    plots = []
    for key, label in CURVES:
        drawing, axes = plot(3.7, 3.0)
        for i, row in enumerate(rows):
            points = [
                p
                for p in (row.trial.curve if row.trial else [])
                if key in p.scores and p.seconds > 0
            ]
            style = "-" if i < 10 else "--"
            xy = [p.seconds / 60 for p in points], [p.scores[key] for p in points]
            axes.plot(
                *xy,
                style,
                color=f"C{i % 10}",
                marker="o",
                markersize=3.5,
                linewidth=1.4,
                label=row.cell.method,
            )
        if not any(len(line.get_xdata()) for line in axes.lines):
            continue
        axes.set(xlabel="minutes of training", title=label, xscale="log")
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:.3g}")
        axes.xaxis.set_minor_formatter(lambda x, _: f"{x:.3g}" if f"{x:e}"[0] in "25" else "")
        axes.tick_params(which="minor", labelsize=8)
        legend(axes)
        plots.append(svg(drawing))
    return plots


def chosen_views(rows: Sequence[Row]) -> list[ShownView]:
    """Of the views that all runs show, the one that the methods meet best on average
    and the one that they meet worst (moving pixels where there are).
    """
    views = [{v.name: v for v in r.trial.shown} for r in rows if r.trial is not None]
    names = [n for n in views[0] if all(n in of_run for of_run in views)]

    def quality(name: str) -> float:
        return float(
            np.mean(
                [
                    of_run[name].scores.get("psnr_moving", of_run[name].scores["psnr"])
                    for of_run in views
                ]
            )
        )

    ranked = sorted(names, key=quality, reverse=True)
    return [views[0][n] for n in dict.fromkeys([*ranked[:1], *ranked[-1:]])]


def crops(rows: Sequence[Row], view: ShownView) -> str:
    """The moving region of a view: the truth and what every method makes of it, and
    below the errors.
    """
    folder = rows[0].cell.folder / "shown"
    truth = io.read_image(folder / f"{view.name}_truth.png")
    box = region(folder / f"{view.name}_moving.png", truth.shape[:2])
    pictures, errors = (
        [figure(enlarged(truth, box), "truth")],
        [
            figure(
                scale_bar(), f"absolute error, mean of the channels: 0 to {ERROR_TOP:g} and above"
            )
        ],
    )
    for row in rows:
        predicted = io.read_image(row.cell.folder / "shown" / f"{view.name}_run.png")
        own = next(v for v in (row.trial.shown if row.trial else []) if v.name == view.name)
        moving = f", moving {own.scores['psnr_moving']:.2f}" if "psnr_moving" in own.scores else ""
        pictures.append(
            figure(
                enlarged(predicted, box), f"{row.cell.method}: {own.scores['psnr']:.2f} dB{moving}"
            )
        )
        error = np.abs(predicted - truth).mean(-1)
        errors.append(
            figure(enlarged(io.colorize(error, 0.0, ERROR_TOP), box), f"{row.cell.method}, error")
        )
    style = f'style="display:grid;gap:10px;margin-bottom:14px;grid-template-columns:repeat({len(pictures)},minmax(150px,{CROP_WIDTH}px))"'
    lines = "".join(
        f'<div class="wide"><div {style}>{"".join(cells)}</div></div>'
        for cells in (pictures, errors)
    )
    return (
        f"<h3>{escape(view.name)}, time {view.time:g}: around what moves, as recorded</h3>{lines}"
    )


def region(mask: io.Path, size: tuple[int, int]) -> tuple[slice, slice]:
    """The box of a moving mask with a margin; the whole picture where nothing moves."""
    if not mask.is_file():
        return slice(0, size[0]), slice(0, size[1])
    where = np.nonzero(io.read_mask(mask))
    sides = []
    for places, length in zip(where, size, strict=True):
        low, high = int(places.min()), int(places.max()) + 1
        margin = max(round(MARGIN * (high - low)), length // 12)
        sides.append(slice(max(low - margin, 0), min(high + margin, length)))
    return sides[0], sides[1]


def enlarged(rgb: np.ndarray, box: tuple[slice, slice]) -> np.ndarray:
    """The box of a picture, its pixels as squares, about as wide as a crop on the page."""
    part = rgb[box]
    times = max(1, round(2 * CROP_WIDTH / part.shape[1]))
    return cv2.resize(part, None, fx=times, fy=times, interpolation=cv2.INTER_NEAREST)


def scale_bar() -> np.ndarray:
    """The colors of an error from 0 (left) to `ERROR_TOP` (right)."""
    ramp = np.linspace(0, ERROR_TOP, 256)[None].repeat(24, 0)
    return io.colorize(ramp, 0.0, ERROR_TOP)
