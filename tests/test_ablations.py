"""Ablations of ours: each changes one thing, and what it says it does."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from presets import random_field, small, trainer

from hdr_nsff.config import ABLATIONS, METHODS, PRESETS, ablated
from hdr_nsff.scene import Scene
from hdr_nsff.train import heeded

NAMES = [name for name in PRESETS if name not in METHODS]


@pytest.mark.parametrize("name", NAMES)
def test_an_ablation_differs_from_its_preset_in_one_part(name: str) -> None:
    base, changed = (asdict(PRESETS[n]) for n in (name.partition("-")[0], name))
    parts = {k for k in base if base[k] != changed[k]}
    assert parts == {
        "no-flow": {"loss"}, "no-depth": {"loss", "paint"}, "no-saturation": {"saturation"}, "sigmoid": {"field"},
    }.get(name.partition("-")[2], {"tonemap"})  # fmt: skip


def test_every_ablation_that_makes_sense_is_a_preset() -> None:
    assert {n.removeprefix("grid-") for n in NAMES if n.startswith("grid-")} == set(ABLATIONS)
    assert set(ABLATIONS) - {n.removeprefix("splat-") for n in NAMES if n.startswith("splat-")} == {"no-saturation", "sigmoid"}


def test_without_flow_nothing_is_started_from_it(toy: Scene) -> None:
    assert heeded(toy, PRESETS["grid"].loss) is toy
    blind = heeded(toy, PRESETS["splat-no-flow"].loss)
    assert all(f.flow == {} and f.flow_valid == {} for f in blind.train) and toy.train[0].flow


def test_without_depth_the_prior_neither_paints_nor_pulls() -> None:
    config = ablated(PRESETS["grid"], "no-depth")
    assert not config.paint and config.loss.depth == 0 and config.loss.flow == PRESETS["grid"].loss.flow


def test_a_sigmoid_keeps_radiance_below_one_and_starts_where_it_is_painted(toy: Scene) -> None:
    bounded, free = random_field("grid-sigmoid", toy), random_field("grid", toy)
    raw = torch.linspace(-30, 30, 61)
    assert float(bounded.to_radiance(raw).max()) <= 1 < float(free.to_radiance(raw).max())
    radiance = torch.tensor([0.02, 0.5, 0.9])
    for field in (bounded, free):
        field.bias.fill_(-1.3)
        torch.testing.assert_close(field.to_radiance(field.from_radiance(radiance)), radiance)
    assert float(bounded.to_radiance(bounded.from_radiance(torch.tensor(40.0)))) < 1


@pytest.mark.parametrize("name", ["splat-response-mlp", "grid-response-none", "grid-response-per-image", "splat-no-depth"])
def test_ablations_train(name: str, toy: Scene, toy_folder: Path, tmp_path: Path) -> None:
    t = trainer(small(name, toy_folder, tmp_path / "run"), toy)
    for _ in range(2):
        assert all(v == v for v in t.step().values())
        t.clock = replace(t.clock, step=t.clock.step + 1)
