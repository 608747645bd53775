"""The rasterizer's twin on NVIDIA GPUs: our own kernels, written in Python and compiled
by numba-cuda (extras `gpu` and `gpu12`), without a CUDA toolkit.

torch sorts the (Gaussian, tile) pairs and holds all memory; the kernels in
`kernels/cuda/` do the rest, on torch's current stream. The host waits once a
picture: for the number of pairs, before it takes memory for them.
"""

from __future__ import annotations

from functools import cache
from importlib import metadata
from typing import Any

import torch
from torch import Tensor

from hdr_nsff.fields.kernels.cuda.launch import blocks_for, launch
from hdr_nsff.fields.kernels.cuda.layout import CHANNELS, ELLIPSE, PIXELS, THREADS, TILE
from hdr_nsff.fields.kernels.footprint import MOMENTS, NEAREST
from hdr_nsff.fields.splat.try_out import fault_of


@cache
def fault(device: str = "cuda") -> str | None:
    """Why the kernels cannot draw on `device`, and how to fix it; None where they draw
    one Gaussian and its gradients.
    """
    try:
        version = metadata.version("numba-cuda")
    except metadata.PackageNotFoundError:  # numba's own CUDA target needs a toolkit
        return f"CUDA kernels need numba-cuda, which is not installed: {install_command()}"
    reason = fault_of(composite, device)
    if reason is None:
        return None
    return (
        f"numba-cuda {version} cannot draw with torch {torch.__version__} "
        f"({reason}): {install_command()}, or update NVIDIA's driver"
    )


def install_command() -> str:
    """The command that installs the compiler for the CUDA version that torch brings."""
    if (torch.version.cuda or "").startswith("12."):
        return "pip install 'hdr-nsff[gpu12]'"
    return "pip install 'hdr-nsff[gpu]'"


def composite(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    w2c: Tensor,
    K: Tensor,
    size: tuple[int, int],
    nearest: float = NEAREST,
) -> tuple[Tensor, Tensor, Tensor]:
    """Features (H, W, D), z-depth (H, W) and alpha (H, W) of Gaussians.

    They are as `rasterize.rasterize` takes them, seen by `w2c` (3, 4) and `K` (3, 3) in
    a picture of `size` (width, height). All on one CUDA device, float32; gradients
    reach everything but `K`.
    """
    gaussians = means, quaternions, scales, opacities, features
    seen, depth, alpha = RasterizeCuda.apply(*gaussians, w2c, K, size, float(nearest))
    return seen.permute(1, 2, 0), depth, alpha


class RasterizeCuda(torch.autograd.Function):
    """Features (D, H, W), z-depth (H, W) and alpha (H, W).

    Gradients reach everything but `K`, the pose `w2c` (3, 4) included. Those of a
    Gaussian are sums in no fixed order, so that their last digits differ between runs.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        features: Tensor,
        w2c: Tensor,
        K: Tensor,
        size: tuple[int, int],
        nearest: float,
    ) -> tuple[Tensor, Tensor, Tensor]:
        parts = (means, quaternions, scales, opacities)
        gaussians = [t.detach().contiguous() for t in parts]
        view = w2c.detach().contiguous(), K.detach().contiguous(), *size, nearest
        count, (width, height) = len(means), size
        num_features = features.shape[1]  # z-depth comes after them
        num_chunks = -(-(num_features + 1) // CHANNELS)
        ellipses = means.new_empty(count, ELLIPSE)
        depths = means.new_empty(count)
        values = means.new_empty(count, num_chunks * CHANNELS)
        boxes = means.new_empty((count, 4), dtype=torch.int32)
        counts = means.new_empty(count, dtype=torch.int64)
        copied = features.detach().contiguous()
        projected = ellipses, depths, values, boxes, counts
        launch("project", blocks_for(count), THREADS, *gaussians, copied, *view, *projected)
        starts, owners = sort_pairs(boxes, counts, depths, size)
        maps = means.new_empty(num_features + 1, height, width)
        alpha = means.new_empty(height, width)
        grid = (len(starts) - 1, num_chunks)
        tiles = starts, owners, ellipses, values, maps, alpha
        launch("forward", grid, PIXELS, *tiles)
        ctx.gaussians, ctx.view, ctx.counts = gaussians, view, counts
        # a result itself would hold on to its own graph
        ctx.tiles, ctx.grid, ctx.num_features = (*tiles[:-1], alpha.detach()), grid, num_features
        return maps[:num_features], maps[num_features], alpha

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        means, values = ctx.gaussians[0], ctx.tiles[3]
        sums = means.new_zeros(len(means), MOMENTS + values.shape[1])
        launch("backward", ctx.grid, PIXELS, *ctx.tiles, *(g.contiguous() for g in grads), sums)
        needs_pose = ctx.needs_input_grad[5]
        out = [torch.empty_like(t) for t in ctx.gaussians]
        poses = means.new_empty(len(means) if needs_pose else 0, 12)
        given = (*ctx.gaussians, *ctx.view, ctx.counts, sums, ctx.num_features)
        launch("project_backward", blocks_for(len(means)), THREADS, *given, *out, poses)
        grad_pose = None
        if needs_pose:
            grad_pose = poses.sum(0, dtype=torch.float64).view(3, 4).to(means)
        grad_features = sums[:, MOMENTS : MOMENTS + ctx.num_features]
        return *out, grad_features, grad_pose, None, None, None


def sort_pairs(
    boxes: Tensor, counts: Tensor, depths: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """The tiles' lists of Gaussians, front to back, one after the other.

    Returns where they start (tiles + 1,), and the Gaussians `owners` (P,) int32.
    `boxes` (G, 4), `counts` (G,) and `depths` (G,) are those of the kernel `project`.
    """
    width, height = size
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    ends = counts.cumsum(0)
    num_pairs = int(ends[-1]) if len(ends) else 0  # the host waits here
    keys = counts.new_empty(num_pairs)
    owners, ordered = boxes.new_empty(num_pairs), boxes.new_empty(num_pairs)
    bits = depths.view(torch.int32)  # which grow with a positive float
    listed = tiles_x, keys, owners
    launch("list_pairs", blocks_for(len(counts)), THREADS, boxes, ends, bits, *listed)
    keys, order = torch.sort(keys, stable=True)
    starts = counts.new_empty(tiles_x * tiles_y + 1)
    given = keys, order, owners
    launch("order_pairs", blocks_for(num_pairs + 1), THREADS, *given, starts, ordered)
    return starts, ordered
