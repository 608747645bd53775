"""The loop: same seed same parameters, killed and resumed like unbroken, two processes
like one; clocks and schedules.
"""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
import torch
from presets import interrupted_at, small, trainer
from safetensors.torch import load_file
from torch import Tensor

from hdr_nsff.core import distributed
from hdr_nsff.core.checkpoints import latest_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_json
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.training import run_folder
from hdr_nsff.training.budget import Budget, Clock, Schedule, Stopwatch, minutes_for
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run, read_log, snapshots
from hdr_nsff.training.run_writer import RunWriter
from hdr_nsff.training.train import Trainer, train

STEPS = 24  # over them the culling grids refresh and the tone mapper is anchored


def config(scene: Path, out: Path, preset: str = "grid") -> TrainConfig:
    return replace(small(preset, scene, out, STEPS), batches=2, seed=3)


def final(run: Path) -> dict[str, Tensor]:
    """The newest checkpoint: parameters, culling grids, moments."""
    return load_file(max((run / "checkpoints").glob("step_*.safetensors")))


def assert_same(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    assert a.keys() == b.keys()
    different = [k for k in a if not torch.equal(a[k], b[k])]
    assert not different, different


@pytest.fixture(scope="module")
def unbroken(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `STEPS` steps in one go."""
    return train(config(toy_folder, tmp_path_factory.mktemp("unbroken") / "run"))


def test_the_same_seed_gives_the_same_parameters_bit_for_bit(
    unbroken: Path, toy_folder: Path, tmp_path: Path
) -> None:
    again = final(train(config(toy_folder, tmp_path / "run")))
    assert_same(final(unbroken), again)
    assert (
        any(k.startswith("optimizer.touched.") for k in again)
        and "field.static_cells.weight" in again
    )


def test_another_seed_gives_others(unbroken: Path, toy_folder: Path, tmp_path: Path) -> None:
    other = final(train(replace(config(toy_folder, tmp_path / "run"), seed=4)))
    name = "field.branches.static_grid.table"
    assert not torch.equal(final(unbroken)[name], other[name])


@pytest.mark.parametrize("preset", ["splat", "grid", "paper", "hdr-hexplane", "nerf-wt"])
def test_a_stopped_run_resumes_to_the_unbroken_ones_parameters(
    preset: str, unbroken: Path, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(config(toy_folder, tmp_path / "run", preset), checkpoint_seconds=0.0)
    straight = final(
        unbroken
        if preset == "grid"
        else train(replace(settings, out=tmp_path / "straight", checkpoint_seconds=1e9))
    )
    monkeypatch.setattr(run_folder, "write_preview", lambda *_: None)
    for stop in (3, 17):  # before and after culling starts and the tone mapper is anchored
        interrupted_at(stop, settings, monkeypatch)
        assert (
            max(p.name for p in (settings.out / "checkpoints").iterdir())
            == f"step_{stop:08d}.safetensors"
        )
    assert_same(final(train(settings)), straight)


# Adam divides by the size of a gradient. Where that cancels to nearly nothing, the
# order of a sum decides the step; with this epsilon, it does not.
SMOOTH_ADAM = (
    "from hdr_nsff.training import optimizers\n"
    "as_dict = optimizers.as_dict\n"
    "optimizers.as_dict = lambda group: as_dict(group) | {'eps': 1e-5}\n"
)


def command(settings: TrainConfig, *launcher: str, setup: str = "") -> subprocess.Popen[bytes]:
    """`hdr-nsff train` in other processes, which first run the lines of `setup`."""
    script = settings.out.parent / "again.py"
    script.write_text(
        "import json, sys\n"
        "from hdr_nsff.training.config import TrainConfig\n"
        "from hdr_nsff.training import run_folder\n"
        "from hdr_nsff.training.train import train\n"
        "run_folder.write_preview = lambda *_: None\n"
        f"{setup}"
        "train(TrainConfig.from_json(json.loads(open(sys.argv[1]).read())))\n"
    )
    given = settings.out.parent / "given.json"
    write_json(given, settings.to_json())
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    arguments = [sys.executable, *launcher, str(script), str(given)]
    return subprocess.Popen(
        arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )


def test_a_run_killed_outright_resumes_to_the_same_parameters(
    unbroken: Path, toy_folder: Path, tmp_path: Path
) -> None:
    settings = replace(config(toy_folder, tmp_path / "run"), checkpoint_seconds=0.0)
    process = command(settings)
    deadline = time.monotonic() + 120
    while len(list(tmp_path.glob("run/checkpoints/step_0000000[2-9]*"))) == 0:
        assert process.poll() is None and time.monotonic() < deadline, (
            process.stderr and process.stderr.read().decode()
        )
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    left = max(p.name for p in (settings.out / "checkpoints").glob("step_*"))
    assert left < f"step_{STEPS:08d}.safetensors", "killed too late to show anything"
    assert_same(final(train(settings)), final(unbroken))


def test_two_processes_do_what_one_does_and_resume_too(toy_folder: Path, tmp_path: Path) -> None:
    def checkpoint_of(settings: TrainConfig, *launcher: str) -> dict[str, Tensor]:
        process = command(settings, *launcher, setup=SMOOTH_ADAM)
        _, errors = process.communicate(timeout=240)
        assert process.returncode == 0, errors.decode()[-3000:]
        return final(settings.out)

    settings = replace(config(toy_folder, tmp_path / "run"), checkpoint_seconds=0.0)
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    one = checkpoint_of(config(toy_folder, tmp_path / "one"))
    for _ in range(2):
        two = checkpoint_of(settings, *launcher)
        assert two.keys() == one.keys()
        for name in one:
            if name.startswith(("field.", "tonemapper.")):
                torch.testing.assert_close(
                    two[name], one[name], atol=2e-6, rtol=2e-5, msg=lambda m, n=name: f"{n}: {m}"
                )
        max(
            (settings.out / "checkpoints").glob("step_*")
        ).unlink()  # the second round goes on from the step before


def test_more_processes_than_batches_is_said(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        distributed, "group", lambda device: contextlib.nullcontext(distributed.Ranks(0, 4))
    )
    with pytest.raises(InputError, match="4 processes share 2 batches"):
        train(config(toy_folder, tmp_path / "run"))


@torch.no_grad()
def squared_error(run: Run) -> float:
    """Mean squared error of the pictures of all training frames."""
    errors = []
    for i, frame in enumerate(run.scene.train):
        recorder = run.tonemapper.recorder(frame.bracket, frame.camera_id, i)
        (rgb,) = record_pixels(run.field, frame.camera, frame.time, [recorder])
        errors.append((rgb.view_as(frame.image) - frame.image).square().mean())
    return float(torch.stack(errors).mean())


def test_training_lowers_the_error(toy_folder: Path, tmp_path: Path) -> None:
    settings = replace(small("grid", toy_folder, tmp_path / "run", 75), rays=192, moving_rays=64)
    train(settings)
    first, run = (
        Run.open(settings.out, at=min(settings.out.glob("checkpoints/*"))),
        Run.open(settings.out),
    )
    log = run.log()
    assert [line.step for line in log] == [25, 50, 75] and (first.step, run.step) == (0, 75)
    assert squared_error(run) < 0.5 * squared_error(first)
    assert {"photometric", "dynamic", "temporal", "cycle", "response_smoothness"} <= set(
        log[-1].losses
    )
    assert list((settings.out / "previews").glob("*.png"))


def test_other_settings_in_the_same_folder_are_refused(unbroken: Path, toy_folder: Path) -> None:
    with pytest.raises(InputError, match="other settings"):
        train(replace(config(toy_folder, unbroken), rays=65))


def test_a_run_goes_on_with_its_own_budget_where_none_is_given(
    unbroken: Path, toy_folder: Path
) -> None:
    train(replace(config(toy_folder, unbroken), budget=Budget()))
    assert Run.open(unbroken).step == STEPS


def test_a_finished_run_stays_finished(unbroken: Path, toy_folder: Path) -> None:
    before = final(unbroken)
    train(config(toy_folder, unbroken))
    assert_same(before, final(unbroken))


def test_without_steps_and_minutes_the_time_follows_the_clip() -> None:
    assert Budget().for_clip(64 * 36, 10) == Budget(minutes=5.0)
    assert minutes_for(640 * 360, 65) > 10 and minutes_for(1920 * 1080, 300) == 30
    for given in (Budget(steps=7), Budget(minutes=2.0)):
        assert given.for_clip(1920 * 1080, 300) == given


def test_a_minute_limit_holds(toy_folder: Path, tmp_path: Path) -> None:
    settings = replace(config(toy_folder, tmp_path / "run"), budget=Budget(minutes=1.5 / 60))
    run = Run.open(train(settings))
    assert run.step > 3 and 1.5 <= run.seconds < 10


def test_snapshots_are_kept_during_training_and_do_not_change_it(
    unbroken: Path, toy_folder: Path, tmp_path: Path
) -> None:
    run = train(config(toy_folder, tmp_path / "run"), keep_at=(0.5, 0.125), previews=False)
    assert_same(final(unbroken), final(run))
    assert not (run / "previews").exists() and list(snapshots(run)) == [0.125, 0.5]
    half = Run.open(run, at=snapshots(run)[0.5])
    assert half.step == STEPS // 2 and 0 < half.seconds < Run.open(run).seconds
    table = "branches.static_grid.table"
    assert not torch.equal(half.field.state_dict()[table], Run.open(run).field.state_dict()[table])
    assert not any(k.startswith("optimizer.") for k in load_file(snapshots(run)[0.5]))


def test_a_resumed_run_keeps_the_snapshots_that_are_still_to_come(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(config(toy_folder, tmp_path / "run"), checkpoint_seconds=0.0)
    step = Trainer.step

    def stopping(self: Trainer) -> dict[str, float]:
        if self.clock.step == 8:
            raise KeyboardInterrupt
        return step(self)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "step", stopping)
        train(settings, keep_at=(0.25, 0.5))
    first = snapshots(settings.out)[0.25].stat().st_mtime_ns
    train(settings, keep_at=(0.25, 0.5))
    assert (
        list(snapshots(settings.out)) == [0.25, 0.5]
        and snapshots(settings.out)[0.25].stat().st_mtime_ns == first
    )


def test_the_clock_stops_while_files_are_written(
    toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RunWriter, "save_snapshot", lambda self, clock, share: time.sleep(3.0))
    monkeypatch.setattr(Trainer, "step", lambda self: {"psnr": 0.0})
    start = time.monotonic()
    run = Run.open(train(config(toy_folder, tmp_path / "run"), keep_at=(0.5,), previews=False))
    assert run.seconds < 2 and time.monotonic() - start > 3


def test_draws_depend_on_seed_step_and_slot_alone(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    t = trainer(config(toy_folder, tmp_path / "run"), toy)
    first, same, slot = t.draw(0), t.draw(0), t.draw(1)
    assert torch.equal(first.pixels, same.pixels) and first.seed == same.seed
    t.clock = replace(t.clock, step=1)
    assert len({first.seed, slot.seed, t.draw(0).seed}) == 3
    frames = {t.draw(s).frame for s in range(40)}
    assert frames == set(range(6))


def test_nan_names_the_step_and_the_term(toy: Scene, toy_folder: Path, tmp_path: Path) -> None:
    t = trainer(config(toy_folder, tmp_path / "run"), toy)
    t.field.branches.static_grid.table.data.fill_(math.nan)
    with pytest.raises(
        FloatingPointError, match=r"step 0: the terms \['photometric'.* are not finite; pixel \["
    ):
        t.step()


def test_a_checkpoint_with_nan_is_not_written_and_the_last_one_stays(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    t = trainer(config(toy_folder, tmp_path / "run"), toy)
    t.save()
    with torch.no_grad():
        next(t.field.parameters()).view(-1)[0] = math.nan
    t.clock = replace(t.clock, step=1)
    with pytest.raises(FloatingPointError, match=r"step 1: field\..* not finite"):
        t.save()
    kept = latest_checkpoint(tmp_path / "run")
    assert kept is not None and kept.step == 0


def at(preset: str, step: int, frames: int = 24, budget: Budget | None = None) -> Clock:
    config = PRESETS[preset]
    return Clock(budget or config.budget, config.schedule, frames, step)


def test_the_published_period_is_a_thousand_steps_per_frame_between_30_and_250_frames() -> None:
    for frames, period in ((6, 30_000), (30, 30_000), (100, 100_000), (999, 250_000)):
        assert at("paper", period, frames).phase == 1.0
        assert at("paper", period // 2, frames).phase == 0.5


def test_the_published_learning_rate_falls_by_a_tenth_in_300_000_steps() -> None:
    assert at("paper", 0).lr_share == 1.0
    assert math.isclose(at("paper", 300_000).lr_share, 0.1)


def test_grid_schedules_follow_the_share_of_the_run() -> None:
    clock = at("grid", 45, budget=Budget(steps=90))
    assert (
        clock.progress == 0.5
        and math.isclose(clock.phase, 0.5 / 0.45)
        and math.isclose(clock.lr_share, 0.05**0.5)
    )


def test_training_says_its_time_left_early_and_at_checkpoints(
    toy: Scene, toy_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    budget = Budget(steps=1000, minutes=None)
    t = trainer(replace(config(toy_folder, tmp_path / "run"), budget=budget), toy)
    capsys.readouterr()
    with t.writer.progress_bar():
        for step in (1, 25, 50, 75):  # a second each
            clock = replace(t.clock, step=step, seconds=float(step))
            t.writer.log(clock, {"psnr": 20.0})
        t.writer.finish_checkpoint(clock)
    printed = capsys.readouterr().err.splitlines()
    assert printed == [
        "train: 2%, step 25, 20.0 dB, 16 min left",
        "train: 8%, step 75, 20.0 dB, 15 min left",
    ]


def test_without_steps_the_clock_counts_minutes() -> None:
    clock = Clock(Budget(minutes=5.0), Schedule(period=0.5), 24, 10**6, 75.0)
    assert clock.progress == 0.25 and clock.phase == 0.5
    assert replace(clock, seconds=1e6).progress == 1.0


def test_the_first_step_says_nothing_of_the_time_left() -> None:
    clock = Clock(Budget(steps=100), Schedule(), 24, step=1, seconds=Stopwatch(0.0).read())
    assert clock.seconds_left is None
    assert replace(clock, step=50, seconds=20.0).seconds_left == pytest.approx(20.0)


@pytest.mark.parametrize("kind", ["none", "fixed", "per_image", "mlp", "sigmoid"])
def test_every_kind_of_tone_mapper_trains(
    kind: Literal["none", "fixed", "per_image", "mlp", "sigmoid"], toy_folder: Path, tmp_path: Path
) -> None:
    settings = replace(config(toy_folder, tmp_path / "run"), tonemap=ToneMapConfig(kind=kind))
    log = read_log(train(replace(settings, budget=Budget(steps=25))))
    assert log[-1].step == 25 and log[-1].psnr > 5
