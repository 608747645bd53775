"""Kernels are compiled with a cache where numba can write one, and without it where it
cannot.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import hdr_nsff

PACKAGE = Path(hdr_nsff.__file__).parent
KERNELS = """
from hdr_nsff.core.jit import cache_is_writable, jit

@jit(nogil=True)
def double(x):
    return 2 * x

@jit(inline="always")
def one():
    return 1

@jit(fastmath=True)
def increment(x):
    return x + one()

print(cache_is_writable(), double(4), increment(4))
"""


ENVIRONMENT = {
    name: value
    for name, value in os.environ.items()
    if name not in ("XDG_CACHE_HOME", "NUMBA_CACHE_DIR")
}


def run_kernels(folder: Path, kernels: str = KERNELS, **environment: str) -> tuple[str, str]:
    """Output and errors of the kernels in a copy of `core/jit.py`, in a new process."""
    for name in ("__init__.py", "core/__init__.py", "core/jit.py", "core/progress.py"):
        target = folder / "hdr_nsff" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PACKAGE / name, target)
    source = folder / "kernels.py"
    if not source.exists() or source.read_text() != kernels:
        source.write_text(kernels)  # a new one is compiled anew
    own = {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    ended = subprocess.run(
        [sys.executable, source],
        env=ENVIRONMENT | own | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return ended.stdout, ended.stderr


def block_caches(folder: Path) -> str:
    """Put files where numba would make its folders; a home that is none. Permissions
    would not hold where the tests run as root.
    """
    for parent in (folder, folder / "hdr_nsff/core"):
        parent.mkdir(parents=True, exist_ok=True)
        (parent / "__pycache__").touch()
    (folder / "home").touch()
    return str(folder / "home")


def test_compiled_kernels_are_kept_beside_their_source(tmp_path: Path) -> None:
    assert run_kernels(tmp_path) == ("True 8 5\n", "")
    assert list((tmp_path / "__pycache__").glob("kernels.double-*.nbi"))


def test_without_a_writable_folder_kernels_are_compiled_and_it_is_said_once(
    tmp_path: Path,
) -> None:
    output, error = run_kernels(tmp_path, HOME=block_caches(tmp_path))
    assert output == "False 8 5\n"
    assert error.count("compiling without a cache") == 1
    assert "set NUMBA_CACHE_DIR to a writable folder" in " ".join(error.split())


def test_compiling_for_long_is_said_once_and_not_where_the_cache_has_it(tmp_path: Path) -> None:
    impatient = "import hdr_nsff.core.jit\nhdr_nsff.core.jit.LONG_SECONDS = 0.0\n" + KERNELS
    output, error = run_kernels(tmp_path, impatient)
    assert output == "True 8 5\n"
    assert error.count("\n") == error.count("compiling kernels") == 1
    assert run_kernels(tmp_path, impatient) == (output, "")
    shutil.rmtree(tmp_path / "__pycache__")
    _, error = run_kernels(tmp_path, impatient, HOME=block_caches(tmp_path))
    assert "compiling kernels" not in error and "compiling without a cache" in error


def test_the_folder_that_the_message_names_is_used(tmp_path: Path) -> None:
    home = block_caches(tmp_path)
    cache = tmp_path / "cache"
    assert run_kernels(tmp_path, HOME=home, NUMBA_CACHE_DIR=str(cache)) == ("True 8 5\n", "")
    assert list(cache.rglob("*.nbi"))


def test_a_changed_function_is_changed_in_its_callers_in_other_files(tmp_path: Path) -> None:
    parts = (
        "from hdr_nsff.core.jit import jit\n\n@jit(forceinline=True)\ndef half(x):\n    return x"
    )
    (tmp_path / "parts.py").write_text(f"{parts} / 2\n")
    run_kernels(tmp_path)
    caller = "from hdr_nsff.core.jit import jit\nfrom parts import half\n\n"
    caller += "@jit()\ndef twice(x):\n    return half(x) + half(x)\n\nprint(twice(6.0))\n"
    (tmp_path / "kernels.py").write_text(caller)

    def run() -> str:
        environment = ENVIRONMENT | {"PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, tmp_path / "kernels.py"]
        return subprocess.run(
            command, env=environment, capture_output=True, check=True
        ).stdout.decode()

    assert [run(), run()] == ["6.0\n"] * 2
    kept = sorted((tmp_path / "__pycache__").glob("kernels.twice*.nbc"))
    (tmp_path / "parts.py").write_text(f"{parts} / 3\n")
    assert run() == "4.0\n"
    assert kept and run() == "4.0\n"
