"""Every preset trains, renders and evaluates on another device than the CPU: a pretend
one that refuses to mix devices (`pretend_device.py`). It computes what the CPU does.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from presets import interrupted_at, random_field, small
from pretend_device import PretendTensor, counted, pretend_device
from torch import nn

from hdr_nsff.core import distributed
from hdr_nsff.core.checkpoints import latest_checkpoint
from hdr_nsff.core.tensors import to_device
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.fields.nsff.encodings import TouchedAdam
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.rasterize import Maps
from hdr_nsff.priors.flow.networks import build
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shot_views import plan_shot
from hdr_nsff.rendering.shots import render_shot
from hdr_nsff.scene.batch import Recorder
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training import run_folder
from hdr_nsff.training.presets import METHODS
from hdr_nsff.training.run_folder import Run, open_folder
from hdr_nsff.training.train import Trainer, train

STEPS = 5
EACH_FIELD = ["splat", "grid", "paper", "nerf-wt", "hdr-hexplane"]
# ablations whose tone mapper, or field without a static branch, no method has
OTHER_PARTS = ["splat-response-fixed", "grid-response-mlp", "paper-small-no-split"]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    with pretend_device() as found:
        monkeypatch.setattr("hdr_nsff.fields.build.pick_device", lambda name: found)
        yield found


def test_the_pretend_device_refuses_tensors_of_the_cpu(device: torch.device) -> None:
    there = torch.rand(3, device=device)
    for mixed in (
        lambda: there + torch.rand(3),
        lambda: torch.cat([there, torch.rand(3)]),
        lambda: nn.Linear(3, 2)(there),
        lambda: torch.rand(3)[there > 0.5],
    ):
        with pytest.raises(RuntimeError, match=r"tensors on the CPU and on pretend meet"):
            mixed()
    with pytest.raises(RuntimeError, match="numpy"):
        there.numpy()
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(3, device=device, generator=torch.Generator())


def test_the_pretend_device_computes_gradients(device: torch.device) -> None:
    there = torch.tensor([1.0, 2.0], device=device, requires_grad=True)
    (there[[1, 0]] * torch.tensor(3.0)).square().sum().backward()
    assert isinstance(there.grad, PretendTensor) and there.grad.tolist() == [18.0, 36.0]


@pytest.mark.parametrize("preset", [*METHODS, *OTHER_PARTS])
def test_a_preset_trains_renders_and_evaluates(
    preset: str, toy_folder: Path, tmp_path: Path, device: torch.device
) -> None:
    config = small(preset, toy_folder, tmp_path / "run", STEPS)
    train(replace(config, bf16=False), previews=False)  # it has no autocast
    run = Run.open(tmp_path / "run")
    moved = [*run.field.parameters(), *run.tonemapper.parameters()]
    assert run.step == STEPS and all(isinstance(p, PretendTensor) for p in moved)
    at_time, between = plan_shot(run, "slowmo", factor=2).views[:2]
    views = [replace(at_time, ev=-1.0).resized(0.5), between.resized(0.5)]
    render_shot(run, Shot("some", views, 12), tmp_path, Output(video=False))
    metrics = evaluate_run(run, None)
    assert metrics["headline"]["psnr"] > 0


@pytest.mark.parametrize("preset", ["splat", "grid"])
def test_optimizers_clear_the_marks_that_the_field_makes(
    preset: str, toy: Scene, toy_folder: Path, tmp_path: Path, device: torch.device
) -> None:
    config = small(preset, toy_folder, tmp_path / "run")
    open_folder(config)
    trainer = Trainer(config, toy, device, distributed.Ranks())
    made = {id(b) for name, b in trainer.field.named_buffers() if name.endswith("touched")}
    touched = trainer.optimizers.by_name["touched"]
    assert isinstance(touched, TouchedAdam) and made
    for held in (trainer.optimizers.row_marks, list(touched.marks.values())):
        assert {id(marks) for marks in held} == made
        assert all(isinstance(marks, PretendTensor) for marks in held)


@pytest.mark.parametrize("preset", ["splat", "grid"])
def test_a_stopped_run_resumes_on_the_device(
    preset: str,
    toy_folder: Path,
    tmp_path: Path,
    device: torch.device,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(run_folder, "write_preview", lambda *_: None)
    settings = small(preset, toy_folder, tmp_path / "run", STEPS)
    settings = replace(settings, checkpoint_seconds=0.0)
    interrupted_at(3, settings, monkeypatch)
    straight = replace(settings, out=tmp_path / "straight")
    learned = [latest_checkpoint(train(each)) for each in (settings, straight)]
    resumed, expected = (found.tensors for found in learned if found)
    assert resumed.keys() == expected.keys()
    for name, tensor in resumed.items():
        torch.testing.assert_close(tensor, expected[name], rtol=0, atol=0, msg=name)


@pytest.mark.parametrize("preset", ["splat", "grid"])
def test_poses_are_corrected_on_the_device(
    preset: str, toy_folder: Path, tmp_path: Path, device: torch.device
) -> None:
    train(replace(small(preset, toy_folder, tmp_path / "run", STEPS), refine_poses=True))
    assert Run.open(tmp_path / "run").step == STEPS


@pytest.mark.parametrize("preset", EACH_FIELD)
def test_a_step_has_the_losses_of_the_cpu(
    preset: str, toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    config = small(preset, toy_folder)

    def first_step(out: Path, where: torch.device) -> dict[str, float]:
        of_folder = replace(config, out=out)
        open_folder(of_folder)
        trainer = Trainer(of_folder, toy, where, distributed.Ranks())
        trainer.monitor.read_every = 1
        return trainer.step()

    expected = first_step(tmp_path / "cpu", torch.device("cpu"))
    with pretend_device() as device:
        found = first_step(tmp_path / "pretend", device)
    assert found == pytest.approx(expected, rel=2e-3, abs=1e-5)


def test_autocast_may_make_other_types_of_raw_numbers(
    toy: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On CUDA, exponentials of bfloat16 are float32; on the CPU, they are not."""
    field = random_field("paper", toy).eval()  # without noise
    to_density, to_radiance = field.to_density, field.to_radiance
    monkeypatch.setattr(field, "to_density", lambda raw, bias: to_density(raw.float(), bias))
    monkeypatch.setattr(field, "to_radiance", lambda raw: to_radiance(raw.float()))
    raw, index = torch.randn(3, 5).bfloat16(), torch.tensor([1, 2, 5])
    found = field.scatter(raw, index, torch.Size((2, 3)), 0.5)
    kept = torch.zeros(6, dtype=torch.bool)
    kept[index] = True
    expected = to_density(raw[:, 3].float(), 0.5)
    torch.testing.assert_close(found.density.view(-1)[kept], expected)
    torch.testing.assert_close(found.radiance.view(-1, 3)[kept], to_radiance(raw[:, :3].float()))
    torch.testing.assert_close(found.blend.view(-1)[kept], raw[:, 4].sigmoid())
    assert not found.density.view(-1)[~kept].any() and not found.radiance.view(-1, 3)[~kept].any()


