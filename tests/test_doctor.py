"""`hdr-nsff doctor` describes an installation in any state."""

import importlib.metadata
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import av
import pytest
import torch

from hdr_nsff import cli, doctor
from hdr_nsff.fields.splat import cuda_backends

Capture = pytest.CaptureFixture[str]
PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]

LIBRARIES = doctor.REQUIRED | doctor.HELPFUL
EXTRAS = doctor.EXTRAS
NEEDED_BY_WEIGHTS = ("torch", "numpy", "rich", "safetensors", "cv2", "OpenEXR")
LIBRARIES_OF_WEIGHTS = {k: v for k, v in doctor.REQUIRED.items() if v in NEEDED_BY_WEIGHTS}


@pytest.fixture(autouse=True)
def two_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few libraries, so that a test takes no ten seconds."""
    monkeypatch.setattr(doctor, "REQUIRED", {"numpy>=1.26": "numpy", "rich>=13": "rich"})
    monkeypatch.setattr(doctor, "EXTRAS", {"gpu": {"no-such-package>=1": "no_such_module"}})


def block(capsys: Capture, exit_code: int) -> str:
    """What `hdr-nsff doctor` prints, as one line."""
    capsys.readouterr()
    if exit_code == 0:
        cli.main(["doctor"])
    else:
        with pytest.raises(SystemExit) as stop:
            cli.main(["doctor"])
        assert stop.value.code == exit_code
    return " ".join(capsys.readouterr().out.split())


def fake_module(folder: Path, name: str, content: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a module in the way of an installed one, for processes that are started."""
    (folder / f"{name}.py").write_text(content)
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_the_tables_of_libraries_are_those_of_the_package() -> None:
    dependencies = {line.partition(";")[0] for line in PROJECT["dependencies"]}
    assert set(LIBRARIES) == dependencies
    for extra, packages in EXTRAS.items():
        assert list(packages) == PROJECT["optional-dependencies"][extra]


def test_a_working_installation_is_described_and_exits_with_0(capsys: Capture) -> None:
    said = block(capsys, 0)
    version = importlib.metadata.version("numpy")
    assert f"numpy {version}" in said and "gpu no (no-such-package is not installed)" in said
    assert f"Python: {sys.version.split()[0]}" in said
    assert "usable of" in said and "GB free at" in said
    assert said.endswith("`hdr-nsff run` can work here, on the CPU at least")


def test_every_line_is_printed_as_soon_as_it_is_known(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before libraries are imported, which takes seconds."""
    before: list[str] = []

    def import_faults(modules: Iterable[str]) -> dict[str, str | None]:
        before.append(capsys.readouterr().out)
        return dict.fromkeys(modules)

    monkeypatch.setattr(doctor, "import_faults", import_faults)
    cli.main(["doctor"])
    of_machine, of_libraries = before
    assert "temporary files:" in of_machine and "libraries:" not in of_machine
    assert of_libraries.startswith("libraries:")


def test_a_missing_library_is_named_with_its_fix(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", {"no-such-package>=2": "no_such_module"})
    said = block(capsys, 1)
    assert said.endswith(
        "cannot run: no-such-package is not installed; pip install --upgrade 'no-such-package>=2'"
    )


@pytest.mark.parametrize(("content", "reason"), [
    ("raise ImportError('libz.so.9: no such file')", "ImportError: libz.so.9: no such file"),
    ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashes when it is imported"),
])  # fmt: skip
def test_a_library_that_breaks_on_import_is_a_problem_and_not_the_end(
    content: str, reason: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_module(tmp_path, "numpy", content, monkeypatch)
    said = block(capsys, 1)
    assert (
        f"cannot run: numpy {'' if 'crash' in reason else 'cannot be imported ('}{reason}" in said
    )
    assert "weights: unknown without" in said


def test_broken_weights_that_run_would_read_are_a_problem(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", LIBRARIES_OF_WEIGHTS)
    monkeypatch.setattr(doctor, "import_fault", lambda module: None)
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path))
    (tmp_path / "xfeat").mkdir()
    (tmp_path / "xfeat" / "xfeat.pt").write_text("no weights")
    said = block(capsys, 1)
    assert "weights: xfeat BROKEN" in said
    assert f"cannot run: {tmp_path}/xfeat/xfeat.pt has SHA-256" in said


def test_a_library_that_is_too_old_is_a_problem(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", {"numpy>=99": "numpy"})
    assert "is needed; pip install --upgrade 'numpy>=99'" in block(capsys, 1)


def test_an_old_python_is_a_problem(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "MIN_PYTHON", (9, 0))
    assert "make an environment with Python 9.0 or newer" in block(capsys, 1)


def test_an_unwritable_temporary_folder_is_a_problem(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unwritable() -> None:
        raise FileNotFoundError("No usable temporary directory found")

    monkeypatch.setattr(tempfile, "TemporaryFile", unwritable)
    assert "set TMPDIR to a writable folder" in block(capsys, 1)


def test_a_missing_video_encoder_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", {"prores_ks"})
    report = doctor.Report()
    doctor.encoders(report)
    assert "libx264 no" in report.lines[0] and "prores_ks yes" in report.lines[0]
    assert "PyAV has no libx264" in report.problems[0]


def test_a_cuda_device_is_named_with_what_can_draw_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda i: "Fake H100")
    found = cuda_backends.Backend(None, "nothing draws", "nothing draws")
    monkeypatch.setattr(cuda_backends, "find_backend", lambda: found)
    report = doctor.Report()
    doctor.cuda(report)
    assert any("Fake H100" in line for line in report.lines)
    assert any("nothing draws" in line for line in report.lines)
    assert not report.problems  # the CPU still works


def test_the_driver_is_queried_where_it_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    answer = SimpleNamespace(stdout="570.86\n570.86\n")
    monkeypatch.setattr(doctor.subprocess, "run", lambda *words, **options: answer)
    assert doctor.driver() == "570.86"


def test_a_broken_part_is_one_line(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(report: doctor.Report) -> None:
        raise RuntimeError("no such thing\nat all")

    monkeypatch.setattr(doctor, "numba_cache", broken)
    monkeypatch.setattr(doctor, "REQUIRED", {"numba>=0.1": "numba", "rich>=1": "rich"})
    assert "numba cache: unknown (RuntimeError: no such thing)" in block(capsys, 0)


def test_doctor_takes_no_options(capsys: Capture) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["doctor", "--everything"])
    assert stop.value.code == 2


def test_the_home_folder_is_not_spelled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "home", lambda: Path("/home/ada"))
    assert doctor.short("/home/ada/.venv/bin/python") == "~/.venv/bin/python"
    assert doctor.short("/home/adam/python") == "/home/adam/python"
