"""The wheel holds the package, all of it, and nothing else."""

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from hdr_nsff import __version__

ROOT = Path(__file__).parents[1]
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> ZipFile:
    """The wheel, built from a copy of the sources: building leaves files behind."""
    copy = tmp_path_factory.mktemp("sources")
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    shutil.copytree(ROOT / "src", copy / "src", ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, copy)
    command = [sys.executable, "-c", BUILD, str(copy / "dist")]
    subprocess.run(command, cwd=copy, capture_output=True, check=True)
    (path,) = (copy / "dist").iterdir()
    return ZipFile(path)


def test_the_wheel_holds_every_file_of_the_package_and_nothing_else(wheel: ZipFile) -> None:
    sources = {p for p in (ROOT / "src/hdr_nsff").rglob("*") if p.is_file()}
    expected = {
        p.relative_to(ROOT / "src").as_posix() for p in sources if "__pycache__" not in p.parts
    }
    folder = f"hdr_nsff-{__version__}.dist-info/"
    found = {name for name in wheel.namelist() if not name.startswith(folder)}
    assert found == expected
    assert {"hdr_nsff/py.typed", "hdr_nsff/synth/scenes/sky.exr"} <= found


def test_the_wheel_brings_the_command_and_the_licenses(wheel: ZipFile) -> None:
    folder = f"hdr_nsff-{__version__}.dist-info"
    assert "hdr-nsff = hdr_nsff.cli:main" in wheel.read(f"{folder}/entry_points.txt").decode()
    assert {f"{folder}/licenses/{name}" for name in ("LICENSE", "NOTICE")} <= set(wheel.namelist())
