"""Evaluation against closed forms: a perfect run scores perfectly, scales that LDR
leaves free do not count, poses are carried over.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import EV, SPEED, DiscBeforeWall, H, W, camera, fake_run
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import read_image, read_mask, write_png
from hdr_nsff.core.io import write_json
from hdr_nsff.evaluation.evaluate import EvaluateConfig, evaluate, evaluate_run
from hdr_nsff.fields.base import Render
from hdr_nsff.geometry import alignment
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.truth import Truth, TruthView, as_exposed, match_brackets
from hdr_nsff.training.run_folder import Run

# The truth's world is turned, three times as large, and elsewhere.
TURN = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SHIFT = torch.tensor([5.0, -2.0, 1.0])


def true_pose(c2w: Tensor) -> list[list[float]]:
    """A pose of the scene in the truth's world."""
    center = 3 * TURN @ c2w[:, 3] + SHIFT
    return torch.cat([TURN @ c2w[:, :3], center[:, None]], 1).tolist()


def write_truth(folder: Path, run: Run, field: DiscBeforeWall, **changes: Any) -> Path:
    """Exact views: a clip pose at another time, between frames, and off the path."""
    views = []
    for name, time, anchor, off in (
        ("a", 3.0, 1, None),
        ("b", 2.5, 4, None),
        ("c", 2.0, 2, camera(0.37)),
    ):
        seen = field.render(off or run.scene.train[anchor].camera, time)
        radiance = {"RGB": seen.radiance.reshape(H, W, 3).numpy()}
        write_exr(folder / f"radiance/{name}.exr", radiance, half=False)
        write_png(folder / f"masks/{name}.png", (seen.motion.reshape(H, W) > 0.5).numpy())
        pose = true_pose(off.c2w) if off else None
        views.append(
            TruthView(
                name=name,
                time=time,
                bracket=1,
                anchor=anchor,
                c2w=pose,
                radiance=f"radiance/{name}.exr",
                mask=f"masks/{name}.png",
            )
        )
    x = np.linspace(0, 1, 256) ** 2.2
    clip = [true_pose(f.camera.c2w) for f in run.scene.train]
    truth = Truth(
        bracket_ev=list(EV),
        reference_bracket=2,
        response_x=x.tolist(),
        response_y=[(x ** (1 / 2.2)).tolist()] * 3,
        K=camera().K.tolist(),
        clip_c2w=clip,
        views=views,
    )
    write_json(folder / "truth.json", truth.model_copy(update=changes).model_dump())
    return folder


class Scaled(DiscBeforeWall):
    """The scene with all radiance times a factor per channel."""

    factor = torch.ones(3)

    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        seen = super().render(camera, time, pixels)
        return replace(seen, radiance=seen.radiance * self.factor)


def field_of(run: Run) -> DiscBeforeWall:
    assert isinstance(run.field, DiscBeforeWall)
    return run.field


def test_a_perfect_run_is_perfect_and_off_path_poses_are_carried_over(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, field_of(run)))
    views = {v["name"]: v for v in result["views"]}
    groups = {name: view["group"] for name, view in views.items()}
    assert groups == {"a": "view", "b": "view+time", "c": "off-path"}
    for name in ("a", "c"):  # b is splatted between two frames
        view = views[name]
        assert view["psnr"] > 55 and view["ssim"] > 0.999 and view["mu5000"] > 55
    assert views["b"]["psnr"] > 22 and result["scale"] == pytest.approx(1, abs=1e-3)
    assert result["poses"]["ate"] < 1e-5 and result["poses"]["rotation_degrees"] < 0.1
    assert result["poses"]["focal_error"] == pytest.approx(0, abs=1e-6)
    assert result["camera"]["response_rmse"] < 2e-3 and result["camera"]["largest_ev_error"] == 0


