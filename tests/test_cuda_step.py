"""A training step of `splat` by CUDA kernels, without a GPU: every test of three
files, in processes with numba-cuda's simulator.
"""

from pathlib import Path

import pytest
from simulator import assert_passed, names_in

FILES = ("simulated_cloud.py", "simulated_picture.py", "simulated_step.py")
PATHS = [Path(__file__).with_name(name) for name in FILES]


@pytest.mark.parametrize(("path", "name"), [(p, name) for p in PATHS for name in names_in(p)])
def test_simulated(path: Path, name: str) -> None:
    assert_passed(path, name)
