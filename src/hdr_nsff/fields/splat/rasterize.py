"""3D Gaussians to feature maps, differentiable in everything, the camera's pose and
focal lengths included (EWA splatting; Zwicker et al. 2001, Kerbl et al. 2023). One
call, twins behind it: numba kernels on the CPU, gsplat on CUDA, and `dense`, the
plain-torch one, slow and obviously right.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.kernels import compositing, projection
from hdr_nsff.fields.splat import rasterize_gsplat as rasterize_cuda
from hdr_nsff.geometry.cameras import Camera


class Maps(NamedTuple):
    """What the camera sees."""

    features: Tensor  # (H, W, D) sum of weight * feature, premultiplied by opacity
    depth: Tensor  # (H, W) sum of weight * z-depth, premultiplied as well, scene units
    alpha: Tensor  # (H, W) in [0, 1]: sum of weights


def rasterize(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
) -> Maps:
    """Composite G Gaussians front to back by the z-depth of their means.

    `means` (G, 3) and `scales` (G, 3; standard deviations > 0) in scene units,
    `quaternions` (G, 4) w x y z of any length, `opacities` (G,) in [0, 1], `features`
    (G, D) anything. Gaussians whose shape or opacity is no finite number are not drawn.
    Float32 on the CPU or on CUDA; every other dtype and device takes `dense`.
    """
    gaussians = means, quaternions, scales, opacities, features
    match means.device.type if means.dtype == torch.float32 else None:
        case "cpu":
            maps, alpha = Rasterize.apply(*gaussians, stretched(camera), camera)
            seen, depth = maps.split(
                [len(maps) - 1, 1]
            )  # whose gradients are joined, where slices' would be added up
            return Maps(seen.permute(1, 2, 0), depth[0], alpha)
        case "cuda" if rasterize_cuda.available():
            rules = camera.width, camera.height, projection.NEAREST, projection.BLUR
            return Maps(
                *rasterize_cuda.composite(*gaussians, stretched(camera), camera.K.detach(), *rules)
            )
        case (
            "cuda"
        ):  # `dense` would hold every Gaussian at every pixel: too much for a real picture
            seen = rasterize(*to_device(gaussians, "cpu"), to_device(camera, "cpu"))
            return Maps(*(m.to(means.device) for m in seen))
        case _:
            return dense(*gaussians, camera)


def world_to_camera(camera: Camera) -> Tensor:
    """(3, 4), differentiable in the pose."""
    rotation = camera.c2w[:, :3].T
    return torch.cat([rotation, -rotation @ camera.c2w[:, 3:]], 1)


def stretched(camera: Camera) -> Tensor:
    """`world_to_camera` that carries the gradient of the focal lengths as well, for
    kernels to which K is numbers: a longer focal length is a camera whose x and y are
    stretched.
    """
    w2c, focal = world_to_camera(camera), camera.K[[0, 1], [0, 1]]
    if not focal.requires_grad:
        return w2c
    return torch.cat([focal / focal.detach(), focal.new_ones(1)])[:, None] * w2c


def products(*wanted: str) -> Tensor:
    """(16, n) that makes the `wanted` sums of products, such as "wx -zy", of the outer
    product (16) of two quaternions w x y z.
    """
    table = torch.zeros(16, len(wanted))
    for column, terms in enumerate(wanted):
        for term in terms.split():
            first, second = ("wxyz".index(axis) for axis in term[-2:])
            table[4 * first + second, column] += -1 if term[0] == "-" else 1
    return table


ROTATION = products(
    "ww xx -yy -zz", "xy xy -wz -wz", "xz xz wy wy",
    "xy xy wz wz", "ww -xx yy -zz", "yz yz -wx -wx",
    "xz xz -wy -wy", "yz yz wx wx", "ww -xx -yy zz",
)  # fmt: skip


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """(G, 3, 3) from (G, 4) w x y z of any length."""
    unit = quaternions / (quaternions.norm(dim=-1, keepdim=True) + 1e-12)
    return ((unit[..., None] * unit[..., None, :]).flatten(-2) @ ROTATION.to(unit)).unflatten(
        -1, (3, 3)
    )


def project(
    means: Tensor, quaternions: Tensor, scales: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixel centers (G, 2), 2D covariances (G, 2, 2) in pixels^2 and z-depths (G,)."""
    w2c, K = world_to_camera(camera), camera.K
    t = means @ w2c[:, :3].T + w2c[:, 3]
    z = t[:, 2].clamp_min(projection.NEAREST)
    size = torch.tensor([camera.width, camera.height]).to(means)
    focal, center = K[[0, 1], [0, 1]], K[:2, 2]
    edge = projection.MARGIN * 0.5 * size / focal
    xy = z[:, None] * torch.minimum(
        torch.maximum(t[:, :2] / z[:, None], -center / focal - edge), (size - center) / focal + edge
    )
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            focal[0] / z,
            zero,
            -focal[0] * xy[:, 0] / z**2,
            zero,
            focal[1] / z,
            -focal[1] * xy[:, 1] / z**2,
        ],
        -1,
    ).unflatten(-1, (2, 3))
    half_axes = rotation_matrices(quaternions) * scales[:, None]
    spread = jacobian @ w2c[:, :3] @ half_axes
    covariance = spread @ spread.mT + projection.BLUR * torch.eye(2).to(means)
    return t[:, :2] / z[:, None] * focal + center, covariance, t[:, 2]


