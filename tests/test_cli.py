"""The command line: help, versions, exit codes; one sentence where the user can fix it,
and nothing lost.
"""

import errno
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hdr_nsff import __version__, cli
from hdr_nsff.core import refusals
from hdr_nsff.core.errors import InputError
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import ABLATIONS, METHODS, PRESETS
from hdr_nsff.training.run_folder import Run

Act = Callable[[Callable[[Any], Any]], None]
Capture = pytest.CaptureFixture[str]
MAIN = "from hdr_nsff.cli import main; main()"
INTERRUPTIBLE = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
COMMAND = [sys.executable, "-c", INTERRUPTIBLE + MAIN]


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
def act(monkeypatch: pytest.MonkeyPatch) -> Act:
    """Replaces what `hdr-nsff evaluate` does."""
    return lambda does: monkeypatch.setattr("hdr_nsff.evaluation.evaluate.evaluate", does)


@pytest.fixture
def trained_with(monkeypatch: pytest.MonkeyPatch) -> list[TrainConfig]:
    """The configs that `hdr-nsff train` is called with, which trains nothing."""
    configs: list[TrainConfig] = []
    monkeypatch.setattr("hdr_nsff.training.train.train", configs.append)
    return configs


def raising(error: BaseException) -> Callable[[Any], Any]:
    def act(config: Any) -> None:
        raise error

    return act


@pytest.mark.parametrize("verb", list(cli.VERBS))
def test_every_verb_explains_itself(verb: str, capsys: Capture) -> None:
    assert call(verb, "--help") == 0
    assert f"usage: hdr-nsff {verb}" in capsys.readouterr().out


@pytest.mark.parametrize("preset", list(PRESETS))
def test_every_preset_explains_its_settings(preset: str, capsys: Capture) -> None:
    assert call("train", preset, "--help") == 0
    out = capsys.readouterr().out
    own_setting = "--field.bases" if preset.startswith("splat") else "--field.samples"
    assert all(setting in out for setting in ("--scene", own_setting, "--loss.photometric"))


def test_train_lists_methods_line_by_line_and_ablations_in_a_sentence(
    capsys: Capture,
) -> None:
    assert call("train", "--help") == 0
    out = capsys.readouterr().out
    assert all(f" {name} " in out for name in METHODS)
    assert all(name in out for name in ABLATIONS)
    assert not any(f"grid-{name} " in out for name in ABLATIONS)
    assert len(out.splitlines()) < 60


def test_an_ablation_reaches_the_verb_by_its_name(trained_with: list[TrainConfig]) -> None:
    assert call("train", "splat-response-mlp", "--steps", "7") == 0
    assert trained_with == [replace(PRESETS["splat-response-mlp"], budget=Budget(steps=7))]


def test_every_preset_with_a_line_of_help_exists() -> None:
    assert list(cli.PRESET_HELP) == list(METHODS)


def test_help_lists_every_verb(capsys: Capture) -> None:
    assert call("--help") == 0
    out = capsys.readouterr().out
    assert all(f"\n  {verb} " in out for verb in cli.VERBS)


def test_no_verb_prints_the_help_and_is_an_error(capsys: Capture) -> None:
    assert call() == 2 and "usage:" in capsys.readouterr().out


def test_version(capsys: Capture) -> None:
    assert call("--version") == 0 and capsys.readouterr().out == f"hdr-nsff {__version__}\n"


