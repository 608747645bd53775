"""The rasterizer: numba kernels against the plain-torch twin in float64, the twin
against finite differences, closed forms, and degenerate Gaussians.
"""

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.kernels import compositing, footprint
from hdr_nsff.fields.kernels.projection import TILE_X, TILE_Y
from hdr_nsff.fields.splat import rasterize as module
from hdr_nsff.fields.splat import rasterize_cuda, rasterize_gsplat
from hdr_nsff.fields.splat.rasterize import (
    Maps,
    dense,
    depth_order,
    project,
    rasterize,
    rotation_matrices,
)
from hdr_nsff.geometry.cameras import Camera

FOCAL = 40.0
NAMES = ("means", "quaternions", "scales", "opacities", "features", "c2w", "focal")


def camera(width: int = 41, height: int = 27) -> Camera:
    """An oblique camera whose principal point is off the middle of the picture."""
    turn = rotation_matrices(torch.tensor([[1.0, 0.05, -0.1, 0.2]], dtype=torch.float64))[0]
    c2w = torch.cat([turn, torch.tensor([[0.1], [-0.2], [0.3]], dtype=torch.float64)], 1)
    rows = [[FOCAL, 0, 0.45 * width], [0, 1.1 * FOCAL, 0.6 * height], [0, 0, 1]]
    K = torch.tensor(rows, dtype=torch.float64)
    return Camera(K, c2w, width, height)


def ahead(view: Camera, local: Tensor) -> Tensor:
    """World points of camera points (G, 3)."""
    return local.double() @ view.c2w[:, :3].T + view.c2w[:, 3]


def scene(seed: int, view: Camera, count: int = 60, channels: int = 4) -> list[Tensor]:
    """Random Gaussians in front of a camera, some beyond its frame: means, quaternions,
    scales, opacities, features.

    Float32 numbers in float64, so that both twins see the same ones.
    """
    g = torch.Generator().manual_seed(seed)
    z = 1.5 + 3 * torch.rand(count, 1, generator=g)
    size = torch.tensor([view.width, view.height])
    pixels = (1.4 * torch.rand(count, 2, generator=g) - 0.2) * size
    focal, center = view.K[[0, 1], [0, 1]].float(), view.K[:2, 2].float()
    local = torch.cat([(pixels - center) / focal * z, z], 1)
    parts = [
        ahead(view, local),
        torch.randn(count, 4, generator=g),
        0.02 + 0.3 * torch.rand(count, 3, generator=g),
        0.05 + 0.9 * torch.rand(count, generator=g),
        torch.randn(count, channels, generator=g),
    ]
    return [p.float().double() for p in parts]


def everything(maps: Maps) -> Tensor:
    """All maps in one, (H, W, D + 2)."""
    return torch.cat([maps.features, maps.depth[..., None], maps.alpha[..., None]], -1).double()


def lens(view: Camera, focal: Tensor) -> Camera:
    """The camera with other focal lengths (2,), differentiable in them."""
    diagonal = torch.diag(torch.cat([focal, focal.new_ones(1)]))
    return replace(view, K=diagonal + view.K - torch.diag(view.K.diagonal()))


