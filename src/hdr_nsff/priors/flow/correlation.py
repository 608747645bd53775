"""The position of a feature in another frame: cosine cost volume, and a soft-argmax
around its maximum.

Positions are in cells (x, y), with the centers of cells at whole numbers. All of it is
differentiable except the choice of the maximum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

CHUNK = 512  # queries whose similarities are held at a time: bounds the memory
EXCLUDED = -9.0  # a similarity below every cosine


@dataclass(frozen=True)
class Search:
    """How a feature is searched for in another frame."""

    reach: float
    """Largest motion, in x and in y, in cells."""
    radius: int
    """The soft-argmax covers the cells within this distance of the best one, in x and
    in y, in cells.
    """
    temperature: float
    """Of the softmax of cosines."""


def cell_positions(height: int, width: int) -> Tensor:
    """The positions (H*W, 2) of all cells, row by row."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2).float()


def sample_features(maps: Tensor, positions: Tensor) -> Tensor:
    """Features (N, C) of `maps` (C, h, w) at `positions` (N, 2), bilinear.

    Positions outside the grid read its edge.
    """
    h, w = maps.shape[-2:]
    grid = (2 * positions + 1) / positions.new_tensor([w, h]) - 1
    sampled = functional.grid_sample(
        maps[None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return sampled[0, :, 0].T


def cosines(queries: Tensor, target: Tensor) -> Tensor:
    """Cosine (N, h*w) of `queries` (N, C) with all cells of `target` (C, h, w)."""
    return functional.normalize(queries, dim=-1) @ functional.normalize(target, dim=0).flatten(1)


def soft_argmax(similarity: Tensor, radius: int, temperature: float) -> Tensor:
    """Sub-cell positions (N, 2) of the maxima of `similarity` (N, h, w).

    Each is the mean of the positions within `radius` cells of the maximum, weighted by
    softmax(similarity / temperature).
    """
    h, w = similarity.shape[1:]
    flat = similarity.flatten(1)
    best = flat.detach().argmax(1)
    side = 2 * radius + 1
    around = torch.arange(side * side, device=flat.device)
    y = (best // w)[:, None] + around // side - radius
    x = (best % w)[:, None] + around % side - radius
    inside = (y >= 0) & (y < h) & (x >= 0) & (x < w)
    near = flat.gather(1, y.clamp(0, h - 1) * w + x.clamp(0, w - 1))
    weights = torch.softmax(near.masked_fill(~inside, EXCLUDED) / temperature, 1)
    return (weights[..., None] * torch.stack([x, y], -1)).sum(1)


def locate(queries: Tensor, start: Tensor, target: Tensor, search: Search) -> Tensor:
    """Positions (N, 2) of `queries` (N, C) in `target` (C, h, w).

    They are searched around `start` (N, 2).
    """
    h, w = target.shape[-2:]
    rows, columns = torch.arange(h).to(target), torch.arange(w).to(target)
    found = []
    for chunk, center in zip(queries.split(CHUNK), start.split(CHUNK), strict=True):
        first, last = torch.aminmax(center[:, 1].detach())
        low = max(math.ceil(float(first) - search.reach), 0)
        high = min(math.floor(float(last) + search.reach) + 1, h)
        similarity = cosines(chunk, target[:, low:high]).unflatten(1, (high - low, w))
        beyond_x = (columns - center[:, :1]).abs() > search.reach  # (N, w)
        beyond_y = (rows[low:high] - center[:, 1:]).abs() > search.reach
        beyond = beyond_y[:, :, None] | beyond_x[:, None]
        similarity = similarity.masked_fill(beyond, EXCLUDED)
        position = soft_argmax(similarity, search.radius, search.temperature)
        found.append(position + position.new_tensor([0, low]))
    return torch.cat(found)


def feature_motion(a: Tensor, b: Tensor, search: Search) -> Tensor:
    """Motion (h, w, 2), in cells, of each cell of `a` to its position in `b`.

    Both are features (C, h, w).
    """
    h, w = a.shape[-2:]
    start = cell_positions(h, w).to(a)
    end = locate(a.flatten(1).T, start, b, search)
    return (end - start).reshape(h, w, 2)
