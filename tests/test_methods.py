"""Methods of a benchmark: budgets in words, presets with changed settings, and the
sentences that refuse the rest.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hdr_nsff.bench.config import BenchConfig
from hdr_nsff.bench.methods import minutes_of, parse_method
from hdr_nsff.core.errors import InputError
from hdr_nsff.training.presets import PRESETS

CONFIG = BenchConfig(Path("out"), "scene", "tiny")


@pytest.mark.parametrize(
    ("text", "minutes"),
    [("5min", 5), ("90s", 1.5), ("0.5h", 30), ("2 m", 2), (".5min", 0.5), ("30SEC", 0.5)],
)
def test_a_budget_in_words(text: str, minutes: float) -> None:
    assert minutes_of(text) == pytest.approx(minutes)


@pytest.mark.parametrize(
    "text", ["5", "min", "", "-5min", "5 days", "0s", "nan s", "1e9h", "5min3s"]
)
def test_a_text_that_is_no_budget_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"5min, 90s or 0\.5h"):
        minutes_of(text)


def test_options_change_the_settings_of_a_preset() -> None:
    name, mine = parse_method("mine=splat --loss.depth 0 --field.bases 3", CONFIG)
    assert name == "mine" and (mine.loss.depth, mine.field.bases) == (0.0, 3)
    assert mine.loss.flow == PRESETS["splat"].loss.flow


def test_without_a_budget_a_preset_keeps_its_own() -> None:
    for name in ("paper", "tiny"):
        assert parse_method(name, CONFIG)[1].budget == PRESETS[name].budget


def test_budget_and_seed_are_the_same_for_every_preset() -> None:
    config = replace(CONFIG, budget="90s", seed=5)
    methods = [parse_method(name, config)[1] for name in PRESETS]
    assert {(m.budget.minutes, m.budget.steps, m.seed) for m in methods} == {(1.5, None, 5)}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sparkle", "no preset 'sparkle'; there are splat"),
        ("", "no preset"),
        ("tiny --rays 3", "name of its own"),
        ("x=tiny --steps 3", "same for all"),
        ("x=tiny 'a", "correct the quotes"),
        ("x=tiny --rays -1", "--rays"),
        ("x=tiny --rays a", "--methods 'x=tiny --rays a': --rays a: not a whole number"),
        ("x=tiny --raiys 3", r"--raiys: no such option \(did you mean --rays\?\)"),
    ],
)
def test_texts_that_are_no_method_are_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_method(text, CONFIG)
