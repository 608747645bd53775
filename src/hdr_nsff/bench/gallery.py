"""The page of a benchmark, index.html: one file that opens offline.

Tables, quality over training time, and crops of the same views side by side with their
errors; laid out in `gallery.html`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup

from hdr_nsff.bench.config import BenchPlan
from hdr_nsff.bench.tables import (
    COSTS,
    SCORES,
    Column,
    Row,
    best_numbers,
    command,
    describe_machines,
    describe_measurements,
    mean_table,
    mean_title,
    means,
    methods_of,
    scenes_of,
    shown,
    used,
)
from hdr_nsff.core.images import colorize, read_image, read_mask
from hdr_nsff.core.io import write_text
from hdr_nsff.core.notes import CurvePoint, ShownView
from hdr_nsff.core.page import Figure, Table, figure, legend, plot, plural, render_page, svg

CURVES = {
    "psnr": "PSNR, dB",
    "psnr_moving": "PSNR moving, dB",
    "mu5000": "μ-law 5000 PSNR, dB",
}
NUM_COLORS = 10  # of matplotlib's cycle; further lines are dashed
MINOR_TICKS = "25"  # leading digits of the labeled ticks between powers of ten
MAX_ERROR = 0.25  # of the recorded range [0, 1]: where the colors of an error end
MARGIN = 0.3  # around the moving region, of its size (hand-chosen)
MIN_MARGIN = 12  # at least this part of the picture's side (hand-chosen)
CROP_WIDTH = 300  # pixels of a crop on the page
SCALE_BAR = (24, 256)  # pixels


@dataclass(frozen=True)
class Crops:
    """The moving region of one view: pictures of all methods, and their errors."""

    name: str
    time: float  # in frames
    pictures: list[Figure]
    errors: list[Figure]


@dataclass(frozen=True)
class SceneResults:
    """Curves and crops of one scene."""

    name: str
    num_views: int  # of the curves; 0: no run has pictures
    curves: list[Markup]
    crops: list[Crops]


@dataclass(frozen=True)
class MeanResults:
    """Means over scenes."""

    title: str
    table: Table


def write_page(plan: BenchPlan, rows: Sequence[Row]) -> None:
    """Write index.html."""
    scenes = scenes_of(rows)
    failed = [row for row in rows if row.status != "done"]
    counts = f"{plural(len(scenes), 'scene')}, {plural(len(methods_of(rows)), 'method')}"
    page = render_page(
        "bench/gallery.html",
        title=f"Benchmark {plan.config.out.resolve().name}",
        facts=f"{counts}, {len(rows) - len(failed)} of {len(rows)} runs done",
        quality=runs_table(rows, SCORES),
        means=mean_results(rows),
        cost=runs_table(rows, COSTS),
        failed=failed_table(failed),
        scenes=[scene_results(name, rows) for name in scenes],
        measurements=describe_measurements(rows),
        machines=f"{describe_machines(rows)}; seed {plan.config.seed}.",
        command=command(plan),
    )
    write_text(plan.config.out / "index.html", page)


def runs_table(rows: Sequence[Row], wanted: tuple[Column, ...]) -> Table:
    """Every run; the best of each scene bold."""
    columns = used(rows, wanted)
    bold = frozenset((i, j + 2) for i, j in best_numbers(rows, columns))
    lines = [[row.run.scene.name, row.run.method, *shown(row, columns)] for row in rows]
    header = ("scene", "method", *(column.label for column in columns))
    return Table(header, lines, num_labels=2, bold=bold)


def mean_results(rows: Sequence[Row]) -> list[MeanResults]:
    """Means over scenes, oracle runs apart."""
    results = []
    for oracle in (False, True):
        found = means(rows, oracle)
        if found:
            header, lines = mean_table(found, rows)
            table = Table(header, lines, num_labels=3)
            results.append(MeanResults(mean_title(found, oracle), table))
    return results


def failed_table(failed: Sequence[Row]) -> Table | None:
    """The runs without a result and their reasons; None where there are none."""
    if not failed:
        return None
    lines = [[row.run.name, row.status, row.reason] for row in failed]
    return Table(("run", "", "reason"), lines, num_labels=3)


def scene_results(name: str, rows: Sequence[Row]) -> SceneResults:
    """Curves and crops of one scene."""
    own = [row for row in rows if row.run.scene.name == name and shown_views(row)]
    if not own:
        return SceneResults(name, 0, [], [])
    crops = [crops_of(own, view) for view in choose_views(own)]
    return SceneResults(name, len(shown_views(own[0])), plot_curves(own), crops)


def shown_views(row: Row) -> list[ShownView]:
    """The views of a run that have pictures."""
    return [] if row.record is None else row.record.shown


# Curves


def plot_curves(rows: Sequence[Row]) -> list[Markup]:
    """Quality against training time, a line per method.

    Scores without a point are left out.
    """
    drawings = []
    for score, label in CURVES.items():
        points = {row.run.method: curve_points(row, score) for row in rows}
        if any(points.values()):
            drawings.append(plot_curve(score, label, points))
    return drawings


def curve_points(row: Row, score: str) -> list[CurvePoint]:
    """The points of a run's curve that have the score and a place on a log axis."""
    points = [] if row.record is None else row.record.curve
    return [point for point in points if score in point.scores and point.seconds > 0]


