"""Steps of `splat` and `grid` by CUDA kernels, on the pretend device: their launches,
and that terms and gradients are those of the CPU. `test_cuda_step.py` runs these tests
in a process with NUMBA_ENABLE_CUDASIM=1, where a simulator runs the kernels.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from presets import small
from pretend_device import COUNTING, PretendTensor, counted, pretend_device, unwrap
from simulated_tone import use_few_knots
from torch import Tensor

from hdr_nsff.core import distributed
from hdr_nsff.fields.kernels.cuda import launch as launching
from hdr_nsff.fields.kernels.cuda.launch import check_arguments, launch
from hdr_nsff.fields.nsff import encodings, fused_grid
from hdr_nsff.fields.splat import (
    draw,
    fused_cloud,
    fused_parts,
    fused_picture,
    local_gaussians,
    rasterize_cuda,
    training_view,
)
from hdr_nsff.fields.splat.rasterize import Maps, Planes, composite_view
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap import bracketed, curve, fused_tone, photograph_cuda
from hdr_nsff.training import fused_losses, kernel_adam, optimizers, weighted_terms
from hdr_nsff.training.run_folder import open_folder
from hdr_nsff.training.train import Trainer

WITH_LAUNCHES = (
    rasterize_cuda,
    fused_cloud,
    fused_parts,
    fused_picture,
    fused_grid,
    encodings,
    photograph_cuda,
    fused_losses,
    fused_tone,
    kernel_adam,
    local_gaussians,
)


def arrive(name: str, values: tuple[Tensor | float, ...]) -> list[Tensor | float]:
    """Count a launch; its arguments, once all of them are known to be there."""
    for counts in COUNTING:
        counts.launches[name] += 1
    for i, value in enumerate(values):
        there = not isinstance(value, Tensor) or isinstance(value, PretendTensor)
        assert there, f"{name}: argument {i} {tuple(value.shape)} is on the CPU"
    arguments = [unwrap(v) for v in values]
    check_arguments(name, arguments)
    return arguments


def launch_there(name: str, grid: tuple[int, int], threads: int, *values: Tensor | float) -> None:
    """A kernel on tensors of the pretend device."""
    if 0 not in grid:
        launch(name, grid, threads, *arrive(name, values))


def count_launch(name: str, grid: tuple[int, int], threads: int, *values: Tensor | float) -> None:
    """A kernel that does nothing but fill its last result with one number."""
    if 0 in grid:
        return
    *_, last = arrive(name, values)
    if isinstance(last, Tensor):  # every time-local Gaussian is alive
        last.fill_(name == "living")


class NothingDrawn(torch.autograd.Function):
    """Maps that brighten, of all Gaussians, by no launch at all."""

    @staticmethod
    def forward(ctx: Any, camera: Camera, *gaussians: Tensor) -> tuple[Tensor, ...]:
        ctx.shapes = [g.shape for g in gaussians]
        size = camera.height, camera.width
        ctx.there = isinstance(gaussians[0], PretendTensor)
        shapes = (*size, gaussians[-1].shape[1]), size, size
        return tuple(like_those(ramp(shape), ctx.there) for shape in shapes)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        return None, *(like_those(torch.zeros(shape), ctx.there) for shape in ctx.shapes)


def ramp(shape: tuple[int, ...]) -> Tensor:
    return torch.linspace(0.1, 0.9, math.prod(shape)).view(shape)


def like_those(made: Tensor, there: bool) -> Tensor:
    return PretendTensor(made) if there else made


def draw_nothing(*arguments: Any) -> Maps:
    *gaussians, camera, _ = arguments
    return Maps(*NothingDrawn.apply(camera, *gaussians))


def draw_no_planes(*arguments: Any) -> Planes:
    maps = draw_nothing(*arguments)
    return Planes(torch.cat([maps.features.permute(2, 0, 1), maps.depth[None]]), maps.alpha)


def launch_by(monkeypatch: pytest.MonkeyPatch, launched: Callable[..., None]) -> None:
    for module in WITH_LAUNCHES:
        monkeypatch.setattr(module, "launch", launched)


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """The pretend device, on which our kernels run."""
    launch_by(monkeypatch, launch_there)
    use_few_knots(monkeypatch)
    monkeypatch.setattr(launching, "MAX_BLOCKS", 2)
    for module in (draw, training_view):
        monkeypatch.setattr(module, "rasterize", draw_nothing)
    monkeypatch.setattr(training_view, "rasterize_planes", draw_no_planes)
    objectives = (fused_losses, weighted_terms, optimizers)
    fields = training_view, local_gaussians, encodings
    for module in (*fields, curve, bracketed, *objectives):
        monkeypatch.setattr(module, "kernels_on", lambda device: device.type == "pretend")
    with pretend_device() as found:
        yield found


def trainer_on(
    device: torch.device,
    scene: Scene,
    folder: Path,
    out: Path,
    preset: str = "splat",
    **settings: bool | int,
) -> Trainer:
    config = small(preset, folder, out)
    config = replace(config, field=replace(config.field, **settings))
    if config.rays:
        config = replace(config, rays=8, moving_rays=8)
    open_folder(config)
    return Trainer(config, scene, device, distributed.Ranks())


# launches of a step of `splat` without the rasterizer's, one of which clears numbers
# for many steps, and with time-local Gaussians; those of the rasterizer, forward and
# backward, and of a number that the host reads; those of a step of `grid`; and what
# late mixing launches besides
SPLAT, SPLAT_LOCAL, RASTERIZER, GRID = 21, 24, 10, 948
LATE_MIXING = 5


@pytest.fixture
def counting(
    toy: Scene,
    toy_folder: Path,
    tmp_path: Path,
    device: torch.device,
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Trainer]:
    """Makes a trainer whose kernels are counted, and do nothing."""
    launch_by(monkeypatch, count_launch)

    def make(preset: str = "splat", **settings: bool | int) -> Trainer:
        return trainer_on(device, toy, toy_folder, tmp_path / "run", preset, **settings)

    return make


@pytest.mark.parametrize("late_mixing", [False, True])
def test_launches_of_a_step(late_mixing: bool, counting: Callable[..., Trainer]) -> None:
    assert SPLAT_LOCAL + LATE_MIXING + RASTERIZER <= 40
    trainer = counting(late_mixing=late_mixing)
    most = SPLAT + late_mixing * LATE_MIXING
    for number, step in enumerate((1, 2, 1, 2)):  # constants are there by the second time
        trainer.clock = replace(trainer.clock, step=step)
        with counted() as counts:
            trainer.step()
        if number >= 2:
            assert counts.launches.total() <= most, counts.launches.most_common()
            assert not counts.waits


def gradients_of_a_step(trainer: Trainer, step: int) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Terms, and gradients by the names of parameters; nothing is moved."""
    trainer.clock, trainer.monitor.read_every = replace(trainer.clock, step=step), 1
    found = {}

    def keep(*arguments: float) -> None:
        for module in (trainer.field, trainer.tonemapper):
            for name, p in module.named_parameters():
                if p.grad is not None:
                    found[name], p.grad = unwrap(p.grad).clone(), None

    trainer.optimizers.step = keep  # type: ignore[method-assign]
    return trainer.step(), found


