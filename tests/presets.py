"""The presets, shrunk so that a test trains each in seconds: the same code paths, fewer numbers."""

from dataclasses import replace
from pathlib import Path

import torch

from hdr_nsff import distributed
from hdr_nsff.config import PRESETS, TrainConfig
from hdr_nsff.fields import build_field
from hdr_nsff.fields.branches import GridBranches, GridConfig, MlpConfig
from hdr_nsff.fields.nsff import NSFF
from hdr_nsff.scene import Scene
from hdr_nsff.train import Trainer, open_folder

NETWORKS = {
    "grid": GridConfig(finest=4.0, depth_cells=16, levels=2, max_rows=2**12),
    "paper": MlpConfig(layers=3, width=32, skip_after=1, octaves=4, direction_octaves=2),
    "tiny": GridConfig(finest=6.0, depth_cells=16, levels=2, max_rows=2**12),
}


def small(preset: str, scene: Path = Path("scene"), out: Path = Path("run"), steps: int = 2) -> TrainConfig:
    """A preset with a small network, few samples and few rays."""
    config = PRESETS[preset]
    field = replace(config.field, encoding=NETWORKS[preset], samples=12, render_samples=16, cull_after=4)
    return replace(
        config, field=field, scene=scene, out=out, steps=steps, minutes=None, rays=64, moving_rays=16, checkpoint_seconds=1e9, device="cpu"
    )  # fmt: skip


def random_field(preset: str, scene: Scene, seed: int = 0) -> NSFF:
    """An untrained field with something in every branch."""
    torch.manual_seed(seed)
    field = build_field(small(preset).field, scene)
    for p in field.parameters():
        p.data.add_(0.3 * torch.randn_like(p))
    if isinstance(field.branches, GridBranches):
        field.branches.dynamic_grid.table.data[:, 3] += 1.5  # movers that cover something
    return field


def trainer(config: TrainConfig, scene: Scene) -> Trainer:
    """Ready for its first step, alone."""
    open_folder(config)
    return Trainer(config, scene, torch.device("cpu"), distributed.Ranks())
