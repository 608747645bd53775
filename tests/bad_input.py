"""Commands that have to fail well, for the tests of bad input.

Exit code 2, one sentence that names the place, no traceback, and no file is lost.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from toy_scene import ToyScene, camera_center

from hdr_nsff import cli
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_json, write_npy

Capture = pytest.CaptureFixture[str]
FRAMES = 9


def call(*arguments: object) -> int:
    """Exit code of the command line."""
    try:
        cli.main([str(a) for a in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def refused(capsys: Capture, *arguments: object) -> str:
    """The sentence with which the command line refuses."""
    capsys.readouterr()
    assert call(*arguments) == 2, arguments
    error = capsys.readouterr().err
    sentences = [line for line in error.splitlines() if line.startswith("hdr-nsff: ")]
    assert "Traceback" not in error, error
    assert len(sentences) == 1, error
    assert error.strip().endswith(sentences[0]), error
    assert len(sentences[0]) < 600, error
    return sentences[0]


def verbs_with(setting: str) -> list[str]:
    """The verbs that have a setting of this name."""
    verbs = []
    for name, verb in cli.VERBS.items():
        config = cli.load(verb.config) if verb.config is not None else None
        if is_dataclass(config) and setting in {f.name for f in fields(config)}:
            verbs.append(name)
    return verbs


# Verbs that write something.
WORKING_VERBS = [v for v in cli.VERBS if v not in ("weights", "doctor", "view")]
FOOTAGE_VERBS = verbs_with("clip")  # that read footage
RUN_VERBS = [v for v in verbs_with("run") if v in WORKING_VERBS]  # that read a run
CPU = ["--device", "cpu"]


def commands(run: Path, footage: Path, out: Path) -> dict[str, list[object]]:
    """Every working verb on `run`, whose scene lies next to it, or on `footage`.

    All but `evaluate` write to `out`. `finetune-flow` needs the fixture `flow_data`.
    """
    scene = run.parent / "scene"
    small = ["--path", "fixed", "--scale", 0.3]
    flow = ["--data", run.parent / "pairs", "--weights", run.parent / "flow.pkl"]
    short = ["--size", "128x128", "--steps", 3, "--batch", 1]
    often = ["--measure", 1, "--checkpoint-steps", 1]
    tiny = ["--methods", "tiny", "--steps", 1]
    return {
        "run": ["run", footage, out],
        "check": on_footage("check", footage, out),
        "prepare": ["prepare", footage, out],
        "train": training(scene, out, 1),
        "render": ["render", run, *small, "--out", out, *CPU],
        "export": ["export", run, out, "--ply-sequence", *CPU],
        "evaluate": ["evaluate", run, *CPU],
        "report": ["report", run, "--out", out / "report.html"],
        "reexpose": ["reexpose", footage, out],
        "synth": ["synth", "interior", out],
        "finetune-flow": ["finetune-flow", out, *flow, *short, *often, *CPU],
        "bench": ["bench", out, "--scenes", scene, *tiny, *CPU],
    }


def on_footage(verb: str, footage: Path, out: Path) -> list[object]:
    """The command of a verb that reads footage."""
    if verb == "check":
        return ["check", footage, "--picture", out / "check.png"]
    return [verb, footage, out]


def reading(run: Path, out: Path) -> list[list[object]]:
    """The commands that read a run."""
    return [commands(run, out, out)[verb] for verb in RUN_VERBS]


def training(scene: Path, out: Path, steps: int) -> list[object]:
    """The command that trains a small field."""
    few = ["--field.static", 300, "--field.moving", 100, "--field.bases", 2]
    return ["train", "splat", "--scene", scene, "--out", out, "--steps", steps, *CPU, *few]


def snapshot(folder: Path) -> dict[Path, bytes]:
    """All files below `folder` with their contents."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def recorded(count: int = FRAMES) -> list[np.ndarray]:
    """The toy scene in three exposures."""
    scene = ToyScene(frames=count)
    pictures = []
    for t in range(count):
        radiance, _, _ = scene.see(t)
        exposure = radiance * 2.0 ** (-1.5 * (t % 3))
        pictures.append(np.clip(exposure, 0, 1) ** (1 / 2.2))
    return pictures


def clip(folder: Path, pictures: list[np.ndarray] | None = None) -> Path:
    """A folder of PNG frames."""
    for t, picture in enumerate(recorded() if pictures is None else pictures):
        write_png(folder / f"{t:03d}.png", picture)
    return folder


def poses(path: Path, count: int = FRAMES) -> Path:
    """The cameras of the toy scene as LLFF writes them."""
    scene, rows = ToyScene(), []
    for t in range(count):
        x, y, z = camera_center(t)
        # Columns: down, right, back, center, (height, width, focal length).
        matrix = [[0, 1, 0, x, scene.height], [1, 0, 0, y, scene.width], [0, 0, -1, z, scene.f]]
        rows.append([*np.ravel(matrix), 1.8, 5.0])
    write_npy(path, np.array(rows))
    return path


def truth(folder: Path) -> Path:
    """Truth of two frames of the toy scene."""
    scene = ToyScene()
    x = (np.linspace(0, 1, 64) ** 2.2).tolist()
    views = []
    for t in (1, 3):
        name = f"radiance/{t}.exr"
        write_exr(folder / name, {"RGB": scene.see(t)[0].astype(np.float32)})
        view = {"name": f"{t:05d}", "time": t, "bracket": 1, "anchor": t, "radiance": name}
        views.append(view)
    document = {
        "bracket_ev": [2.0, 0.0, -2.0],
        "reference_bracket": 1,
        "response_x": x,
        "response_y": [x] * 3,
        "views": views,
        "K": scene.K.tolist(),
        "clip_c2w": [np.c_[np.eye(3), camera_center(t)].tolist() for t in range(6)],
    }
    write_json(folder / "truth.json", document)
    return folder


def cut(path: Path) -> None:
    """Leave the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edit(path: Path, change: Callable[[dict], object]) -> None:
    """Change the content of a JSON file."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def prepared(capsys: Capture, clip: Path, *options: object) -> str:
    """The sentence with which `prepare` refuses to write `scene` next to the footage.

    No other file may change.
    """

    def rest() -> dict[Path, bytes]:
        files = snapshot(clip.parent)
        return {p: b for p, b in files.items() if not p.is_relative_to(clip.parent / "scene")}

    before = rest()
    sentence = refused(capsys, "prepare", clip, clip.parent / "scene", *options)
    assert rest() == before
    return sentence
