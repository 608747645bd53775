"""Depth, motion, stability and the learned camera against closed forms; which views
belong to which protocol. The truth's world is turned, shifted and three times as large
as the scene's.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from estimates import tone_mapper
from fakes import DISC, FOCAL, SPEED, DiscBeforeWall, H, W, fake_run
from test_evaluate import TURN, field_of, write_truth
from torch import Tensor

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr, write_exr
from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import write_json
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.evaluation.predictions import intervals
from hdr_nsff.evaluation.scores.camera import camera_errors
from hdr_nsff.evaluation.scores.stability import MAX_PAIRS, stability
from hdr_nsff.evaluation.targets import choose_targets
from hdr_nsff.fields.base import Render
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.tonemap.curve import knot_positions
from hdr_nsff.training.run_folder import Run

MOTION = SPEED / 4  # of the fake run's disc, scene units per frame
PIXELS = FOCAL / DISC * float(MOTION.norm())  # the same in its picture


class Wrong(DiscBeforeWall):
    """The scene with depth times a factor, scene flow times another, radiance that
    flickers from frame to frame.
    """

    deeper, faster, flicker = 1.0, 1.0, 0.0

    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        seen = super().render(camera, time, pixels)
        flow = {o: f * self.faster for o, f in seen.scene_flow.items()}
        return replace(
            seen,
            depth=seen.depth * self.deeper,
            scene_flow=flow,
            radiance=seen.radiance * (1 + self.flicker * (time % 2)),
        )


class Still(DiscBeforeWall):
    """A field without scene flow."""

    layers = None  # type: ignore[assignment]

    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        moving = DiscBeforeWall(speed=self.speed, red=self.red)
        return replace(moving.render(camera, time, pixels), scene_flow={})


def truth_of(folder: Path, run: Run) -> Path:
    """The exact truth of the fake scene, with depth and motion of every view."""
    field = DiscBeforeWall(speed=MOTION, red=3.0)
    write_truth(folder, run, field)
    truth = Truth.open(folder)
    for view, target in zip(truth.views, choose_targets(run, truth, folder)[1], strict=True):
        camera = target.view.camera
        seen = field.render(camera, view.time)
        rays = camera.rays(camera.pixel_grid())
        points = rays.origins + seen.depth[:, None] * rays.directions
        maps = {"Z": 3 * seen.depth}
        for side, name in MOTION_DIRECTIONS.items():
            flow = seen.scene_flow[side]
            world = 3 * flow @ TURN.T
            pixels = camera.project(points + flow)[0] - camera.pixel_grid()
            maps |= {f"{name}.{a}": world[:, k] for k, a in enumerate("xyz")}
            maps |= {f"{name}.{a}": pixels[:, k] for k, a in enumerate("uv")}
        channels = {name: values.reshape(H, W).numpy() for name, values in maps.items()}
        write_exr(folder / f"geometry/{view.name}.exr", channels, half=False)
    views = [v.model_copy(update={"geometry": f"geometry/{v.name}.exr"}) for v in truth.views]
    write_json(folder / "truth.json", truth.model_copy(update={"views": views}).model_dump())
    return folder


def wrong_run(folder: Path, **changes: float) -> Run:
    field = Wrong(speed=MOTION, red=3.0)
    for name, value in changes.items():
        setattr(field, name, value)
    return fake_run(folder, field=field)


def views_of(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {v["name"]: v for v in result["views"]}


# Depth and motion


def test_the_true_field_has_no_error_of_depth_or_motion(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, truth_of(tmp_path / "truth", run))
    assert result["depth_scale"] == pytest.approx(3, rel=1e-4)
    assert result["world_scale"] == pytest.approx(3, rel=1e-4)
    for name in ("a", "c"):  # b is splatted between two frames
        view = views_of(result)[name]
        for score in ("depth_abs_rel", "depth_rmse", "scene_flow_epe", "flow_epe"):
            assert view[score] < 1e-3 and view[f"{score}_moving"] < 1e-3, score
        assert view["flow_epe_of_rest_moving"] == pytest.approx(PIXELS, rel=1e-4)
        assert min(view["pu21"], view["pu21_moving"], view["mu50_per_channel_moving"]) > 55
    assert not any("depth" in note or "motion" in note for note in result["notes"])


def test_the_note_that_the_report_reads_holds_all_of_the_metrics(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, truth_of(tmp_path / "truth", run))
    note = notes.read(run.folder / "metrics.json", notes.Metrics)
    assert note is not None
    assert {"geometry_scores", "pu21", "stability", "protocols"} <= note.model_fields_set
    for key, value in json.loads(note.model_dump_json(exclude_unset=True)).items():
        assert value == result[key], key


def test_depth_takes_one_scale_for_all_views_and_motion_that_of_the_cameras(tmp_path: Path) -> None:
    """Depth that is 1.5 times too large everywhere is aligned away; the scale of the
    flow is that of the camera path and stays.
    """
    run = wrong_run(tmp_path / "run", deeper=1.5)
    result = evaluate_run(run, truth_of(tmp_path / "truth", run))
    view = views_of(result)["a"]
    assert result["depth_scale"] == pytest.approx(2, rel=1e-4)
    assert result["world_scale"] == pytest.approx(3, rel=1e-4)
    assert view["depth_abs_rel"] < 1e-3 and view["scene_flow_epe"] < 1e-3
    # At 1.5 times the depth, the disc moves 2/3 as far.
    assert view["flow_epe_moving"] == pytest.approx(PIXELS / 3, rel=1e-3)


def test_errors_of_wrong_scene_flow_are_in_true_units_and_in_pixels(tmp_path: Path) -> None:
    run = wrong_run(tmp_path / "run", faster=0.25)
    view = views_of(evaluate_run(run, truth_of(tmp_path / "truth", run)))["a"]
    assert view["scene_flow_epe_moving"] == pytest.approx(0.75 * 3 * float(MOTION.norm()), rel=1e-4)
    assert view["flow_epe_moving"] == pytest.approx(0.75 * PIXELS, rel=1e-4)
    moving = read_mask(tmp_path / "truth/masks/a.png").mean()
    expected = moving * view["flow_epe_moving"]  # the wall is at rest in both
    assert view["flow_epe"] == pytest.approx(expected, rel=1e-4)


def test_depth_errors_are_in_true_units_after_the_scale(tmp_path: Path) -> None:
    """The wall, most of the picture, sets the scale; the disc is then 12 % too far
    away, of true z-depth 3 * DISC.
    """
    run = fake_run(tmp_path / "run", field=DiscTooFar(speed=MOTION, red=3.0))
    view = views_of(evaluate_run(run, truth_of(tmp_path / "truth", run)))["a"]
    assert view["depth_abs_rel_moving"] == pytest.approx(0.12, rel=1e-3)
    assert view["depth_rmse_moving"] == pytest.approx(0.12 * 3 * DISC, rel=1e-3)
    share = read_mask(tmp_path / "truth/masks/a.png").mean()
    assert view["depth_abs_rel"] == pytest.approx(0.12 * share, rel=1e-3)


class DiscTooFar(DiscBeforeWall):
    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        seen = super().render(camera, time, pixels)
        return replace(seen, depth=seen.depth * (1 + 0.12 * seen.motion))


def test_scene_flow_reaches_from_one_training_time_to_the_next() -> None:
    assert intervals(1.0, [0.0, 1.0, 2.0]) == {1: 1, -1: 1}
    assert intervals(2.0, [0.0, 2.0, 4.0]) == {1: 2, -1: 2}
    # Nothing was learned about the time before the clip.
    assert intervals(0.0, [0.0, 2.0, 4.0]) == {1: 2}
    assert intervals(3.0, [0.0, 2.0, 4.0]) == {-1: 2}
    assert intervals(2.0, [0.0, 2.0, 3.0]) == {1: 1, -1: 2}
    # Half-way from 0 to 2 leads to half-way from 2 to 3.
    assert intervals(1.0, [0.0, 2.0, 3.0]) == {1: pytest.approx(1.5)}


def test_flow_over_two_frames_is_compared_per_frame(tmp_path: Path) -> None:
    """Every second frame held out: the field's flow is twice as long, and what is
    measured is the same.
    """
    run = wrong_run(tmp_path / "run", faster=2.0)
    truth = truth_of(tmp_path / "truth", run)
    frames = [f for f in run.scene.train if f.index % 2 == 0 or f.index == 5]
    thinned = replace(run, scene=replace(run.scene, train=frames))
    scores = views_of(evaluate_run(thinned, truth))["c"]  # at time 2
    assert scores["scene_flow_epe"] < 1e-4 and scores["flow_epe"] < 1e-3


def test_a_truth_without_depth_and_a_field_without_flow_are_named(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "old", run, field_of(run)))
    assert any("this truth folder has none" in note for note in result["notes"])
    assert "depth_scale" not in result
    still = fake_run(tmp_path / "still", field=Still(speed=MOTION, red=3.0))
    result = evaluate_run(still, truth_of(tmp_path / "truth", still))
    assert any("this field has no scene flow" in note for note in result["notes"])
    assert result["headline"]["depth_abs_rel"] < 1e-3 and "flow_epe" not in result["headline"]


def test_a_tripod_has_no_scale_for_scene_flow(tmp_path: Path) -> None:
    tripod = fake_run(tmp_path / "tripod", parallax="none")
    result = evaluate_run(tripod, truth_of(tmp_path / "truth", fake_run(tmp_path / "moves")))
    assert any("fix no scale" in note for note in result["notes"])
    assert "scene_flow_epe" not in result["headline"]


def test_depth_and_motion_that_fit_nothing_are_refused_in_a_sentence(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    folder = truth_of(tmp_path / "truth", run)
    channels = read_exr(folder / "geometry/a.exr")
    fewer = {name: values for name, values in channels.items() if name != "backward.v"}
    write_exr(folder / "geometry/a.exr", fewer, half=False)
    with pytest.raises(InputError, match=r"no channel backward\.v"):
        evaluate_run(run, folder)
    smaller = {name: values[:5] for name, values in channels.items()}
    write_exr(folder / "geometry/a.exr", smaller, half=False)
    with pytest.raises(InputError, match="but the pictures of that view are"):
        evaluate_run(run, folder)
    lost = Truth.open(folder).model_copy(update={"clip_c2w": None})
    write_json(folder / "truth.json", lost.model_dump())
    with pytest.raises(InputError, match="nobody knows which way they point"):
        evaluate_run(run, folder)


# Stability


def with_flow(run: Run) -> Run:
    """The run with the exact flow of its clip, valid everywhere but at the disc's edge
    and where the other frame hides it.
    """
    field, frames = DiscBeforeWall(speed=MOTION, red=3.0), []
    for k, frame in enumerate(run.scene.train):
        neighbors = {o: k + o for o in (-1, 1) if 0 <= k + o < len(run.scene.train)}
        flow, valid = {}, {}
        for side, j in neighbors.items():
            seen, there = field.render(frame.camera, frame.time), run.scene.train[j].camera
            rays = frame.camera.rays(frame.camera.pixel_grid())
            points = rays.origins + seen.depth[:, None] * rays.directions + seen.scene_flow[side]
            landing, depth = there.project(points)
            around = [
                field.render(there, run.scene.train[j].time, landing + torch.tensor(d)).depth
                for d in ((1.0, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            flow[side] = (landing - frame.camera.pixel_grid()).view(H, W, 2)
            valid[side] = torch.stack([(a - depth).abs() < 0.1 for a in around]).all(0).view(H, W)
        frames.append(replace(frame, neighbors=neighbors, flow=flow, flow_valid=valid))
    return replace(run, scene=replace(run.scene, train=frames))


def test_a_steady_field_is_steady_and_flicker_is_measured(tmp_path: Path) -> None:
    """Radiance that changes by a tenth between even and odd frames: 0.1 / 2.1,
    whichever of the two is brighter. Of the disc, which is red alone, two channels stay
    black.
    """
    run = with_flow(fake_run(tmp_path / "run"))
    steady = stability(run, tmp_path / "steady")
    assert steady["pairs"] == 5 and steady["hdr_tae"] < 2e-4 and steady["hdr_tae_moving"] < 2e-4
    field = Wrong(speed=MOTION, red=3.0)
    field.flicker = 0.1
    found = stability(replace(run, field=field), tmp_path / "flickers")
    assert found["hdr_tae"] == pytest.approx(0.1 / 2.1, rel=0.04)
    assert found["hdr_tae_moving"] == pytest.approx(0.1 / 2.1 / 3, abs=2e-4)


def test_a_mover_at_rest_in_the_field_is_not_steady(tmp_path: Path) -> None:
    run = with_flow(fake_run(tmp_path / "run"))
    at_rest = DiscBeforeWall(speed=torch.zeros(3), red=3.0)
    found = stability(replace(run, field=at_rest), tmp_path / "rests")
    assert found["hdr_tae_moving"] > 0.02


def test_long_clips_are_sampled_and_clips_without_flow_have_no_stability(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", num_frames=30)
    assert stability(run, tmp_path / "none") == {} and not (tmp_path / "none").exists()
    assert stability(with_flow(run), tmp_path / "long")["pairs"] == MAX_PAIRS
    result = evaluate_run(fake_run(tmp_path / "other"), None)
    assert result["stability"] == {} and any("HDR-TAE: absent" in note for note in result["notes"])


# The learned camera


def learned(run: Run, ev: list[float], gamma: float) -> Run:
    """The run with learned exposures and the response x^(1 / gamma)."""
    tonemapper = tone_mapper(
        [i % 3 for i in range(6)], [0] * 6, [None, None, 0.0], reference=2, residual=False
    )
    tonemapper.set_exposures(ev)
    knots = knot_positions("gamma")
    tonemapper.set_curve(knots, (knots ** (1 / gamma)).expand(3, -1))
    manifest = run.scene.manifest.model_copy(
        update={"exposure_given": False, "bracket_ev": [None, None, 0.0]}
    )
    return replace(run, tonemapper=tonemapper, scene=replace(run.scene, manifest=manifest))


def test_the_power_that_recordings_leave_free_is_removed_from_curve_and_steps(
    tmp_path: Path,
) -> None:
    """E^1.25 through x^(1 / (2.2 * 1.25)) with steps of 2.5 EV records what E through
    x^(1 / 2.2) with steps of 2 EV does.
    """
    run = fake_run(tmp_path / "run")
    truth = Truth.open(write_truth(tmp_path / "truth", run, field_of(run)))
    errors = camera_errors(learned(run, [-5.0, -2.5, 0.0], 2.2 * 1.25), truth)
    assert errors["true_ev_steps"] == [2, 2]
    assert errors["learned_ev_steps"] == pytest.approx([2.5, 2.5])
    assert errors["largest_step_error"] == pytest.approx(0.5) and errors["response_rmse"] > 0.05
    assert errors["power"] == pytest.approx(1.25)
    assert errors["power_of_response"] == pytest.approx(1.25, rel=0.005)
    assert errors["response_rmse_after_power"] < 2e-3
    assert errors["largest_step_error_after_power"] < 0.02


def test_neither_curve_nor_steps_are_measured_against_themselves(tmp_path: Path) -> None:
    """The true curve with steps that are 25 % too long is no gauge: the error stays in
    both.
    """
    run = fake_run(tmp_path / "run")
    truth = Truth.open(write_truth(tmp_path / "truth", run, field_of(run)))
    errors = camera_errors(learned(run, [-5.0, -2.5, 0.0], 2.2), truth)
    assert errors["power_of_response"] == pytest.approx(1, rel=0.005)
    assert errors["response_rmse"] < 2e-3
    assert errors["largest_step_error_after_power"] == pytest.approx(0.5, abs=0.02)
    assert errors["response_rmse_after_power"] > 0.05


def test_the_error_of_a_response_worked_by_hand(tmp_path: Path) -> None:
    """The identity against x^(1 / 2.2), over u in [0, 1] with x = u^2.2: the root of
    the integral of (u^2.2 - u)^2.
    """
    run = fake_run(tmp_path / "run")
    truth = Truth.open(write_truth(tmp_path / "truth", run, field_of(run)))
    errors = camera_errors(learned(run, [-4.0, -2.0, 0.0], 1.0), truth)
    assert errors["response_rmse"] == pytest.approx((1 / 5.4 - 2 / 4.2 + 1 / 3) ** 0.5, rel=0.01)
    assert errors["largest_step_error"] == pytest.approx(0)


# Which views belong to which protocol


def test_views_at_and_between_training_times_belong_to_different_protocols(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, truth_of(tmp_path / "truth", run))
    assert {v["name"]: v["protocol"] for v in result["views"]} == {
        "a": "novel-view",
        "b": "novel-view-time",
        "c": "novel-view",
    }
    assert result["protocol"] is None and result["headline"]["views"] == 3
    assert {p: m["views"] for p, m in result["protocols"].items()} == {
        "novel-view": 2,
        "novel-view-time": 1,
    }


@pytest.mark.parametrize(
    "protocol, names", [("novel-view", ["a", "c"]), ("novel-view-time", ["b"])]
)
def test_the_headline_is_that_of_the_scenes_protocol(
    tmp_path: Path, protocol: str, names: list[str]
) -> None:
    run = fake_run(tmp_path / "run")
    truth = truth_of(tmp_path / "truth", run)
    manifest = run.scene.manifest.model_copy(update={"protocol": protocol})
    result = evaluate_run(replace(run, scene=replace(run.scene, manifest=manifest)), truth)
    assert result["headline"] == result["protocols"][protocol]
    expected = np.mean([views_of(result)[name]["psnr"] for name in names])
    assert result["headline"]["psnr"] == pytest.approx(expected)


def test_with_every_second_frame_held_out_its_time_is_a_new_one(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    truth = truth_of(tmp_path / "truth", run)
    train = [f for f in run.scene.train if f.index in (0, 2, 4, 5)]
    result = evaluate_run(replace(run, scene=replace(run.scene, train=train)), truth)
    assert {v["name"]: v["protocol"] for v in result["views"]} == {
        "a": "novel-view-time",
        "b": "novel-view-time",
        "c": "novel-view",
    }


def test_a_frame_that_was_trained_on_is_no_held_out_view(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, field_of(run))
    truth = Truth.open(folder)
    own = TruthView(
        name="own", time=4.0, bracket=1, anchor=4, radiance="radiance/a.exr", mask="masks/a.png"
    )
    both = truth.model_copy(update={"views": [*truth.views, own]})
    write_json(folder / "truth.json", both.model_dump())
    result = evaluate_run(run, folder)
    found = views_of(result)["own"]
    assert found["group"] == "training view" and found["protocol"] is None
    assert result["headline"]["views"] == 3
    assert any("trained on" in note for note in result["notes"])
    assert result["kind"] == "held-out views with exact radiance"
    write_json(folder / "truth.json", truth.model_copy(update={"views": [own]}).model_dump())
    result = evaluate_run(run, folder)
    assert result["kind"] == "training views with exact radiance"
    assert result["headline"]["views"] == 1 and result["protocols"] == {}


def test_a_scene_whose_protocol_has_no_view_is_noted(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", num_frames=8, held_out=2)
    manifest = run.scene.manifest.model_copy(update={"protocol": "novel-view"})
    held = replace(run.scene.test[0], time=4.5)
    scene = replace(run.scene, test=[held], manifest=manifest)
    result = evaluate_run(replace(run, scene=scene), None)
    assert any("novel-view" in note for note in result["notes"])
    assert result["headline"]["views"] == 1
    assert result["views"][0]["protocol"] == "novel-view-time"
