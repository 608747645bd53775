"""The standard set of a run: complete, within its budget, and kept by a restart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fakes import camera, fake_run

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import ENCODERS
from hdr_nsff.core.images import read_image
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shot_views import plan_shot
from hdr_nsff.rendering.shots import render_shot
from hdr_nsff.rendering.standard_set import cut, render_all, with_hdr_clip

NAMES = {
    "EXR sequence",
    "as filmed",
    "fixed camera",
    "bullet time",
    "slow motion",
    "depth",
    "scene flow",
    "overview",
    "LDR at EV -4.0",
    "LDR at EV -2.0",
    "LDR at EV +0.0",
}


def test_the_set_is_complete_and_restarts_without_work(tmp_path: Path) -> None:
    run, out = fake_run(tmp_path), tmp_path / "out"
    results = render_all(run, out)
    assert set(results) == NAMES and all(p.exists() for p in results.values())
    assert len(list((out / "training").glob("*.exr"))) == 6
    for folder in ("ldr/ev-2.0", "depth", "scene_flow"):
        assert len(list((out / folder).glob("*.png"))) == 6
    dark = read_image(out / "ldr/ev-4.0/00000.png")
    assert np.allclose(dark, run.scene.train[0].image, atol=0.01)  # frame 0 was recorded at EV -4
    before = run.field.calls
    render_all(run, out)
    assert run.field.calls - before <= 1  # the focus depth of bullet time


def test_the_set_replaces_no_shot_that_was_asked_for_by_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, out = fake_run(tmp_path), tmp_path / "out"
    slow = plan_shot(run, "slowmo", factor=4, num_views=8)
    render_shot(run, slow, out, Output())
    made = {file: file.read_bytes() for file in (out / "slowmo").iterdir()}
    assert len(list((out / "slowmo").glob("*.exr"))) == len(slow.views)
    results = render_all(run, out)
    assert {file: file.read_bytes() for file in (out / "slowmo").iterdir()} == made
    assert results["slow motion"] == out / "slowmo" and "it stays" in capsys.readouterr().err
    render_all(run, out, output=Output(ev=-2.0))  # its own shots it does replace
    assert len(list((out / "fixed").glob("*.png")))
    render_shot(run, plan_shot(run, "training"), tmp_path / "other", Output(exr="float"))
    made = {file: file.read_bytes() for file in (tmp_path / "other/training").iterdir()}
    results = render_all(run, tmp_path / "other")
    assert {file: file.read_bytes() for file in (tmp_path / "other/training").iterdir()} == made
    assert results["as filmed"] == tmp_path / "other/training" and "overview" not in results


def test_the_shot_as_filmed_has_an_hdr_video_where_one_can_be_encoded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    view = PathView(camera(), 0.0)
    small = Shot("training", [view], 24)
    large = Shot("training", [view.resized(2)], 24)
    assert with_hdr_clip(Output(), small) == Output()
    assert with_hdr_clip(Output(), large) == Output(hdr_video=("hlg",))
    asked = Output(hdr_video=("pq",))
    assert with_hdr_clip(asked, large) == asked
    monkeypatch.setitem(ENCODERS, "hevc", "libnone")
    assert with_hdr_clip(Output(), large) == Output()


def test_without_an_encoder_of_av1_the_set_says_so_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(ENCODERS, "av1", "libnone")
    assert set(render_all(fake_run(tmp_path), tmp_path / "out")) == NAMES
    assert "no HDR clip in AV1" in capsys.readouterr().err


def test_without_parallax_the_set_leaves_out_bullet_time(tmp_path: Path) -> None:
    results = render_all(fake_run(tmp_path, parallax="none"), tmp_path / "out")
    assert "bullet time" not in results and results["fixed camera"].exists()


def test_the_budget_shrinks_videos_and_then_drops_views() -> None:
    assert cut([1.0] * 10, 20, 0.25, thin=False) == (1.0, list(range(10)))
    # 10 * 0.75^2 = 5.6
    assert cut([1.0] * 10, 6, 0.25, thin=False) == (0.75, list(range(10)))
    # At a quarter of the size 64 views take 4 s, so half of them, in the middle.
    assert cut([1.0] * 64, 2, 0.25, thin=False) == (0.25, list(range(16, 48)))


def test_thinned_shots_drop_views_evenly_and_keep_eight() -> None:
    # 15 / 8 = 1.875 apart
    assert cut([1.0] * 16, 9, 1.0, thin=True) == (1.0, [0, 2, 4, 6, 8, 9, 11, 13, 15])
    assert cut([1.0] * 20, 1, 1.0, thin=True)[1][::7] == [0, 19]


@pytest.mark.parametrize(
    ("output", "option"), [(Output(exr="none"), "--exr none"), (Output(png=False), "--no-png")]
)
def test_the_set_needs_its_exr_sequence_and_pictures(
    tmp_path: Path, output: Output, option: str
) -> None:
    with pytest.raises(InputError, match=option):
        render_all(fake_run(tmp_path), tmp_path / "out", output=output)
    assert not (tmp_path / "out").exists()
