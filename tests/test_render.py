"""Rendering a run whose field is known in closed form: files hold what the field says,
restarts keep them, refusals are sentences.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from fakes import SPEED, DiscBeforeWall, H, W, camera, fake_run

from hdr_nsff.core import io
from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.paths import View
from hdr_nsff.rendering.render import (
    RenderConfig,
    cut,
    plan_shot,
    render,
    render_all,
    three_exposures,
)
from hdr_nsff.rendering.shots import Output, Shot, render_shot, take
from hdr_nsff.training.run_folder import Run


def test_exr_holds_radiance_depth_motion_and_motion_vectors(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    view = View(camera(0.1), 2.0)
    render_shot(run, Shot("one", [view], 12), tmp_path / "out", Output(exr="float"))
    seen, truth = io.read_exr(tmp_path / "out/one/00000.exr"), run.field.render(view.camera, 2.0)
    assert np.allclose(seen["RGB"].reshape(-1, 3), truth.radiance) and np.allclose(
        seen["Z"].ravel(), truth.depth
    )
    disc = seen["motion"] > 0.5
    assert disc.sum() == truth.motion.sum()
    # speed 0.1, 0.025 scene units a frame at depth 2, focal 40: 2 and 0.5 pixels
    assert np.allclose(seen["forward.u"][disc], 2.0, atol=1e-3) and np.allclose(
        seen["backward.v"][disc], -0.5, atol=1e-3
    )
    assert np.allclose(seen["forward.u"][~disc], 0, atol=1e-3)


def test_exr_header_names_primaries_exposure_and_time(tmp_path: Path) -> None:
    render_shot(
        fake_run(tmp_path), Shot("one", [View(camera(), 1.5, ev=-2.0)], 12), tmp_path, Output()
    )
    with OpenEXR.File(str(tmp_path / "one/00000.exr")) as file:
        header = dict(file.header())
    assert tuple(np.round(header["chromaticities"], 4)) == io.REC709
    assert header["exposure"] == 0 and header["time"] == 1.5 and header["developedEV"] == -2
    assert header["bracketEV"] == "-4.000 -2.000 +0.000"


def test_an_ev_is_developed_by_the_learned_camera(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    render_shot(run, Shot("one", [View(camera(), 0.0)], 12), tmp_path, Output(ev=-1.0))
    expected = (run.field.render(camera(), 0.0).radiance / 2).clamp(0, 1) ** (1 / 2.2)
    assert np.allclose(
        io.read_image(tmp_path / "one/00000.png").reshape(-1, 3), expected, atol=0.01
    )


def test_rendering_again_asks_the_field_for_missing_views_only(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    shot = Shot("some", [View(camera(), float(t)) for t in range(4)], 12)
    render_shot(run, shot, tmp_path, Output())
    (tmp_path / "some/00002.exr").unlink()
    before = run.field.calls
    render_shot(run, shot, tmp_path, Output())
    assert run.field.calls == before + 1 and (tmp_path / "some/00002.exr").exists()
    render_shot(run, shot, tmp_path, Output())
    assert run.field.calls == before + 1


@pytest.mark.parametrize("change", ["step", "ev", "views"])
def test_another_checkpoint_or_setting_starts_over(tmp_path: Path, change: str) -> None:
    run, output, views = fake_run(tmp_path), Output(), [View(camera(), 0.0), View(camera(), 1.0)]
    render_shot(run, Shot("some", views, 12), tmp_path, output)
    run = replace(run, step=8) if change == "step" else run
    output = replace(output, ev=-1.0) if change == "ev" else output
    views = views[:1] if change == "views" else views
    before = run.field.calls
    render_shot(run, Shot("some", views, 12), tmp_path, output)
    assert run.field.calls > before and len(list((tmp_path / "some").glob("*.exr"))) == len(views)


def test_video_has_every_view_and_png_can_be_left_out(tmp_path: Path) -> None:
    video = render_shot(
        fake_run(tmp_path),
        Shot("some", [View(camera(), float(t)) for t in range(4)], 12),
        tmp_path,
        Output(exr="none", png=False),
    )
    frames = [f for f, _ in io.read_video(video)]
    assert len(frames) == 4 and frames[0].shape == (H, W, 3)
    assert not list((tmp_path / "some").glob("*.png")) and (tmp_path / "some_sheet.png").exists()


def test_slow_motion_shows_the_disc_between_its_places(tmp_path: Path) -> None:
    run = fake_run(tmp_path, field=DiscBeforeWall(speed=SPEED / 4, red=3.0))
    shot = plan_shot(run, "slowmo", factor=4)
    assert [v.time for v in shot.views[:5]] == [0, 0.25, 0.5, 0.75, 1] and len(shot.views) == 21
    places = []
    for view in shot.views[4:9]:
        still = take(run, replace(view, camera=camera()))
        places.append(float((np.arange(W) * still.motion.sum(0)).sum() / still.motion.sum()))
    assert np.allclose(np.diff(places), 0.5, atol=0.15)  # 2 pixels per frame


def test_bullet_time_spirals_around_the_frame_at_its_time(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    views = plan_shot(run, "bullet", frame=1, num_views=8).views
    assert {v.time for v in views} == {1.0} and torch.allclose(
        views[0].camera.c2w, run.scene.train[1].camera.c2w, atol=1e-6
    )
    assert len({tuple(v.camera.c2w[:, 3].tolist()) for v in views}) == 8


@pytest.mark.parametrize(
    ("parallax", "word"), [("none", "stood still"), ("rotation", "only turned")]
)
def test_bullet_time_without_parallax_is_refused_but_the_standard_set_goes_on(
    tmp_path: Path, parallax: str, word: str
) -> None:
    run = fake_run(tmp_path, parallax=parallax)
    with pytest.raises(InputError, match=f"no bullet time.*{word}"):
        plan_shot(run, "bullet")
    results = render_all(run, tmp_path / "out")
    assert "bullet time" not in results and results["fixed camera"].exists()


def test_standard_set_is_complete_and_restarts_without_work(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    results = render_all(run, tmp_path / "out")
    names = {
        "EXR sequence",
        "as filmed",
        "fixed camera",
        "bullet time",
        "slow motion",
        "depth",
        "scene flow",
        "overview",
    }
    assert set(results) == names | {"LDR at EV -4.0", "LDR at EV -2.0", "LDR at EV +0.0"}
    assert all(p.exists() for p in results.values())
    for folder, kind in (
        ("training", "exr"),
        ("ldr/ev-2.0", "png"),
        ("depth", "png"),
        ("scene_flow", "png"),
    ):
        assert len(list((tmp_path / "out" / folder).glob(f"*.{kind}"))) == 6
    dark = io.read_image(tmp_path / "out/ldr/ev-4.0/00000.png")
    assert np.allclose(dark, run.scene.train[0].image, atol=0.01)  # frame 0 was recorded at EV -4
    before = run.field.calls
    render_all(run, tmp_path / "out")
    assert run.field.calls - before <= 1  # the focus depth of bullet time


def test_budget_shrinks_videos_and_then_drops_views() -> None:
    assert cut([1.0] * 10, 20, 0.25, thin=False) == (1.0, list(range(10)))
    assert cut([1.0] * 10, 6, 0.25, thin=False) == (0.75, list(range(10)))  # 10 * 0.75^2 = 5.6
    assert cut([1.0] * 64, 2, 0.25, thin=False) == (
        0.25,
        list(range(16, 48)),
    )  # a quarter: 4 s, so half of them, in the middle
    assert cut([1.0] * 16, 9, 1.0, thin=True) == (
        1.0,
        [0, 2, 4, 6, 8, 9, 11, 13, 15],
    )  # 15 / 8 = 1.875 apart
    assert cut([1.0] * 20, 1, 1.0, thin=True)[1][::7] == [0, 19]  # never fewer than 8


def test_three_exposures_span_the_clip() -> None:
    assert three_exposures([0.0, -4.0, -2.0]) == [-4, -2, 0]
    assert three_exposures([0.0, -3.0]) == [-3, -1.5, 0]
    assert three_exposures([0.0]) == [-2, 0, 2]


def path_file(folder: Path, x: float, time: float) -> str:
    (folder / "ride.json").write_text(
        json.dumps([{"time": time, "c2w": camera(x).c2w.tolist(), "ev": -2}])
    )
    return str(folder / "ride.json")


def test_the_verb_renders_a_path_file_at_half_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder, device: fake_run(Path(folder))))
    found = render(RenderConfig(tmp_path, path_file(tmp_path, 0.1, 2.5), scale=0.5))
    assert found == {"ride": tmp_path / "render/ride.mp4"}
    assert io.read_image(tmp_path / "render/ride/00000.png").shape == (H // 2, W // 2, 3)


def test_bad_requests_are_refused_in_a_sentence(tmp_path: Path) -> None:
    run, still = fake_run(tmp_path), fake_run(tmp_path, parallax="none")
    requests = [
        ("not known", lambda: plan_shot(run, "orbit")),
        ("frame 99: the scene has no such frame", lambda: plan_shot(run, "fixed", frame=99)),
        ("outside the clip", lambda: plan_shot(run, path_file(tmp_path, 0.0, 7.5))),
        ("leaves the clip's viewpoint", lambda: plan_shot(still, path_file(tmp_path, 0.5, 1.0))),
        ("camera 3: the run has learned cameras 0 to 0", lambda: render_shot(run, plan_shot(run, "fixed"), tmp_path, Output(camera_id=3))),
        ("--scale 0: must be", lambda: render(RenderConfig(tmp_path, scale=0.0))),
        ("--fps -1: must be", lambda: render(RenderConfig(tmp_path, fps=-1.0))),
        ("--ev nan", lambda: render(RenderConfig(tmp_path, output=Output(ev=float("nan"))))),
        ("nothing left to write", lambda: render(RenderConfig(tmp_path, output=Output(exr="none", png=False, video=False)))),
        ("not a run folder", lambda: render(RenderConfig(tmp_path))),
        ("--exr none", lambda: render_all(run, tmp_path, output=Output(exr="none"))),
    ]  # fmt: skip
    for sentence, request in requests:
        with pytest.raises(InputError, match=sentence):
            request()
