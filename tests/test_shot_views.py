"""Views of named paths and path files, and the sentences that refuse the others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import SPEED, DiscBeforeWall, W, camera, fake_run

from hdr_nsff.core.errors import InputError
from hdr_nsff.rendering.shot_views import SHOTS, plan_shot
from hdr_nsff.rendering.shots import filmed_frame
from hdr_nsff.rendering.stills import render_still


def path_file(folder: Path, x: float, time: float) -> str:
    """A path file of one view at (x, 0, 0)."""
    view = {"time": time, "c2w": camera(x).c2w.tolist(), "ev": -2}
    (folder / "ride.json").write_text(json.dumps([view]))
    return str(folder / "ride.json")


def test_slow_motion_shows_the_disc_between_its_places(tmp_path: Path) -> None:
    run = fake_run(tmp_path, field=DiscBeforeWall(speed=SPEED / 4, red=3.0))
    shot = plan_shot(run, "slowmo", factor=4)
    assert [v.time for v in shot.views[:5]] == [0, 0.25, 0.5, 0.75, 1] and len(shot.views) == 21
    places = []
    for view in shot.views[4:9]:
        motion = render_still(run, replace(view, camera=camera())).motion
        places.append(float((np.arange(W) * motion.sum(0)).sum() / motion.sum()))
    assert np.allclose(np.diff(places), 0.5, atol=0.15)  # 2 pixels per frame


def test_bullet_time_spirals_around_the_frame_at_its_time(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    views = plan_shot(run, "bullet", frame=1, num_views=8).views
    assert {v.time for v in views} == {1.0}
    start = run.scene.train[1].camera.c2w
    assert torch.allclose(views[0].camera.c2w, start, atol=1e-6)
    assert len({tuple(v.camera.c2w[:, 3].tolist()) for v in views}) == 8


@pytest.mark.parametrize(
    ("parallax", "word"), [("none", "stood still"), ("rotation", "only turned")]
)
def test_bullet_time_without_parallax_is_refused(tmp_path: Path, parallax: str, word: str) -> None:
    with pytest.raises(InputError, match=f"no bullet time.*{word}"):
        plan_shot(fake_run(tmp_path, parallax=parallax), "bullet")


def test_paths_that_the_footage_cannot_show_are_refused(tmp_path: Path) -> None:
    run, still = fake_run(tmp_path), fake_run(tmp_path, parallax="none")
    with pytest.raises(InputError, match="not known"):
        plan_shot(run, "orbit")
    with pytest.raises(InputError, match="frame 99: the scene has no such frame"):
        plan_shot(run, "fixed", frame=99)
    with pytest.raises(InputError, match="outside the clip"):
        plan_shot(run, path_file(tmp_path, 0.0, 7.5))
    with pytest.raises(InputError, match=r"leaves the clip's viewpoint.*; only turn the camera"):
        plan_shot(still, path_file(tmp_path, 0.5, 1.0))


@pytest.mark.parametrize("name", SHOTS)
def test_a_path_file_with_the_name_of_a_shot_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=f"replace those of `--path {name}`; rename the file"):
        plan_shot(fake_run(tmp_path), str(tmp_path / f"{name}.json"))


def test_held_out_frames_have_their_pictures_too(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    frames = run.scene.train
    kept, held_out = [f for f in frames if f.index != 3], [frames[3]]
    other = replace(frames[2], camera_id=1, time=2.5)  # filmed by a camera of no training frame
    scene = replace(run.scene, train=kept, test=[*held_out, other])
    gapped = replace(run, scene=scene)
    for path in ("training", "fixed", "slowmo"):
        whole, found = plan_shot(run, path), plan_shot(gapped, path)
        assert [v.time for v in found.views] == [v.time for v in whole.views]
    cameras = [v.camera.c2w for v in plan_shot(gapped, "training").views]
    assert all(torch.equal(c, f.camera.c2w) for c, f in zip(cameras, frames, strict=True))
    assert filmed_frame(gapped, plan_shot(gapped, "training").views[3]) is held_out[0]


def test_slow_motion_of_too_many_views_is_refused_before_it_is_planned(tmp_path: Path) -> None:
    run = fake_run(tmp_path)  # 6 frames: 5 steps
    assert len(plan_shot(run, "slowmo", factor=1999).views) == 5 * 1999 + 1
    with pytest.raises(InputError, match="10,001 views; a shot has at most 10,000, use 1999"):
        plan_shot(run, "slowmo", factor=2000)
    with pytest.raises(InputError, match=r"--factor 10\^400.* use 1999"):
        plan_shot(run, "slowmo", factor=10**400)


@pytest.mark.parametrize("path", ["fixed", "slowmo"])
def test_a_pause_longer_than_a_shot_is_refused(tmp_path: Path, path: str) -> None:
    run = fake_run(tmp_path)
    late = replace(run.scene.train[-1], time=1e9)
    paused = replace(run, scene=replace(run.scene, train=[*run.scene.train[:-1], late]))
    with pytest.raises(InputError, match=r"lasts 1,000,000,001 frames.*use --path training"):
        plan_shot(paused, path, factor=1)