def test_metrics_and_pictures_are_written_and_a_restart_renders_nothing(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    truth = write_truth(tmp_path / "truth", run, field_of(run))
    result = evaluate_run(run, truth)
    assert json.loads((run.folder / "metrics.json").read_text()) == result
    picture = read_image(run.folder / "evaluation/a.png")
    # two rows of prediction, truth, error
    assert picture.shape[0] > 2 * H and picture.shape[1] > 3 * W
    before = field_of(run).calls
    again = evaluate_run(run, truth)
    assert field_of(run).calls == before and again["headline"] == result["headline"]
    (run.folder / "evaluation/a.exr").write_bytes(b"cut short")
    repaired = evaluate_run(run, truth)
    assert field_of(run).calls > before and repaired["headline"] == result["headline"]


def test_a_scale_of_the_radiance_is_aligned_and_reported(tmp_path: Path) -> None:
    field = Scaled(speed=SPEED / 4, red=3.0)
    run = fake_run(tmp_path / "run", field=field)
    truth = write_truth(tmp_path / "truth", run, DiscBeforeWall(speed=SPEED / 4, red=3.0))
    field.factor = torch.tensor([0.5, 0.5, 0.25])
    result = evaluate_run(run, truth)
    assert result["scale"] == pytest.approx(2, rel=1e-3)
    assert result["scale_per_channel"] == pytest.approx([2, 2, 4], rel=1e-3)
    view = next(v for v in result["views"] if v["name"] == "a")
    assert view["mu5000_per_channel"] > 55
    assert view["mu5000_per_channel"] > view["mu5000"] > view["mu5000_unaligned"]
    assert view["psnr"] < 25  # recorded rgb is not aligned


def test_moving_only_numbers_see_the_mover_alone(tmp_path: Path) -> None:
    wrong = Scaled(speed=SPEED / 4, red=1.5)  # only the disc differs
    run = fake_run(tmp_path / "run", field=wrong)
    right = DiscBeforeWall(speed=SPEED / 4, red=3.0)
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, right))
    view = next(v for v in result["views"] if v["name"] == "a")
    assert view["psnr_moving"] < view["psnr"] - 5
    error = 0.75 ** (1 / 2.2) - 0.375 ** (1 / 2.2)  # red at EV -2, one channel of three
    assert view["psnr_moving"] == pytest.approx(-10 * np.log10(error**2 / 3), abs=0.1)
    # the wall has no error: means over it and the disc differ by the disc's share
    share = -10 * np.log10(read_mask(tmp_path / "truth/masks/a.png").mean())
    for name in ("pu21", "mu5000", "mu50_per_channel", "mu50_unaligned"):
        assert view[name] - view[f"{name}_moving"] == pytest.approx(share, abs=0.05), name
    assert view["hdr_flip_moving"] > 3 * view["hdr_flip"] > 0
    assert view["mu50_recordable"] > 55  # the disc has black channels


