"""The step `response`: which footage shows the noise of the sensor."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.images import write_png
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.prepare.steps.response import shows_noise
from hdr_nsff.prepare.work import PrepareConfig, Work
from hdr_nsff.scene.manifest import LensEntry, Manifest


@pytest.fixture
def work(tmp_path: Path) -> Work:
    """Footage of one PNG of 40 x 20 pixels, used in that size."""
    write_png(tmp_path / "clip" / "0.png", np.full((20, 40, 3), 0.5, np.float32))
    config = PrepareConfig(tmp_path / "clip", tmp_path / "scene")
    manifest = Manifest(source="clip", inputs={}, width=40, height=20)
    return Work(config, open_footage(tmp_path / "clip"), manifest)


def test_frames_that_are_kept_as_recorded_show_noise(work: Work) -> None:
    assert shows_noise(work)


def test_frames_that_were_shrunk_do_not(work: Work) -> None:
    work.manifest.width, work.manifest.height = 32, 16
    assert not shows_noise(work)


def test_frames_that_were_undistorted_do_not(work: Work) -> None:
    work.manifest.lens = {
        0: LensEntry(K=np.eye(3).tolist(), distortion=[-0.1, 0, 0, 0], width=40, height=20)
    }
    assert not shows_noise(work)


def test_frames_of_a_lossy_format_do_not(work: Work) -> None:
    name = work.footage.path / "0.jpg"
    assert not shows_noise(replace(work, footage=replace(work.footage, cameras=[[name]])))
