"""The verb `bench`: methods x scenes in one table.

Every pair is trained and measured in a process of its own. Finished runs are kept,
failed ones are shown.
"""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial

from hdr_nsff.bench.config import BenchConfig, BenchPlan, BenchRun, arguments
from hdr_nsff.bench.gallery import write_page
from hdr_nsff.bench.plan import claim, describe_scenes, make_plan
from hdr_nsff.bench.pool import Job, end_with_parent, failure_reason, run_jobs, shell_line, slots
from hdr_nsff.bench.run import LOG, do_run, is_complete, prepare_scene
from hdr_nsff.bench.tables import Row, row_of, write_tables
from hdr_nsff.core import notes
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import bar, say
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.evaluation.evaluate import load_lpips
from hdr_nsff.training.run_folder import last_logged, stored_config

__all__ = ["BenchConfig", "bench"]

MEASURING_SHARE = 0.1  # of a run's progress bar
MIN_TIME_LEFT_S = 90  # a shorter time left is not printed


def bench(config: BenchConfig) -> None:
    """The verb. SystemExit with 1 where a run has no result."""
    end_with_parent()
    plan = make_plan(config)
    if config.list:
        for run in plan.runs:
            print(shell_line(arguments(config, run.name)))
        return
    if config.lpips is not None:
        load_lpips(config.lpips)  # refuses unreadable weights before anything is trained
    if config.devices is None:
        pick_device(config.device)
    # A part of a benchmark (`--only`) leaves the folder's lock to the benchmark itself.
    lock = lock_output(config.out) if config.only is None else nullcontext()
    with writing_to(config.out), lock:
        claim(plan)
        if config.only is not None:
            do_one(plan, config.only)
            return
        describe_scenes(plan)
        if not config.collect:
            prepare_scenes(plan)
            do_runs(plan)
        unfinished = write_results(plan)
    if unfinished:
        raise SystemExit(1)


def do_one(plan: BenchPlan, name: str) -> None:
    """One run, or one scene, by name."""
    for scene in plan.scenes:
        if scene.name == name:
            return prepare_scene(scene)
    (run,) = [run for run in plan.runs if run.name == name]
    return do_run(run, plan.config.views, plan.config.lpips)


def prepare_scenes(plan: BenchPlan) -> None:
    """Prepare the scenes that are not there yet, in parallel.

    Where one fails, so do its runs, with the reason.
    """
    waiting = [scene.name for scene in plan.scenes if not scene.ready]
    if not waiting:
        return

    def ended(job: Job, code: int) -> None:
        if code == 0:
            say(f"{job.name}: prepared")
            return
        reason = failure_reason(job.log, code)
        say(f"{job.name}: could not be prepared: {reason} (log: {job.log})")
        failure = notes.Failure(reason=f"preparing: {reason}", log=str(job.log))
        for run in plan.runs:
            if run.scene.name == job.name:
                notes.write(run.failure, failure)

    say(f"preparing {', '.join(waiting)}")
    jobs = [job_of(plan, name) for name in waiting]
    run_jobs(jobs, slots(plan.config.jobs, plan.config.devices), ended, lambda running: None)


def job_of(plan: BenchPlan, name: str) -> Job:
    """The process of one run or scene."""
    log = plan.config.out / "logs" / f"{name}.log"
    return Job(name, arguments(plan.config, name), log, {LOG: str(log)})


def do_runs(plan: BenchPlan) -> None:
    """All runs that are not done and whose scenes are there, a few at a time."""
    config = plan.config
    waiting = {}
    for run in plan.runs:
        if run.scene.ready and not is_complete(run, config.views, config.lpips):
            waiting[run.name] = run
    if not waiting:
        return
    jobs = [job_of(plan, name) for name in waiting]
    with bar() as progress:
        task = progress.add_task("bench", total=len(waiting), note="")
        state = Progress(plan, waiting)

        def update(running: set[str]) -> None:
            completed = state.num_ended + state.work_done(running)
            progress.update(task, completed=completed, note=", ".join(sorted(running)))

        run_jobs(jobs, slots(config.jobs, config.devices), partial(report_end, state), update)


@dataclass
class Progress:
    """The progress of the runs."""

    plan: BenchPlan
    runs: dict[str, BenchRun]
    num_ended: int = 0
    start: float = field(default_factory=time.monotonic)

    def work_done(self, running: set[str]) -> float:
        """The sum of the shares that are done of the runs at work."""
        return sum(share_done(self.runs[name]) for name in running)

    def time_left(self) -> float:
        """Estimated seconds until all runs have ended."""
        seconds = time.monotonic() - self.start
        return seconds / self.num_ended * (len(self.runs) - self.num_ended)


def share_done(run: BenchRun) -> float:
    """The share of a run at work that is done, by the last line of its log."""
    line = last_logged(run.folder)
    if line is None:
        return 0.0
    budget = stored_config(run.folder)[0].budget  # an open one follows the clip there
    share = budget.progress(line.step, line.seconds)
    return (1 - MEASURING_SHARE) * min(share, 1.0)


def report_end(state: Progress, job: Job, code: int) -> None:
    """Print the result of a run that has ended.

    Where it failed without a note, write one.
    """
    state.num_ended += 1
    run = state.runs[job.name]
    if code != 0 and not run.failure.is_file():
        reason = failure_reason(job.log, code)
        notes.write(run.failure, notes.Failure(reason=reason, log=str(job.log)))
    position = f"{state.num_ended} of {len(state.runs)}"
    left = state.time_left()
    if left > MIN_TIME_LEFT_S:
        position += f", about {left / 60:.0f} min left"
    say(f"{run.name}: {result_in_words(row_of(run, state.plan))}  ({position})")


def result_in_words(row: Row) -> str:
    """Quality and cost of a run, or why it has none."""
    values = row.values
    if not values:
        return f"{row.status}: {row.reason}"
    scores = []
    if "psnr" in values:
        scores.append(f"{values['psnr']:.2f} dB")
    if "psnr_moving" in values:
        scores.append(f"{values['psnr_moving']:.2f} dB moving")
    cost = f"{values['steps']:,} steps in {values['train_seconds']:.0f} s"
    return f"{', '.join(scores)}; {cost}"


def write_results(plan: BenchPlan) -> int:
    """The tables and the page; the number of runs without a result."""
    rows = [row_of(run, plan) for run in plan.runs]
    write_tables(plan, rows)
    write_page(plan, rows)
    unfinished = [row for row in rows if row.status != "done"]
    for row in unfinished:
        say(f"{row.run.name}: {row.status}: {row.reason}")
    files = f"{plan.config.out / 'index.html'}, results.md, results.csv, results.json"
    say(f"{len(rows) - len(unfinished)} of {len(rows)} runs done; results: {files}")
    return len(unfinished)
