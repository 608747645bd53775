"""Camera paths as Nuke reads them: matrices made from the text are the cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fakes import fake_run

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.rendering.chan import write_chan
from hdr_nsff.rendering.export_scene import export_chan
from hdr_nsff.rendering.shot_views import plan_shot
from hdr_nsff.scene.scene import Scene


def turn(axis: int, degrees: float) -> np.ndarray:
    """A rotation (3, 3) about an axis."""
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix[a, a], matrix[b, b], matrix[a, b], matrix[b, a] = c, c, -s, s
    return matrix


def see(line: str, camera: Camera, point: np.ndarray) -> list[float]:
    """The pixel of a point (+y up) in the camera of a line."""
    _, *place, rx, ry, rz, fov = (float(x) for x in line.split())
    rotation = turn(1, ry) @ turn(0, rx) @ turn(2, rz)
    local = rotation.T @ (point - place)
    focal = camera.height / 2 / np.tan(np.radians(fov) / 2)
    x = camera.width / 2 + focal * local[0] / -local[2]
    return [x, camera.height / 2 - focal * local[1] / -local[2]]


def test_nuke_sees_points_where_the_scene_does(toy: Scene, tmp_path: Path) -> None:
    cameras = []
    for i, frame in enumerate(toy.train):
        turned = frame.camera.c2w.clone()
        tilt = turn(0, 12.0 * i) @ turn(1, -7.0 * i) @ turn(2, 5.0)
        turned[:, :3] = turned.new_tensor(tilt.tolist())
        cameras.append(frame.camera.moved(turned))
    write_chan(tmp_path / "a.chan", cameras)
    lines = (tmp_path / "a.chan").read_text().splitlines()
    assert [line.split()[0] for line in lines] == [str(i) for i in range(len(cameras))]
    for line, camera in zip(lines, cameras, strict=True):
        local = camera.c2w.new_tensor([0.3, -0.2, 3.0])
        point = camera.c2w[:, :3] @ local + camera.c2w[:, 3]
        expected = camera.project(point)[0].tolist()
        assert see(line, camera, np.array([1, -1, -1]) * point.numpy()) == pytest.approx(
            expected, abs=1e-2
        )


def test_only_camera_files_are_replaced(tmp_path: Path) -> None:
    run, path = fake_run(tmp_path), tmp_path / "camera.chan"
    export_chan(run, path)
    export_chan(run, path)
    ours = path.read_text()
    of_nuke = "1\t0.5\t0\t2\t0\t12.5\t0\t45\n"
    others = ["my notes", "", of_nuke, ours.replace("\n", "0\n"), ours.partition("\n")[2]]
    for text in others:
        path.write_text(text)
        with pytest.raises(InputError, match="not made by export; choose another name, or del"):
            export_chan(run, path)
        assert path.read_text() == text


def test_two_tracks_of_one_camera_have_one_line_for_every_picture(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    second = [replace(f, index=f.index + len(run.scene.train)) for f in run.scene.train]
    both = replace(run, scene=replace(run.scene, train=run.scene.train + second))
    assert len(plan_shot(both, "training").views) == len(run.scene.train)
    export_chan(both, tmp_path / "both.chan")
    export_chan(run, tmp_path / "one.chan")
    assert (tmp_path / "both.chan").read_text() == (tmp_path / "one.chan").read_text()


@pytest.mark.parametrize(("num_pictures", "is_named"), [(2, True), (6, False)])
def test_pictures_that_were_thinned_out_are_named_with_the_command_for_all(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], num_pictures: int, is_named: bool
) -> None:
    run = replace(fake_run(tmp_path), folder=tmp_path / "run")
    assert len(plan_shot(run, "training").views) == 6
    shot = tmp_path / "render/training"  # where the verb `run` puts it
    views = [notes.SequenceView(time=time, ev=None) for time in range(num_pictures)]
    note = notes.Sequence(key="", step=1, fps=24, display_exposure=1, views=views, seconds=0)
    notes.write(shot / "sequence.json", note)
    export_chan(run, tmp_path / "camera.chan")
    command = f"`hdr-nsff render {run.folder} --path training --out {shot.parent}`"
    sentence = f"has 2 of these pictures, numbered otherwise; {command} renders them all"
    assert (sentence in capsys.readouterr().err) is is_named
