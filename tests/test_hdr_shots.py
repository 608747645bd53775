"""HDR videos of a shot: one exposure, measured light levels, no EXR left behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fakes import camera, fake_run
from test_hdr_video import decoded, luma

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.maths.hdr_signal import display_light, encode, ycbcr_planes
from hdr_nsff.radiometry.hdr_footage import measure_light
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shots import render_shot


def large_shot(scale: float = 2.0) -> Shot:
    """Two views, as large as the encoders want them."""
    return Shot("some", [PathView(camera(), time).resized(scale) for time in (0.0, 1.0)], 12)


def test_a_shot_has_its_radiance_in_hlg_and_pq(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    output = Output(exr="float", hdr_video=("hlg", "pq"), ev=0.0)
    render_shot(run, large_shot(), tmp_path, output)
    radiance = read_exr(tmp_path / "some/00001.exr")["RGB"]
    neutral = radiance * run.tonemapper.neutral(0).detach().numpy()
    for transfer in output.hdr_video:
        _, frames = decoded(tmp_path / f"some_{transfer}.mp4")
        expected = ycbcr_planes(encode(display_light(neutral, 1.0, transfer), transfer))[0]
        assert len(frames) == 2
        assert np.abs(luma(frames[1]) - expected.astype(int)).mean() < 2


def test_prores_is_a_mov_of_the_same_light(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    render_shot(run, large_shot(), tmp_path, Output(hdr_video=("hlg", "pq"), hdr_codec="prores"))
    render_shot(run, large_shot(), tmp_path, Output(hdr_video=("pq",)))
    _, frames = decoded(tmp_path / "some_pq_prores.mov")
    _, expected = decoded(tmp_path / "some_pq.mp4")
    assert (tmp_path / "some_hlg_prores.mov").is_file()
    assert np.abs(luma(frames[1]) / 4 - luma(expected[1])).mean() < 2


def test_hdr_videos_are_added_without_rendering_again(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    render_shot(run, large_shot(), tmp_path, Output())
    before = run.field.calls
    render_shot(run, large_shot(), tmp_path, Output(hdr_video=("pq",)))
    assert run.field.calls == before and (tmp_path / "some_pq.mp4").is_file()


def test_hdr_videos_leave_no_exr_that_was_not_wanted(tmp_path: Path) -> None:
    output = Output(exr="none", png=False, video=False, hdr_video=("hlg",))
    render_shot(fake_run(tmp_path), large_shot(), tmp_path, output)
    assert (tmp_path / "some_hlg.mp4").is_file()
    assert [p.name for p in (tmp_path / "some").iterdir()] == ["sequence.json"]


def test_light_levels_are_measured_from_the_largest_channel() -> None:
    frames = np.zeros((2, 2, 2, 3))
    frames[0, 0, 0] = [10, 800, 20]
    frames[1] = [300, 0, 0]
    levels = measure_light(iter(frames))
    assert levels.max_cll == pytest.approx(800) and levels.max_fall == pytest.approx(300)


def test_pictures_too_small_for_an_encoder_are_refused_before_rendering(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    before = run.field.calls
    with pytest.raises(InputError, match="48 x 32 pixels; an HDR encoder takes at least 64"):
        render_shot(run, large_shot(1.0), tmp_path / "out", Output(hdr_video=("pq",)))
    assert run.field.calls == before and not (tmp_path / "out").exists()


def test_a_rate_that_an_encoder_does_not_take_is_refused_before_rendering(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    before = run.field.calls
    fast = replace(large_shot(), fps=480)
    with pytest.raises(InputError, match="480 frames a second; AV1 has at most 240"):
        render_shot(run, fast, tmp_path / "out", Output(hdr_video=("pq",), hdr_codec="av1"))
    assert run.field.calls == before and not (tmp_path / "out").exists()