def new_process(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A Python process that has run `code`."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_importing_the_command_line_imports_no_library() -> None:
    loaded = "import sys, hdr_nsff.cli; print({name.partition('.')[0] for name in sys.modules})"
    names = new_process(loaded).stdout
    assert "'hdr_nsff'" in names
    assert not any(f"'{name}'" in names for name in ("torch", "numpy", "numba", "cv2", "tyro"))


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_version_and_help_answer_at_once(option: str) -> None:
    seconds = []
    for _ in range(5):
        start = time.monotonic()
        assert new_process(MAIN, option).returncode == 0
        seconds.append(time.monotonic() - start)
    assert min(seconds) < 0.3


@pytest.mark.parametrize(("is_terminal", "seconds"), [(True, 0.0), (True, 60.0), (False, 0.0)])
def test_a_terminal_shows_that_libraries_are_loaded_where_that_takes_long(
    is_terminal: bool, seconds: float, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    with cli.loading(seconds):
        time.sleep(0.1)
    shown = f"{cli.LOADING}\r{' ' * len(cli.LOADING)}\r"
    assert capsys.readouterr().err == (shown if is_terminal and not seconds else "")


def test_an_unknown_verb_suggests_the_closest_one(capsys: Capture) -> None:
    assert call("trian") == 2
    sentence = one_sentence(capsys.readouterr().err)
    assert "no verb 'trian'; did you mean train?" in sentence
    assert all(verb in sentence for verb in cli.VERBS)


def test_an_unknown_verb_unlike_any_other_gets_the_list(capsys: Capture) -> None:
    assert call("quux") == 2
    assert "did you mean" not in one_sentence(capsys.readouterr().err)


def test_a_library_that_cannot_be_imported_is_one_sentence(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "hdr_nsff.synth.reexpose", raising=False)
    monkeypatch.setitem(sys.modules, "cv2", None)
    monkeypatch.delitem(sys.modules, "hdr_nsff.core.images", raising=False)
    assert call("reexpose", "clip", "out") == 2
    sentence = one_sentence(capsys.readouterr().err)
    assert "cv2" in sentence and "`hdr-nsff doctor`" in sentence


def test_a_broken_import_inside_the_package_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = replace(cli.VERBS["report"], function="hdr_nsff.no_such_room:report")
    monkeypatch.setitem(cli.VERBS, "report", broken)
    with pytest.raises(ModuleNotFoundError, match="no_such_room"):
        call("report")


def test_a_very_long_argument_is_not_repeated_whole(act: Act, capsys: Capture) -> None:
    act(raising(InputError(f"--ev {'9' * 5000}: write stops")))
    assert call("evaluate", "run") == 2
    sentence = one_sentence(capsys.readouterr().err)
    assert len(sentence) < 600 and sentence.endswith("9: write stops")


@pytest.mark.parametrize("arguments", [["--help"], ["prepare", "--help"], ["weights"]])
def test_a_reader_that_has_gone_gets_silence(arguments: list[str]) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-c", MAIN, *arguments]
    process = subprocess.Popen(command, stdout=write_end, stderr=subprocess.PIPE, text=True)
    os.close(write_end)
    assert process.communicate(timeout=120)[1] == ""
    assert process.returncode in (1, 141)  # 1: `rich` closes the pipe of a table itself


def test_ctrl_c_while_libraries_are_imported_shows_no_traceback() -> None:
    interrupted = """
import signal, sys
def interrupt(event, arguments):
    if event == "import" and arguments[0] == sys.argv[1]:
        signal.raise_signal(signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.addaudithook(interrupt)
from hdr_nsff.cli import main
main(["report", "--help"])
"""
    for module in ("hdr_nsff.core.process", "hdr_nsff.core.io", "cv2"):
        ended = new_process(interrupted, module)
        assert ended.returncode == 130, module
        assert "Traceback" not in ended.stderr


REFUSED = {
    "render": "RUN is missing; `hdr-nsff render --help` explains it",
    "run a": "OUT is missing; `hdr-nsff run --help`",
    "bench": "OUT, --scenes and --methods are missing; `hdr-nsff bench --help` explains them",
    "bench out --scene a --methods b": "--scene: no such option (did you mean --scenes?)",
    "prepare a b --sterde 3": "--sterde: no such option (did you mean --stride?); `hdr-nsff prep",
    "prepare a b -x": "-x: no such option; `hdr-nsff prepare --help` lists all",
    "prepare a b --redo nothing": "--redo nothing: no such choice; choose one of frames, exp",
    "prepare a b c": "'c': one argument too many",
    "prepare a b --same-camera x": "--same-camera x: not two values; `hdr-nsff prepare --help`",
    "prepare a b --max_size=1e": "--max-size 1e: not a whole number; `hdr-nsff prepare --help`",
    "run a b --tripod maybe": "--tripod maybe: the option takes no value; leave 'maybe' out",
    "run a b --preset gird": "--preset gird: no such choice (did you mean grid?)",
    "run a b --preset paper-small": "`hdr-nsff train paper-small --scene OUT/scene` has it",
    "export a b --layout foo": "--layout foo: no such choice; choose one of hdr-gopro, nerfstudio",
    "render a b": "'b': one argument too many; name it by its option (--out), leave it out, or",
    "synth cave out": "NAME cave: no such choice; choose one of interior, lamp",
    "train": "train: name a preset first, as in `hdr-nsff train splat`; the presets are splat,",
    "train --tyro-print-completion bash": "train: name a preset first",
    "train --steps 3": "train: name a preset first",
    "train splatt a b": "no preset 'splatt' (did you mean splat?); the presets are splat, grid,",
    "train tiny --steps x": "--steps x: not a whole number; `hdr-nsff train tiny --help`",
    "train tiny --steps": "--steps: no value follows; `hdr-nsff train tiny --help` explains",
    "train splat --field.statik 3": "--field.statik: no such option (did you mean --field.static?)",
    "render --tyro-print-completion bash": "--tyro-print-completion: no such option; `hdr-nsff r",
    "check --tyro_write_completion bash a": "--tyro_write_completion: no such option; `hdr-nsff c",
    "doctor extra": "'extra': `doctor` takes no arguments; leave it out",
}


@pytest.mark.parametrize("command", list(REFUSED))
def test_what_the_parser_refuses_is_one_sentence(command: str, capsys: Capture) -> None:
    assert call(*command.split()) == 2
    assert REFUSED[command] in one_sentence(capsys.readouterr().err)


def test_a_parser_that_explains_itself_by_a_box_alone_is_one_sentence_too(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refusals, "hook", lambda refuse: nullcontext())
    assert call("prepare", "a", "b", "--max-size", "x") == 2
    sentence = one_sentence(capsys.readouterr().err)
    assert "--max-size" in sentence and "'x'" in sentence and "\u2500" not in sentence


def test_arguments_reach_the_verb(trained_with: list[TrainConfig]) -> None:
    changes = ["--field.samples", "9", "--loss.flow", "0.25", "--set", "field.encoding.levels=3"]
    assert call("train", "grid", "--scene", "a b/é", "--steps", "7", *changes) == 0
    (config,) = trained_with
    default = PRESETS["grid"]
    assert config.scene == Path("a b/é")
    assert (config.budget.steps, config.rays) == (7, default.rays)
    assert (config.field.samples, config.loss.flow) == (9, 0.25)
    assert config.field.encoding == default.field.encoding
    assert config.set == ("field.encoding.levels=3",)


def test_bad_input_is_one_sentence_and_exit_code_2(act: Act, capsys: Capture) -> None:
    act(raising(InputError("x.png: cut short; copy it again")))
    assert call("evaluate", "run") == 2
    assert one_sentence(capsys.readouterr().err) == "hdr-nsff: x.png: cut short; copy it again"


def test_ctrl_c_exits_with_130_and_explains_how_to_continue(act: Act, capsys: Capture) -> None:
    act(raising(KeyboardInterrupt()))
    assert call("evaluate", "run") == 130
    assert "the same command continues" in one_sentence(capsys.readouterr().err)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS])
