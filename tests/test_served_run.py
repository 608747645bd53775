"""A run as the viewer's server shows it: frames as `render` makes them, and the newest
checkpoint.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from test_export_gaussians import make_run

from hdr_nsff.core.checkpoints import pack, save_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.rendering import row_bands
from hdr_nsff.rendering import served_run as module
from hdr_nsff.rendering.row_bands import render_in_bands
from hdr_nsff.rendering.served_run import ServedRun
from hdr_nsff.rendering.stills import Still
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.run_folder import Run, write_config
from hdr_nsff.viewer import display
from hdr_nsff.viewer.scene_file import from_bytes
from hdr_nsff.viewer.server import FrameRequest


def save_run(toy: Scene, scene_folder: Path, folder: Path, preset: str = "splat") -> Run:
    """A run folder with one checkpoint."""
    run = make_run(toy, folder, preset)
    run = replace(run, tonemapper=tone_mapper_for(run.config.tonemap, toy))
    write_config(folder, replace(run.config, scene=scene_folder, out=folder))
    save_step(run, 7)
    return run


def save_step(run: Run, step: int) -> None:
    assert isinstance(run.field, torch.nn.Module)
    save_checkpoint(
        run.folder, step, 1.0, pack({"field": run.field, "tonemapper": run.tonemapper}, {})
    )


def request_of(toy: Scene, **change: object) -> FrameRequest:
    """The first frame's view at its own size, as recorded at EV 0."""
    camera = toy.train[0].camera
    request = FrameRequest(
        time=1.0,
        c2w=camera.c2w.double().numpy(),
        K=camera.K.double().numpy(),
        width=camera.width,
        height=camera.height,
        ev=0.0,
        curve="camera",
        camera_id=0,
        show="radiance",
        clipping=False,
        false_color=False,
        kind="jpeg",
    )
    return replace(request, **change)  # type: ignore[arg-type]


def frame(served: ServedRun, request: FrameRequest) -> bytes:
    """The frame that somebody waits for."""
    found = served.frame(request, lambda: True)
    assert found is not None
    return found


def decode(file: bytes) -> np.ndarray:
    bgr = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
    return bgr[..., ::-1] / np.iinfo(bgr.dtype).max


@pytest.mark.parametrize("preset", ["splat", "grid", "paper"])
def test_a_frame_is_what_the_camera_would_record(
    toy: Scene, toy_folder: Path, tmp_path: Path, preset: str
) -> None:
    run = save_run(toy, toy_folder, tmp_path / "run", preset)
    served = ServedRun(tmp_path / "run", "cpu")
    camera = toy.train[0].camera
    radiance = run.field.render(camera, 1.0, scene_flow=False).radiance
    expected = run.tonemapper.develop(radiance, 0.0).view(camera.height, camera.width, 3)
    found = decode(frame(served, request_of(toy)))
    assert np.abs(found - expected.numpy()).mean() < 0.06  # noise, as a JPEG
    for show in ("depth", "motion", "flow"):
        assert decode(frame(served, request_of(toy, show=show))).shape == found.shape


