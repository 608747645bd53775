"""Shots of a field known in closed form: files hold the field's values, and a restart
keeps them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from fakes import DiscBeforeWall, H, W, camera, fake_run

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.core.video import read_video
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.fingerprint import fingerprint
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shots import render_shot
from hdr_nsff.rendering.stills import screen_motion


def shot_of(*times: float) -> Shot:
    """Views of one camera."""
    return Shot("some", [PathView(camera(), time) for time in times], 12)


def test_exr_holds_radiance_depth_motion_and_motion_vectors(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    view = PathView(camera(0.1), 2.0)
    render_shot(run, Shot("one", [view], 12), tmp_path / "out", Output(exr="float"))
    seen = read_exr(tmp_path / "out/one/00000.exr")
    truth = run.field.render(view.camera, 2.0)
    assert np.allclose(seen["RGB"].reshape(-1, 3), truth.radiance)
    assert np.allclose(seen["Z"].ravel(), truth.depth)
    disc = seen["motion"] > 0.5
    assert disc.sum() == truth.motion.sum()
    # speed 0.1, 0.025 scene units a frame at depth 2, focal 40: 2 and 0.5 pixels
    assert np.allclose(seen["content.forward.u"][disc], 2.0, atol=1e-3)
    assert np.allclose(seen["content.backward.v"][disc], -0.5, atol=1e-3)
    assert np.allclose(seen["content.forward.u"][~disc], 0, atol=1e-3)
    assert np.allclose(seen["opacity"].ravel(), truth.opacity)
    assert (seen["RGBA"][..., 3] == 1).all()
    # a view alone: the same motion on the screen, y up
    assert np.allclose(seen["forward.u"], seen["content.forward.u"])
    assert np.allclose(seen["backward.v"], -seen["content.backward.v"])


def motion_of_a_pair(tmp_path: Path, output: Output) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Channels of the first of two views half a frame apart, and its disc (H, W) bool.

    The camera goes 0.2 to the right: the wall at depth 4 moves 2 pixels to the left,
    the disc at 2 moves 4, and half a frame of its own motion back: 1 and 0.25 pixels.
    """
    views = [PathView(camera(0.0), 2.0), PathView(camera(0.2), 2.5)]
    render_shot(fake_run(tmp_path), Shot("two", views, 12), tmp_path, output)
    seen = read_exr(tmp_path / "two/00000.exr")
    return seen, seen["motion"] > 0.5


def test_motion_on_the_screen_has_the_cameras_part_and_y_up(tmp_path: Path) -> None:
    seen, disc = motion_of_a_pair(tmp_path, Output(exr="float", between="direct"))
    assert np.allclose(seen["forward.u"][disc], -3.0, atol=1e-3)
    assert np.allclose(seen["forward.v"][disc], -0.25, atol=1e-3)
    assert np.allclose(seen["forward.u"][~disc], -2.0, atol=1e-3)
    assert np.allclose(seen["forward.v"][~disc], 0, atol=1e-3)
    # the first view of a shot: motion continues in a straight line
    assert np.allclose(seen["backward.u"], -seen["forward.u"])


def test_motion_on_the_screen_is_by_real_time_beside_a_gap() -> None:
    times = [0.0, 1.0, 2.0, 3.0, 5.0, 6.0]  # 4 was held out
    for time, forward, backward in ((2.5, 1.5, 1.0), (3.0, 2.0, 1.0), (5.5, 1.5, 1.5)):
        seen = DiscBeforeWall().render(camera(), time)
        disc = seen.motion > 0.5
        durations = {1: forward, -1: backward}  # to one training interval away
        flow = {o: durations[o] * seen.scene_flow[o] for o in durations}
        neighbors = {o: PathView(camera(), time + 0.5 * o) for o in durations}
        view = PathView(camera(), time)
        scene = replace(seen, scene_flow=flow)
        moved = screen_motion(scene, view, neighbors, times, torch.device("cpu"))
        for side in (1, -1):  # half a frame of 8 and 2 pixels
            expected = side * torch.tensor([4.0, 1.0])
            assert torch.allclose(moved[side][disc], expected, atol=1e-3)


