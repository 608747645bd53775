"""The command line: help, versions, exit codes; one sentence where the user can mend
it, and nothing lost.
"""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hdr_nsff import __version__, cli
from hdr_nsff.core.errors import InputError
from hdr_nsff.training.config import ABLATIONS, METHODS, PRESETS, TrainConfig
from hdr_nsff.training.run_folder import Run

COMMAND = [
    sys.executable,
    "-c",
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from hdr_nsff.cli import main; main()",
]


def call(*arguments: str) -> int:
    """Exit code of the command line."""
    try:
        cli.main(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def one_sentence(error: str) -> str:
    """What stderr holds, which must be one line and no traceback."""
    assert "Traceback" not in error and len(error.strip().splitlines()) == 1, error
    return error.strip()


@pytest.fixture
def act(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Replaces what `hdr-nsff evaluate` does."""
    return lambda does: monkeypatch.setitem(
        cli.VERBS, "evaluate", replace(cli.VERBS["evaluate"], act=does)
    )


def raising(error: BaseException) -> Any:
    def act(config: Any) -> None:
        raise error

    return act


@pytest.mark.parametrize("verb", list(cli.VERBS))
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(verb, "--help") == 0
    assert f"usage: hdr-nsff {verb}" in capsys.readouterr().out


@pytest.mark.parametrize("preset", list(PRESETS))
def test_every_preset_explains_its_settings(
    preset: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("train", preset, "--help") == 0
    out = capsys.readouterr().out
    assert (
        "--scene" in out
        and ("--field.bases" if preset.startswith("splat") else "--field.samples") in out
        and "--loss.temporal" in out
    )


def test_train_lists_methods_line_by_line_and_ablations_in_a_sentence(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert call("train", "--help") == 0
    out = capsys.readouterr().out
    assert all(f" {name} " in out for name in METHODS) and not any(
        f"grid-{name} " in out for name in ABLATIONS
    )
    assert all(name in out for name in ABLATIONS) and len(out.splitlines()) < 60


def test_an_ablation_reaches_the_verb_by_its_name(
    act: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[TrainConfig] = []
    monkeypatch.setitem(cli.VERBS, "train", replace(cli.VERBS["train"], act=seen.append))
    assert call("train", "splat-response-mlp", "--steps", "7") == 0
    assert seen == [replace(PRESETS["splat-response-mlp"], steps=7)]


def test_help_lists_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--help") == 0
    out = capsys.readouterr().out
    assert all(f"\n  {verb} " in out for verb in cli.VERBS)


def test_no_verb_prints_the_help_and_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert call() == 2 and "usage:" in capsys.readouterr().out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert call("--version") == 0 and capsys.readouterr().out == f"hdr-nsff {__version__}\n"


def test_an_unknown_verb_is_one_sentence_with_the_known_ones(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert call("sparkle") == 2
    said = one_sentence(capsys.readouterr().err)
    assert "'sparkle'" in said and all(verb in said for verb in cli.VERBS)


@pytest.mark.parametrize(
    "arguments",
    [
        ("render",),
        ("train",),
        ("train", "sparkle"),
        ("train", "tiny", "--steps", "x"),
        ("run", "a"),
    ],
)
def test_what_the_parser_refuses_exits_with_2(arguments: tuple[str, ...]) -> None:
    assert call(*arguments) == 2


def test_arguments_reach_the_verb(act: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[TrainConfig] = []
    monkeypatch.setitem(cli.VERBS, "train", replace(cli.VERBS["train"], act=seen.append))
    arguments = [
        "--scene",
        "a b/é",
        "--steps",
        "7",
        "--field.samples",
        "9",
        "--field.encoding.levels",
        "3",
        "--loss.cycle",
        "0.25",
    ]
    assert call("train", "grid", *arguments) == 0
    got, default = seen[0], PRESETS["grid"]
    assert (got.scene, got.steps, got.field.samples, got.loss.cycle) == (Path("a b/é"), 7, 9, 0.25)
    assert (
        got.field.encoding == replace(default.field.encoding, levels=3) and got.rays == default.rays
    )


def test_bad_input_is_one_sentence_and_exit_code_2(
    act: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    act(raising(InputError("x.png: cut short; copy it again")))
    assert call("evaluate", "run") == 2
    assert one_sentence(capsys.readouterr().err) == "hdr-nsff: x.png: cut short; copy it again"


def test_ctrl_c_exits_with_130_and_says_how_to_go_on(
    act: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    act(raising(KeyboardInterrupt()))
    assert call("evaluate", "run") == 130
    assert "the same command goes on" in one_sentence(capsys.readouterr().err)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS])
def test_a_disk_that_takes_nothing_is_one_sentence(
    number: int, act: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    act(raising(OSError(number, os.strerror(number), "out/a.exr")))
    assert call("evaluate", "run") == 2
    said = one_sentence(capsys.readouterr().err)
    assert "out/a.exr" in said and os.strerror(number) in said


@pytest.mark.parametrize(
    "error", [RuntimeError("ours"), OSError(errno.EBADF, "ours"), AssertionError("ours")]
)
def test_our_own_mistakes_are_not_hidden(error: Exception, act: Any) -> None:
    act(raising(error))
    with pytest.raises(type(error), match="ours"):
        call("evaluate", "run")


def test_training_from_a_folder_that_is_no_scene_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("train", "tiny", "--scene", str(tmp_path), "--out", str(tmp_path / "run")) == 2
    assert "no scene.json here" in one_sentence(capsys.readouterr().err)
    assert not (tmp_path / "run").exists()


def test_what_run_will_need_at_its_end_is_checked_at_its_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(b"")
    for option, word in (("--truth", "/nowhere"), ("--device", "gpu7")):
        assert call("run", str(tmp_path), str(tmp_path / "out"), option, word) == 2
        assert f"{option} {word}" in one_sentence(capsys.readouterr().err)
    assert not (tmp_path / "out").exists()


def train_arguments(scene: Path, out: Path, steps: int) -> list[str]:
    return [
        "train",
        "tiny",
        "--scene",
        str(scene),
        "--out",
        str(out),
        "--steps",
        str(steps),
        "--checkpoint-seconds",
        "0",
    ]


def training(scene: Path, out: Path, steps: int, limit: int | None = None) -> subprocess.Popen[str]:
    """`hdr-nsff train tiny` in a process of its own, which can write no file larger
    than `limit` bytes.
    """

    def prepare() -> None:
        if limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    arguments = train_arguments(scene, out, steps)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return subprocess.Popen(
        [*COMMAND, *arguments],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=prepare,
    )


def test_a_full_disk_ends_training_with_a_sentence_and_room_lets_it_go_on(
    toy_folder: Path, tmp_path: Path
) -> None:
    process = training(toy_folder, tmp_path / "run", 3, limit=65536)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "Traceback" not in error and "the disk is full" in error.strip().splitlines()[-1]
    assert not list(tmp_path.rglob(".partial-*")) and not list(tmp_path.rglob("step_*"))
    assert call(*train_arguments(toy_folder, tmp_path / "run", 3)) == 0
    assert Run.open(tmp_path / "run").step == 3


def test_ctrl_c_while_training_keeps_the_last_checkpoint(toy_folder: Path, tmp_path: Path) -> None:
    process = training(toy_folder, tmp_path / "run", 100_000)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("run/checkpoints/step_*[1-9].safetensors")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert (
        process.returncode == 130
        and "Traceback" not in error
        and "the same command goes on" in error
    )
    assert 0 < Run.open(tmp_path / "run").step < 100_000
