"""Invalid truth folders are refused in one sentence, before anything is written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bad_input import Capture, call, cut, edit, refused, snapshot, truth

from hdr_nsff.core.exr import write_exr


def view(key: str, value: object) -> Callable[[dict], object]:
    return lambda d: d["views"][0].update({key: value})


TRUTHS: dict[str, tuple[Callable[[dict], object], str]] = {
    "a name that leads elsewhere": (view("name", "../../elsewhere"), "name"),
    "no name": (view("name", ""), "name"),
    "two views of one name": (view("name", "00003"), "same name"),
    "a bracket that is none": (view("bracket", 3), "bracket 3"),
    "a frame that is none": (view("anchor", 99), "frame 99"),
    "a ragged pose": (view("c2w", [[1.0], [2.0, 3.0]]), "c2w"),
    "a pose with NaN": (view("c2w", [[float("nan")] * 4] * 3), "c2w"),
    "a picture elsewhere": (view("radiance", "/etc/passwd"), "outside"),
    "a picture that is gone": (view("radiance", "none.exr"), "none.exr"),
    "true poses of no shape": (lambda d: d.update(clip_c2w=[[[1.0]]] * 6), "clip_c2w"),
    "a reference that is none": (lambda d: d.update(reference_bracket=7), "reference_bracket 7"),
    "an exposure with NaN": (lambda d: d.update(bracket_ev=[2.0, 0.0, float("nan")]), "bracket_ev"),
    "an exposure beyond all light": (lambda d: d.update(bracket_ev=[2.0, 0.0, 1e9]), "bracket_ev"),
    "no response": (lambda d: d.update(response_x=[]), "response_x"),
    "two channels": (lambda d: d.update(response_y=d["response_y"][:2]), "response_y"),
    "a response that falls": (lambda d: d.update(response_x=d["response_x"][::-1]), "response_x"),
    "a response beyond what is recorded": (
        lambda d: d["response_y"][1].__setitem__(-1, 1e308),
        "response_y leaves [0, 1]",
    ),
    "a white balance beyond all light": (
        lambda d: d.update(white_balance=[1.0, 1e308, 1.0]),
        "white_balance",
    ),
    "a white balance of nothing": (lambda d: d.update(white_balance=[0.0] * 3), "white_balance"),
    "no focal length": (lambda d: d.update(K=[[0.0] * 3] * 3), "K is no"),
    "no views": (lambda d: d.update(views=[]), "lists none"),
}


@pytest.mark.parametrize("what", TRUTHS)
def test_truth_edited_into_nonsense_is_named(
    what: str, run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    change, expected = TRUTHS[what]
    path = truth(tmp_path / "truth") / "truth.json"
    edit(path, change)
    before = snapshot(tmp_path)
    assert expected in refused(
        capsys, "evaluate", run_folder, "--truth", path.parent, "--device", "cpu"
    )
    assert snapshot(tmp_path) == before


def test_truth_of_impossible_radiance_is_named(
    run_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder = truth(tmp_path / "truth")
    command = ["evaluate", run_folder, "--truth", folder, "--device", "cpu"]
    for value, word in ((-1.0, "negative"), (0.0, "every view is 0")):
        for t in (1, 3):
            write_exr(
                folder / f"radiance/{t}.exr", {"RGB": np.full((34, 60, 3), value, np.float32)}
            )
        assert word in refused(capsys, *command)
    cut(folder / "radiance/1.exr")
    assert "radiance/1.exr" in refused(capsys, *command)
    truth(folder)
    assert call(*command) == 0