@pytest.mark.parametrize(("capability", "fast"), [((7, 5), False), ((8, 0), True), ((12, 0), True)])
def test_flow_is_computed_in_bfloat16_where_a_gpu_has_units_for_it(
    capability: tuple[int, int], fast: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    monkeypatch.setattr("hdr_nsff.priors.flow.networks.GMFlow", lambda bf16: bf16)
    assert build("gmflow", torch.device("cuda", 1)) is fast


# operations that a step launches at most, forward and backward and Adam, and for which
# the host waits. Of `splat` without its rasterizer, which waits once for the number of
# (Gaussian, tile) pairs; the size of arrays that `grid` and `paper` select is known on
# the device alone.
STEP_COSTS = {"splat": (842, 0), "splat-late": (1154, 0), "grid": (7700, 25), "paper": (2200, 33)}


def flat_picture(*arguments: Any) -> Maps:
    """Maps that depend on all Gaussians, by as few operations as possible."""
    means, quaternions, scales, opacities, features, view, _ = arguments
    size = view.height, view.width
    shapes = sum(t.mean() for t in (means, quaternions, scales)) * 1e-6
    alpha = (opacities.mean() + shapes).clamp(0.1, 0.9).expand(*size)
    return Maps(features.mean(0).sigmoid().expand(*size, features.shape[1]), alpha, alpha)


@pytest.mark.parametrize("preset", list(STEP_COSTS))
def test_a_step_launches_and_waits_no_more_than_it_did(
    preset: str,
    toy: Scene,
    toy_folder: Path,
    tmp_path: Path,
    device: torch.device,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hdr_nsff.fields.splat.draw.rasterize", flat_picture)
    config = small(preset.removesuffix("-late"), toy_folder, tmp_path / "run")
    if isinstance(config.field, SplatConfig):
        late_mixing = preset.endswith("-late")
        config = replace(config, field=replace(config.field, late_mixing=late_mixing))
    open_folder(config)
    trainer = Trainer(config, toy, device, distributed.Ranks())
    for step in (*range(1, 13), 1):  # every constant of step 1 is on the device by then
        trainer.clock = replace(trainer.clock, step=step)
        with counted() as counts:
            trainer.step()
    max_launches, max_waits = STEP_COSTS[preset]
    assert counts.launches.total() <= max_launches, counts.launches.most_common()
    assert counts.waits.total() <= max_waits, counts.waits


@pytest.mark.parametrize("preset", EACH_FIELD)
def test_a_picture_is_that_of_the_cpu(preset: str, toy: Scene) -> None:
    field, camera = random_field(preset, toy).eval(), toy.train[2].camera
    recorder = Recorder(lambda radiance: radiance.clamp(0, 1), (2,))
    expected = field.record(camera, 2.5, [recorder]) if hasattr(field, "record") else []
    radiance = field.render(camera, 2.5).radiance
    with pretend_device() as device:
        field.to(device)
        there = to_device(camera, device)
        found = field.render(there, 2.5).radiance
        assert isinstance(found, PretendTensor)
        # the CPU's kernel skips Gaussians that hardly show
        torch.testing.assert_close(found.cpu(), radiance, rtol=1e-3, atol=2e-3)
        recorded = field.record(there, 2.5, [recorder]) if expected else []
        for a, b in zip(recorded, expected, strict=True):
            torch.testing.assert_close(a.cpu(), b, rtol=1e-3, atol=2e-3)
