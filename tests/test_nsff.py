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
from hdr_nsff.fields.space import build_space
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, draw_pixels
from hdr_nsff.scene.scene import Scene

W, H, FOCAL = 48, 32, 40.0
NEAR, FAR = 1.0, 8.0
VELOCITY = torch.tensor([0.08, 0.04, 0.0])  # cube per knot
START = torch.tensor([0.35, 0.4, 0.7])  # cube, of the blob at knot 0
RADIUS, WALL = 0.12, 0.2  # cube; the wall is everything beyond (disparity below) WALL
EMPTY, SOLID = -30.0, 9.0  # raw densities


class Blob(nn.Module):
    """Branches in closed form, instead of grids: a wall that stands, and a blob (or
    none) with constant scene flow both ways.
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
        return torch.cat(
            [
                2 * coords[:, :1],
                1 - coords[:, 1:2],
                coords[:, :1] * 0,
                self.density(inside),
                coords[:, :1] * 0,
            ],
            -1,
        )

    def dynamic(
        self, coords: Tensor, knot: float, directions: Tensor, motion: bool
    ) -> tuple[Tensor, Tensor | None]:
        local = coords - START - knot * self.velocity
        inside = (local.norm(dim=-1) < RADIUS) & self.blob
        brightness_drift = torch.cat([3 * local[:, :1], 2 + local[:, 1:2], 0 * local[:, :1]], -1)
        raw = torch.cat(
            [brightness_drift, self.density(inside), torch.where(inside, 30.0, -30.0)[:, None]], -1
        )
        both = torch.cat(
            [
                self.velocity,
                torch.tensor([self.disocclusion]),
                -self.velocity,
                torch.tensor([self.disocclusion]),
            ]
        )
        scale = torch.tensor(
            [20.0, 20, 20, 1, 20, 20, 20, 1]
        )  # raw flow is in units of `flow_scale`, 0.05
        return raw, (both * scale).expand(len(coords), 8) if motion else None

    @staticmethod
    def density(inside: Tensor) -> Tensor:
        return torch.where(inside, SOLID, EMPTY)[:, None]

    def param_groups(self) -> list[dict[str, Any]]:
        return []


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
    n = len(pixels)
    around = {-1: camera(neighbors[0]), 1: camera(neighbors[1])}
    return PixelBatch(
        0, time, c, 0, 0, around, pixels, torch.zeros(n, 3), torch.ones(n, dtype=torch.bool)
    )


def centroid(motion: Tensor) -> Tensor:
    """Mean pixel of dynamic content (2,)."""
    return (motion[:, None] * camera().pixel_grid()).sum(0) / motion.sum()


def test_knots_count_training_times_however_uneven() -> None:
    field = blob_field(Blob(), times=(0.0, 1.0, 3.0, 4.0))
    for time, knot in (
        (-1.0, 0.0),
        (0.0, 0.0),
        (0.5, 0.5),
        (1.0, 1.0),
        (2.0, 1.5),
        (3.5, 2.5),
        (4.0, 3.0),
        (9.0, 3.0),
    ):
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
    torch.testing.assert_close(
        r.depth[wall], torch.full_like(r.depth[wall], face), rtol=0.05, atol=0
    )
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
    for warp, shift in (
        (forward, 0.1),
        (backward, -0.1),
    ):  # the camera goes right by `shift`, the wall goes left
        torch.testing.assert_close(
            warp.flow[:, 0], -FOCAL * shift / render.depth, atol=1e-3, rtol=1e-3
        )
        assert float(warp.flow[:, 1].abs().max()) < 1e-3
    assert float(render.motion.max()) < 1e-3


def test_flow_into_the_neighbors_camera_adds_motion_and_parallax() -> None:
    field = blob_field(Blob())
    render, _ = field(batch(neighbors=(0.1, 0.1)))  # nobody moves but the blob
    blob = render.motion > 0.99
    ends = [camera(0.1).project(field.space.decode(START + k * VELOCITY))[0] for k in (1, 2)]
    torch.testing.assert_close(
        render.warps[0].flow[blob].mean(0), ends[1] - ends[0], atol=0.3, rtol=0
    )
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
    assert float(own["cycle"]) < 1e-6
    assert float(own["disocclusion"]) < 1e-6


def test_two_steps_along_the_flow_see_the_same_too() -> None:
    render, _ = blob_field(Blob())(replace(batch(time=0.0), chain=1))
    chained = [w for w in render.warps if w.offset == 2]
    blob = render.motion > 0.99
    torch.testing.assert_close(
        chained[0].radiance[blob], render.radiance[blob], atol=0.02, rtol=0.02
    )


def test_content_that_ignores_its_flow_looks_different() -> None:
    lying = Blob()
    dynamic = lying.dynamic
    lying.dynamic = lambda c, k, d, motion: (
        dynamic(c, 1.0, d, False)[0],
        dynamic(c, k, d, motion)[1],
    )  # type: ignore[method-assign]
    render, _ = blob_field(lying)(batch())  # stands still, but says it moves
    blob = render.motion > 0.99
    assert float((render.warps[0].radiance[blob] - render.radiance[blob]).abs().mean()) > 0.1


def test_confidence_is_one_minus_the_rendered_disocclusion() -> None:
    render, own = blob_field(Blob(disocclusion=0.0))(batch())  # sigmoid(0) = a half
    torch.testing.assert_close(
        render.warps[0].confidence, 1 - 0.5 * render.motion, atol=1e-4, rtol=0
    )
    assert float(own["disocclusion"]) == 0.5


def test_steady_flow_in_a_frustum_costs_little_kinetic_energy_and_a_bend_costs_more() -> None:
    steady = blob_field(Blob())(batch())[1]["kinetic"]
    bent = Blob()
    dynamic = bent.dynamic

    def back_is_forth(c: Tensor, k: float, d: Tensor, motion: bool) -> tuple[Tensor, Tensor | None]:
        raw, flows = dynamic(c, k, d, motion)
        return raw, None if flows is None else torch.cat([flows[:, :4], flows[:, :4]], -1)

    bent.dynamic = back_is_forth  # type: ignore[method-assign]
    assert float(steady) < 0.01 * float(blob_field(bent)(batch())[1]["kinetic"])


# Gradients, on grids


def pass_of(field: NSFF, toy: Scene, frame: int = 3) -> tuple[Any, dict[str, Tensor], PixelBatch]:
    b = replace(draw_pixels(toy, frame, 150, 60, torch.Generator().manual_seed(0)), seed=1)
    field.train()
    render, own = field(b)
    return render, own, b


def size(t: nn.Parameter) -> float:
    return 0.0 if t.grad is None else float(t.grad.abs().sum())


def test_the_picture_teaches_both_branches_but_not_the_flow(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, b = pass_of(field, toy)
    (render.radiance - b.rgb).abs().mean().backward()
    assert (
        size(field.branches.static_grid.table) > 0 and size(field.branches.dynamic_grid.table) > 0
    )
    assert all(size(g.table) == 0 for g in field.branches.motion_grids)


def test_the_warped_picture_teaches_scene_flow_and_the_neighbors_content(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, b = pass_of(field, toy)
    (render.warps[0].radiance - b.rgb).abs().mean().backward()
    forward = field.branches.motion_grids[0].table.grad.abs().sum(0)
    assert (
        bool((forward[:3] > 0).all()) and float(forward[3]) == 0
    )  # the flow itself, not the disocclusion
    assert size(field.branches.motion_grids[1].table) == 0  # the way back has no part in it
    grid = field.branches.dynamic_grid
    per_slice = (
        grid.table.grad[: int(grid.size[0])].abs().sum(-1).view(6, -1).sum(1)
    )  # the coarsest level, frame by frame
    assert float(per_slice[4]) > 0 and float(per_slice[[0, 1, 2, 3, 5]].sum()) == 0


def test_rendered_flow_teaches_scene_flow_and_depth(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, b = pass_of(field, toy)
    (render.warps[0].flow - b.flow[1]).abs().mean().backward()
    assert (
        size(field.branches.motion_grids[0].table) > 0
        and size(field.branches.static_grid.table) > 0
    )


def test_disocclusion_is_taught_by_the_confidence_only(toy: Scene) -> None:
    field = random_field("grid", toy)
    render, _, _ = pass_of(field, toy)
    render.warps[0].confidence.sum().backward()
    grad = field.branches.motion_grids[0].table.grad
    assert float(grad[:, 3].abs().sum()) > 0 and float(grad[:, :3].abs().sum()) == 0
    assert size(field.branches.dynamic_grid.table) == 0  # rendered weights take part as numbers


def test_a_field_learns_the_way_things_went_from_warped_pictures_alone() -> None:
    branches = Blob()
    truth, wrong = branches.velocity.clone(), VELOCITY * 0.6
    learned = nn.Parameter(wrong.clone())
    content = branches.dynamic

    def dynamic(c: Tensor, k: float, d: Tensor, motion: bool) -> tuple[Tensor, Tensor | None]:
        both = torch.cat(
            [learned * 20, torch.tensor([-30.0]), -learned * 20, torch.tensor([-30.0])]
        )
        return content(c, k, d, False)[0], both.expand(len(c), 8) if motion else None

    branches.dynamic = dynamic  # type: ignore[method-assign]
    field, optimizer, b = blob_field(branches), torch.optim.Adam([learned], lr=4e-3), batch()
    core = field(b)[0].motion > 0.99
    b = replace(b, pixels=b.pixels[core], uniform=b.uniform[core])
    for _ in range(25):
        render, _ = field(b)
        loss = sum((w.radiance - render.radiance.detach()).abs().mean() for w in render.warps)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float((learned.detach() - truth)[:2].norm()) < 0.3 * float((wrong - truth)[:2].norm())


def test_culled_samples_get_no_gradient_and_nothing_is_seen_there(toy: Scene) -> None:
    field = random_field("grid", toy)
    field.config = replace(field.config, explore=0.0)  # type: ignore[misc]
    field.static_cells.mask[..., field.static_cells.resolution[0] // 2 :] = False  # the right half
    field.dynamic_cells.mask.zero_()
    render, own, b = pass_of(field, toy)
    render.radiance.sum().backward()
    assert own == {} and size(field.branches.dynamic_grid.table) == 0
    grid = field.branches.static_grid
    nx, ny, nz = (int(n) for n in grid.res[-1])
    columns = grid.table.grad[int(grid.offset[-1]) :].abs().sum(-1).view(nz, ny, nx).sum((0, 1))
    assert float(columns[: nx // 2].sum()) > 0 and float(columns[nx // 2 + 1 :].sum()) == 0
    right = b.pixels[:, 0] > 45
    assert (
        float(render.opacity.detach()[right].max()) == 0
        and float(render.depth.detach()[right].min()) > 4.9
    )  # far


def test_masks_say_where_motion_may_be(toy: Scene) -> None:
    field = random_field("tiny", toy)
    f = toy.train[2]
    motion = field.render(f.camera, f.time).motion.view(f.moving.shape)
    rows, columns = f.moving.nonzero().unbind(1)
    far = torch.ones_like(f.moving)
    far[
        max(rows.min() - 18, 0) : rows.max() + 18, max(columns.min() - 22, 0) : columns.max() + 22
    ] = False
    assert float(motion[f.moving].mean()) > 0.02 and float(motion[far].max()) == 0


def test_a_clip_in_which_nothing_moves_trains(toy: Scene) -> None:
    still = replace(toy, train=[replace(f, moving=torch.zeros_like(f.moving)) for f in toy.train])
    field = random_field("grid", still)
    render, own, _ = pass_of(field, still)
    assert own == {} and not render.motion.any()
    assert bool(torch.isfinite(render.radiance).all())
    torch.testing.assert_close(render.warps[0].radiance, render.radiance.detach())


def test_one_frame_alone_trains(toy: Scene) -> None:
    alone = replace(toy, train=[replace(toy.train[0], neighbors={}, flow={}, flow_valid={})])
    render, own, _ = pass_of(random_field("grid", alone), alone, frame=0)
    assert render.warps == () and render.scene_flow == {} and set(own) == {"disocclusion"}


def test_radiance_is_unbounded_above_and_extreme_numbers_stay_finite(toy: Scene) -> None:
    field = random_field("grid", toy)
    raw = torch.tensor([[-1e4, 0.0, 1e4]])
    assert float(field.to_radiance(raw)[0, 2]) > 1e6 and bool(
        torch.isfinite(field.to_radiance(raw)).all()
    )
    assert (
        bool(torch.isfinite(field.to_density(raw, 0.0)).all())
        and float(field.to_density(raw, 0.0).min()) >= 0
    )
    assert float(random_field("paper", toy).to_radiance(raw).max()) == 1.0
