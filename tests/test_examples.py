"""The scripts in examples/ do what they say."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from viewer_scenes import render, scene_file, trained, trained_local

from hdr_nsff.maths.metrics import mu_law_psnr
from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.field_scene import scene_of
from hdr_nsff.viewer.page_file import PageSettings, make_page
from hdr_nsff.viewer.scene_file import to_bytes

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import read_scene

SIZE = (96, 64)


def draw(path: Path, toy: Scene, time: float) -> np.ndarray:
    """What the example draws with the camera of the second frame."""
    camera = toy.train[1].camera.resized(*SIZE)
    document, arrays = read_scene.read(path)
    return read_scene.draw(document, arrays, time, camera.c2w.numpy(), camera.K.numpy(), *SIZE)


@pytest.mark.parametrize("preset", ["splat", "splat-sigmoid"])
def test_the_reader_draws_what_render_does(toy: Scene, tmp_path: Path, preset: str) -> None:
    field, _ = trained(toy, preset)
    page = make_page("Toy", to_bytes(scene_file(toy, preset)), PageSettings())
    (tmp_path / "scene.html").write_text(page)
    for time in (0.0, 1.7):
        expected = render(field, toy, 1, time, SIZE)
        found = torch.from_numpy(draw(tmp_path / "scene.html", toy, time))
        assert mu_law_psnr(found, expected, float(expected.max())) > 50


def test_the_reader_draws_time_local_gaussians(toy: Scene, tmp_path: Path) -> None:
    field, tonemapper = trained_local(toy)
    path = tmp_path / "local.hdr4d"
    path.write_bytes(to_bytes(scene_of(field, tonemapper, toy, "Toy", 1.0)))
    expected = render(field, toy, 1, 1.7, SIZE)
    found = torch.from_numpy(draw(path, toy, 1.7))
    assert mu_law_psnr(found, expected, float(expected.max())) > 50
