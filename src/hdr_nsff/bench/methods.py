"""Methods of a benchmark: presets of `train` with changed settings and one budget."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from functools import partial

import tyro

from hdr_nsff.bench.config import BenchConfig, safe_name
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.refusals import Command, refusals_as_sentences
from hdr_nsff.core.settings import check
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import HELP, TrainConfig, check_config
from hdr_nsff.training.presets import PRESETS

SAME_FOR_ALL = ("scene", "out", "steps", "minutes", "seed", "device")  # settings of `train`
MINUTES_OF_UNIT = {"s": 1 / 60, "sec": 1 / 60, "m": 1.0, "min": 1.0, "h": 60.0}
MAX_MINUTES = 1e6  # two years


def parse_method(text: str, config: BenchConfig) -> tuple[str, TrainConfig]:
    """Name and settings of "PRESET" or "NAME=PRESET OPTIONS"."""
    found = re.fullmatch(r"\s*(?:([^\s=]+)=)?(.*)", text, re.DOTALL)
    assert found is not None
    name, rest = found.groups()
    words = split_words(text, rest)
    check_words(text, name, words)
    settings = settings_of(text, words)
    settings = replace(check_config(settings), seed=config.seed, device=config.device)
    if config.budget is not None:
        settings = replace(settings, budget=Budget(minutes=minutes_of(config.budget)))
    if config.steps is not None:
        settings = replace(settings, budget=Budget(steps=config.steps, minutes=None))
    check(settings, HELP)
    return safe_name(name or words[0], "--methods"), settings


def settings_of(text: str, words: list[str]) -> TrainConfig:
    """The settings of a preset with options, in words as `train` takes them."""
    presets = {preset: ("", settings) for preset, settings in PRESETS.items()}
    read = partial(tyro.extras.overridable_config_cli, presets, prog="hdr-nsff train")
    print_help = partial(read, args=[words[0], "--help"])
    try:
        with refusals_as_sentences(Command(f"hdr-nsff train {words[0]}", words, print_help)):
            return read(args=words)
    except InputError as error:
        raise InputError(f"--methods {text!r:.60}: {error}") from error


def split_words(text: str, rest: str) -> list[str]:
    """The words of a preset with options, as a shell splits them."""
    try:
        return shlex.split(rest)
    except ValueError as error:
        raise InputError(f"--methods {text!r:.60}: {error}; correct the quotes") from error


def check_words(text: str, name: str | None, words: list[str]) -> None:
    """InputError where the words name no preset, or change a setting of all runs."""
    if not words or words[0] not in PRESETS:
        asked = " ".join(words[:1])
        raise InputError(f"--methods: no preset {asked!r:.60}; there are {', '.join(PRESETS)}")
    if len(words) > 1 and name is None:
        advice = f"needs a name of its own, NAME={text.strip()[:60]}"
        raise InputError(f"--methods {text!r:.60}: a method with options {advice}")
    given = {word.split("=")[0] for word in words}
    for option in SAME_FOR_ALL:
        if f"--{option}" in given:
            problem = f"--{option} is the same for all runs of a benchmark"
            raise InputError(f"--methods {text!r:.60}: {problem}; leave it out there")


def minutes_of(budget: str) -> float:
    """Minutes of "5min", "90s" or "0.5h"."""
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*([a-z]+)", budget.strip().lower())
    if found is not None and found[2] in MINUTES_OF_UNIT:
        minutes = float(found[1]) * MINUTES_OF_UNIT[found[2]]
        if 0 < minutes <= MAX_MINUTES:
            return minutes
    raise InputError(f"--budget {budget!r:.40}: write a time such as 5min, 90s or 0.5h")
