"""NSFF on contents known in closed form: a wall and a blob that moves at constant scene
flow; warps, flows, gradients, culling.
"""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from presets import random_field
from torch import Tensor, nn

from hdr_nsff.fields.nsff.nsff import NSFF, NSFFConfig
from hdr_nsff.fields.nsff.scene_flow import SceneFlowPass
from hdr_nsff.fields.space import build_space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, draw_pixels
from hdr_nsff.scene.scene import Scene

W, H, FOCAL = 48, 32, 40.0
NEAR, FAR = 1.0, 8.0
VELOCITY = torch.tensor([0.08, 0.04, 0.0])  # cube per knot
START = torch.tensor([0.35, 0.4, 0.7])  # cube, of the blob at knot 0
RADIUS = 0.12  # cube, of the blob
WALL = 0.2  # cube; the wall is everything beyond, that is of less disparity
EMPTY, SOLID = -30.0, 9.0  # raw densities


class Blob(nn.Module):
    """Branches in closed form, instead of grids: a static wall, and a blob (or none)
    with constant scene flow both ways.
    """

    def __init__(
        self,
        velocity: Tensor = VELOCITY,
        wall: bool = True,
        blob: bool = True,
        disocclusion: float = -30.0,
    ) -> None:
        super().__init__()
        self.velocity, self.wall, self.blob, self.disocclusion = velocity, wall, blob, disocclusion

    def static(self, coords: Tensor, directions: Tensor) -> Tensor:
        inside = (coords[:, 2] < WALL) & self.wall
        x, y = coords[:, :1], coords[:, 1:2]
        blend = torch.where(inside, 30.0, -30.0)[:, None]  # v is 1 inside of the wall
        return torch.cat([2 * x, 1 - y, 0 * x, self.density(inside), blend], -1)

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        local = coords - START - knot * self.velocity
        inside = (local.norm(dim=-1) < RADIUS) & self.blob
        x, y = local[:, :1], local[:, 1:2]
        raw = torch.cat([3 * x, 2 + y, 0 * x, self.density(inside)], -1)
        if not motion:
            return raw, None
        return raw, raw_motion(self.velocity, self.disocclusion).expand(len(coords), 8)

    @staticmethod
    def density(inside: Tensor) -> Tensor:
        return torch.where(inside, SOLID, EMPTY)[:, None]

    def param_groups(self) -> list[dict[str, Any]]:
        return []


def raw_motion(velocity: Tensor, disocclusion: float) -> Tensor:
    """Raw motion (8,) of a constant velocity (3,), in units of `flow_scale`, 0.05."""
    last = torch.tensor([disocclusion])
    return torch.cat([20 * velocity, last, -20 * velocity, last])


def camera(x: float = 0.0) -> Camera:
    K = torch.tensor([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]])
    return Camera(K, torch.cat([torch.eye(3), torch.tensor([[x], [0.0], [0.0]])], 1), W, H)


def blob_field(
    branches: Blob, compositing: Any = "add", times: tuple[float, ...] = (0.0, 1.0, 2.0)
) -> NSFF:
    cameras = [camera(0.1 * t) for t in times]
    config = NSFFConfig(samples=160, render_samples=160, compositing=compositing, cull=False)
    field = NSFF(config, build_space(cameras, NEAR, FAR), torch.tensor(times), NEAR, FAR, W, H)
    field.branches = branches  # type: ignore[assignment]
    return field


def batch(
    time: float = 1.0, x: float = 0.1, neighbors: tuple[float, float] = (0.0, 0.2)
) -> PixelBatch:
    """Every pixel of the camera at `x`; the previous and the next camera are at
    `neighbors`.
    """
    c = camera(x)
    pixels = c.pixel_grid()
    rgb, uniform = torch.zeros(len(pixels), 3), torch.ones(len(pixels), dtype=torch.bool)
    around = {-1: camera(neighbors[0]), 1: camera(neighbors[1])}
    return PixelBatch(0, time, c, 0, 0, around, pixels, rgb, uniform)


def centroid(motion: Tensor) -> Tensor:
    """Mean pixel of dynamic content (2,)."""
    return (motion[:, None] * camera().pixel_grid()).sum(0) / motion.sum()


