"""A refused option costs a finished scene nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_prepare import config, stamps  # noqa: F401

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_npy
from hdr_nsff.prepare.engine import ASIDE
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.prepare.work import PrepareConfig


def too_few_poses(root: Path) -> Path:
    write_npy(root / "too_few.npy", np.zeros((3, 17)))
    return root / "too_few.npy"


def small_flow(root: Path) -> Path:
    for first, second in ((0, 1), (1, 0)):
        write_npy(root / f"small/{first:05d}_{second:05d}.npy", np.zeros((4, 4, 2), np.float32))
    return root / "small"


@pytest.mark.parametrize("option", ["start", "ev", "poses", "flow"])
def test_a_finished_scene_stays_as_it_was(
    option: str,
    config: PrepareConfig,  # noqa: F811
    tmp_path: Path,
) -> None:
    wrong = {
        "start": 50,
        "ev": "0,-2,-4,-6,-8,-10,-12,-14,-16,-18,-20,-22,-24",
        "poses": too_few_poses(tmp_path),
        "flow": small_flow(tmp_path),
    }[option]
    prepare(config)
    before = stamps(config.out)
    manifest = (config.out / "scene.json").read_bytes()
    with pytest.raises(InputError):
        prepare(replace(config, **{option: wrong}))
    assert (config.out / "scene.json").read_bytes() == manifest
    del before["scene.json"]
    after = stamps(config.out)
    del after["scene.json"]
    assert after == before and not (config.out / ASIDE).exists()
    prepare(config)  # nothing to do
    assert stamps(config.out).items() >= before.items()


def test_what_a_killed_step_has_set_aside_is_removed_by_the_next(
    config: PrepareConfig,  # noqa: F811
) -> None:
    prepare(config)
    (config.out / ASIDE / "raw_flow").mkdir(parents=True)
    prepare(replace(config, redo=("flow",)))
    assert not (config.out / ASIDE).exists()
