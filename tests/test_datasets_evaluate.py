"""Held-out views that a data set recorded: a perfect run scores perfectly on them, at the exposures it knows and at new ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import EV, DiscBeforeWall, H, W, camera, fake_run

from hdr_nsff import io, run_all
from hdr_nsff.errors import InputError
from hdr_nsff.evaluate import evaluate_run
from hdr_nsff.prepare import PrepareConfig
from hdr_nsff.run import Run
from hdr_nsff.truth import Truth, TruthView

BRIGHTER = 1.5  # EV that no frame of the clip has


def write_truth(folder: Path, run: Run, radiance: bool, **changes: Any) -> Path:
    """Two views off the path as recorded at brackets 0 and 1 and, one of them, at an exposure of its own."""
    assert isinstance(run.field, DiscBeforeWall)
    views = []
    for name, time, x, bracket in (("a", 3.0, 0.33, 0), ("b", 1.0, -0.2, 1)):
        c = camera(x)
        exact = run.field.render(c, time).radiance
        recorded = {bracket: run.tonemapper(exact, bracket, 0, None, leaky=False).detach()}
        if name == "a":
            recorded[3] = run.tonemapper.develop(exact, BRIGHTER, 0)
        for b, rgb in recorded.items():
            io.write_png(folder / f"recorded/{name}_{b}.png", rgb.reshape(H, W, 3).numpy(), bits=16)
        if radiance:
            io.write_exr(folder / f"radiance/{name}.exr", {"RGB": exact.reshape(H, W, 3).numpy()}, half=False)
        views.append(
            TruthView(
                name=name, time=time, bracket=bracket, anchor=int(time), c2w=c.c2w.tolist(),
                recorded={b: f"recorded/{name}_{b}.png" for b in recorded}, radiance=f"radiance/{name}.exr" if radiance else None,
            )
        )  # fmt: skip
    truth = Truth(
        bracket_ev=[*EV, BRIGHTER], reference_bracket=2, bracket_frame=[3, 4, 5, None], K=camera().K.tolist(),
        clip_c2w=[f.camera.c2w.tolist() for f in run.scene.train], views=views,
    )  # fmt: skip
    io.write_json(folder / "truth.json", truth.model_copy(update=changes).model_dump())
    return folder


def test_a_perfect_run_is_perfect_on_recorded_views(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, radiance=False))
    assert result["kind"] == "held-out views as recorded"
    assert [v["psnr"] > 60 for v in result["views"]] == [True, True]
    assert result["views"][0]["psnr_novel_exposures"] > 60 and "psnr_novel_exposures" not in result["views"][1]
    assert "mu5000" not in result["headline"] and "camera" not in result and "scale" not in result
    assert result["poses"]["ate"] == pytest.approx(0, abs=1e-6)


def test_radiance_beside_recordings_is_scored_too(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, radiance=True))
    assert result["kind"] == "held-out views with exact radiance"
    assert result["headline"]["mu5000"] > 55 and result["scale"] == pytest.approx(1, abs=1e-3)
    assert "camera" not in result  # the true response is not known


def test_a_wrong_exposure_is_seen(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    result = evaluate_run(run, write_truth(tmp_path / "truth", run, radiance=False, bracket_frame=[4, 3, 5, None]))
    assert result["headline"]["psnr"] < 20


def test_given_poses_need_no_spread_to_share_a_world(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", parallax="none")  # all cameras in one place
    assert evaluate_run(run, write_truth(tmp_path / "truth", run, radiance=False))["headline"]["views"] == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bracket_frame": None, "bracket_ev": [None, 0.0, 1.0, 2.0]}, "bracket_frame does not say"),
        ({"bracket_frame": [0]}, "bracket_frame lists 1 brackets"),
        ({"response_x": [0.0, 1.0]}, "not three curves"),
    ],
)
def test_a_truth_that_makes_no_sense_is_one_sentence(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance=False, **changes)
    with pytest.raises(InputError, match=words):
        Truth.open(folder)


@pytest.mark.parametrize(
    ("update", "words"),
    [
        ({"recorded": {}}, "no picture of bracket"),
        ({"recorded": {0: "recorded/a_0.png", 9: "recorded/a_0.png"}}, "recordings at brackets"),
        ({"K": [[1.0]]}, "a K that is no 3x3"),
    ],
)
def test_a_view_that_makes_no_sense_is_one_sentence(update: dict[str, Any], words: str, tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance=False)
    truth = io.read_json(folder / "truth.json")
    truth["views"][0] |= update
    io.write_json(folder / "truth.json", truth)
    with pytest.raises(InputError, match=words):
        Truth.open(folder)


def test_pictures_of_several_sizes_are_refused(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    folder = write_truth(tmp_path / "truth", run, radiance=True)
    io.write_png(folder / "recorded/a_0.png", np.zeros((H // 2, W // 2, 3)))
    with pytest.raises(InputError, match="several sizes"):
        evaluate_run(run, folder)


def test_run_measures_on_what_the_data_set_held_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, seen = fake_run(tmp_path / "run"), []

    def prepare(config: PrepareConfig) -> Path:
        place = config.out.with_name("scene_truth")
        io.write_json(place / "made_of.json", {"key": ""})
        write_truth(place, run, radiance=False)
        return config.out

    monkeypatch.setattr(run_all, "prepare", prepare)
    monkeypatch.setattr(run_all, "train", lambda settings: tmp_path)
    monkeypatch.setattr(run_all.Run, "open", staticmethod(lambda folder, device: run))
    monkeypatch.setattr(run_all, "render_all", lambda run, out: {})
    monkeypatch.setattr(run_all, "write_report", lambda *rest: tmp_path)
    monkeypatch.setattr(run_all, "evaluate_run", lambda run, truth: seen.append(truth))
    run_all.run_all(run_all.RunConfig(tmp_path, tmp_path / "out"))
    assert seen == [tmp_path / "out/scene_truth"]