def test_knots_count_training_times_however_uneven() -> None:
    field = blob_field(Blob(), times=(0.0, 1.0, 3.0, 4.0))
    inside = {0.0: 0.0, 0.5: 0.5, 1.0: 1.0, 2.0: 1.5, 3.5: 2.5, 4.0: 3.0}
    for time, knot in (inside | {-1.0: 0.0, 9.0: 3.0}).items():
        assert math.isclose(field.knot(time), knot)
    assert blob_field(Blob(), times=(5.0,)).knot(7.0) == 0.0


@pytest.mark.parametrize("compositing", ["add", "blend"])
def test_wall_and_blob_are_rendered_where_they_are(compositing: str) -> None:
    field = blob_field(Blob(), compositing)
    r = field.render(camera(), 0.0)
    blob, wall = r.motion > 0.9, r.motion < 0.1
    assert 20 < int(blob.sum()) < 400 and int((blob | wall).sum()) > 0.9 * W * H
    space = field.space
    middle = space.decode(START)
    torch.testing.assert_close(centroid(r.motion), camera().project(middle)[0], atol=0.5, rtol=0)
    assert float(r.depth[blob].mean()) == pytest.approx(float(camera().project(middle)[1]), rel=0.2)
    face = float(space.decode(torch.tensor([0.5, 0.5, WALL]))[2])
    expected = torch.full_like(r.depth[wall], face)
    torch.testing.assert_close(r.depth[wall], expected, rtol=0.05, atol=0)
    assert float(r.opacity.min()) > 0.99
    assert float(r.radiance[blob].mean(0)[1]) == pytest.approx(math.exp(2), rel=0.1)


@pytest.mark.parametrize("compositing", ["add", "blend"])
def test_between_two_times_content_has_moved_by_the_fraction_of_its_flow(compositing: str) -> None:
    field = blob_field(Blob(), compositing)
    at = [centroid(field.render(camera(), t).motion) for t in (0.0, 0.25, 0.5, 1.0)]
    step = at[3] - at[0]
    assert float(step.norm()) > 3  # pixels
    for place, fraction in ((at[1], 0.25), (at[2], 0.5)):
        torch.testing.assert_close(place - at[0], fraction * step, atol=0.3, rtol=0)
    whole, half = (field.render(camera(), t).motion.sum() for t in (0.0, 0.5))
    assert float(half) == pytest.approx(float(whole), rel=0.06)  # one blob, not two ghosts


def test_a_static_scene_flows_as_the_camera_moves() -> None:
    field = blob_field(Blob(blob=False))
    b = batch()
    render, _ = field(b)
    forward, backward = render.warps
    assert (forward.offset, backward.offset) == (1, -1)
    # the camera goes right by `shift`, so the wall goes left
    for warp, shift in ((forward, 0.1), (backward, -0.1)):
        expected = -FOCAL * shift / render.depth
        torch.testing.assert_close(warp.flow[:, 0], expected, atol=1e-3, rtol=1e-3)
        assert float(warp.flow[:, 1].abs().max()) < 1e-3
    assert float(render.motion.max()) < 1e-3


def test_flow_into_the_neighbors_camera_adds_motion_and_parallax() -> None:
    field = blob_field(Blob())
    render, _ = field(batch(neighbors=(0.1, 0.1)))  # nothing moves but the blob
    blob = render.motion > 0.99
    start, end = (camera(0.1).project(field.space.decode(START + k * VELOCITY))[0] for k in (1, 2))
    mean_flow = render.warps[0].flow[blob].mean(0)
    torch.testing.assert_close(mean_flow, end - start, atol=0.3, rtol=0)
    assert float(render.warps[0].flow[render.motion < 1e-3].abs().max()) < 1e-2


@pytest.mark.parametrize("compositing", ["add", "blend"])
def test_content_that_follows_its_flow_looks_the_same_through_both_neighbors(
    compositing: str,
) -> None:
    field = blob_field(Blob(), compositing)
    render, own = field(replace(batch(time=1.0), chain=0))
    blob = render.motion > 0.99
    for warp in render.warps:
        torch.testing.assert_close(warp.radiance[blob], render.radiance[blob], atol=0.02, rtol=0.02)
        torch.testing.assert_close(warp.confidence, torch.ones_like(warp.confidence))
    assert float(own["cycle"].max()) < 1e-6
    assert float(own["disocclusion"].max()) < 1e-6


def test_two_steps_along_the_flow_see_the_same_too() -> None:
    render, _ = blob_field(Blob())(replace(batch(time=0.0), chain=1))
    (chained,) = (w for w in render.warps if w.offset == 2)
    blob = render.motion > 0.99
    torch.testing.assert_close(chained.radiance[blob], render.radiance[blob], atol=0.02, rtol=0.02)