def dense(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    cut: bool = True,
) -> Maps:
    """The plain-torch twin: every Gaussian at every pixel, any dtype and device.
    Without `cut`, no alpha is too small to count.
    """
    known = torch.cat([means, quaternions, scales, opacities[:, None]], 1).isfinite().all(1)
    means, quaternions, scales, opacities, features = (
        t[known] for t in (means, quaternions, scales, opacities, features)
    )
    centers, covariance, z = project(means, quaternions, scales, camera)
    order = torch.argsort(z.detach(), stable=True)
    order = order[z.detach()[order] > projection.NEAREST]
    d = camera.pixel_grid().to(means)[:, None] - centers[order]  # (S, G, 2)
    s = 0.5 * (d[:, :, None] @ torch.linalg.inv(covariance[order]) @ d[..., None])[..., 0, 0]
    alpha = (opacities[order] * torch.exp(-s)).clamp_max(float(compositing.ALPHA_MAX))
    if cut:
        alpha = torch.where(alpha >= float(projection.ALPHA_MIN), alpha, torch.zeros_like(alpha))
    left = torch.cumprod(1 - alpha, 1)
    weights = alpha * torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
    shape = (camera.height, camera.width)
    seen = (weights @ torch.cat([features, z[:, None]], 1)[order]).unflatten(0, shape)
    return Maps(seen[..., :-1], seen[..., -1], weights.sum(1).unflatten(0, shape))


def front_to_back(depths: np.ndarray) -> np.ndarray:
    """Stable order (G,) of positive float32 depths, the others last: radix sort on the
    halves of their bits, which numpy has for 16 bits.
    """
    bits = depths.view(np.uint32)
    low = np.argsort((bits & 0xFFFF).astype(np.uint16), kind="stable")
    return low[np.argsort((bits >> 16).astype(np.uint16)[low], kind="stable")]


def blocks(features: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Features (G, D) and z-depths (G,) side by side, then zeros up to a whole number
    of the kernels' blocks.
    """
    count, d = features.shape
    values = np.zeros((count, -(-(d + 1) // compositing.BLOCK) * compositing.BLOCK), np.float32)
    values[:, :d], values[:, d] = features, depths
    return values


class Rasterize(torch.autograd.Function):
    """The numba twin. Returns maps (D + 1, H, W), the last one z-depth, and alpha (H,
    W).
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
        camera: Camera,
    ) -> tuple[Tensor, Tensor]:
        arrays = [t.detach().contiguous().numpy() for t in (means, quaternions, scales, opacities)]
        pose = w2c.detach().double().numpy()
        k = camera.K.detach().double().numpy()[[0, 1, 0, 1], [0, 1, 2, 2]]
        count, size = len(means), (camera.width, camera.height)
        centers, depths, conics = (np.empty(s, np.float32) for s in ((count, 2), count, (count, 3)))
        rows, boxes = np.empty((count, 2), np.int64), np.empty((count, 4), np.int64)
        projection.project(*arrays, pose, k, *size, centers, depths, conics, rows, boxes)
        order = front_to_back(depths)
        tiles = -(-size[0] // projection.TILE_X), -(-size[1] // projection.TILE_Y)
        starts, members, places, owned = compositing.bin_tiles(boxes, order, *tiles)
        values, channels = blocks(features.detach().numpy(), depths), features.shape[1] + 1
        maps = torch.empty(channels, size[1], size[0])
        alpha = torch.empty(size[1], size[0])
        drawn = (starts, members, centers, conics, arrays[3], values, rows)
        compositing.forward(*drawn, maps.numpy(), alpha.numpy())
        ctx.kept = (arrays, pose, k, size, drawn, places, owned)
        ctx.save_for_backward(maps, alpha)
        return maps, alpha

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        maps, alpha = ctx.saved_tensors
        arrays, pose, k, size, (starts, members, *drawn), places, owned = ctx.kept
        values = drawn[3]
        pairs = np.empty((len(members), projection.MOMENTS + values.shape[1]), np.float32)
        seen = maps.numpy(), alpha.numpy()
        compositing.backward(
            starts, members, places, *drawn, *seen, *(g.contiguous().numpy() for g in grads), pairs
        )
        out = [torch.empty(a.shape) for a in (*arrays, values[:, : len(maps)])]
        poses = torch.zeros(len(arrays[0]) if ctx.needs_input_grad[5] else 0, 12)
        projection.project_backward(
            *arrays, pose, k, *size, owned, pairs, *(t.numpy() for t in out), poses.numpy()
        )
        grad_pose = poses.double().sum(0).view(3, 4).to(maps) if len(poses) else None
        return *out[:4], out[4][:, :-1], grad_pose, None