def drawn(
    twin: Callable[..., Maps], gaussians: list[Tensor], view: Camera, weight: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Maps (H, W, D + 2), and the gradients of all NAMES of their sum with `weight`."""
    kind = torch.float64 if twin is dense else torch.float32
    leaves = [t.to(kind, copy=True).requires_grad_() for t in gaussians]
    pose, focal = view.c2w.clone().requires_grad_(), view.K[[0, 1], [0, 1]].clone().requires_grad_()
    seen = everything(twin(*leaves, lens(view, focal).moved(pose)))
    (seen * weight).sum().backward()
    inputs = (*leaves, pose, focal)
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad.double() for t in inputs]
    return seen.detach(), gradients


def clear_pixels(gaussians: list[Tensor], view: Camera) -> Tensor:
    """Pixels (H, W) where no alpha is so close to a cut that rounding decides."""
    centers, covariance, z = project(*gaussians[:3], view)
    d = view.pixel_grid()[:, None] - centers
    exponent = 0.5 * (d[:, :, None] @ torch.linalg.inv(covariance) @ d[..., None])[..., 0, 0]
    alpha = gaussians[3] * torch.exp(-exponent)
    near_min = (alpha / float(footprint.ALPHA_MIN)).log().abs() < 0.01
    near_max = (alpha / float(compositing.ALPHA_MAX)).log().abs() < 3e-4
    doubtful = (near_min | near_max) & (z > footprint.NEAREST)
    return ~doubtful.any(1).unflatten(0, (view.height, view.width))


def compare(
    gaussians: list[Tensor],
    view: Camera,
    gradients: float = 1e-3,
    twin: Callable[..., Maps] = rasterize,
) -> Tensor:
    """The maps (H, W, D + 2), after `twin` and `dense` were found to give the same.

    Gradients are the same up to the share `gradients` of the largest ones.
    """
    clear = clear_pixels(gaussians, view)
    assert clear.double().mean() > 0.8
    shape = (view.height, view.width, gaussians[4].shape[1] + 2)
    generator = torch.Generator().manual_seed(99)
    weight = torch.randn(shape, generator=generator, dtype=torch.float64) * clear[..., None]
    ours, theirs = (drawn(twin, gaussians, view, weight) for twin in (twin, dense))
    top = theirs[0].abs().amax((0, 1)).clamp_min(1.0)
    assert float(((ours[0] - theirs[0]).abs() / top)[clear].max()) < 2e-4
    for name, a, b in zip(NAMES, ours[1], theirs[1], strict=True):
        if b.numel():
            off, largest = float((a - b).abs().max()), float(b.abs().max())
            assert off <= gradients * largest + 1e-9, (
                f"gradient of {name} is off by {off:.3g}, the largest is {largest:.3g}"
            )
    return theirs[0]


@pytest.mark.parametrize(
    ("seed", "channels", "size"),
    [(0, 4, (41, 27)), (1, 1, (16, 8)), (2, 17, (33, 50)), (3, 4, (1, 1)), (4, 4, (48, 32))],
)
def test_kernels_equal_plain_torch_in_values_and_gradients(
    seed: int, channels: int, size: tuple[int, int]
) -> None:
    view = camera(*size)
    assert float(compare(scene(seed, view, channels=channels), view)[..., -1].max()) > 0.5


def at_depths(view: Camera, z: tuple[float, float], wide: float, size: float = 1.0) -> list[Tensor]:
    """Random Gaussians whose z-depths lie in a range, within `wide` of the optical axis
    at z = 1; `size` multiplies their scales.
    """
    _, quaternions, scales, opacities, features = scene(5, view)
    g = torch.Generator().manual_seed(7)
    depth = z[0] + (z[1] - z[0]) * torch.rand(60, 1, generator=g)
    local = torch.cat([wide * (torch.rand(60, 2, generator=g) - 0.5) * depth, depth], 1)
    means, scales = (t.float().double() for t in (ahead(view, local), scales * size))
    return [means, quaternions, scales, opacities, features]


def test_gaussians_behind_the_camera_are_hidden_and_have_no_gradient() -> None:
    view = camera()
    seen = compare(at_depths(view, (-2.0, 0.0), 1.0), view)
    assert float(seen.abs().max()) == 0  # and so is the largest gradient of plain torch


@pytest.mark.parametrize("size", [0.01, 1.0])
def test_kernels_equal_plain_torch_across_the_near_plane(size: float) -> None:
    view = camera()
    gaussians = at_depths(view, (0.0, 3 * footprint.NEAREST), 1.0, size)
    assert float(compare(gaussians, view, gradients=5e-3)[..., -1].max()) > 0.5


@pytest.mark.parametrize("length", [1e-3, 1e3])
def test_pictures_do_not_depend_on_the_unit_of_length(length: float) -> None:
    view = camera()
    means, quaternions, scales, *others = (t.float() for t in scene(1, view))
    # every other Gaussian near the camera, some of them nearer than what is drawn
    means[::2] = ahead(view, torch.rand(30, 3) * torch.tensor([0.0, 0, 0.03])).float()
    pose = view.c2w * torch.tensor([1, 1, 1, length])
    expected = rasterize(means, quaternions, scales, *others, view)
    scaled = means * length, quaternions, scales * length, *others
    seen = rasterize(*scaled, view.moved(pose), footprint.NEAREST * length)
    for a, b, unit in zip(seen, expected, (1, length, 1), strict=True):
        torch.testing.assert_close(a / unit, b, rtol=1e-3, atol=1e-4)
    assert not torch.allclose(rasterize(*scaled, view.moved(pose)).alpha, expected.alpha)


def test_kernels_equal_plain_torch_at_the_frames_edge_and_beyond_it() -> None:
    view = camera()
    gaussians = at_depths(view, (1.0, 2.0), 3.0)
    centers = project(*gaussians[:3], view)[0]
    # there the projection is linearized at the edge, not at the mean
    outside = ((centers < -0.3 * 0.5 * 41) | (centers > 1.3 * 41)).any(1)
    assert 10 < int(outside.sum()) < 50
    gradients = drawn(dense, gaussians, view, torch.ones(27, 41, 6, dtype=torch.float64))[1]
    assert int((gradients[0][outside] != 0).any(1).sum()) > 5
    compare(gaussians, view)


@pytest.mark.parametrize("length", [0.3, 3.0, 1000.0])
def test_kernels_equal_plain_torch_on_needles(length: float) -> None:
    view = camera()
    gaussians = scene(5, view)
    gaussians[2] = torch.tensor([length, 1e-5, 1e-5]).double().expand(60, 3)
    assert float(compare(gaussians, view)[..., -1].max()) > 0.1


def test_kernels_equal_plain_torch_on_needles_whose_center_is_far_outside() -> None:
    view = camera().moved(torch.eye(4, dtype=torch.float64)[:3])
    g = torch.Generator().manual_seed(7)
    angle, z = 6.28 * torch.rand(60, generator=g), 2 + torch.rand(60, 1, generator=g)
    # a point in the frame that the needle passes, 30 units from its center
    through = (torch.rand(60, 2, generator=g) - 0.5) * z
    gaussians = scene(5, view)
    gaussians[0] = torch.cat([through + 30 * torch.stack([angle.cos(), angle.sin()], 1), z], 1)
    gaussians[1] = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], 1)
    gaussians[2] = torch.tensor([30, 1e-3, 1e-3]).expand(60, 3)
    gaussians = [t.float().double() for t in gaussians]
    seen = compare(gaussians, view, gradients=0.1)  # moments of gradients still cancel
    assert float(seen[..., -1].mean()) > 0.2


@pytest.mark.parametrize("size", [1e-6, 1000.0])
def test_kernels_equal_plain_torch_on_dust_and_on_giants(size: float) -> None:
    view = camera()
    gaussians = scene(5, view)
    gaussians[2] = (gaussians[2] * size).float().double()
    assert float(compare(gaussians, view)[..., -1].max()) > 0.1


def test_kernels_equal_plain_torch_at_opacities_0_and_1() -> None:
    view = camera()
    gaussians = scene(5, view)
    gaussians[3] = (gaussians[3] > 0.5).double()
    for size in (1.0, 1e5):  # giants fill the picture with alphas at the largest one
        scales = (gaussians[2] * size).float().double()
        seen = compare([*gaussians[:2], scales, *gaussians[3:]], view)
        assert float(seen[..., -1].max()) > 0.9


def test_no_gaussians_make_an_empty_picture() -> None:
    view = camera()
    assert float(compare(scene(0, view, count=0), view).abs().max()) == 0


def test_plain_torch_agrees_with_finite_differences_pose_and_focal_lengths_included() -> None:
    view = camera(3, 2)
    gaussians = [t.requires_grad_() for t in scene(3, view, count=4, channels=2)]
    pose, focal = view.c2w.clone().requires_grad_(), view.K[[0, 1], [0, 1]].clone().requires_grad_()

    def maps(*inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(dense(*inputs[:5], lens(view, inputs[6]).moved(inputs[5]), cut=False))

    assert torch.autograd.gradcheck(maps, (*gaussians, pose, focal), eps=1e-6, atol=1e-6)


def facing(*opacities: float, z: tuple[float, ...]) -> tuple[list[Tensor], Camera]:
    """Small round Gaussians behind each other, on the middle of pixel (4, 3) of a
    camera at the origin; features 1, 2, ...
    """
    view = Camera(torch.tensor([[20.0, 0, 4.5], [0, 20, 3.5], [0, 0, 1]]), torch.eye(4)[:3], 9, 7)
    count = len(z)
    means = torch.tensor([[0.0, 0.0, depth] for depth in z])
    features = torch.arange(1.0, count + 1)[:, None]
    turned = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return [means, turned, torch.full((count, 3), 0.05), torch.tensor(opacities), features], view


both = pytest.mark.parametrize("twin", [rasterize, dense])


@both
def test_alpha_at_the_center_is_the_opacity_and_depth_is_z(twin: Callable[..., Maps]) -> None:
    gaussians, view = facing(0.7, z=(2.5,))
    seen = twin(*gaussians, view)
    assert float(seen.alpha.max()) == float(seen.alpha[3, 4]) == pytest.approx(0.7)
    assert float(seen.depth[3, 4] / seen.alpha[3, 4]) == pytest.approx(2.5)
    variance = (20 / 2.5 * 0.05) ** 2 + 0.3  # pixels^2
    one_pixel_aside = 0.7 * math.exp(-0.5 / variance)
    assert float(seen.alpha[3, 5]) == pytest.approx(one_pixel_aside, rel=1e-4)


@both
def test_gaussians_on_one_line_of_sight_composite_front_to_back(twin: Callable[..., Maps]) -> None:
    for z in ((2.0, 3.0, 4.0), (4.0, 2.0, 3.0)):
        gaussians, view = facing(0.5, 0.4, 0.8, z=z)
        seen, left, expected = twin(*gaussians, view), 1.0, 0.0
        for i in sorted(range(3), key=lambda i: z[i]):
            expected += left * float(gaussians[3][i]) * (i + 1)
            left *= 1 - float(gaussians[3][i])
        assert float(seen.features[3, 4, 0]) == pytest.approx(expected)
        assert float(seen.alpha[3, 4]) == pytest.approx(1 - left)


@both
def test_of_coincident_gaussians_the_first_is_in_front(twin: Callable[..., Maps]) -> None:
    gaussians, view = facing(0.6, 0.5, z=(2.0, 2.0))
    assert float(twin(*gaussians, view).features[3, 4, 0]) == pytest.approx(0.6 * 1 + 0.4 * 0.5 * 2)


def test_the_depth_order_is_a_stable_sort_of_all_that_is_drawn() -> None:
    g = np.random.default_rng(0)
    parts = [g.random(500), g.integers(1, 9, 500), 10.0 ** g.uniform(-2, 30, 200)]
    depths = np.concatenate([*parts, [-1.0, 0.0, np.nan, np.inf]])
    depths = g.permutation(depths).astype(np.float32)
    order = depth_order(depths)
    assert sorted(order.tolist()) == list(range(len(depths)))
    drawn = order[depths[order] > footprint.NEAREST]
    expected = np.argsort(depths, kind="stable")
    assert drawn.tolist() == expected[depths[expected] > footprint.NEAREST].tolist()


def test_opacity_never_exceeds_1_however_many_gaussians_there_are() -> None:
    view = camera()
    gaussians = [t.float() for t in scene(0, view, count=500)]
    gaussians[3][:] = 1.0
    alpha = rasterize(*gaussians, view).alpha
    assert float(alpha.min()) >= 0 and 0.999 < float(alpha.max()) <= 1


@both
@pytest.mark.parametrize(
    ("part", "bad"),
    [*((part, math.nan) for part in range(4)), (0, math.inf), (2, math.inf), (3, math.inf)],
)
def test_a_gaussian_that_is_not_finite_is_not_drawn_and_harms_no_other(
    twin: Callable[..., Maps], part: int, bad: float
) -> None:
    view = camera()
    gaussians = scene(0, view)
    rest = [torch.cat([t[:7], t[8:]]) for t in gaussians]
    gaussians[part].view(60, -1)[7, -1] = bad
    weight = torch.ones(27, 41, 6, dtype=torch.float64)
    seen, gradients = drawn(twin, gaussians, view, weight)
    expected, theirs = drawn(twin, rest, view, weight)
    assert torch.equal(seen, expected)
    for a, b in zip(gradients[:5], theirs[:5], strict=True):
        assert float(a[7].abs().max()) == 0
        torch.testing.assert_close(torch.cat([a[:7], a[8:]]), b)
    for a, b in zip(gradients[5:], theirs[5:], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


def test_no_gradient_is_made_for_a_pose_that_wants_none() -> None:
    view = camera()
    leaves = [t.float().requires_grad_() for t in scene(0, view)]
    rasterize(*leaves, view).alpha.sum().backward()
    assert view.c2w.grad is None and float(leaves[0].grad.abs().max()) > 0


def fingerprints() -> None:
    """Print a hash of maps and gradients for 1, 2, 2 and 1 threads."""
    view = camera(70, 50)
    weight = torch.randn(50, 70, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for threads in (1, 2, 2, 1):
        numba.set_num_threads(threads)
        seen, gradients = drawn(rasterize, scene(0, view, count=400), view, weight)
        print(hashlib.sha256(b"".join(t.numpy().tobytes() for t in (seen, *gradients))).hexdigest())


def test_the_result_is_the_same_to_the_bit_for_any_number_of_threads() -> None:
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": os.pathsep.join(sys.path)}
    code = "import test_rasterize; test_rasterize.fingerprints()"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    hashes = result.stdout.split()
    assert len(hashes) == 4 and len(set(hashes)) == 1


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("channels", [1, 4, 17, 40])
@pytest.mark.parametrize("backend", [rasterize_cuda, rasterize_gsplat, None])
def test_cuda_equals_plain_torch(
    channels: int, backend: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    if backend is rasterize_gsplat:
        pytest.importorskip("gsplat")
    composite = backend.composite if backend else None
    monkeypatch.setattr(module, "composite_on", lambda device: composite)
    view = camera()
    gaussians = scene(0, view, channels=channels)
    clear = clear_pixels(gaussians, view)[..., None]
    generator = torch.Generator().manual_seed(99)
    weight = torch.randn(27, 41, channels + 2, generator=generator).double() * clear
    leaves = [t.float().cuda().requires_grad_() for t in gaussians]
    pose, focal = (t.float().cuda().requires_grad_() for t in (view.c2w, view.K[[0, 1], [0, 1]]))
    there = Camera(view.K.float().cuda(), pose, view.width, view.height)
    seen = everything(rasterize(*leaves, lens(there, focal)))
    (seen * weight.cuda()).sum().backward()
    expected, gradients = drawn(dense, gaussians, view, weight)
    off = (seen.detach().cpu() - expected).abs() * clear
    assert float(off.max()) < 1e-3 * float(expected.abs().max())
    for a, b in zip((*leaves, pose, focal), gradients, strict=True):
        assert float((a.grad.cpu() - b).abs().max()) < 5e-3 * float(b.abs().max())


def test_a_tiles_span_holds_all_that_a_gaussian_shows_in_it_and_little_more() -> None:
    rng = np.random.default_rng(0)
    rows_in_all = rows_needed = 0
    for _ in range(400):
        deviations = np.exp(rng.uniform(-1, 6)), np.exp(rng.uniform(-1, 2))  # up to needles
        turn = rng.uniform(0, np.pi)
        axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        covariance = axes * np.square(deviations) @ axes.T
        opacity, center = rng.uniform(0.01, 1), rng.uniform(-40, 40, 2)
        y, x = np.mgrid[:TILE_Y, :TILE_X] + 0.5
        offsets = np.stack([x - center[0], y - center[1]], -1)
        squares = np.einsum("yxi,ij,yxj->yx", offsets, np.linalg.inv(covariance), offsets)
        shown = (opacity * np.exp(-0.5 * squares) >= footprint.ALPHA_MIN).any(1).nonzero()[0]
        edge = footprint.outline((covariance[0, 0], covariance[0, 1], covariance[1, 1]), opacity)
        span = compositing.pixel_span(tuple(np.float32(edge)), -center[0], -center[1])
        first, last = (int(end) // TILE_X for end in span)
        if len(shown):
            assert first <= shown[0] and shown[-1] < last
            rows_needed += 2 * (shown[-1] // 2 - shown[0] // 2 + 1)  # they go in pairs
        rows_in_all += last - first
    assert rows_needed <= rows_in_all <= 1.02 * rows_needed