def test_content_that_ignores_its_flow_looks_different() -> None:
    branches = Blob()
    dynamic = branches.dynamic

    def at_rest(c: Tensor, k: float, d: Tensor, motion: bool) -> tuple[Tensor, Tensor | None]:
        return dynamic(c, 1.0, d, False)[0], dynamic(c, k, d, motion)[1]

    branches.dynamic = at_rest  # type: ignore[method-assign]
    render, _ = blob_field(branches)(batch())  # at rest, with a scene flow all the same
    blob = render.motion > 0.99
    assert float((render.warps[0].radiance[blob] - render.radiance[blob]).abs().mean()) > 0.1


def test_confidence_is_one_minus_the_rendered_disocclusion() -> None:
    render, own = blob_field(Blob(disocclusion=0.0))(batch())  # sigmoid(0) = a half
    confidence = render.warps[0].confidence
    torch.testing.assert_close(confidence, 1 - 0.5 * render.motion, atol=1e-4, rtol=0)
    assert own["disocclusion"].tolist() == [0.5, 0.5]


def test_steady_flow_costs_little_kinetic_energy_and_a_turn_costs_more() -> None:
    steady = blob_field(Blob())(batch())[1]["kinetic"]
    bent = Blob()
    dynamic = bent.dynamic

    def turn_back(c: Tensor, k: float, d: Tensor, motion: bool) -> tuple[Tensor, Tensor | None]:
        raw, flows = dynamic(c, k, d, motion)
        return raw, None if flows is None else torch.cat([flows[:, :4], flows[:, :4]], -1)

    bent.dynamic = turn_back  # type: ignore[method-assign]
    assert float(steady.max()) < 0.01 * float(blob_field(bent)(batch())[1]["kinetic"].max())


def test_steady_flow_past_a_missing_frame_costs_no_kinetic_energy() -> None:
    field = blob_field(Blob())
    field.host_times = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    base = field.query(batch(), motion=True)
    seen = SceneFlowPass(field, field.to_flow, batch(), base)
    v = torch.tensor([[0.1, -0.2, 0.3]])
    assert float(seen.acceleration(1, 2 * v, -v)) < 1e-12
    assert float(seen.acceleration(1, v, -v)) > 1e-3
    assert float(seen.acceleration(0, v, -v)) == float(seen.acceleration(2, v, -v)) == 0


# Gradients, on grids


def train_pass(
    field: NSFF, toy: Scene, frame: int = 3
) -> tuple[Any, dict[str, Tensor], PixelBatch]:
    """A training render of some pixels of a frame, its regularizers, and the batch."""
    b = replace(draw_pixels(toy, frame, 150, 60, torch.Generator().manual_seed(0)), seed=1)
    field.train()
    render, own = field(b)
    return render, own, b


def size(t: nn.Parameter) -> float:
    """Sum of the absolute gradients."""
    return 0.0 if t.grad is None else float(t.grad.abs().sum())


