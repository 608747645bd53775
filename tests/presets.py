"""Small versions of the presets: the same code paths, trained in seconds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from hdr_nsff.core import distributed
from hdr_nsff.fields.baselines.hexplane import HexPlane, HexPlaneConfig
from hdr_nsff.fields.build import AnyField, build_field, initialize_field
from hdr_nsff.fields.nsff.branches import GridBranches, GridConfig, MlpConfig
from hdr_nsff.fields.nsff.two_branches import TwoBranches
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import open_folder
from hdr_nsff.training.train import Trainer, train

GRID = GridConfig(finest=4.0, depth_cells=16, levels=2, max_rows=2**12)
MLP = MlpConfig(layers=3, width=32, skip_after=1, octaves=4, direction_octaves=2)
HEXPLANE = HexPlaneConfig(
    density_components=3,
    appearance_components=4,
    coarsest=8,
    finest=16,
    grow_every=3,
    width=16,
    samples=12,
    render_samples=16,
    cull_after=4,
)
NETWORKS: dict[str, GridConfig | MlpConfig | SplatConfig | HexPlaneConfig] = {
    "splat": SplatConfig(static=400, moving=150, bases=2),
    "grid": GRID,
    "paper": MLP,
    "paper-small": MLP,
    "tiny": GridConfig(finest=6.0, depth_cells=16, levels=2, max_rows=2**12),
    "nsff": GRID,
    "nsff-paper": MLP,
    "nerf-wt": GRID,
    "nsff-paper-small": MLP,
    "nerf-wt-paper": MLP,
    "nerf-wt-paper-small": MLP,
    "hdr-hexplane": HEXPLANE,
    "hdr-hexplane-paper": HEXPLANE,
    "grid-sigmoid": GRID,  # the ablation whose field differs
    "splat-sigmoid": SplatConfig(static=400, moving=150, bases=2, radiance="sigmoid"),
}


def small(
    preset: str, scene: Path = Path("scene"), out: Path = Path("run"), steps: int = 2
) -> TrainConfig:
    """A preset with a small network, few samples and few rays."""
    config = PRESETS[preset]
    network = NETWORKS.get(preset) or NETWORKS[preset.partition("-")[0]]
    field = (
        network
        if isinstance(network, SplatConfig | HexPlaneConfig)
        else replace(config.field, encoding=network, samples=12, render_samples=16, cull_after=4)
    )
    rays = {"rays": 64, "moving_rays": 16} if config.rays else {}
    return replace(
        config,
        field=field,
        scene=scene,
        out=out,
        budget=Budget(steps=steps, minutes=None),
        checkpoint_seconds=1e9,
        device="cpu",
        **rays,
    )


def random_field(preset: str, scene: Scene, seed: int = 0) -> AnyField:
    """An untrained field whose branches all contribute."""
    torch.manual_seed(seed)
    field = build_field(small(preset).field, scene)
    if isinstance(field, Splat):
        initialize_field(field, scene, lambda rgb, *frame: rgb + 0.1, 0.0, True)
        for p in field.trajectories.parameters():
            p.data.add_(0.02 * torch.randn_like(p))
        for p in (
            field.moving.log_radiance_offsets,
            field.static.log_radiance_offsets,
            field.mixture_logits,
        ):
            p.data.add_(0.3 * torch.randn_like(p))
        return field
    for p in field.parameters():
        p.data.add_(0.3 * torch.randn_like(p))
    if isinstance(field, HexPlane):
        field.to_density.weight.data.mul_(10)  # visible, in spite of the density's shift
        return field
    assert isinstance(field, TwoBranches)
    if isinstance(field.branches, GridBranches):
        field.branches.dynamic_grid.table.data[:, 3] += 1.5  # opaque movers
    return field


def trainer(config: TrainConfig, scene: Scene) -> Trainer:
    """A trainer before its first step, in one process."""
    open_folder(config)
    return Trainer(config, scene, torch.device("cpu"), distributed.Ranks())


def interrupted_at(stop: int, settings: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train up to step `stop`, as if Ctrl-C were pressed there."""
    step = Trainer.step

    def stopping(self: Trainer) -> dict[str, float]:
        if self.clock.step == stop:
            raise KeyboardInterrupt
        return step(self)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "step", stopping)
        train(settings)
