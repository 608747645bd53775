"""Rolling shutters and motion blur against renders at the time of each row."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from bad_input import Capture, refused, training
from moments import HERE, THERE
from test_splat import BESIDE, CAMERA, STEP, batch_of, card_field
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.fields.build import scene_shutter, timing_of
from hdr_nsff.fields.splat import training_view
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.shutter import (
    MAX_RENDERS,
    Shutter,
    Timing,
    apparent_motion,
    open_times,
    row_times,
    shutter_for,
)
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Scene

TIME = 4


def trained_picture(shutter: Shutter | None) -> Tensor:
    """What a training frame of the moving card sees, (H, W, 3)."""
    field = card_field()
    field.shutter = shutter
    batch = batch_of(TIME, 1)
    batch.neighbors.update({1: CAMERA, -1: CAMERA})
    return field(batch)[0].radiance.detach().reshape(CAMERA.height, CAMERA.width, 3)


def picture(time: float) -> Tensor:
    return card_field().render(CAMERA, time).radiance.reshape(CAMERA.height, CAMERA.width, 3)


def test_every_row_is_of_its_own_time() -> None:
    readout = 0.9
    rolled = trained_picture(Shutter(readout))
    rows = [readout * ((y + 0.5) / CAMERA.height - 0.5) for y in range(CAMERA.height)]
    exact = torch.stack([picture(TIME + t)[y] for y, t in enumerate(rows)])
    assert (rolled - exact).abs().mean() < 0.25 * (picture(TIME) - exact).abs().mean()


def test_blur_is_the_mean_over_the_time_of_the_open_shutter() -> None:
    blurred = trained_picture(Shutter(open=(0.8,) * (TIME + 1)))
    moments = [TIME + 0.8 * ((k + 0.5) / 40 - 0.5) for k in range(40)]
    exact = torch.stack([picture(t) for t in moments]).mean(0)
    assert (blurred - exact).abs().mean() < 0.25 * (picture(TIME) - exact).abs().mean()


def test_no_shutter_and_a_moment_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    by_kernels = trained_picture(None)  # which have no shutter
    monkeypatch.setattr(training_view, "cloud_maker", lambda model, view: None)
    moment = trained_picture(Shutter(0.0, (0.0,) * (TIME + 1)))
    assert torch.equal(trained_picture(None), moment)
    torch.testing.assert_close(by_kernels, moment)


@pytest.mark.parametrize("here, there", [(CAMERA, BESIDE), (HERE, replace(THERE, K=HERE.K))])
def test_the_cameras_motion_counts_as_that_of_points(here: Camera, there: Camera) -> None:
    points = torch.tensor([[0.0, 0, 2], [0.3, 0.1, 4]])
    motion = apparent_motion(here, [(there, points + STEP, 5.0)], points, 4.0)
    seen = there.project(points + STEP)[0]
    torch.testing.assert_close(here.project(points + motion)[0], seen)
    both = [(CAMERA, points - STEP, 3.0), (CAMERA, points + STEP, 5.0)]
    torch.testing.assert_close(apparent_motion(CAMERA, both, points, 4.0), STEP.expand(2, 3))


def test_rows_are_read_from_the_first_to_the_last() -> None:
    rows = torch.tensor([0.0, CAMERA.height / 2, CAMERA.height])
    y = (rows - CAMERA.K[1, 2]) / CAMERA.K[1, 1]
    points = torch.stack([torch.zeros(3), y, torch.ones(3)], -1)
    assert row_times(CAMERA, points, 0.5).tolist() == pytest.approx([-0.25, 0.0, 0.25])


def test_as_many_renders_as_pixels_of_blur() -> None:
    points = torch.tensor([[0.0, 0, 1]])
    for pixels, count in ((0.4, 1), (1.5, 2), (3.2, 4), (50.0, MAX_RENDERS)):
        motion = torch.tensor([[pixels / 60, 0, 0]])
        times = open_times(CAMERA, points, motion, 1.0)
        assert len(times) == count and math.isclose(sum(times), 0, abs_tol=1e-9)
    assert open_times(CAMERA, points, motion, 0.0) == [0.0]


def timing(exposures: list[float], seconds: float | None = None, **known: Any) -> Timing:
    """Of frames at these exposures in stops, the longest exposed for `seconds`."""
    times = [None if seconds is None else seconds * 2 ** (ev - max(exposures)) for ev in exposures]
    numbers: dict[str, Any] = {"interval": 0.04, "stride": 1, "frame_seconds": None, **known}
    return Timing(exposure_times=tuple(times), exposures=tuple(exposures), **numbers)


def test_exposures_shorten_the_shutter_and_nothing_is_nothing() -> None:
    assert shutter_for(0.0, 0.0, timing([0.0, -2.0])) is None
    shutter = shutter_for(20.0, 0.5, timing([-2.0, 0.0, -4.0]))
    assert shutter == Shutter(0.5, (0.125, 0.5, 0.03125))


def test_the_shutter_follows_times_and_not_the_gain() -> None:
    alternating_iso = replace(timing([0.0, 2.0]), exposure_times=(0.01, 0.01))
    shutter = shutter_for(0.0, 0.5, alternating_iso)
    assert shutter is not None and shutter.open == (0.5, 0.5)


def test_exposure_times_say_for_how_long_the_shutter_is_open() -> None:
    shutter = shutter_for(0.0, "auto", timing([0.0, -1.0], seconds=0.02, frame_seconds=0.04))
    assert shutter is not None and shutter.open == pytest.approx((0.5, 0.25))


@pytest.mark.parametrize("share", [0.5, "auto"])
def test_a_frame_of_every_second_one_is_twice_as_long(share: float | Literal["auto"]) -> None:
    every = timing([0.0], seconds=0.02, frame_seconds=0.04)
    second = replace(every, stride=2, interval=0.08)
    one, two = shutter_for(10.0, share, every), shutter_for(10.0, share, second)
    assert one == Shutter(0.25, (0.5,)) and two == Shutter(0.125, (0.25,))


def test_a_field_has_the_readout_of_its_scene_unless_told_another(toy: Scene) -> None:
    rolling = replace(toy, manifest=toy.manifest.model_copy(update={"readout": 10.0}))
    of_scene = scene_shutter(SplatConfig(), rolling)
    assert of_scene == Shutter(pytest.approx(0.01 * toy.manifest.fps))
    assert scene_shutter(SplatConfig(readout=0.0), rolling) is None
    assert scene_shutter(SplatConfig(), toy) is None


@pytest.mark.parametrize(
    ("known", "problem"),
    [
        (timing([0.0, -2.0], frame_seconds=0.04), "no exposure times"),
        (timing([0.0, -2.0], seconds=0.02), "nothing shows the time from frame to frame"),
        (timing([0.0], seconds=0.05, frame_seconds=0.04), "0.05 s, which is longer than the 0.04"),
    ],
)
def test_times_that_are_unknown_or_impossible_are_refused(known: Timing, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        shutter_for(0.0, "auto", known)


def test_a_shutter_that_the_scene_does_not_know_is_refused_before_a_run_begins(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    command = [*training(toy_folder, tmp_path / "run", 1), "--shutter", "auto"]
    assert "--shutter auto: the scene has no exposure times" in refused(capsys, *command)
    assert not list((tmp_path / "run").glob("*"))


def test_a_scene_says_when_its_frames_were_taken(toy: Scene) -> None:
    frames = toy.manifest.frames
    entries = [f.model_copy(update={"exposure_time": 0.001 * (f.index + 1)}) for f in frames]
    update = {"frames": entries, "stride": 3, "frame_seconds": 0.1}
    manifest = toy.manifest.model_copy(update=update)
    drifting = [replace(f, drift=0.5) for f in toy.train]
    found = timing_of(replace(toy, manifest=manifest, train=drifting))
    assert found.stride == 3 and found.interval == pytest.approx(0.3)
    assert timing_of(toy).interval == pytest.approx(1 / toy.manifest.fps)
    assert found.exposure_times == tuple(0.001 * (f.index + 1) for f in toy.train)
    ev = [float(toy.response.ev[f.bracket]) + 0.5 for f in toy.train]
    assert found.exposures == pytest.approx(tuple(ev))
