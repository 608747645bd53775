"""The results of a benchmark as numbers: rows of runs, means, best and worst scenes;
CSV, JSON, Markdown. Every score is that of the run's own metrics.json, from its
`headline`.
"""

from __future__ import annotations

import csv
import io as memory
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from hdr_nsff import __version__
from hdr_nsff.bench.plan import OF_THE_WHOLE, BenchRun, Plan
from hdr_nsff.bench.pool import shell_line
from hdr_nsff.bench.run import complete, read_trial
from hdr_nsff.core import io, notes
from hdr_nsff.core.notes import RunRecord


@dataclass(frozen=True)
class Column:
    """A number of a run that the tables show."""

    key: str
    label: str
    digits: int
    better: int  # 1: the larger, -1: the smaller, 0: neither


SCORES = (
    Column("psnr", "PSNR", 2, 1), Column("psnr_moving", "moving", 2, 1), Column("ssim", "SSIM", 3, 1), Column("ssim_moving", "moving", 3, 1),
    Column("lpips", "LPIPS", 3, -1), Column("lpips_moving", "moving", 3, -1),
    Column("mu5000", "HDR μ-law 5000", 2, 1), Column("mu5000_moving", "moving", 2, 1), Column("mu5000_recordable", "recordable", 2, 1),
    Column("pu21", "PU21", 2, 1), Column("hdr_flip", "HDR-FLIP", 3, -1),
    Column("camera.response_rmse", "response RMSE", 4, -1), Column("camera.largest_step_error", "error of EV steps", 3, -1),
)  # fmt: skip
COSTS = (
    Column("train_seconds", "training, s", 1, 0), Column("steps", "steps", 0, 0), Column("start_seconds", "before it, s", 1, 0),
    Column("measure_seconds", "measuring, s", 1, 0), Column("memory_gb", "peak memory, GB", 2, -1),
    Column("gpu_memory_gb", "of the GPU", 2, -1), Column("frame_seconds", "seconds a frame", 3, -1),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A run in the tables."""

    cell: BenchRun
    status: str  # done, failed, or not finished
    reason: str  # why not done
    metrics: dict[str, Any] | None
    trial: RunRecord | None

    @property
    def values(self) -> dict[str, float]:
        """Every number of the run, by key."""
        if self.metrics is None or self.trial is None or self.trial.trained is None:
            return {}
        t = self.trial.trained
        costs = {
            "train_seconds": t.seconds,
            "steps": t.steps,
            "start_seconds": t.start_seconds,
            "frame_seconds": t.frame_seconds,
        }
        costs |= {"measure_seconds": self.trial.seconds}
        costs |= {"memory_gb": t.memory / 1e9} | (
            {} if t.gpu_memory is None else {"gpu_memory_gb": t.gpu_memory / 1e9}
        )
        parts = {
            "": self.metrics["headline"],
            "camera.": self.metrics.get("camera", {}),
            "poses.": self.metrics.get("poses", {}),
        }
        found = {
            p + k: v
            for p, part in parts.items()
            for k, v in part.items()
            if isinstance(v, int | float)
        }
        return found | costs


def row_of(cell: BenchRun, plan: Plan) -> Row:
    """What there is of a run."""
    if complete(cell, plan.config.views, plan.config.lpips):
        found = notes.read(cell.folder / "metrics.json", notes.Metrics)
        if found is not None:
            return Row(cell, "done", "", notes.to_dict(found), read_trial(cell))
    failure = notes.read(cell.folder / "failure.json", notes.Failure)
    if failure is not None:
        return Row(
            cell,
            "failed",
            failure.reason + (f" (log: {failure.log})" if failure.log else ""),
            None,
            None,
        )
    return Row(cell, "not finished", "the same command goes on with it", None, None)


def used(rows: Sequence[Row], columns: Sequence[Column]) -> list[Column]:
    """The columns that any run has."""
    return [c for c in columns if any(c.key in r.values for r in rows)]


def shown(row: Row, columns: Sequence[Column]) -> list[str]:
    """The numbers of a run as texts; where it has none, what became of it."""
    if row.status != "done":
        return [row.status, *[""] * (len(columns) - 1)]
    return [text(row.values.get(c.key), c) for c in columns]


def text(value: float | None, column: Column) -> str:
    """A number for people."""
    return (
        "–"
        if value is None
        else f"{value:,.{column.digits}f}"
        if column.key == "steps"
        else f"{value:.{column.digits}f}"
    )


def best_cells(rows: Sequence[Row], columns: Sequence[Column]) -> set[tuple[int, int]]:
    """(row, column) of the best value, as shown, of each column on each scene, where at
    least two runs have one.
    """
    found = set()
    for j, column in enumerate(columns):
        for name in dict.fromkeys(r.cell.scene.name for r in rows):
            values = {
                i: column.better * round(r.values[column.key], column.digits)
                for i, r in enumerate(rows)
                if r.cell.scene.name == name and column.key in r.values
            }
            if column.better and len(values) > 1:
                found |= {(i, j) for i, v in values.items() if v == max(values.values())}
    return found


@dataclass(frozen=True)
class Mean:
    """A method over scenes."""

    method: str
    scenes: tuple[str, ...]  # that all methods have finished
    values: dict[str, float]
    best: str  # scene, by PSNR, of all it has finished
    worst: str


def means(rows: Sequence[Row], oracle: bool) -> list[Mean]:
    """The mean of each method over the scenes that all of them have finished (but those
    that have finished none), of oracle runs or of others.
    """
    done = [r for r in rows if r.status == "done" and r.cell.scene.oracle == oracle]
    methods = list(dict.fromkeys(r.cell.method for r in done))
    finished = {m: [r for r in done if r.cell.method == m] for m in methods}
    scenes = [s for s in dict.fromkeys(r.cell.scene.name for r in done)
              if all(any(r.cell.scene.name == s for r in runs) for runs in finished.values())]  # fmt: skip
    result = []
    for name, runs in finished.items():
        common = [r.values for r in runs if r.cell.scene.name in scenes]
        keys = [
            k for k in dict.fromkeys(k for v in common for k in v) if all(k in v for v in common)
        ]
        ranked = sorted(runs, key=lambda r: r.values["psnr"])
        values = {k: sum(v[k] for v in common) / len(common) for k in keys if k != "views"}
        result.append(
            Mean(name, tuple(scenes), values, ranked[-1].cell.scene.name, ranked[0].cell.scene.name)
        )
    return result


def machine(rows: Sequence[Row]) -> str:
    """What it ran on, in a sentence."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    cpu = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )
    trained = [r.trial.trained for r in rows if r.trial is not None and r.trial.trained is not None]
    devices = ", ".join(dict.fromkeys(t.device for t in trained)) or "nothing yet"
    threads = ", ".join(dict.fromkeys(str(t.threads) for t in trained)) or "-"
    return f"hdr-nsff {__version__}, torch {torch.__version__}, tables made on {os.cpu_count()} cores of {cpu}; runs on {devices}, threads of each: {threads}"


def command(plan: Plan) -> str:
    """The command of the whole."""
    words = ["bench", str(plan.config.out)]
    for field in fields(plan.config):
        value = getattr(plan.config, field.name)
        if field.name not in ("out", "only", "list", "collect") and value != field.default:
            option = f"--{field.name.replace('_', '-')}"
            words += [option] if value is True else [option, str(value)]
    return shell_line(words)


def write_tables(plan: Plan, rows: Sequence[Row]) -> None:
    """results.csv, results.json and results.md."""
    out = plan.config.out
    keys = list(dict.fromkeys(k for r in rows for k in r.values))
    head = ["scene", "method", "oracle", "status", "reason"]
    sheet = memory.StringIO()
    writer = csv.writer(sheet, lineterminator="\n")
    writer.writerow(head + keys)
    for r in rows:
        start = [r.cell.scene.name, r.cell.method, int(r.cell.scene.oracle), r.status, r.reason]
        writer.writerow(start + [repr(r.values[k]) if k in r.values else "" for k in keys])
    io.write_text(out / "results.csv", sheet.getvalue())
    io.write_json(out / "results.json", as_data(plan, rows))
    io.write_text(out / "results.md", markdown(plan, rows))


def as_data(plan: Plan, rows: Sequence[Row]) -> dict[str, Any]:
    """All of it as plain data."""
    return {
        "command": command(plan),
        "machine": machine(rows),
        "settings": {f.name: getattr(plan.config, f.name) for f in fields(plan.config) if f.name not in ("out", *OF_THE_WHOLE)},
        "columns": {c.key: c.label for c in used(rows, SCORES + COSTS)},
        "means": [
            {"method": m.method, "oracle": oracle, "scenes": list(m.scenes), "best": m.best, "worst": m.worst, "values": m.values}
            for oracle in (False, True)
            for m in means(rows, oracle)
        ],
        "runs": [
            {
                "scene": r.cell.scene.name, "method": r.cell.method, "oracle": r.cell.scene.oracle, "status": r.status, "reason": r.reason,
                "values": r.values, "curve": [p.model_dump() for p in r.trial.curve] if r.trial else [],
                "measured_on": (r.metrics or {}).get("kind"), "notes": (r.metrics or {}).get("notes", []), "folder": str(r.cell.folder),
            }
            for r in rows
        ],
    }  # fmt: skip


def told_of_scenes(rows: Sequence[Row]) -> list[str]:
    """A sentence per scene: what its numbers are of."""
    found = []
    for name in dict.fromkeys(r.cell.scene.name for r in rows):
        own = [r for r in rows if r.cell.scene.name == name]
        oracle = (
            " An oracle run: its poses, masks, depth and flow were made from the truth."
            if own[0].cell.scene.oracle
            else ""
        )
        kinds = list(
            dict.fromkeys(
                f"{r.metrics['headline']['views']} {r.metrics['kind']}"
                for r in own
                if r.metrics is not None
            )
        )
        said = dict.fromkeys(note for r in own for note in (r.metrics or {}).get("notes", []))
        found.append(
            f"{name}: {', '.join(kinds) or 'nothing measured yet'}.{oracle}{''.join(f' {s[:1].upper()}{s[1:]}.' for s in said)}"
        )
    return found


def markdown(plan: Plan, rows: Sequence[Row]) -> str:
    """results.md."""
    parts = [
        "# Results",
        f"```sh\n{command(plan)}\n```",
        f"{machine(rows)}.",
        markdown_table(rows, SCORES),
    ]
    for oracle in (False, True):
        if found := means(rows, oracle):
            parts += [f"## {mean_title(found, oracle)}", grid(*mean_table(found, rows))]
    if failed := [r for r in rows if r.status != "done"]:
        parts += [
            "## Without a result",
            "\n".join(f"- {r.cell.name}: {r.status}: {r.reason}" for r in failed),
        ]
    parts += ["## Cost", markdown_table(rows, COSTS)]
    parts += ["## What the numbers are of", "\n".join(f"- {s}" for s in told_of_scenes(rows))]
    return "\n\n".join(parts) + "\n"


def markdown_table(rows: Sequence[Row], wanted: Sequence[Column]) -> str:
    """A line per run, the best of each scene bold."""
    columns = used(rows, wanted)
    bold = best_cells(rows, columns)
    lines = [
        [f"**{t}**" if (i, j) in bold else t for j, t in enumerate(shown(r, columns))]
        for i, r in enumerate(rows)
    ]
    names = [[r.cell.scene.name, r.cell.method] for r in rows]
    return grid(
        ["scene", "method", *(c.label for c in columns)],
        [n + line for n, line in zip(names, lines, strict=True)],
    )


def mean_title(found: Sequence[Mean], oracle: bool) -> str:
    """What is averaged."""
    scenes = found[0].scenes
    over = (
        f"over {len(scenes)} scene{'s' * (len(scenes) != 1)}: {', '.join(scenes)}"
        if scenes
        else "none: no scene that all methods finished"
    )
    return f"Mean {'of oracle runs ' * oracle}{over}"


def mean_table(found: Sequence[Mean], rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Header and lines of the means, with the best and the worst scene of every method."""
    columns = used(rows, SCORES)
    lines = [
        [m.method, m.best, m.worst, *(text(m.values.get(c.key), c) for c in columns)] for m in found
    ]
    return ["method", "best scene (PSNR)", "worst scene", *(c.label for c in columns)], lines


def grid(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    safe = [[c.replace("|", "\\|").replace("\n", " ") for c in line] for line in lines]
    return "\n".join(
        f"| {' | '.join(line)} |" for line in [list(header), ["---"] * len(header), *safe]
    )
