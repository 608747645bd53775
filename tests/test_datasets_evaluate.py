"""Held-out views that a data set recorded: a perfect run scores perfectly on them, at
the exposures it knows and at new ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import EV, DiscBeforeWall, H, W, camera, fake_run

from hdr_nsff import pipeline as run_all
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.io import read_json, write_json
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.training.run_folder import Run

BRIGHTER = 1.5  # EV that no frame of the clip has


def write_truth(folder: Path, run: Run, radiance: str, **changes: Any) -> Path:
    """Two views off the path, a and b, as recorded at brackets 0 and 1 and, one of
    them, at an exposure of its own; of those named in `radiance` it is known too.
    """
    assert isinstance(run.field, DiscBeforeWall)
    views = []
    for name, time, x, bracket in (("a", 3.0, 0.33, 0), ("b", 1.0, -0.2, 1)):
        c = camera(x)
        exact = run.field.render(c, time).radiance
        recorded = {bracket: run.tonemapper(exact, bracket, 0, None, leaky=False).detach()}
        if name == "a":
            recorded[3] = run.tonemapper.develop(exact, BRIGHTER, 0)
        for b, rgb in recorded.items():
            write_png(folder / f"recorded/{name}_{b}.png", rgb.reshape(H, W, 3).numpy(), bits=16)
        if name in radiance:
            write_exr(
                folder / f"radiance/{name}.exr", {"RGB": exact.reshape(H, W, 3).numpy()}, half=False
            )
        views.append(
            TruthView(
                name=name,
                time=time,
                bracket=bracket,
                anchor=int(time),
                c2w=c.c2w.tolist(),
                recorded={b: f"recorded/{name}_{b}.png" for b in recorded},
                radiance=f"radiance/{name}.exr" if name in radiance else None,
            )
        )
    truth = Truth(
        bracket_ev=[*EV, BRIGHTER],
        reference_bracket=2,
        bracket_frame=[3, 4, 5, None],
        K=camera().K.tolist(),
        clip_c2w=[f.camera.c2w.tolist() for f in run.scene.train],
        views=views,
    )
    write_json(folder / "truth.json", truth.model_copy(update=changes).model_dump())
    return folder


def test_a_perfect_run_is_perfect_on_recorded_views(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, radiance=""))
    assert result["kind"] == "held-out views as recorded"
    assert [v["psnr"] > 60 for v in result["views"]] == [True, True]
    assert result["views"][0]["psnr_novel_exposures"] > 60
    assert "psnr_novel_exposures" not in result["views"][1]
    assert "mu5000" not in result["headline"]
    assert result["camera"] == {}
    assert "scale" not in result
    assert result["poses"]["ate"] == pytest.approx(0, abs=1e-6)


def test_radiance_beside_recordings_is_scored_too(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, radiance="ab"))
    assert result["kind"] == "held-out views with exact radiance"
    assert result["headline"]["mu5000"] > 55
    assert result["scale"] == pytest.approx(1, abs=1e-3)
    assert result["camera"] == {}  # the true response is not known


def test_views_without_radiance_do_not_count_in_its_scores(tmp_path: Path) -> None:
    """The gauge is that of the view that has radiance; both have recorded values."""
    run = fake_run(tmp_path / "run")
    one = evaluate_run(run, write_truth(tmp_path / "truth", run, radiance="b"))
    a, b = one["views"]
    assert "mu5000" not in a
    assert b["mu5000"] > 55
    assert one["headline"]["mu5000"] == b["mu5000"]
    assert one["scale"] == pytest.approx(1, abs=1e-3)
    assert one["peak"] == pytest.approx(3)  # the disc's red
    assert (
        read_image(run.folder / "evaluation/a.png").shape[0]
        < read_image(run.folder / "evaluation/b.png").shape[0]
    )


def test_moving_pixels_count_alone_at_all_exposures_of_a_view(tmp_path: Path) -> None:
    """The mask covers the left half; there the recordings are right, elsewhere they are
    black.
    """
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance="")
    for path in (folder / "recorded").glob("*.png"):
        write_png(path, read_image(path) * (np.arange(W) < W // 2)[None, :, None], bits=16)
    write_png(folder / "left.png", np.arange(W)[None, :].repeat(H, 0) < W // 2)
    truth = read_json(folder / "truth.json")
    truth["views"][0]["mask"] = "left.png"
    write_json(folder / "truth.json", truth)
    view = evaluate_run(run, folder)["views"][0]
    for score in ("psnr", "psnr_all_exposures", "psnr_novel_exposures"):
        moving = score.replace("psnr", "psnr_moving")
        assert view[moving] > 60 and view[score] < 20, score


def test_a_view_is_rendered_through_its_lens(tmp_path: Path) -> None:
    """Recorded with twice the focal length. The clip's own focal length is not that of
    the view.
    """
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance="")
    truth, K = read_json(folder / "truth.json"), camera().K * torch.tensor([[2.0], [2.0], [1.0]])
    K[:2, 2] = camera().K[:2, 2]
    near = Camera(K, torch.tensor(truth["views"][0]["c2w"]), W, H)
    rgb = (
        run.tonemapper(run.field.render(near, 3.0).radiance, 0, 0, None, leaky=False)
        .detach()
        .reshape(H, W, 3)
    )
    write_png(folder / "recorded/a_0.png", rgb.numpy(), bits=16)
    assert evaluate_run(run, folder)["views"][0]["psnr"] < 40
    truth["views"][0]["K"] = K.tolist()
    write_json(folder / "truth.json", truth)
    result = evaluate_run(run, folder)
    assert result["views"][0]["psnr"] > 60
    assert result["poses"]["focal_error"] == pytest.approx(0, abs=1e-6)


def test_recorded_views_belong_to_protocols(tmp_path: Path) -> None:
    """View a is at time 3, b at time 1. Of a run that was not trained at time 3 it is
    between its frames.
    """
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance="")
    assert [v["protocol"] for v in evaluate_run(run, folder)["views"]] == [
        "novel-view",
        "novel-view",
    ]
    frames = run.scene.train
    some = replace(
        run, scene=replace(run.scene, train=[f for f in frames if f.index != 3], test=[frames[3]])
    )
    some.scene.manifest.protocol = "novel-view-time"
    result = evaluate_run(some, folder)
    assert [v["protocol"] for v in result["views"]] == ["novel-view-time", "novel-view"]
    assert result["headline"]["views"] == 1
    assert result["headline"]["psnr"] == result["views"][0]["psnr"]


def test_a_wrong_exposure_is_seen(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(
        run, write_truth(tmp_path / "truth", run, radiance="", bracket_frame=[4, 3, 5, None])
    )
    assert result["headline"]["psnr"] < 20


def test_given_poses_need_no_spread_to_share_a_world(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", parallax="none")  # all cameras in one place
    assert (
        evaluate_run(run, write_truth(tmp_path / "truth", run, radiance=""))["headline"]["views"]
        == 2
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"bracket_frame": None, "bracket_ev": [None, 0.0, 1.0, 2.0]},
            "bracket_frame does not say",
        ),
        ({"bracket_frame": [0]}, "bracket_frame lists 1 brackets"),
        ({"bracket_frame": [3, 4, None, 5]}, "no frame of the reference exposure 2"),
        ({"response_x": [0.0, 1.0]}, "not three curves"),
    ],
)
def test_a_truth_that_makes_no_sense_is_one_sentence(
    changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance="", **changes)
    with pytest.raises(InputError, match=words):
        Truth.open(folder)


@pytest.mark.parametrize(
    ("update", "words"),
    [
        ({"recorded": {}}, "no picture of bracket"),
        ({"recorded": {0: "recorded/a_0.png", 9: "recorded/a_0.png"}}, "recordings at brackets"),
        ({"K": [[1.0]]}, "a K that is not a 3x3"),
    ],
)
def test_a_view_that_makes_no_sense_is_one_sentence(
    update: dict[str, Any], words: str, tmp_path: Path
) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance="")
    truth = read_json(folder / "truth.json")
    truth["views"][0] |= update
    write_json(folder / "truth.json", truth)
    with pytest.raises(InputError, match=words):
        Truth.open(folder)


def test_pictures_of_several_sizes_are_refused(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance="ab")
    write_png(folder / "recorded/a_0.png", np.zeros((H // 2, W // 2, 3)))
    with pytest.raises(InputError, match="several sizes"):
        evaluate_run(run, folder)


def test_a_clip_without_the_reference_exposure_is_refused(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    with pytest.raises(InputError, match="frame 77 shows the reference exposure"):
        evaluate_run(
            run, write_truth(tmp_path / "truth", run, radiance="", bracket_frame=[3, 4, 77, None])
        )


def test_run_measures_on_what_the_data_set_held_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, seen = fake_run(tmp_path / "run"), []

    def prepare_scenes(config: PrepareConfig, part_cuts: bool) -> list[Path]:
        place = config.out.with_name("scene_truth")
        write_json(place / "made_of.json", {"key": ""})
        write_truth(place, run, radiance="")
        return [config.out]

    monkeypatch.setattr(run_all, "prepare_scenes", prepare_scenes)
    monkeypatch.setattr(run_all, "train", lambda settings: tmp_path)
    monkeypatch.setattr(run_all.Run, "open", staticmethod(lambda folder, device: run))
    monkeypatch.setattr(run_all, "render_all", lambda run, out: {})
    monkeypatch.setattr(run_all, "write_report", lambda *rest: tmp_path)
    monkeypatch.setattr(run_all, "evaluate_run", lambda run, truth: seen.append(truth))
    run_all.run_all(run_all.RunConfig(tmp_path, tmp_path / "out"))
    assert seen == [tmp_path / "out/scene_truth"]
