"""Where a feature of one frame lies in another: cosine cost volume, and a soft-argmax
around its maximum.

Positions are in cells (x, y), a cell's middle at its whole number, so they need no
rounding; everything is differentiable but for the choice of the maximum.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

CHUNK = 512  # queries whose costs are held at a time
FAR = -9.0  # below every cosine


def cells(height: int, width: int) -> Tensor:
    """The positions (H*W, 2) of all cells, row by row."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2).float()


def sample(maps: Tensor, positions: Tensor) -> Tensor:
    """`maps` (C, h, w) at `positions` (N, 2), between cells linearly, outside as at the
    edge: (N, C).
    """
    h, w = maps.shape[-2:]
    grid = (2 * positions + 1) / positions.new_tensor([w, h]) - 1
    found = functional.grid_sample(
        maps[None], grid[None, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


def costs(queries: Tensor, target: Tensor) -> Tensor:
    """Cosine (N, h*w) of each of `queries` (N, C) with each cell of `target` (C, h, w)."""
    return functional.normalize(queries, dim=-1) @ functional.normalize(target, dim=0).flatten(1)


def soft_argmax(cost: Tensor, place: Tensor, radius: float, temperature: float) -> Tensor:
    """Sub-cell positions (N, 2) of the maxima of `cost` (N, M) at `place` (M, 2): the
    mean of the places within `radius` cells of the largest cost, weighted by
    softmax(cost / temperature).
    """
    best = place[cost.detach().argmax(1)]
    near = ((place - best[:, None]).abs() <= radius).all(-1)
    return torch.softmax(cost.masked_fill(~near, FAR) / temperature, 1) @ place


def locate(
    queries: Tensor, start: Tensor, target: Tensor, reach: float, radius: float, temperature: float
) -> Tensor:
    """Where in `target` (C, h, w) each of `queries` (N, C) is: positions (N, 2), at
    most `reach` cells in x and in y from `start` (N, 2).
    """
    place = cells(*target.shape[-2:]).to(target)
    found = []
    for some, origin in zip(queries.split(CHUNK), start.split(CHUNK), strict=True):
        cost = costs(some, target)
        cost = cost.masked_fill(((place - origin[:, None]).abs() > reach).any(-1), FAR)
        found.append(soft_argmax(cost, place, radius, temperature))
    return torch.cat(found)


def motion(a: Tensor, b: Tensor, reach: float, radius: float, temperature: float) -> Tensor:
    """Motion (h, w, 2), in cells, of all cells of `a` (C, h, w) to where they are in
    `b` (C, h, w).
    """
    start = cells(*a.shape[-2:]).to(a)
    return (locate(a.flatten(1).T, start, b, reach, radius, temperature) - start).reshape(
        *a.shape[-2:], 2
    )
