"""What several tests share."""

from pathlib import Path

import pytest
from toy_scene import ToyScene

from hdr_nsff.scene import Scene


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed-form scene folder (read only)."""
    return ToyScene().write(tmp_path_factory.mktemp("toy") / "scene")


@pytest.fixture(scope="session")
def toy(toy_folder: Path) -> Scene:
    """The closed-form scene in memory."""
    return Scene.open(toy_folder)
