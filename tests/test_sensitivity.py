"""The sensitivity benchmark scales one constant at a time, and sees what changes."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

from hdr_nsff.prepare.steps.refined_flow import RefinedFlowTuning
from hdr_nsff.priors.masks.geometric_tuning import GeometricMaskTuning

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def sensitivity(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("sensitivity")


def test_every_constant_is_a_number_of_its_step(sensitivity: ModuleType) -> None:
    names = [constant.name for constant in sensitivity.CONSTANTS]
    assert len(set(names)) == len(names)
    for constant in sensitivity.CONSTANTS:
        tuning = sensitivity.STEPS[constant.step].tuning
        changed, value = sensitivity.scaled(tuning, constant.path.split("."), 2.0)
        assert changed != tuning and value > 0, constant.name


def test_only_the_scaled_constant_changes(sensitivity: ModuleType) -> None:
    tuning = RefinedFlowTuning()
    changed, value = sensitivity.scaled(tuning, ["least_squares", "window_px"], 0.5)
    assert value == changed.least_squares.window_px == tuning.least_squares.window_px / 2
    assert changed.least_squares.blur_px == tuning.least_squares.blur_px
    assert changed.local_motion == tuning.local_motion


def test_whole_numbers_stay_whole_and_positive(sensitivity: ModuleType) -> None:
    changed, value = sensitivity.scaled(GeometricMaskTuning(votes=1), ["votes"], 0.5)
    assert value == 1 and changed.votes == 1


def test_an_error_differs_beyond_one_percent_of_the_range_of_the_default(
    sensitivity: ModuleType,
) -> None:
    assert not sensitivity.differs(2.01, 2.0, 2.0)
    assert sensitivity.differs(2.03, 2.0, 2.0)
    assert not sensitivity.differs(2.5, 2.0, 3.0)
    assert not sensitivity.differs(0.9, 0.0, 0.0), "1 % of the pixels, where the default is 0"


def test_a_failed_step_differs_from_one_that_works(sensitivity: ModuleType) -> None:
    assert sensitivity.differs(None, 2.0, 2.0)
    assert sensitivity.differs(2.0, None, None)
    assert not sensitivity.differs(None, None, None)


def test_equal_runs_are_summarized_by_median_and_range(sensitivity: ModuleType) -> None:
    runs = [{"pose": 3.0}, {"pose": 1.0}, {"pose": 2.0}]
    assert sensitivity.summary(runs) == {"errors": {"pose": 2.0}, "range": {"pose": [1.0, 3.0]}}