def test_radiance_is_shown_as_by_a_page_that_draws(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    run = save_run(toy, toy_folder, tmp_path / "run", "grid")
    served = ServedRun(tmp_path / "run", "cpu")
    camera = toy.train[0].camera
    radiance = run.field.render(camera, 1.0, scene_flow=False).radiance.numpy()
    light = radiance.reshape(camera.height, camera.width, 3) * run.tonemapper.neutral(0).numpy()
    for curve in ("agx", "neutral", "reinhard", "clip"):
        expected = display.develop(2 * light, curve)
        request = request_of(toy, curve=curve, ev=1.0, kind="png16")
        np.testing.assert_allclose(decode(frame(served, request)), expected, atol=2e-5)
    request = request_of(toy, curve="clip", ev=3.0, clipping=True, kind="png8")
    marked = display.mark_clipping(display.develop(8 * light, "clip"))
    np.testing.assert_allclose(decode(frame(served, request)), marked, atol=0.51 / 255)
    request = request_of(toy, curve="clip", false_color=True, kind="png8")
    shown = decode(frame(served, request))
    np.testing.assert_allclose(shown, display.false_color(light), atol=0.51 / 255)


def test_a_view_is_rendered_once_for_all_of_its_looks(
    toy: Scene, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = save_run(toy, toy_folder, tmp_path / "run", "grid")
    served = ServedRun(tmp_path / "run", "cpu")
    rendered: list[float] = []

    def counted(*arguments: Any) -> Still | None:
        rendered.append(arguments[1].time)
        return render_in_bands(*arguments)

    monkeypatch.setattr(module, "render_in_bands", counted)
    for change in ({}, {"ev": 2.0}, {"curve": "agx"}, {"show": "depth"}, {"kind": "png8"}):
        frame(served, request_of(toy, **change))
    assert rendered == [1.0]
    frame(served, request_of(toy, time=2.0))
    save_step(run, 9)
    served.version()
    frame(served, request_of(toy, time=2.0))
    assert rendered == [1.0, 2.0, 2.0]


@pytest.mark.parametrize("preset", ["hdr-hexplane", "nerf-wt"])
def test_fields_that_record_by_themselves_are_served(
    toy: Scene, toy_folder: Path, tmp_path: Path, preset: str
) -> None:
    save_run(toy, toy_folder, tmp_path / "run", preset)
    served = ServedRun(tmp_path / "run", "cpu")
    found = decode(frame(served, request_of(toy, ev=-1.0)))
    assert found.shape == (toy.train[0].camera.height, toy.train[0].camera.width, 3)
    assert '"records": true' in served.page()
    with pytest.raises(InputError, match="This field has no scene flow"):
        frame(served, request_of(toy, show="flow"))


def test_a_frame_is_given_up_between_two_bands(
    toy: Scene, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_run(toy, toy_folder, tmp_path / "run", "grid")
    served = ServedRun(tmp_path / "run", "cpu")
    whole = decode(frame(served, request_of(toy)))
    monkeypatch.setattr(row_bands, "BAND_PIXELS", 5 * toy.train[0].camera.width + 1)
    served.kept = None
    np.testing.assert_array_equal(decode(frame(served, request_of(toy))), whole)
    served.kept = None
    answers = iter([True, True, False])
    assert served.frame(request_of(toy), lambda: next(answers)) is None
    assert next(answers, None) is None  # asked no more


def test_requests_beyond_the_clip_are_refused(toy: Scene, toy_folder: Path, tmp_path: Path) -> None:
    save_run(toy, toy_folder, tmp_path / "run")
    served = ServedRun(tmp_path / "run", "cpu")
    with pytest.raises(InputError, match="outside the clip"):
        frame(served, request_of(toy, time=99.0))
    with pytest.raises(InputError, match="camera 3 is not known"):
        frame(served, request_of(toy, camera_id=3))


def test_the_newest_checkpoint_is_opened_again(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    run = save_run(toy, toy_folder, tmp_path / "run")
    served = ServedRun(tmp_path / "run", "cpu")
    before = served.version(), from_bytes(served.scene())
    assert served.version() == before[0]
    with torch.no_grad():
        run.field.get_parameter("background").fill_(-1.0)  # type: ignore[attr-defined]
    save_step(run, 9)
    assert served.version() != before[0]
    assert from_bytes(served.scene()).background == pytest.approx([np.exp(-1)] * 3)


def test_videos_of_render_and_of_run_are_served(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    save_run(toy, toy_folder, tmp_path / "run")
    served = ServedRun(tmp_path / "run", "cpu")
    assert served.videos() == {} and '"hdr_clips": []' in served.page()
    renders = tmp_path / "render"  # where `run` puts them
    renders.mkdir()
    clips = ["training_hlg.mp4", "training_hlg_av1.mp4"]
    for name in ("training.mp4", *clips, "other.mp4"):
        (renders / name).write_bytes(b"")
    videos = {f"/video/{name}": renders / name for name in ("training.mp4", *clips)}
    assert served.videos() == videos
    again = tmp_path / "run/render"  # where `render` puts them
    again.mkdir()
    (again / "training.mp4").write_bytes(b"")
    assert served.videos() == videos | {"/video/training.mp4": again / "training.mp4"}
    links = [{"href": f"video/{name}", "text": "HDR clip"} for name in clips]
    assert f'"hdr_clips": {json.dumps(links)}' in served.page()


def test_ctrl_c_ends_the_verb(toy: Scene, toy_folder: Path, tmp_path: Path) -> None:
    save_run(toy, toy_folder, tmp_path / "run")
    code = "import sys; from hdr_nsff.cli import main; main(sys.argv[1:])"
    command = [sys.executable, "-c", code, "view", str(tmp_path / "run"), "--no-browser"]
    environment = {**os.environ, "COLUMNS": "200"}
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}

    def listen() -> None:  # tests that run in the background ignore Ctrl-C
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    process = subprocess.Popen(command, text=True, env=environment, preexec_fn=listen, **both)
    assert process.stdout is not None
    assert "http://127.0.0.1:" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "viewer closed" in rest