def plot_curve(score: str, label: str, points: dict[str, list[CurvePoint]]) -> Markup:
    """One score against minutes of training, a line per method."""
    drawing, axes = plot(3.7, 3.0)
    for i, (method, of_method) in enumerate(points.items()):
        axes.plot(
            [point.seconds / 60 for point in of_method],
            [point.scores[score] for point in of_method],
            "-" if i < NUM_COLORS else "--",
            color=f"C{i % NUM_COLORS}",
            marker="o",
            markersize=3.5,
            linewidth=1.4,
            label=method,
        )
    axes.set(xlabel="minutes of training", title=label, xscale="log")
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:.3g}")
    axes.xaxis.set_minor_formatter(lambda x, _: f"{x:.3g}" if f"{x:e}"[0] in MINOR_TICKS else "")
    axes.tick_params(which="minor", labelsize=8)
    legend(axes)
    return svg(drawing)


# Crops


def choose_views(rows: Sequence[Row]) -> list[ShownView]:
    """The views of the best and of the worst mean PSNR over the methods.

    Only views that all runs show count, and of each its moving pixels where there
    are some.
    """
    by_run = [{view.name: view for view in shown_views(row)} for row in rows]
    common = [name for name in by_run[0] if all(name in views for views in by_run)]

    def mean_psnr(name: str) -> float:
        return float(np.mean([psnr_of(views[name]) for views in by_run]))

    ranked = sorted(common, key=mean_psnr, reverse=True)
    return [by_run[0][name] for name in dict.fromkeys([*ranked[:1], *ranked[-1:]])]


def psnr_of(view: ShownView) -> float:
    """PSNR in dB of moving pixels, of all where none moves."""
    return view.scores.get("psnr_moving", view.scores["psnr"])


def crops_of(rows: Sequence[Row], view: ShownView) -> Crops:
    """The moving region of a view: the truth, the methods' pictures, the errors."""
    folder = rows[0].run.folder / "shown"
    truth = read_image(folder / f"{view.name}_truth.png")
    box = moving_box(folder / f"{view.name}_moving.png", truth.shape[:2])
    range_words = f"absolute error, mean of the channels: 0 to {MAX_ERROR:g} and above"
    pictures = [figure(enlarge(truth[box]), "truth")]
    errors = [figure(scale_bar(), range_words)]
    for row in rows:
        predicted = read_image(row.run.folder / "shown" / f"{view.name}_run.png")
        own = next(v for v in shown_views(row) if v.name == view.name)
        caption = f"{row.run.method}: {own.scores['psnr']:.2f} dB"
        if "psnr_moving" in own.scores:
            caption += f", moving {own.scores['psnr_moving']:.2f}"
        pictures.append(figure(enlarge(predicted[box]), caption))
        error = colorize(np.abs(predicted - truth).mean(-1), 0.0, MAX_ERROR)
        errors.append(figure(enlarge(error[box]), f"{row.run.method}, error"))
    return Crops(view.name, view.time, pictures, errors)


def moving_box(mask: Path, size: tuple[int, int]) -> tuple[slice, slice]:
    """The box of a moving mask, with a margin, in a picture of `size` (H, W).

    The whole picture where the file `mask` does not exist.
    """
    if not mask.is_file():
        return slice(0, size[0]), slice(0, size[1])
    rows, columns = np.nonzero(read_mask(mask))
    return margin_around(rows, size[0]), margin_around(columns, size[1])


def margin_around(positions: np.ndarray, length: int) -> slice:
    """From the first to the last of `positions` with a margin, inside 0 to `length`."""
    low, high = int(positions.min()), int(positions.max()) + 1
    margin = max(round(MARGIN * (high - low)), length // MIN_MARGIN)
    return slice(max(low - margin, 0), min(high + margin, length))


def enlarge(rgb: np.ndarray) -> np.ndarray:
    """A picture with its pixels as squares, about twice the width of a crop."""
    factor = max(1, round(2 * CROP_WIDTH / rgb.shape[1]))
    return cv2.resize(rgb, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)


def scale_bar() -> np.ndarray:
    """The colors of an error from 0 (left) to `MAX_ERROR` (right)."""
    height, width = SCALE_BAR
    ramp = np.linspace(0, MAX_ERROR, width)[None].repeat(height, 0)
    return colorize(ramp, 0.0, MAX_ERROR)