def test_held_out_frames_are_used_without_truth(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", num_frames=8, held_out=2)
    run = replace(run, scene=replace(run.scene, test=[replace(run.scene.test[0], time=4.5)]))
    result = evaluate_run(run, None)
    assert result["kind"] == "held-out frames" and [v["name"] for v in result["views"]] == ["00006"]
    assert "mu5000" not in result["headline"] and result["headline"]["psnr"] > 15


def test_training_views_are_named_as_such(tmp_path: Path) -> None:
    result = evaluate_run(fake_run(tmp_path / "run"), None)
    assert result["kind"] == "training views (not held out)" and "trained on" in result["notes"][0]
    assert result["headline"]["psnr"] > 50 and "absent" in result["lpips"]


def test_training_views_are_of_all_exposures(tmp_path: Path) -> None:
    result = evaluate_run(fake_run(tmp_path / "run", num_frames=36), None)
    frames = [int(view["name"]) for view in result["views"]]
    assert len(frames) == 9 and {frame % 3 for frame in frames} == {0, 1, 2}


def test_of_true_exposures_that_the_scene_does_not_tell_apart_the_views_own_counts(
    tmp_path: Path,
) -> None:
    run = fake_run(tmp_path / "run")  # brackets at EV -4, -2, 0
    truth = write_truth(tmp_path / "truth", run, field_of(run), bracket_ev=[-4, -2, -1.2, 0])
    (view,) = (v for v in evaluate_run(run, truth)["views"] if v["name"] == "a")
    assert view["psnr"] > 55


def test_tripod_views_off_the_path_are_left_out_by_name(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", parallax="none")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, field_of(run)))
    assert [v["name"] for v in result["views"]] == ["a", "b"]
    assert "c: left out" in result["notes"][0]
    assert "ate" not in result["poses"]


def test_brackets_are_matched_by_rank_of_exposure() -> None:
    assert match_brackets([-2, 0, 2], [0.1, -2.2, 2.1]) == {0: 1, 1: 0, 2: 2}
    assert match_brackets([-4, -2, 0], [0.0, -2.1]) == {0: 1, 1: 1, 2: 0}


def test_brackets_of_a_drifting_clip_have_the_mean_exposure_of_their_training_frames(
    tmp_path: Path,
) -> None:
    """The scene knows the drift of frame 0. Frame 6, held out, does not count."""
    run = fake_run(tmp_path / "run", num_frames=7, held_out=1)
    mean = np.array([0.5, -0.25, 0.25])  # of the training frames of every bracket
    drift = [*(mean + 0.1), *(mean - 0.1), 3.0]
    frames = run.scene.manifest.frames
    frames[0].drift = 0.2
    drift[0] += 0.2
    changes = {"bracket_ev": (EV - mean).tolist(), "clip_drift": drift, "clip_c2w": None}
    truth = write_truth(tmp_path / "truth", run, field_of(run), **changes)
    found = as_exposed(Truth.open(truth), frames, EV)
    assert found.bracket_ev == pytest.approx(EV)
    views = Truth.open(truth).views
    write_truth(truth, run, field_of(run), **changes, views=[v for v in views if v.c2w is None])
    result = evaluate_run(run, truth)
    view = next(v for v in result["views"] if v["name"] == "a")
    assert view["psnr"] > 55 and result["camera"]["largest_ev_error"] < 1e-6


def test_a_scene_that_counts_other_frames_than_the_truth_is_refused(tmp_path: Path) -> None:
    """Of `prepare --start 2` or `--stride 2`; of a video, and of a folder of frames."""
    run = fake_run(tmp_path / "run")
    truth = write_truth(tmp_path / "truth", run, field_of(run))
    manifest = run.scene.manifest
    for start, stride in ((0, 1), (2, 1), (0, 2)):
        for names in ("clip.mp4#{}", "img_{}.png"):
            manifest.inputs = {names.format(n): "" for n in range(20) if "#" not in names}
            for frame in manifest.frames:
                frame.source = names.format(start + stride * frame.index)
            if (start, stride) == (0, 1):
                evaluate_run(run, truth)
                continue
            with pytest.raises(InputError, match="without --start, --stride"):
                evaluate_run(run, truth)


def test_learned_exposures_are_compared_up_to_a_power(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    truth = write_truth(tmp_path / "truth", run, field_of(run), bracket_ev=[-2.0, -1.0, 0.0])
    camera = evaluate_run(run, truth)["camera"]
    assert camera["power"] == pytest.approx(2) and camera["largest_ev_error"] == pytest.approx(2)
    assert camera["response_rmse_after_power"] > 0.05  # the curve of this run is that of power 1


def test_umeyama_finds_the_similarity_and_refuses_points_in_one_place() -> None:
    points = np.random.default_rng(0).standard_normal((9, 3))
    fit = alignment.umeyama(points, 3 * points @ TURN.double().numpy().T + SHIFT.double().numpy())
    assert fit is not None and fit.scale == pytest.approx(3)
    assert np.allclose(fit.rotation, TURN) and np.allclose(fit.translation, SHIFT)
    assert alignment.umeyama(points, np.ones((9, 3))) is None


def test_pose_errors_are_in_true_units(tmp_path: Path) -> None:
    poses = np.stack([np.c_[np.eye(3), [0.1 * i, np.sin(i), np.cos(2.0 * i)]] for i in range(40)])
    estimated = poses.copy()
    noise = 0.02 * np.random.default_rng(0).standard_normal((40, 3))
    estimated[:, :, 3] = 2 * poses[:, :, 3] + noise
    errors = alignment.pose_errors(poses, estimated)
    assert errors["ate"] == pytest.approx(0.01 * 3**0.5, rel=0.2)
    extent = np.linalg.norm(np.ptp(poses[:, :, 3], axis=0))
    assert errors["ate_share"] == pytest.approx(errors["ate"] / extent)
    assert errors["rotation_degrees"] < 1e-5


def lone_view(**changes: Any) -> dict[str, Any]:
    """A truth of one view."""
    settings = {"name": "x", "time": 1, "bracket": 0, "anchor": 0, "radiance": "radiance/a.exr"}
    return {"views": [TruthView(**(settings | changes))]}


BAD_TRUTH: dict[str, dict[str, Any]] = {
    "3 frames, the scene has 6": {"clip_c2w": [true_pose(camera().c2w)] * 3},
    "clip_c2w is missing": {"clip_c2w": None},
    "no view of this truth": {"views": []},
    "anchored at frame 77": lone_view(anchor=77),
    "has bracket 5": lone_view(bracket=5),
    "outside the scene folder": lone_view(radiance="../a.exr"),
    "no such file": lone_view(radiance="radiance/z.exr"),
    "outside the training frames": lone_view(time=9),
}


@pytest.mark.parametrize("sentence", BAD_TRUTH)
def test_bad_truth_is_refused_in_a_sentence(sentence: str, tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    truth = write_truth(tmp_path / "truth", run, field_of(run), **BAD_TRUTH[sentence])
    with pytest.raises(InputError, match=sentence):
        evaluate_run(run, truth)


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    truth = write_truth(tmp_path / "truth", run, field_of(run))
    write_png(truth / "masks/a.png", np.zeros((4, 4), bool))
    with pytest.raises(InputError, match="a mask of"):
        evaluate_run(run, truth)


def test_the_verb_opens_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder, device: fake_run(Path(folder))))
    assert evaluate(EvaluateConfig(tmp_path))["headline"]["views"] == 6
