"""Fixtures that several test files share."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from synth_scene import Flat
from toy_scene import ToyScene

from hdr_nsff.core.process import prepare_process
from hdr_nsff.priors.flow import networks as flow_networks
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.scene.scene import Scene
from hdr_nsff.synth.pathtracer import Tracer
from hdr_nsff.synth.scenes.interior import INTERIOR
from hdr_nsff.synth.settings import SynthConfig

if TYPE_CHECKING:
    from browser import Page

prepare_process()  # as the command line does, before a test imports numba
if os.environ.get("NUMBA_ENABLE_CUDASIM") == "1":
    from simulated_threads import take_turns

    take_turns()


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed-form scene folder (read only)."""
    return ToyScene().write(tmp_path_factory.mktemp("toy") / "scene")


@pytest.fixture(scope="session")
def toy(toy_folder: Path) -> Scene:
    """The closed-form scene in memory."""
    return Scene.open(toy_folder)


@pytest.fixture(scope="session")
def trained(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps next to a copy of its scene (read only)."""
    from bad_input import call, training

    out = tmp_path_factory.mktemp("a run, é 日")
    shutil.copytree(toy_folder, out / "scene")
    assert call(*training(out / "scene", out / "run", 2)) == 0
    return out / "run"


@pytest.fixture
def run_folder(trained: Path, tmp_path: Path) -> Path:
    """A copy of that run and its scene, which a test may damage."""
    shutil.copytree(trained.parent, tmp_path / "ü b")
    config = json.loads((tmp_path / "ü b/run/config.json").read_text())
    (tmp_path / "ü b/run/config.json").write_text(
        json.dumps({**config, "scene": str(tmp_path / "ü b/scene")})
    )
    return tmp_path / "ü b/run"


@pytest.fixture
def flow_data(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The input of `finetune-flow`, next to the run: five pairs and a tiny network."""
    from test_flow_sets import synth

    monkeypatch.setattr(flow_networks, "GMFlow", lambda bf16: GMFlow(8, 1))
    torch.save(GMFlow(8, 1).state_dict(), run_folder.parent / "flow.pkl")
    synth(run_folder.parent / "pairs", frames=6, size=(48, 64))


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> SynthConfig:
    """Settings of a small `synth` that renders an even wall instead of its scene."""
    monkeypatch.setattr("hdr_nsff.synth.synth.Tracer", Flat)
    Flat.rendered = 0
    return SynthConfig("interior", tmp_path / "room", size="16x16", frames=12, noise=0, oracle=True)


@pytest.fixture(scope="session")
def tracer() -> Tracer:
    """The synthetic room, for the slow variant of Mitsuba that needs no LLVM."""
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")
    return Tracer(INTERIOR, 0, "scalar_rgb")


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator["Page"]:
    """A tab of headless Chromium."""
    from browser import browser

    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def viewer(tab: "Page", toy: Scene, tmp_path: Path) -> Iterator["Page"]:
    """The tab with the toy scene's page, newly loaded; the console must stay empty."""
    from viewer_scenes import scene_file
    from viewer_tab import open_page

    open_page(tab, tmp_path / "scene.html", scene_file(toy))
    yield tab
    assert tab.problems() == []