def test_vectors_for_blender_are_to_the_previous_and_from_the_next_picture(
    tmp_path: Path,
) -> None:
    output = Output(exr="float", between="direct", exr_vectors="blender")
    seen, disc = motion_of_a_pair(tmp_path, output)
    for name, expected in zip("XYZW", (3.0, 0.25, 3.0, 0.25), strict=True):
        assert np.allclose(seen[f"Vector.{name}"][disc], expected, atol=1e-3)
    assert "forward.u" not in seen


def test_exr_header_names_exposure_and_time(tmp_path: Path) -> None:
    shot = Shot("one", [PathView(camera(), 1.5, ev=-2.0)], 12)
    render_shot(fake_run(tmp_path), shot, tmp_path, Output())
    with OpenEXR.File(str(tmp_path / "one/00000.exr")) as file:
        header = dict(file.header())
    assert header["exposure"] == 0 and header["time"] == 1.5 and header["developedEV"] == -2
    assert header["bracketEV"] == "-4.000 -2.000 +0.000"


def test_an_ev_is_developed_by_the_learned_camera(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    render_shot(run, shot_of(0.0), tmp_path, Output(ev=-1.0))
    expected = (run.field.render(camera(), 0.0).radiance / 2).clamp(0, 1) ** (1 / 2.2)
    picture = read_image(tmp_path / "some/00000.png")
    assert np.allclose(picture.reshape(-1, 3), expected, atol=0.01)


def test_rendering_again_renders_only_missing_views(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    shot = shot_of(0.0, 1.0, 2.0, 3.0)
    render_shot(run, shot, tmp_path, Output())
    (tmp_path / "some/00002.exr").unlink()
    before = run.field.calls
    render_shot(run, shot, tmp_path, Output())
    assert run.field.calls == before + 1 and (tmp_path / "some/00002.exr").exists()
    render_shot(run, shot, tmp_path, Output())
    assert run.field.calls == before + 1


@pytest.mark.parametrize("change", ["step", "ev", "views"])
def test_another_checkpoint_or_setting_starts_over(tmp_path: Path, change: str) -> None:
    run = fake_run(tmp_path)
    shot, output = shot_of(0.0, 1.0), Output()
    render_shot(run, shot, tmp_path, output)
    run = replace(run, step=8) if change == "step" else run
    output = replace(output, ev=-1.0) if change == "ev" else output
    shot = shot_of(0.0) if change == "views" else shot
    before = run.field.calls
    render_shot(run, shot, tmp_path, output)
    assert run.field.calls > before
    assert len(list((tmp_path / "some").glob("*.exr"))) == len(shot.views)


def test_a_moved_run_keeps_its_pictures_and_another_training_does_not(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    moved = replace(run.config, scene=Path("elsewhere/scene"), out=Path("elsewhere/run"))
    assert fingerprint(replace(run, config=moved), 1) == fingerprint(run, 1)
    assert fingerprint(replace(run, seconds=4.0), 1) != fingerprint(run, 1)
    assert fingerprint(run, 2) != fingerprint(run, 1)


def test_video_has_every_view_and_png_can_be_left_out(tmp_path: Path) -> None:
    output = Output(exr="none", png=False)
    video = render_shot(fake_run(tmp_path), shot_of(0.0, 1.0, 2.0, 3.0), tmp_path, output)
    frames = [frame for frame, _ in read_video(video)]
    assert len(frames) == 4 and frames[0].shape == (H, W, 3)
    assert not list((tmp_path / "some").glob("*.png"))
    assert (tmp_path / "some_sheet.png").exists()


def test_a_camera_that_the_run_has_not_learned_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="camera 3: the run has learned cameras 0 to 0"):
        render_shot(fake_run(tmp_path), shot_of(0.0), tmp_path, Output(camera_id=3))
