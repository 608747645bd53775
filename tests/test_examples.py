"""The scripts in examples/ do what they say."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import fake_run
from test_export_gaussians import make_run
from test_hdr_shots import large_shot
from test_hdr_video import decoded, luma
from viewer_scenes import render, scene_file, trained, trained_local, with_gap

from hdr_nsff.core.exr import read_exr
from hdr_nsff.geometry.paths import read_path
from hdr_nsff.maths.hdr_signal import display_light, encode, ycbcr_planes
from hdr_nsff.maths.metrics import mu_law_psnr
from hdr_nsff.rendering.output import Output
from hdr_nsff.rendering.shots import render_shot
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.run_folder import Run
from hdr_nsff.viewer.field_scene import scene_of
from hdr_nsff.viewer.page_file import PageSettings, make_page
from hdr_nsff.viewer.scene_file import to_bytes

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
import camera_path
import draw_scene
import hdr_video
import read_scene
import render_view

EXAMPLES = Path(camera_path.__file__).parent
SIZE = (96, 64)


def draw(path: Path, toy: Scene, time: float) -> np.ndarray:
    """What the example draws with the camera of the second frame."""
    camera = toy.train[1].camera.resized(*SIZE)
    document, arrays = read_scene.read(path)
    return draw_scene.draw(document, arrays, time, camera.c2w.numpy(), camera.K.numpy(), *SIZE)


@pytest.mark.parametrize("preset", ["splat", "splat-sigmoid"])
def test_the_reader_draws_what_render_does(toy: Scene, tmp_path: Path, preset: str) -> None:
    field, _ = trained(toy, preset)
    page = make_page("Toy", to_bytes(scene_file(toy, preset)), PageSettings())
    (tmp_path / "scene.html").write_text(page)
    for time in (0.0, 1.7):
        expected = render(field, toy, 1, time, SIZE)
        found = torch.from_numpy(draw(tmp_path / "scene.html", toy, time))
        assert mu_law_psnr(found, expected, float(expected.max())) > 50


def test_the_reader_moves_as_render_does_where_frames_are_missing(
    toy: Scene, tmp_path: Path
) -> None:
    scene = with_gap(toy)
    field, _ = trained(scene)
    (tmp_path / "gap.hdr4d").write_bytes(to_bytes(scene_file(scene)))
    expected = render(field, scene, 1, 5.0, SIZE)
    found = torch.from_numpy(draw(tmp_path / "gap.hdr4d", scene, 5.0))
    assert mu_law_psnr(found, expected, float(expected.max())) > 50


def test_the_reader_draws_time_local_gaussians(toy: Scene, tmp_path: Path) -> None:
    field, tonemapper = trained_local(toy)
    path = tmp_path / "local.hdr4d"
    path.write_bytes(to_bytes(scene_of(field, tonemapper, toy, "Toy", 1.0)))
    expected = render(field, toy, 1, 1.7, SIZE)
    found = torch.from_numpy(draw(path, toy, 1.7))
    assert mu_law_psnr(found, expected, float(expected.max())) > 50


def test_beyond_the_clip_the_reader_keeps_its_last_moment(toy: Scene, tmp_path: Path) -> None:
    field, tonemapper = trained_local(toy)
    path = tmp_path / "local.hdr4d"
    path.write_bytes(to_bytes(scene_of(field, tonemapper, toy, "Toy", 1.0)))
    last = float(toy.times[-1])
    np.testing.assert_array_equal(draw(path, toy, last + 3), draw(path, toy, last))


def test_a_view_of_a_run_is_rendered(
    toy: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(toy, tmp_path)
    monkeypatch.setattr(Run, "open", lambda *_: run)
    radiance = render_view.render_view(tmp_path, 1.5, tmp_path / "view.exr")
    seen = read_exr(tmp_path / "view.exr")
    assert np.allclose(seen["RGB"], radiance, rtol=1e-2, atol=1e-3)
    assert seen["Z"].shape == (34, 60) and (tmp_path / "view.png").is_file()


def test_a_path_made_from_the_scene_is_one_that_render_takes(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    count = camera_path.dolly(toy_folder, tmp_path / "dolly.json")
    views = read_path(tmp_path / "dolly.json", toy.train[0].camera)
    assert len(views) == count == 11
    assert [view.time for view in views] == pytest.approx(np.arange(11) / 2)
    assert torch.equal(views[0].camera.c2w, toy.train[3].camera.c2w)
    assert not torch.equal(views[2].camera.c2w, views[0].camera.c2w)


def test_exr_files_become_an_hdr_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = fake_run(tmp_path)
    gains = np.array([1.5, 1.0, 0.6], np.float32)
    monkeypatch.setattr(run.tonemapper, "neutral", lambda _: torch.from_numpy(gains))
    render_shot(run, large_shot(), tmp_path, Output(exr="float"))
    video = tmp_path / "hdr.mp4"
    assert hdr_video.hdr_video(tmp_path / "some", video, 24, -1.0) == 2
    stream, frames = decoded(video)
    assert stream.codec_context.color_trc == 16 and len(frames) == 2
    neutral = read_exr(tmp_path / "some/00001.exr")["RGB"] * gains
    light = display_light(neutral, 0.5, "pq")
    expected = ycbcr_planes(encode(light, "pq"))[0].astype(int)
    assert np.abs(luma(frames[1]) - expected).mean() < 2
    names = {data.type.name for data in frames[0].side_data}
    assert {"CONTENT_LIGHT_LEVEL", "MASTERING_DISPLAY_METADATA"} <= names


@pytest.mark.parametrize("script", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_without_arguments_an_example_tells_how_it_is_called(
    script: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [str(script)])
    with pytest.raises(SystemExit, match=f"python .*{script.name} "):
        runpy.run_path(str(script), run_name="__main__")
