"""Commands that cannot work, for the tests of bad input: exit code 2, one sentence that
names the place, never a traceback, and nothing that was there is lost.
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
from hdr_nsff.core import io

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
    """The one sentence with which the command line refuses."""
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
    return [
        v
        for v, it in cli.VERBS.items()
        if is_dataclass(it.config) and setting in {f.name for f in fields(it.config)}
    ]


FOOTAGE_VERBS = verbs_with("clip")  # that read footage
RUN_VERBS = verbs_with("run")  # that read a run
WORKING_VERBS = [v for v in cli.VERBS if v != "weights"]  # that write something


def commands(run: Path, footage: Path, out: Path) -> dict[str, list[object]]:
    """Every working verb on `run` (with its scene beside it) or `footage`; all but
    `evaluate` write to `out`. `finetune-flow` wants the fixture `flow_data` beside the
    run.
    """
    flow = [
        "--data",
        run.parent / "pairs",
        "--weights",
        run.parent / "flow.pkl",
        "--size",
        "128x128",
        "--steps",
        3,
        "--batch",
        1,
    ]
    return {
        "run": ["run", footage, out],
        "prepare": ["prepare", footage, out],
        "train": training(run.parent / "scene", out, 1),
        "render": [
            "render",
            run,
            "--path",
            "fixed",
            "--scale",
            0.3,
            "--out",
            out,
            "--device",
            "cpu",
        ],
        "export": ["export", run, out, "--ply-sequence", "--device", "cpu"],
        "evaluate": ["evaluate", run, "--device", "cpu"],
        "report": ["report", run, "--out", out / "report.html"],
        "reexpose": ["reexpose", footage, out],
        "synth": ["synth", "interior", out],
        "finetune-flow": [
            "finetune-flow",
            out,
            *flow,
            "--measure",
            1,
            "--checkpoint-steps",
            1,
            "--device",
            "cpu",
        ],
        "bench": [
            "bench",
            out,
            "--scenes",
            run.parent / "scene",
            "--methods",
            "tiny",
            "--steps",
            1,
            "--device",
            "cpu",
        ],
    }


def reading(run: Path, out: Path) -> list[list[object]]:
    """The commands that read a run."""
    return [commands(run, out, out)[verb] for verb in RUN_VERBS]


def training(scene: Path, out: Path, steps: int) -> list[object]:
    """The command that trains a small field."""
    few = ["--field.static", 300, "--field.moving", 100, "--field.bases", 2]
    return [
        "train",
        "splat",
        "--scene",
        scene,
        "--out",
        out,
        "--steps",
        steps,
        "--device",
        "cpu",
        *few,
    ]


def snapshot(folder: Path) -> dict[Path, bytes]:
    """All files below `folder` with their contents."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def recorded(count: int = FRAMES) -> list[np.ndarray]:
    """The toy scene in three exposures."""
    scene = ToyScene(frames=count)
    return [
        np.clip(scene.see(t)[0] * 2.0 ** (-1.5 * (t % 3)), 0, 1) ** (1 / 2.2) for t in range(count)
    ]


def clip(folder: Path, pictures: list[np.ndarray] | None = None) -> Path:
    """A folder of PNG frames."""
    for t, picture in enumerate(recorded() if pictures is None else pictures):
        io.write_png(folder / f"{t:03d}.png", picture)
    return folder


def poses(path: Path, count: int = FRAMES) -> Path:
    """The cameras of the toy scene as LLFF writes them."""
    s, rows = ToyScene(), []
    for t in range(count):
        x, y, z = camera_center(t)
        # columns: down, right, back
        pose = np.array([[0, 1, 0, x, s.height], [1, 0, 0, y, s.width], [0, 0, -1, z, s.f]])
        rows.append([*pose.ravel(), 1.8, 5.0])
    io.write_npy(path, np.array(rows))
    return path


def truth(folder: Path) -> Path:
    """Truth of two frames of the toy scene."""
    scene, x = ToyScene(), (np.linspace(0, 1, 64) ** 2.2).tolist()
    views = []
    for t in (1, 3):
        io.write_exr(folder / f"radiance/{t}.exr", {"RGB": scene.see(t)[0].astype(np.float32)})
        views.append(
            {
                "name": f"{t:05d}",
                "time": t,
                "bracket": 1,
                "anchor": t,
                "radiance": f"radiance/{t}.exr",
            }
        )
    truth = {
        "bracket_ev": [2.0, 0.0, -2.0],
        "reference_bracket": 1,
        "response_x": x,
        "response_y": [x] * 3,
        "views": views,
    }
    centers = [np.c_[np.eye(3), camera_center(t)].tolist() for t in range(6)]
    io.write_json(folder / "truth.json", {**truth, "K": scene.K.tolist(), "clip_c2w": centers})
    return folder


def cut(path: Path) -> None:
    """Leave the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edit(path: Path, change: Callable[[dict], object]) -> None:
    """Change a JSON file as a hand would."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
