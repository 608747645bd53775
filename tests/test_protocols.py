"""Protocols split the clip as the published tables do, and held-out views stay unread.

`prepare` and `train` run next to a poisoned truth folder. test_imports.py checks that
they cannot import its reader.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_prepare import COUNT, footage, given

from hdr_nsff.core.checkpoints import latest_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_json
from hdr_nsff.footage.hold_out import frames_between
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import train

COSTS_AND_KEY = ("seconds", "cpu_seconds", "peak_memory_mb", "key")  # differ from run to run


def kept(count: int, cycle: int) -> list[int]:
    return sorted(set(range(count)) - set(frames_between(count, cycle)))


def test_every_second_frame_is_trained_on_and_so_is_the_last() -> None:
    assert kept(9, 3) == [0, 2, 4, 6, 8]
    assert kept(10, 3) == [0, 2, 4, 6, 8, 9]
    assert kept(5, 1) == [0, 2, 4]


@pytest.mark.parametrize("cycle", [1, 2, 3, 4, 5, 6])
def test_half_of_the_frames_show_all_exposures(cycle: int) -> None:
    frames = kept(36, cycle)
    assert {k % cycle for k in frames} == set(range(cycle))
    assert len(frames) in (18, 19)
    assert frames[0] == 0
    assert frames[-1] == 35
    assert max(np.diff(frames)) <= 3


def test_of_a_cycle_of_two_each_cycle_begins_with_the_other_half() -> None:
    assert kept(9, 2) == [0, 3, 4, 7, 8]


def test_novel_view_time_trains_on_every_second_frame_and_links_those(tmp_path: Path) -> None:
    config = PrepareConfig(
        footage(tmp_path / "clip"),
        tmp_path / "scene",
        protocol="novel-view-time",
        **given(tmp_path / "given"),
    )
    scene = Scene.open(prepare(config))
    assert scene.manifest.protocol == "novel-view-time"
    assert [f.time for f in scene.train] == [0, 2, 4, 6, 8, 10, 11]
    assert [f.time for f in scene.test] == [1, 3, 5, 7, 9]
    middle = scene.train[2]
    assert middle.neighbors == {-1: 1, 1: 3}
    assert (middle.flow[1] == -4 * np.array([1, 0])).all()  # two frames of -2 pixels
    assert all(f.disparity is None and not f.flow for f in scene.test)


def test_novel_view_trains_on_all_frames(tmp_path: Path) -> None:
    config = PrepareConfig(
        footage(tmp_path / "clip"),
        tmp_path / "scene",
        protocol="novel-view",
        **given(tmp_path / "given"),
    )
    scene = Scene.open(prepare(config))
    assert scene.manifest.protocol == "novel-view"
    assert len(scene.train) == COUNT
    assert not scene.test
    changed = Scene.open(prepare(replace(config, protocol=None, hold_out=4)))
    assert changed.manifest.protocol is None
    assert len(changed.test) == 3
    assert all(f.disparity is None for f in changed.test)


def test_protocols_that_cannot_be_followed_are_refused_in_a_sentence(tmp_path: Path) -> None:
    clip = footage(tmp_path / "clip", 4)
    config = PrepareConfig(clip, tmp_path / "scene", ev="-2,0,2", protocol="novel-view-time")
    with pytest.raises(InputError, match="both given"):
        prepare(replace(config, hold_out=2))
    with pytest.raises(InputError, match="show only 2 of 3 exposures"):  # frames 0, 2 and 3
        prepare(config)


# The truth stays out of training


OPENED: list[str] = []
WATCHED: list[str] = []


def watch(event: str, arguments: tuple[object, ...]) -> None:
    """Notes every file below a watched folder that Python opens, and every such folder
    that it lists.
    """
    if (
        WATCHED
        and event in ("open", "os.listdir", "os.scandir")
        and arguments
        and isinstance(arguments[0], str | bytes)
    ):
        name = arguments[0].decode() if isinstance(arguments[0], bytes) else arguments[0]
        OPENED.extend(name for folder in WATCHED if name.startswith(folder))


sys.addaudithook(watch)


def made(root: Path) -> Path:
    """Footage next to its truth, as `synth` writes them."""
    footage(root / "clip")
    wall = np.ones((32, 48, 3), np.float32)
    write_exr(root / "truth/radiance/a.exr", {"RGB": wall})
    write_png(root / "truth/masks/a.png", wall[..., 0] > 2)
    view = TruthView(
        name="a", time=2.5, bracket=0, anchor=2, radiance="radiance/a.exr", mask="masks/a.png"
    )
    truth = Truth(
        bracket_ev=[-2.0, 0.0, 2.0],
        reference_bracket=1,
        response_x=[0.0, 1.0],
        response_y=[[0.0, 1.0]] * 3,
        views=[view],
    )
    write_json(root / "truth/truth.json", truth.model_dump())
    return root


def poison(truth: Path) -> None:
    """No file of it can be read as what it was."""
    for file in truth.rglob("*.*"):
        file.write_bytes(b"\0poison")


def trained(root: Path, maps: dict[str, Path]) -> dict[str, np.ndarray | dict[str, object]]:
    """What `prepare` and `train` make of the clip in `root`: the scene without times,
    every file's bytes, every tensor.
    """
    scene = prepare(
        PrepareConfig(root / "clip", root / "scene", protocol="novel-view-time", **maps)
    )
    run = train(
        replace(
            PRESETS["tiny"],
            scene=scene,
            out=root / "run",
            budget=Budget(steps=6, minutes=None),
            device="cpu",
        )
    )
    manifest = Manifest.load(scene).model_dump(exclude={"source"})
    steps = {
        name: {k: v for k, v in step.items() if k not in COSTS_AND_KEY}
        for name, step in manifest["steps"].items()
    }
    found: dict[str, np.ndarray | dict[str, object]] = {"manifest": {**manifest, "steps": steps}}
    found |= {
        p.relative_to(scene).as_posix(): np.frombuffer(p.read_bytes(), np.uint8)
        for p in scene.rglob("*.*")
        if p.suffix in (".npy", ".png")
    }
    checkpoint = latest_checkpoint(run)
    assert checkpoint is not None
    assert checkpoint.step == 6
    return found | {f"tensor {k}": v.numpy() for k, v in checkpoint.tensors.items()}


def test_a_poisoned_truth_changes_nothing_and_is_not_even_opened(tmp_path: Path) -> None:
    maps = given(tmp_path / "given")
    one = trained(made(tmp_path / "one"), maps)
    other_root = made(tmp_path / "other")
    poison(other_root / "truth")
    with pytest.raises(InputError):
        Truth.open(other_root / "truth")
    WATCHED.append(str(other_root / "truth"))
    try:
        other = trained(other_root, maps)
        assert OPENED == []
        with pytest.raises(InputError):
            Truth.open(other_root / "truth")
        assert len(OPENED) == 1
        assert OPENED[0].endswith("truth.json")  # the watch does see it
    finally:
        WATCHED.clear()
        OPENED.clear()
    assert one.keys() == other.keys()
    assert len(one) > 50
    assert one.pop("manifest") == other.pop("manifest")
    assert all(np.array_equal(one[k], other[k]) for k in one)
