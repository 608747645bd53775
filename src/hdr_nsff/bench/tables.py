"""The results of a benchmark as numbers, in CSV, JSON and Markdown.

Rows of runs, means, best and worst scenes. Every score is that of the run's own
metrics.json, from its `headline`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from hdr_nsff.bench.config import WHOLE_ONLY, BenchPlan, BenchRun, bench_words
from hdr_nsff.bench.machine import this_machine
from hdr_nsff.bench.pool import shell_line
from hdr_nsff.bench.run import is_complete, read_record
from hdr_nsff.core import notes
from hdr_nsff.core.io import write_json, write_text
from hdr_nsff.core.notes import Machine, RunRecord, Trained
from hdr_nsff.core.page import plural

ORACLE_NOTE = "An oracle run: its poses, masks, depth and flow were made from the truth."
DASH = "–"  # where a run has no number


@dataclass(frozen=True)
class Column:
    """A number of a run that the tables show."""

    key: str
    label: str
    digits: int
    better: int  # 1: larger is better, -1: smaller is better, 0: neither


SCORES = (
    Column("psnr", "PSNR", 2, 1),
    Column("psnr_moving", "moving", 2, 1),
    Column("ssim", "SSIM", 3, 1),
    Column("ssim_moving", "moving", 3, 1),
    Column("lpips", "LPIPS", 3, -1),
    Column("lpips_moving", "moving", 3, -1),
    Column("mu5000", "HDR μ-law 5000", 2, 1),
    Column("mu5000_moving", "moving", 2, 1),
    Column("mu5000_recordable", "recordable", 2, 1),
    Column("pu21", "PU21", 2, 1),
    Column("hdr_flip", "HDR-FLIP", 3, -1),
    Column("stability.hdr_tae_moving", "HDR-TAE of movers", 3, -1),
    Column("camera.response_rmse", "response RMSE", 4, -1),
    Column("camera.largest_step_error", "error of EV steps", 3, -1),
)
COSTS = (
    Column("train_seconds", "training, s", 1, 0),
    Column("steps", "steps", 0, 0),
    Column("start_seconds", "before it, s", 1, 0),
    Column("measure_seconds", "measuring, s", 1, 0),
    Column("memory_gb", "peak memory, GB", 2, -1),
    Column("gpu_memory_gb", "of the GPU", 2, -1),
    Column("frame_seconds", "seconds a frame", 3, -1),
)


@dataclass(frozen=True)
class Row:
    """A run in the tables."""

    run: BenchRun
    status: str  # done, failed, or not finished
    reason: str  # why not done
    metrics: dict[str, Any] | None
    record: RunRecord | None

    @property
    def values(self) -> dict[str, float]:
        """Every number of the run, by key; empty where it is not done."""
        if self.metrics is None or self.record is None or self.record.trained is None:
            return {}
        found = numbers_of(self.metrics["headline"], "")
        found |= numbers_of(self.metrics.get("stability") or {}, "stability.")
        found |= numbers_of(self.metrics.get("camera", {}), "camera.")
        found |= numbers_of(self.metrics.get("poses", {}), "poses.")
        found |= costs_of(self.record.trained)
        found["measure_seconds"] = self.record.seconds
        return found


def numbers_of(scores: dict[str, Any], prefix: str) -> dict[str, float]:
    """The numbers among scores, with a prefix to their keys."""
    return {prefix + key: value for key, value in scores.items() if isinstance(value, int | float)}


def costs_of(trained: Trained) -> dict[str, float]:
    """The costs of a training, by key."""
    costs = {
        "train_seconds": trained.seconds,
        "steps": trained.steps,
        "start_seconds": trained.start_seconds,
        "frame_seconds": trained.frame_seconds,
        "memory_gb": trained.memory / 1e9,
    }
    if trained.gpu_memory is not None:
        costs["gpu_memory_gb"] = trained.gpu_memory / 1e9
    return costs


def row_of(run: BenchRun, plan: BenchPlan) -> Row:
    """The row of a run, done or not."""
    if is_complete(run, plan.config.views, plan.config.lpips):
        found = notes.read(run.folder / "metrics.json", notes.Metrics)
        if found is not None:
            return Row(run, "done", "", notes.to_dict(found), read_record(run))
    failure = notes.read(run.failure, notes.Failure)
    if failure is not None:
        log = f" (log: {failure.log})" if failure.log else ""
        return Row(run, "failed", f"{failure.reason}{log}", None, None)
    return Row(run, "not finished", "the same command continues it", None, None)


def scenes_of(rows: Iterable[Row]) -> list[str]:
    """The names of the scenes, in order."""
    return list(dict.fromkeys(row.run.scene.name for row in rows))


def methods_of(rows: Iterable[Row]) -> list[str]:
    """The names of the methods, in order."""
    return list(dict.fromkeys(row.run.method for row in rows))


def used(rows: Sequence[Row], columns: Sequence[Column]) -> list[Column]:
    """The columns that any run has."""
    return [column for column in columns if any(column.key in row.values for row in rows)]


def shown(row: Row, columns: Sequence[Column]) -> list[str]:
    """The numbers of a run as texts; where it has none, its status."""
    if row.status != "done":
        return [row.status, *[""] * (len(columns) - 1)]
    return [text(row.values.get(column.key), column) for column in columns]


def text(value: float | None, column: Column) -> str:
    """A number for people."""
    if value is None:
        return DASH
    if column.key == "steps":
        return f"{value:,.0f}"
    return f"{value:.{column.digits}f}"


def best_numbers(rows: Sequence[Row], columns: Sequence[Column]) -> frozenset[tuple[int, int]]:
    """(row, column) of the best value, as shown, of each column on each scene.

    Only where at least two runs have one.
    """
    found = set()
    for j, column in enumerate(columns):
        for scene in scenes_of(rows):
            values = {}
            for i, row in enumerate(rows):
                if row.run.scene.name == scene and column.key in row.values:
                    values[i] = column.better * round(row.values[column.key], column.digits)
            if column.better and len(values) > 1:
                best = max(values.values())
                found |= {(i, j) for i, value in values.items() if value == best}
    return frozenset(found)


@dataclass(frozen=True)
class Mean:
    """A method over scenes."""

    method: str
    scenes: tuple[str, ...]  # that all methods have finished
    values: dict[str, float]
    best: str  # scene, by PSNR, of all it has finished
    worst: str


def means(rows: Sequence[Row], oracle: bool) -> list[Mean]:
    """The mean of each method over the scenes that all of them have finished.

    Of oracle runs or of others. Methods that have finished no scene do not count.
    """
    done = [row for row in rows if row.status == "done" and row.run.scene.oracle == oracle]
    by_method = {name: [row for row in done if row.run.method == name] for name in methods_of(done)}
    common = []
    for scene in scenes_of(done):
        if all(scene in scenes_of(finished) for finished in by_method.values()):
            common.append(scene)
    result = []
    for name, finished in by_method.items():
        ranked = sorted(finished, key=lambda row: row.values["psnr"])
        values = mean_values([row for row in finished if row.run.scene.name in common])
        best, worst = ranked[-1].run.scene.name, ranked[0].run.scene.name
        result.append(Mean(name, tuple(common), values, best, worst))
    return result


def mean_values(rows: Sequence[Row]) -> dict[str, float]:
    """Means of the numbers that all of these runs have."""
    values = [row.values for row in rows]
    keys = dict.fromkeys(key for of_run in values for key in of_run)
    result = {}
    for key in keys:
        if key != "views" and all(key in of_run for of_run in values):
            result[key] = sum(of_run[key] for of_run in values) / len(values)
    return result


# What the numbers depend on


def trainings(rows: Sequence[Row]) -> list[Trained]:
    """The trainings of the runs that are done."""
    found = []
    for row in rows:
        if row.record is not None and row.record.trained is not None:
            found.append(row.record.trained)
    return found


def describe_machines(rows: Sequence[Row]) -> str:
    """The program, the machines, devices and threads of the runs, in a sentence."""
    trained = trainings(rows)
    machines = [t.machine for t in trained] or [this_machine()]
    devices = joined(t.device for t in trained) or "nothing yet"
    threads = joined(str(t.threads) for t in trained) or "-"
    programs = joined(program_of(machine) for machine in machines)
    computers = joined(f"{machine.cores} cores of {machine.cpu}" for machine in machines)
    return f"{programs}; {computers}; runs on {devices}, threads of each: {threads}"


def program_of(machine: Machine) -> str:
    """The versions that a run was trained with."""
    commit = f" (commit {machine.commit})" if machine.commit else ""
    return f"hdr-nsff {machine.version}{commit}, torch {machine.torch}"


def joined(texts: Iterable[str]) -> str:
    """Different texts with commas between them."""
    return ", ".join(dict.fromkeys(texts))


def command(plan: BenchPlan) -> str:
    """The command of the whole benchmark, for a shell."""
    words = bench_words(plan.config, ("only", "list", "collect"))
    return shell_line([part for word in words for part in word.split("=", 1)])


def describe_measurements(rows: Sequence[Row]) -> list[str]:
    """A sentence per scene: the views that its numbers are means of."""
    sentences = []
    for name in scenes_of(rows):
        own = [row for row in rows if row.run.scene.name == name]
        metrics = [row.metrics for row in own if row.metrics is not None]
        kinds = joined(f"{m['headline']['views']} {m['kind']}" for m in metrics)
        parts = [f"{name}: {kinds or 'nothing measured yet'}."]
        if own[0].run.scene.oracle:
            parts.append(ORACLE_NOTE)
        for note in dict.fromkeys(note for m in metrics for note in m["notes"]):
            parts.append(f"{note[:1].upper()}{note[1:]}.")
        sentences.append(" ".join(parts))
    return sentences


# Files


def write_tables(plan: BenchPlan, rows: Sequence[Row]) -> None:
    """results.csv, results.json and results.md."""
    out = plan.config.out
    write_csv(out / "results.csv", rows)
    write_json(out / "results.json", as_data(plan, rows))
    write_text(out / "results.md", markdown(plan, rows))


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """A line per run, every number that any run has."""
    keys = list(dict.fromkeys(key for row in rows for key in row.values))
    sheet = io.StringIO()
    writer = csv.writer(sheet, lineterminator="\n")
    writer.writerow(["scene", "method", "oracle", "status", "reason", *keys])
    for row in rows:
        scene = row.run.scene
        values = [repr(row.values[key]) if key in row.values else "" for key in keys]
        start = [scene.name, row.run.method, int(scene.oracle), row.status, row.reason]
        writer.writerow(start + values)
    write_text(path, sheet.getvalue())


def as_data(plan: BenchPlan, rows: Sequence[Row]) -> dict[str, Any]:
    """All results as plain data.

    `machine` is that of the tables; every run has its own.
    """
    settings = {}
    for field in fields(plan.config):
        if field.name not in ("out", *WHOLE_ONLY):
            settings[field.name] = getattr(plan.config, field.name)
    averages = []
    for oracle in (False, True):
        averages += [mean_data(mean, oracle) for mean in means(rows, oracle)]
    return {
        "command": command(plan),
        "machine": this_machine().model_dump(),
        "seed": plan.config.seed,
        "settings": settings,
        "columns": {column.key: column.label for column in used(rows, SCORES + COSTS)},
        "means": averages,
        "runs": [run_data(row) for row in rows],
    }


def mean_data(mean: Mean, oracle: bool) -> dict[str, Any]:
    """A mean as plain data."""
    return {
        "method": mean.method,
        "oracle": oracle,
        "scenes": list(mean.scenes),
        "best": mean.best,
        "worst": mean.worst,
        "values": mean.values,
    }


def run_data(row: Row) -> dict[str, Any]:
    """A run as plain data."""
    metrics = row.metrics or {}
    data: dict[str, Any] = {
        "scene": row.run.scene.name,
        "method": row.run.method,
        "oracle": row.run.scene.oracle,
        "status": row.status,
        "reason": row.reason,
        "values": row.values,
        "curve": [],
        "measured_on": metrics.get("kind"),
        "notes": metrics.get("notes", []),
        "folder": str(row.run.folder),
        "seed": row.run.config.seed,
        "device": None,
        "threads": None,
        "machine": None,
    }
    if row.record is not None:
        data["curve"] = [point.model_dump() for point in row.record.curve]
    for trained in trainings([row]):
        data["device"] = trained.device
        data["threads"] = trained.threads
        data["machine"] = trained.machine.model_dump()
    return data


# Markdown


def markdown(plan: BenchPlan, rows: Sequence[Row]) -> str:
    """results.md."""
    parts = [
        "# Results",
        f"```sh\n{command(plan)}\n```",
        f"{describe_machines(rows)}; seed {plan.config.seed}.",
        markdown_table(rows, SCORES),
    ]
    for oracle in (False, True):
        found = means(rows, oracle)
        if found:
            parts += [f"## {mean_title(found, oracle)}", grid(*mean_table(found, rows))]
    failed = [row for row in rows if row.status != "done"]
    if failed:
        lines = [f"- {row.run.name}: {row.status}: {row.reason}" for row in failed]
        parts += ["## Without a result", "\n".join(lines)]
    parts += ["## Cost", markdown_table(rows, COSTS)]
    measured = [f"- {sentence}" for sentence in describe_measurements(rows)]
    parts += ["## The views of these means", "\n".join(measured)]
    return "\n\n".join(parts) + "\n"


def markdown_table(rows: Sequence[Row], wanted: Sequence[Column]) -> str:
    """A line per run, the best of each scene bold."""
    columns = used(rows, wanted)
    bold = best_numbers(rows, columns)
    lines = []
    for i, row in enumerate(rows):
        cells = shown(row, columns)
        marked = [f"**{cell}**" if (i, j) in bold else cell for j, cell in enumerate(cells)]
        lines.append([row.run.scene.name, row.run.method, *marked])
    return grid(["scene", "method", *(column.label for column in columns)], lines)


def mean_title(found: Sequence[Mean], oracle: bool) -> str:
    """The scenes that are averaged, in words."""
    mean = "Mean of oracle runs" if oracle else "Mean"
    scenes = found[0].scenes
    if not scenes:
        return f"{mean} none: no scene that all methods finished"
    return f"{mean} over {plural(len(scenes), 'scene')}: {', '.join(scenes)}"


def mean_table(found: Sequence[Mean], rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Header and lines of the means, with every method's best and worst scene."""
    columns = used(rows, SCORES)
    lines = []
    for mean in found:
        values = [text(mean.values.get(column.key), column) for column in columns]
        lines.append([mean.method, mean.best, mean.worst, *values])
    header = ["method", "best scene (PSNR)", "worst scene", *(column.label for column in columns)]
    return header, lines


def grid(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [list(header), ["---"] * len(header)]
    for line in lines:
        rows.append([cell.replace("|", "\\|").replace("\n", " ") for cell in line])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