def test_the_picture_trains_both_branches_but_not_the_flow(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, b = train_pass(field, toy)
    (render.radiance - b.rgb).abs().mean().backward()
    assert size(field.branches.static_grid.table) > 0
    assert size(field.branches.dynamic_grid.table) > 0
    assert all(size(g.table) == 0 for g in field.branches.motion_grids)


def test_the_warped_picture_trains_scene_flow_and_the_neighbors_content(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, b = train_pass(field, toy)
    (render.warps[0].radiance - b.rgb).abs().mean().backward()
    forward = field.branches.motion_grids[0].table.grad.abs().sum(0)
    assert bool((forward[:3] > 0).all())
    assert float(forward[3]) == 0  # the disocclusion
    assert size(field.branches.motion_grids[1].table) == 0  # backward flow takes no part
    grid = field.branches.dynamic_grid
    coarsest = grid.table.grad[: int(grid.size[0])].abs().sum(-1)
    per_slice = coarsest.view(6, -1).sum(1)  # frame by frame
    assert float(per_slice[4]) > 0 and float(per_slice[[0, 1, 2, 3, 5]].sum()) == 0


def test_rendered_flow_trains_scene_flow_and_depth(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, b = train_pass(field, toy)
    (render.warps[0].flow - b.flow[1]).abs().mean().backward()
    assert size(field.branches.motion_grids[0].table) > 0
    assert size(field.branches.static_grid.table) > 0


def test_disocclusion_is_trained_by_the_confidence_only(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, _ = train_pass(field, toy)
    render.warps[0].confidence.sum().backward()
    grad = field.branches.motion_grids[0].table.grad
    assert float(grad[:, 3].abs().sum()) > 0 and float(grad[:, :3].abs().sum()) == 0
    assert size(field.branches.dynamic_grid.table) == 0  # rendered weights are detached


def test_a_field_learns_scene_flow_from_warped_pictures_alone() -> None:
    branches = Blob()
    truth, wrong = branches.velocity.clone(), VELOCITY * 0.6
    learned = nn.Parameter(wrong.clone())
    content = branches.dynamic

    def dynamic(c: Tensor, k: float, d: Tensor, motion: bool) -> tuple[Tensor, Tensor | None]:
        return content(c, k, d, False)[0], raw_motion(learned, -30.0).expand(len(c), 8)

    branches.dynamic = dynamic  # type: ignore[method-assign]
    field, b = blob_field(branches), batch()
    optimizer = torch.optim.Adam([learned], lr=4e-3)
    core = field(b)[0].motion > 0.99
    b = replace(b, pixels=b.pixels[core], uniform=b.uniform[core])
    for _ in range(25):
        render, _ = field(b)
        loss = sum((w.radiance - render.radiance.detach()).abs().mean() for w in render.warps)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    error, error_before = learned.detach() - truth, wrong - truth
    assert float(error[:2].norm()) < 0.3 * float(error_before[:2].norm())


def test_culled_samples_get_no_gradient_and_render_nothing(toy: Scene) -> None:
    field = random_field("grid", toy)
    field.config = replace(field.config, explore=0.0)  # type: ignore[misc]
    field.static_cells.mask[..., field.static_cells.resolution[0] // 2 :] = False  # the right half
    field.dynamic_cells.mask.zero_()
    render, own, b = train_pass(field, toy)
    render.radiance.sum().backward()
    assert own == {} and size(field.branches.dynamic_grid.table) == 0
    grid = field.branches.static_grid
    nx, ny, nz = (int(n) for n in grid.res[-1])
    columns = grid.table.grad[int(grid.offset[-1]) :].abs().sum(-1).view(nz, ny, nx).sum((0, 1))
    assert float(columns[: nx // 2].sum()) > 0 and float(columns[nx // 2 + 1 :].sum()) == 0
    right = b.pixels[:, 0] > 45
    assert float(render.opacity.detach()[right].max()) == 0
    assert float(render.depth.detach()[right].min()) > 4.9  # far


def test_motion_lies_in_the_dilated_moving_masks(toy: Scene) -> None:
    field = random_field("tiny", toy)
    f = toy.train[2]
    motion = field.render(f.camera, f.time).motion.view(f.moving.shape)
    rows, columns = f.moving.nonzero().unbind(1)
    top, left = max(rows.min() - 18, 0), max(columns.min() - 22, 0)
    far = torch.ones_like(f.moving)
    far[top : rows.max() + 18, left : columns.max() + 22] = False
    assert float(motion[f.moving].mean()) > 0.02 and float(motion[far].max()) == 0


def test_a_clip_without_movers_trains(toy: Scene) -> None:
    still = replace(toy, train=[replace(f, moving=torch.zeros_like(f.moving)) for f in toy.train])
    field = random_field("grid", still)
    render, own, _ = train_pass(field, still)
    assert own == {} and not render.motion.any()
    assert bool(torch.isfinite(render.radiance).all())
    torch.testing.assert_close(render.warps[0].radiance, render.radiance.detach())


def test_one_frame_alone_trains(toy: Scene) -> None:
    alone = replace(toy, train=[replace(toy.train[0], neighbors={}, flow={}, flow_valid={})])
    render, own, _ = train_pass(random_field("grid", alone), alone, frame=0)
    assert render.warps == () and render.scene_flow == {} and set(own) == {"disocclusion"}


def test_radiance_is_unbounded_above_and_extreme_numbers_stay_finite(toy: Scene) -> None:
    field = random_field("grid", toy)
    raw = torch.tensor([[-1e4, 0.0, 1e4]])
    radiance, density = field.to_radiance(raw), field.to_density(raw, 0.0)
    assert float(radiance[0, 2]) > 1e6 and bool(torch.isfinite(radiance).all())
    assert float(density.min()) >= 0 and bool(torch.isfinite(density).all())
    assert float(random_field("paper", toy).to_radiance(raw).max()) == 1.0
