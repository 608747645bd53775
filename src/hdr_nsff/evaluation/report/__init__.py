"""The verb `report`: one HTML file about a run that opens offline.

It shows what the run made, how good it is, and what it is based on. Pictures, plots and
short videos are inside the file. A part that is missing is named, with the command that
makes it. The sections are built in `pictures`, `score_tables`, `plots` and
`provenance`, and laid out in `report.html`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from hdr_nsff import __version__
from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_text, writing_to
from hdr_nsff.core.page import render_page
from hdr_nsff.core.progress import say
from hdr_nsff.evaluation.report.pictures import find_videos, held_out_views, side_by_side
from hdr_nsff.evaluation.report.plots import (
    plot_gains,
    plot_radiance,
    plot_responses,
    plot_training,
)
from hdr_nsff.evaluation.report.provenance import (
    cycle_text,
    provenance_table,
    timing_table,
)
from hdr_nsff.evaluation.report.score_tables import headline_of, quality_tables
from hdr_nsff.rendering.output import render_folders
from hdr_nsff.training.run_folder import Run

MARK = b"HDR-NSFF report"  # in the title of every page
VIEWER = "scene.html"  # the page that `run` and `export` write
MARK_BYTES = 1000  # of a file, within which the title stands


@dataclass(frozen=True)
class ReportConfig:
    """Write report.html for a run from what `render` and `evaluate` have left in it."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    out: Path | None = None
    """The file; default: RUN/report.html."""
    renders: Path | None = None
    """Folder of the files of `render`; default: RUN/render, or where there is none, the
    folder render/ that `run` made beside RUN.
    """


def report(config: ReportConfig) -> Path:
    """The verb: the path of the report."""
    out = config.out or config.run / "report.html"
    if config.renders is not None and not config.renders.is_dir():
        advice = "correct the path, or leave the option out"
        raise InputError(f"--renders {config.renders}: no such folder; {advice}")
    places = render_folders(config.run)
    renders = config.renders or next((place for place in places if place.is_dir()), places[0])
    with writing_to(out):
        path = write_report(Run.open(config.run), out, renders)
    say(f"report: {path}")
    return path


def write_report(run: Run, path: Path, renders: Path) -> Path:
    """Write the report of `run` to `path`, which is returned.

    `renders`: the folder of the files of `render`.
    """
    check_place(path)
    metrics = metrics_of(run)
    log = run.log()
    source = run.scene.manifest.source
    page = render_page(
        "evaluation/report/report.html",
        title=Path(source).name or source,
        facts=facts_of(run),
        headline=headline_of(metrics),
        videos=find_videos(renders, path.parent),
        viewer=find_viewer(run, path.parent),
        side_by_side=side_by_side(run, renders),
        held_out=held_out_views(run.folder / "evaluation", metrics),
        quality=quality_tables(metrics),
        camera_plots=[*plot_responses(run, metrics), plot_gains(run)],
        radiance=plot_radiance(run, renders),
        training=plot_training(log, run.step),
        timings=timing_table(run, metrics, renders),
        provenance=provenance_table(run),
        settings=json.dumps(run.config.to_json(), indent=1),
    )
    write_text(path, page)
    return path


def metrics_of(run: Run) -> dict[str, Any] | None:
    """What `evaluate` has measured, noted where the run has gone on since; None before
    it has run.
    """
    note = notes.read(run.folder / "metrics.json", notes.Metrics)
    if note is None:
        return None
    metrics = notes.to_dict(note)
    if note.step not in (None, run.step):
        advice = "`hdr-nsff evaluate RUN` measures it again"
        words = f"these numbers are of step {note.step}, the run is at step {run.step}; {advice}"
        metrics["notes"] = [words, *note.notes]
    return metrics


def find_viewer(run: Run, folder: Path) -> str | None:
    """The address, from `folder`, of the viewer's page; None without one.

    It lies in `folder` or in the run folder.
    """
    base = folder.resolve()
    for place in (base, run.folder.resolve()):
        page = place / VIEWER
        if page.is_file() and page.is_relative_to(base):
            return page.relative_to(base).as_posix()
    return None


def check_place(path: Path) -> None:
    """InputError where `path` is a folder, or a file that is no report.

    Writing a report would destroy it.
    """
    if path.is_dir():
        advice = f"name the file to write, such as {path / 'report.html'}"
        raise InputError(f"{path}: is a folder; {advice}")
    if path.exists() and not is_report(path):
        problem = "already exists and is not a report"
        raise InputError(f"{path}: {problem}; choose another place for the report")


def is_report(path: Path) -> bool:
    """Whether `path` is a page that this package wrote."""
    if not path.is_file():  # a device or a pipe
        return False
    with open(path, "rb") as file:
        return MARK in file.read(MARK_BYTES)


def facts_of(run: Run) -> str:
    """The line below the title."""
    manifest = run.scene.manifest
    size = f"{len(manifest.frames)} frames, {manifest.width} × {manifest.height} pixels"
    return f"{size}, {cycle_text(run)}; step {run.step}; hdr-nsff {__version__}"