def test_a_disk_that_cannot_be_written_is_one_sentence(
    number: int, act: Act, capsys: Capture
) -> None:
    act(raising(OSError(number, os.strerror(number), "out/a.exr")))
    assert call("evaluate", "run") == 2
    said = one_sentence(capsys.readouterr().err)
    assert "out/a.exr" in said and os.strerror(number) in said


@pytest.mark.parametrize(
    "error", [RuntimeError("ours"), OSError(errno.EBADF, "ours"), AssertionError("ours")]
)
def test_errors_of_the_program_keep_their_traceback(error: Exception, act: Act) -> None:
    act(raising(error))
    with pytest.raises(type(error), match="ours"):
        call("evaluate", "run")


def test_training_from_a_folder_that_is_no_scene_is_one_sentence(
    tmp_path: Path, capsys: Capture
) -> None:
    assert call("train", "tiny", "--scene", str(tmp_path), "--out", str(tmp_path / "run")) == 2
    assert "no scene.json here" in one_sentence(capsys.readouterr().err)
    assert not (tmp_path / "run").exists()


def test_what_run_will_need_at_its_end_is_checked_at_its_start(
    tmp_path: Path, capsys: Capture
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


def test_a_full_disk_ends_training_with_a_sentence_and_it_continues_later(
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
    assert process.returncode == 130
    assert "Traceback" not in error and "the same command continues" in error
    assert 0 < Run.open(tmp_path / "run").step < 100_000


def test_ctrl_c_inside_a_library_that_wraps_it_exits_with_130(act: Act, capsys: Capture) -> None:
    act(raising(ValueError("Field '4':\n  KeyboardInterrupt:")))
    assert call("evaluate", "run") == 130
    assert "the same command continues" in one_sentence(capsys.readouterr().err)
