"""Samples along rays and what a branch holds there."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class March:
    """Samples along rays, all of them."""

    depths: Tensor  # (N, S) z-depth
    points: Tensor  # (N, S, 3) scene units
    coords: Tensor  # (N, S, 3) cube
    deltas: Tensor  # (N, S) cube
    directions: Tensor  # (N, 3) unit view directions


@dataclass(frozen=True)
class Content:
    """What one branch holds at the samples of some rays."""

    density: Tensor  # (N, S)
    radiance: Tensor  # (N, S, 3)
    blend: Tensor  # (N, S)
