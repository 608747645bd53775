"""Which pixels a step compares: a training frame, uniform pixels, and moving ones.

A batch depends on the seed, the step and its slot in the step alone. A resumed run, or
one spread over several processes, therefore draws what an unbroken single one draws.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hdr_nsff.scene.batch import PixelBatch, draw_pixels, whole_frame
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.budget import Clock
from hdr_nsff.training.config import TrainConfig


def draw_batch(
    config: TrainConfig, scene: Scene, clock: Clock, slot: int, chained: bool
) -> PixelBatch:
    """The batch of the slot-th place in a step.

    If `chained`, it is also warped over two steps, forward and backward in turn.
    """
    frame, generator = draw_frame(config, scene, clock.step, slot)
    if config.rays:
        num_moving = moving_rays(config, clock)
        batch = draw_pixels(scene, frame, config.rays, num_moving, generator)
    else:
        batch = whole_frame(scene, frame)
    field_seed = int(torch.randint(2**31, (1,), generator=generator))
    direction = 1 if clock.step % 2 else -1
    return replace(batch, seed=field_seed, chain=direction if chained else 0)


def draw_frame(
    config: TrainConfig, scene: Scene, step: int, slot: int
) -> tuple[int, torch.Generator]:
    """The training frame of the slot-th place in a step, and what draws the rest."""
    seed = np.random.SeedSequence([config.seed, step, slot]).generate_state(1)
    generator = torch.Generator().manual_seed(int(seed[0]))
    return int(torch.randint(len(scene.train), (1,), generator=generator)), generator


def moving_rays(config: TrainConfig, clock: Clock) -> int:
    """Extra pixels of moving content at this time of the run."""
    elapsed = clock.progress if config.schedule.period else clock.phase
    return config.moving_rays if elapsed < config.moving_until else 0


def rays_per_step(config: TrainConfig, scene: Scene) -> int:
    """Pixels that one step compares, at most."""
    drawn = config.rays + config.moving_rays
    pixels_per_frame = scene.train[0].image[..., 0].numel()
    return (drawn or pixels_per_frame) * config.batches
