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

from hdr_nsff.fields.kernels.cuda.launch import launch
from hdr_nsff.fields.kernels.cuda.layout import CHANNELS, ELLIPSE, PIXELS, THREADS, TILE
from hdr_nsff.fields.kernels.footprint import MOMENTS
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
) -> tuple[Tensor, Tensor, Tensor]:
    """Features (H, W, D), z-depth (H, W) and alpha (H, W) of Gaussians.

    They are as `rasterize.rasterize` takes them, seen by `w2c` (3, 4) and `K` (3, 3) in
    a picture of `size` (width, height). All on one CUDA device, float32; gradients
    reach everything but `K`.
    """
    gaussians = means, quaternions, scales, opacities, features
    maps, alpha = RasterizeCuda.apply(*gaussians, w2c, K, size)
    # `split` joins the two gradients, where slices' would be added up
    seen, depth = maps.split([len(maps) - 1, 1])
    return seen.permute(1, 2, 0), depth[0], alpha


class RasterizeCuda(torch.autograd.Function):
    """Maps (D + 1, H, W), the last one z-depth, and alpha (H, W).

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
    ) -> tuple[Tensor, Tensor]:
        parts = (means, quaternions, scales, opacities)
        gaussians = [t.detach().contiguous() for t in parts]
        camera = torch.cat([w2c.flatten(), K.diagonal()[:2], K[:2, 2]]).double()
        count, (width, height) = len(means), size
        ellipses = means.new_empty(count, ELLIPSE)
        depths = means.new_empty(count)
        boxes = means.new_empty((count, 4), dtype=torch.int32)
        counts = means.new_empty(count, dtype=torch.int64)
        projected = ellipses, depths, boxes, counts
        blocks = (-(-count // THREADS), 1)
        launch("project", blocks, THREADS, *gaussians, camera, width, height, *projected)
        starts, owners = sort_pairs(boxes, counts, depths, size)
        channels = features.shape[1] + 1  # z-depth is the last one
        num_chunks = -(-channels // CHANNELS)
        values = means.new_zeros(count, num_chunks * CHANNELS)
        values[:, : channels - 1] = features
        values[:, channels - 1] = depths
        maps = means.new_empty(channels, height, width)
        alpha = means.new_empty(height, width)
        grid = (len(starts) - 1, num_chunks)
        tiles = starts, owners, ellipses, values, maps, alpha
        launch("forward", grid, PIXELS, *tiles)
        ctx.gaussians, ctx.camera, ctx.size, ctx.counts = gaussians, camera, size, counts
        ctx.tiles, ctx.grid = tiles[:4], grid
        ctx.save_for_backward(maps, alpha)
        return maps, alpha

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        maps, alpha = ctx.saved_tensors
        means, values = ctx.gaussians[0], ctx.tiles[3]
        sums = means.new_zeros(len(means), MOMENTS + values.shape[1])
        grad_maps, grad_alpha = (g.contiguous() for g in grads)
        seen = maps, alpha, grad_maps, grad_alpha
        launch("backward", ctx.grid, PIXELS, *ctx.tiles, *seen, sums)
        needs_pose = ctx.needs_input_grad[5]
        out = [torch.empty_like(t) for t in ctx.gaussians]
        poses = means.new_empty(len(means) if needs_pose else 0, 12)
        depth_channel = len(maps) - 1
        view = ctx.camera, *ctx.size
        blocks = (-(-len(means) // THREADS), 1)
        arguments = (*ctx.gaussians, *view, ctx.counts, sums, depth_channel, *out, poses)
        launch("project_backward", blocks, THREADS, *arguments)
        grad_pose = None
        if needs_pose:
            grad_pose = poses.sum(0, dtype=torch.float64).view(3, 4).to(maps)
        grad_features = sums[:, MOMENTS : MOMENTS + depth_channel]
        return *out, grad_features, grad_pose, None, None


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
    owners = boxes.new_empty(num_pairs)
    blocks = (-(-len(counts) // THREADS), 1)
    bits = depths.view(torch.int32)  # which grow with a positive float
    launch("list_pairs", blocks, THREADS, boxes, ends, bits, tiles_x, keys, owners)
    keys, order = torch.sort(keys, stable=True)
    starts = torch.searchsorted(keys, first_keys(tiles_x * tiles_y, counts.device))
    return starts, owners[order]


@cache
def first_keys(num_tiles: int, device: torch.device) -> Tensor:
    """The smallest key of every tile, and one that no tile reaches."""
    return torch.arange(num_tiles + 1, device=device) << 32
