"""A scene that `prepare` was stopped in the middle of is not taken for a whole one."""

from __future__ import annotations

from dataclasses import replace

import pytest
from test_prepare import attempts, config  # noqa: F401

from hdr_nsff.core.errors import InputError
from hdr_nsff.prepare import prepare as prepare_module
from hdr_nsff.prepare.prepare import STEPS, prepare
from hdr_nsff.prepare.work import PrepareConfig, StepName, Work
from hdr_nsff.scene.scene import Scene


def stop_at(step: StepName, settings: PrepareConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """`prepare`, until a step has begun."""

    def stopped(work: Work) -> None:
        raise KeyboardInterrupt

    steps = {**STEPS, step: replace(STEPS[step], run=stopped)}
    with monkeypatch.context() as patch:
        patch.setattr(prepare_module, "STEPS", steps)
        with pytest.raises(KeyboardInterrupt):
            prepare(settings)


@pytest.mark.parametrize("step", ["movers", "depth"])
def test_a_scene_without_depth_yet_is_refused(
    step: StepName,
    config: PrepareConfig,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop_at(step, config, monkeypatch)
    with pytest.raises(InputError, match=f"has not finished the step {step} of this scene"):
        Scene.open(config.out)
    prepare(config)
    assert Scene.open(config.out).train[0].disparity is not None


@pytest.mark.parametrize("step", ["masks", "response", "depth"])
def test_a_scene_that_is_redone_is_refused_until_all_that_builds_on_it_is(
    step: StepName,
    config: PrepareConfig,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prepare(config)
    stop_at(step, replace(config, redo=("poses",)), monkeypatch)
    with pytest.raises(InputError, match=f"has not finished the step {step} of this scene"):
        Scene.open(config.out)
    prepare(config)
    Scene.open(config.out)
    done = attempts(config.out)
    assert (done["flow"], done["poses"], done["depth"]) == (1, 2, 2)


def test_the_contact_sheet_is_not_needed_for_training(
    config: PrepareConfig,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop_at("sheet", config, monkeypatch)
    Scene.open(config.out)