@pytest.mark.parametrize(("preset", "step"), [("splat", 1), ("splat", 2), ("grid", 1)])
def test_a_step_has_the_terms_and_gradients_of_the_cpu(
    preset: str, step: int, toy: Scene, toy_folder: Path, tmp_path: Path, device: torch.device
) -> None:
    cpu = trainer_on(torch.device("cpu"), toy, toy_folder, tmp_path / "cpu", preset)
    terms, gradients = gradients_of_a_step(cpu, step)
    there = trainer_on(device, toy, toy_folder, tmp_path / "there", preset)
    found_terms, found = gradients_of_a_step(there, step)
    assert found_terms == pytest.approx(terms, rel=1e-4, abs=1e-7)
    assert set(gradients) <= set(found)
    for name, gradient in found.items():
        expected = gradients.get(name, torch.zeros_like(gradient))
        largest = float(expected.abs().max()) if expected.numel() else 0.0
        off = float((gradient - expected).abs().max()) if expected.numel() else 0.0
        assert off <= 1e-3 * largest + 1e-7, (name, off, largest)


def test_a_step_moves_the_poses_near_the_knot_as_on_the_cpu(
    toy: Scene, toy_folder: Path, tmp_path: Path, device: torch.device
) -> None:
    moved = []
    for where in (torch.device("cpu"), device):
        trainer = trainer_on(where, toy, toy_folder, tmp_path / where.type)
        poses = trainer.field.trajectories
        before = [unwrap(p.detach()).clone() for p in (poses.rotations, poses.translations)]
        trainer.step()
        after = [unwrap(p.detach()) for p in (poses.rotations, poses.translations)]
        moved.append([(a != b).any(1) for a, b in zip(after, before, strict=True)])
        assert not any(unwrap(marks).any() for marks in trainer.optimizers.row_marks)
    for ours, theirs in zip(*moved, strict=True):
        assert torch.equal(ours, theirs) and 0 < int(ours.sum()) < len(ours)


@pytest.mark.parametrize("late_mixing", [False, True])
def test_launches_of_a_step_with_time_local_gaussians(
    late_mixing: bool, counting: Callable[..., Trainer]
) -> None:
    trainer = counting(local=9, late_mixing=late_mixing)
    most = SPLAT_LOCAL + late_mixing * LATE_MIXING
    assert len(trainer.field.local) == 9
    for step in (1, 2, 1, 2):
        trainer.clock = replace(trainer.clock, step=step)
        with counted() as counts:
            trainer.step()
    assert counts.launches.total() <= most, counts.launches.most_common()
    assert counts.launches["local_backward"] == 1
    assert set(counts.waits) == {"aten.nonzero.default"}  # the number of those alive


def test_launches_of_a_step_of_grid(counting: Callable[..., Trainer]) -> None:
    trainer = counting("grid")
    for _ in range(2):
        with counted() as counts:
            trainer.step()
    assert counts.launches.total() <= GRID, counts.launches.most_common()
    kinds = ("interpolate", "table_backward", "coords_backward")
    assert [counts.launches[kind] for kind in kinds] == [7, 7, 3]


@pytest.mark.parametrize("preset", ["paper-small", "hdr-hexplane", "nerf-wt", "nsff-paper-small"])
def test_adam_takes_what_every_field_learns(preset: str, counting: Callable[..., Trainer]) -> None:
    trainer = counting(preset)
    with counted() as counts:
        trainer.step()
    assert counts.launches["adam"] >= 1


def test_launches_of_the_rasterizer(device: torch.device) -> None:
    parts = (3, 4, 3, 1, 6)
    gaussians = [torch.ones(1, n, device=device).requires_grad_() for n in parts]
    gaussians[3] = gaussians[3].detach()[:, 0].requires_grad_()
    view = Camera(torch.eye(3, device=device), torch.eye(4, device=device)[:3], 3, 3)
    for _ in range(2):  # constants are on the device by the second time
        with counted() as counts:
            maps = composite_view(rasterize_cuda.composite, tuple(gaussians), view)
            torch.autograd.grad(maps, gaussians, maps)
    assert counts.launches.total() <= RASTERIZER, counts.launches
    assert set(counts.waits) <= {"aten._local_scalar_dense.default"}  # the number of pairs
