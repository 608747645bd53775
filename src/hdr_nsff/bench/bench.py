"""Methods x scenes -> one table: every pair is trained and measured in a process of its
own, what is done is kept, what fails is shown.
"""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from hdr_nsff.bench.gallery import write_page
from hdr_nsff.bench.plan import BenchConfig, BenchRun, Plan, arguments, claim, introduce, make_plan
from hdr_nsff.bench.pool import Job, end_with_parent, last_words, run_jobs, shell_line, slots
from hdr_nsff.bench.run import LOG, complete, get_ready, run_cell
from hdr_nsff.bench.tables import row_of, write_tables
from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import bar, say
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.maths.metrics import Lpips
from hdr_nsff.training.run_folder import last_logged

__all__ = ["BenchConfig", "bench"]

MEASURING = 0.1  # share of a run's bar that measuring has


def bench(config: BenchConfig) -> None:
    """The verb. SystemExit with 1 where a run has no result."""
    end_with_parent()
    plan = make_plan(config)
    if config.list:
        for cell in plan.cells:
            print(shell_line(arguments(config, cell.name)))
        return
    if config.lpips is not None:
        Lpips(config.lpips)  # refuses what it cannot read, before anything is trained
    if config.devices is None:
        pick_device(config.device)
    # `--only` is part of a benchmark that may hold the lock; its run has one of its own.
    lock = lock_output(config.out) if config.only is None else nullcontext()
    with writing_to(config.out), lock:
        claim(plan)
        if config.only is not None:
            do_one(plan, config.only)
            return
        introduce(plan)
        if not config.collect:
            prepare_scenes(plan)
            do_all(plan)
        unfinished = write_results(plan)
    if unfinished:
        raise SystemExit(1)


def do_one(plan: Plan, only: str) -> None:
    """One run, or one scene, by name."""
    for scene in plan.scenes:
        if scene.name == only:
            return get_ready(scene)
    cell = next((c for c in plan.cells if c.name == only), None)
    if cell is None:
        raise InputError(
            f"--only {only!r:.100}: no such run; there are {', '.join(c.name for c in plan.cells)}"
        )
    run_cell(cell, plan.config.views, plan.config.lpips)


def prepare_scenes(plan: Plan) -> None:
    """Prepare the scenes that are not there yet, side by side; where one cannot be, its
    runs fail with the reason.
    """
    waiting = [s for s in plan.scenes if not s.ready]
    jobs = [job(plan, s.name, plan.config.out / "logs" / f"{s.name}.log") for s in waiting]

    def ended(done: Job, code: int) -> None:
        if code == 0:
            say(f"{done.name}: prepared")
            return
        reason = last_words(done.log, code)
        say(f"{done.name}: could not be prepared: {reason} (log: {done.log})")
        for cell in plan.cells:
            if cell.scene.name == done.name:
                notes.write(
                    cell.folder / "failure.json",
                    notes.Failure(reason=f"preparing: {reason}", log=str(done.log)),
                )

    places = slots(plan.config.jobs, plan.config.devices)
    if jobs:
        say(f"preparing {', '.join(s.name for s in waiting)}")
        run_jobs(jobs, places, ended, lambda running: None)


def job(plan: Plan, only: str, log: Path) -> Job:
    """The process of one run or scene."""
    return Job(only, arguments(plan.config, only), log, {LOG: str(log)})


def do_all(plan: Plan) -> None:
    """All runs that are not done and whose scenes are there, as many at once as asked
    for.
    """
    config = plan.config
    todo = [c for c in plan.cells if c.scene.ready and not complete(c, config.views, config.lpips)]
    jobs = [job(plan, c.name, c.log) for c in todo]
    if not jobs:
        return
    cells = {c.name: c for c in todo}
    with bar() as progress:
        task = progress.add_task("bench", total=len(todo), note="")
        state = Standing(plan, cells)
        ended = partial(state.ended)

        def look(running: set[str]) -> None:
            progress.update(
                task,
                completed=state.done + state.on_the_way(running),
                note=", ".join(sorted(running)),
            )

        run_jobs(jobs, slots(config.jobs, config.devices), ended, look)


@dataclass
class Standing:
    """How far the runs are."""

    plan: Plan
    cells: dict[str, BenchRun]
    done: int = 0
    start: float = field(default_factory=time.monotonic)

    def ended(self, which: Job, code: int) -> None:
        """Say how a run ended; where it failed without a word, note why."""
        self.done += 1
        cell = self.cells[which.name]
        if code != 0 and not (cell.folder / "failure.json").is_file():
            notes.write(
                cell.folder / "failure.json",
                notes.Failure(reason=last_words(which.log, code), log=str(which.log)),
            )
        row = row_of(cell, self.plan)
        values = row.values
        numbers = [
            f"{values[k]:.2f} dB{word}"
            for k, word in (("psnr", ""), ("psnr_moving", " moving"))
            if k in values
        ]
        told = (
            f"{', '.join(numbers)}; {values['steps']:,} steps in {values['train_seconds']:.0f} s"
            if values
            else f"{row.status}: {row.reason}"
        )
        left = (time.monotonic() - self.start) / self.done * (len(self.cells) - self.done)
        say(
            f"{cell.name}: {told}  ({self.done} of {len(self.cells)}{f', about {left / 60:.0f} min left' if left > 90 else ''})"
        )

    def on_the_way(self, running: set[str]) -> float:
        """What part of the runs at work is done, together."""
        total = 0.0
        for name in running:
            config = self.cells[name].config
            line = last_logged(config.out)
            if line is not None:
                share = (
                    line.step / config.steps
                    if config.steps
                    else line.seconds / 60 / (config.minutes or 1)
                )
                total += (1 - MEASURING) * min(share, 1.0)
        return total


def write_results(plan: Plan) -> int:
    """The tables and the page; how many runs have no result."""
    rows = [row_of(cell, plan) for cell in plan.cells]
    write_tables(plan, rows)
    write_page(plan, rows)
    unfinished = [r for r in rows if r.status != "done"]
    for row in unfinished:
        say(f"{row.cell.name}: {row.status}: {row.reason}")
    say(
        f"{len(rows) - len(unfinished)} of {len(rows)} runs done; results: {plan.config.out / 'index.html'}, results.md, results.csv, results.json"
    )
    return len(unfinished)
