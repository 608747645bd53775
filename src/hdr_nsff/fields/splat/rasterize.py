"""3D Gaussians to feature maps, differentiable in everything, the camera's pose and
focal lengths included (EWA splatting: Zwicker et al. 2001, Kerbl et al. 2023).

One call with twins behind it: numba kernels on the CPU, CUDA kernels or gsplat on
CUDA, and `dense`, plain torch, slow and obviously right. Shapes: G Gaussians with D
features, pictures of (H, W).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.tensors import table_on, to_device
from hdr_nsff.fields.kernels import compositing, footprint, projection
from hdr_nsff.fields.splat.cuda_backends import Composite, composite_on
from hdr_nsff.geometry.cameras import Camera

ALPHA_MIN, ALPHA_MAX = float(footprint.ALPHA_MIN), float(compositing.ALPHA_MAX)
MIN_LENGTH = footprint.MIN_LENGTH  # added to a quaternion's length, which may be 0


class Maps(NamedTuple):
    """What the camera sees."""

    features: Tensor  # (H, W, D) sum of weight * feature, premultiplied by opacity
    depth: Tensor  # (H, W) sum of weight * z-depth, premultiplied as well, scene units
    alpha: Tensor  # (H, W) in [0, 1]: sum of weights


class Planes(NamedTuple):
    """The same plane by plane."""

    planes: Tensor  # (D + 1, H, W) features and z-depth, premultiplied by opacity
    alpha: Tensor  # (H, W)


def rasterize(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    nearest: float = footprint.NEAREST,
) -> Maps:
    """Composite G Gaussians front to back by the z-depth of their means.

    `means` (G, 3) and `scales` (G, 3; standard deviations > 0) in scene units,
    `quaternions` (G, 4) w x y z of any length, `opacities` (G,) in [0, 1], `features`
    (G, D) anything. Gaussians whose shape or opacity is not finite are not drawn, nor
    are those of a z-depth of `nearest` or less, in scene units.
    Float32 on the CPU or on CUDA; every other dtype and device takes `dense`.
    """
    gaussians = means, quaternions, scales, opacities, features
    device = means.device.type if means.dtype == torch.float32 else None
    match device:
        case "cpu":
            planes, alpha = rasterize_planes(*gaussians, camera, nearest)
            # `split` joins the two gradients, where slices' would be added up
            seen, depth = planes.split([len(planes) - 1, 1])
            return Maps(seen.permute(1, 2, 0), depth[0], alpha)
        case "cuda":
            composite = composite_on(means.device)
            if composite is None:
                # not `dense`, which would hold every Gaussian at every pixel
                on_cpu = rasterize(*to_device(gaussians, "cpu"), to_device(camera, "cpu"), nearest)
                return Maps(*(m.to(means.device) for m in on_cpu))
            return composite_view(composite, gaussians, camera, nearest)
        case _:
            return dense(*gaussians, camera, nearest)


def rasterize_planes(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    nearest: float = footprint.NEAREST,
) -> Planes:
    """`rasterize` by the numba kernels of the CPU, as these draw: plane by plane."""
    gaussians = means, quaternions, scales, opacities, features
    w2c = world_to_camera_and_focal(camera)
    return Planes(*RasterizeNumba.apply(*gaussians, w2c, camera, nearest))


def composite_view(
    composite: Composite,
    gaussians: tuple[Tensor, ...],
    camera: Camera,
    nearest: float = footprint.NEAREST,
) -> Maps:
    """`rasterize` by a rasterizer of CUDA devices."""
    if camera.c2w.requires_grad or camera.K.requires_grad:
        w2c = world_to_camera_and_focal(camera)
    else:
        w2c = held_pose(camera.c2w)
    size = camera.width, camera.height
    return Maps(*composite(*gaussians, w2c, camera.K.detach(), size, nearest))


@lru_cache(maxsize=4096)
def held_pose(c2w: Tensor) -> Tensor:
    """World to camera (3, 4) of a pose that does not change, made once."""
    with torch.inference_mode(False), torch.no_grad():
        return invert_pose(c2w)


def invert_pose(c2w: Tensor) -> Tensor:
    """World to camera (3, 4) of camera to world (3, 4)."""
    rotation = c2w[:, :3].T
    return torch.cat([rotation, -rotation @ c2w[:, 3:]], 1)


def world_to_camera(camera: Camera) -> Tensor:
    """World to camera (3, 4), differentiable in the pose."""
    return invert_pose(camera.c2w)


def world_to_camera_and_focal(camera: Camera) -> Tensor:
    """`world_to_camera` (3, 4) that carries the gradient of the focal lengths as well.

    For kernels to which K is numbers: a longer focal length is a camera whose x and y
    are stretched.
    """
    w2c, focal = world_to_camera(camera), camera.K.diagonal()[:2]
    if not focal.requires_grad:
        return w2c
    stretch = torch.cat([focal / focal.detach(), focal.new_ones(1)])  # ones, with a gradient
    return stretch[:, None] * w2c


def sum_products(*sums: str) -> Tensor:
    """A matrix (16, n) that turns the outer product of two quaternions into n sums.

    A sum such as "+wx -zy" is `a_w b_x - a_z b_y` of quaternions a and b, w x y z; the
    outer product is flattened to (16,). One matrix product takes the place of dozens of
    small operations, forward and backward.
    """
    table = torch.zeros(16, len(sums))
    for column, terms in enumerate(sums):
        for term in terms.split():
            sign, first, second = tuple(term)
            row = 4 * "wxyz".index(first) + "wxyz".index(second)
            table[row, column] += 1 if sign == "+" else -1
    return table


# the rotation matrix of a unit quaternion, row by row, from its outer product with
# itself
ROTATION_MATRIX = sum_products(
    "+ww +xx -yy -zz",
    "+xy +xy -wz -wz",
    "+xz +xz +wy +wy",
    "+xy +xy +wz +wz",
    "+ww -xx +yy -zz",
    "+yz +yz -wx -wx",
    "+xz +xz -wy -wy",
    "+yz +yz +wx +wx",
    "+ww -xx -yy +zz",
)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices (G, 3, 3) of quaternions (G, 4) w x y z of any length."""
    unit = quaternions / (quaternions.norm(dim=-1, keepdim=True) + MIN_LENGTH)
    outer = (unit[..., None] * unit[..., None, :]).flatten(-2)  # (G, 16)
    return (outer @ table_on(ROTATION_MATRIX, unit.device, unit.dtype)).unflatten(-1, (3, 3))


