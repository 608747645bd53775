"""Training steps of `splat` and `grid` by CUDA kernels, without a GPU: every test of
these files, in one process with numba-cuda's simulator.
"""

from pathlib import Path

import pytest
from simulator import assert_passed, names_in

FILES = ("cloud", "picture", "tone", "grid", "adam", "step")
PATHS = [Path(__file__).with_name(f"simulated_{name}.py") for name in FILES]


@pytest.mark.parametrize(("path", "name"), [(p, name) for p in PATHS for name in names_in(p)])
def test_simulated(path: Path, name: str) -> None:
    assert_passed(path, name, *PATHS)