def project(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    camera: Camera,
    nearest: float = footprint.NEAREST,
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixel centers (G, 2), 2D covariances (G, 2, 2) in pixels^2 and z-depths (G,).

    The plain-torch twin of `projection.project`, in its notation.
    """
    w2c, K = world_to_camera(camera), camera.K
    t = means @ w2c[:, :3].T + w2c[:, 3]  # camera points
    z = t[:, 2].clamp_min(nearest)
    size = torch.tensor([camera.width, camera.height]).to(means)
    focal, center = K[[0, 1], [0, 1]], K[:2, 2]
    # far outside of the frame the projection is linearized at its edge
    edge = footprint.MARGIN * 0.5 * size / focal
    low, high = -center / focal - edge, (size - center) / focal + edge
    ratio = t[:, :2] / z[:, None]
    xy = z[:, None] * torch.minimum(torch.maximum(ratio, low), high)
    zero = torch.zeros_like(z)
    row_x = torch.stack([focal[0] / z, zero, -focal[0] * xy[:, 0] / z**2], -1)
    row_y = torch.stack([zero, focal[1] / z, -focal[1] * xy[:, 1] / z**2], -1)
    jacobian = torch.stack([row_x, row_y], 1)  # (G, 2, 3)
    half_axes = rotation_matrices(quaternions) * scales[:, None]
    spread = jacobian @ w2c[:, :3] @ half_axes
    covariance = spread @ spread.mT + footprint.BLUR * torch.eye(2).to(means)
    return ratio * focal + center, covariance, t[:, 2]


def dense(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    nearest: float = footprint.NEAREST,
    cut: bool = True,
) -> Maps:
    """The plain-torch twin: every Gaussian at every pixel, any dtype and device.

    Without `cut`, no alpha is too small to count.
    """
    shape = torch.cat([means, quaternions, scales, opacities[:, None]], 1)
    finite = shape.isfinite().all(1)
    means, features = means[finite], features[finite]
    quaternions, scales = quaternions[finite], scales[finite]
    opacities = opacities[finite]
    centers, covariance, z = project(means, quaternions, scales, camera, nearest)
    order = torch.argsort(z.detach(), stable=True)
    order = order[z.detach()[order] > nearest]
    d = camera.pixel_grid().to(means)[:, None] - centers[order]  # (S, G, 2)
    inverse = torch.linalg.inv(covariance[order])
    exponent = 0.5 * (d[:, :, None] @ inverse @ d[..., None])[..., 0, 0]
    alpha = (opacities[order] * torch.exp(-exponent)).clamp_max(ALPHA_MAX)
    if cut:
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    left = torch.cumprod(1 - alpha, 1)
    transmittance = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
    weights = alpha * transmittance
    size = (camera.height, camera.width)
    values = torch.cat([features, z[:, None]], 1)[order]
    seen = (weights @ values).unflatten(0, size)
    return Maps(seen[..., :-1], seen[..., -1], weights.sum(1).unflatten(0, size))


def depth_order(depths: np.ndarray) -> np.ndarray:
    """Stable order (G,) of positive float32 `depths` (G,), the others last.

    A radix sort on the two halves of their bits, which grow with a positive float:
    twenty times as fast as numpy's stable sort of floats.
    """
    bits = depths.view(np.uint32)
    low, high = (bits & 0xFFFF).astype(np.uint16), (bits >> 16).astype(np.uint16)
    by_low = np.argsort(low, kind="stable")
    return by_low[np.argsort(high[by_low], kind="stable")]


def pad_channels(features: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Features (G, D) and z-depths (G,) side by side, padded with zeros.

    As the kernels take them: the kernels' `BLOCK` of columns, or more in pairs.
    """
    count, channels = features.shape
    columns = max(channels + 1 + (channels + 1) % 2, compositing.BLOCK)
    values = np.zeros((count, columns), np.float32)
    values[:, :channels] = features
    values[:, channels] = depths
    return values


class RasterizeNumba(torch.autograd.Function):
    """The numba twin: maps (D + 1, H, W), the last one z-depth, and alpha (H, W)."""

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
        nearest: float,
    ) -> tuple[Tensor, Tensor]:
        gaussians = [
            t.detach().contiguous().numpy() for t in (means, quaternions, scales, opacities)
        ]
        pose = w2c.detach().double().numpy()
        fx_fy_cx_cy = camera.K.detach().double().numpy()[[0, 1, 0, 1], [0, 1, 2, 2]]
        k = np.append(fx_fy_cx_cy, nearest)
        count, (width, height) = len(means), (camera.width, camera.height)
        centers = np.empty((count, 2), np.float32)
        depths = np.empty(count, np.float32)
        conics = np.empty((count, 3), np.float32)
        outlines = np.empty((count, 4), np.float32)
        boxes = np.empty((count, 4), np.int64)
        view = (pose, k, width, height)
        projection.project(*gaussians, *view, centers, depths, conics, outlines, boxes)
        tiles_x = -(-width // projection.TILE_X)
        tiles_y = -(-height // projection.TILE_Y)
        order = depth_order(depths)
        starts, members, places, owned = compositing.bin_tiles(boxes, order, tiles_x, tiles_y)
        values = pad_channels(features.detach().numpy(), depths)
        maps = torch.empty(features.shape[1] + 1, height, width)
        alpha = torch.empty(height, width)
        drawn = (centers, conics, gaussians[3], values, outlines)
        compositing.forward(starts, members, *drawn, maps.numpy(), alpha.numpy())
        ctx.gaussians, ctx.view, ctx.drawn = gaussians, view, drawn
        ctx.tiles = starts, members, places, owned
        ctx.save_for_backward(maps, alpha)
        return maps, alpha

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        maps, alpha = ctx.saved_tensors
        starts, members, places, owned = ctx.tiles
        means, _, _, _ = ctx.gaussians
        values = ctx.drawn[3]
        pairs = np.empty((len(members), footprint.MOMENTS + values.shape[1]), np.float32)
        grad_maps, grad_alpha = (g.contiguous().numpy() for g in grads)
        seen = (maps.numpy(), alpha.numpy(), grad_maps, grad_alpha)
        compositing.backward(starts, members, places, *ctx.drawn, *seen, pairs)
        out = [torch.empty(a.shape) for a in (*ctx.gaussians, values[:, : len(maps)])]
        needs_pose = ctx.needs_input_grad[5]
        poses = torch.zeros(len(means) if needs_pose else 0, 12)
        arrays = [t.numpy() for t in (*out, poses)]
        projection.project_backward(*ctx.gaussians, *ctx.view, owned, pairs, *arrays)
        grad_pose = poses.double().sum(0).view(3, 4).to(maps) if len(poses) else None
        grad_features = out[4][:, :-1]  # without the z-depth, whose gradient is in the means
        return *out[:4], grad_features, grad_pose, None, None
