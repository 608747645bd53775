"""A field of Gaussians: exact flows of what moves, gradients and their reach, and what
is drawn where nothing is.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from estimates import with_movers
from presets import small, trainer
from torch import Tensor
from toy_scene import CARD, card_offset

from hdr_nsff.fields import start_field
from hdr_nsff.fields.base import RadianceField
from hdr_nsff.fields.splat.gaussians import BRIGHTEST
from hdr_nsff.fields.splat.splat import Splat, SplatConfig, picked
from hdr_nsff.fields.splat.trajectories import WINDOW
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, whole_frame
from hdr_nsff.scene.scene import Scene

TIMES = 10
STEP = torch.tensor([0.05, 0.02, 0.03])  # scene units from one time to the next
CAMERA = Camera(torch.tensor([[60.0, 0, 20], [0, 60, 15], [0, 0, 1]]), torch.eye(4)[:3], 40, 30)
BESIDE = CAMERA.moved(torch.tensor([[1.0, 0, 0, 0.2], [0, 1, 0, -0.1], [0, 0, 1, 0.05]]))


def card_field(bases: int = 2) -> Splat:
    """A card of opaque Gaussians at z = 2 that moves by `STEP`, in front of a wall at z
    = 4 that fills the view.
    """
    field = Splat(
        SplatConfig(static=33 * 25, moving=121, bases=bases), torch.arange(TIMES), 1.0, 6.0, 1200
    )
    with torch.no_grad():
        for gaussians, wide, high, z, space in (
            (field.static, 33, 25, 4.0, 0.1),
            (field.moving, 11, 11, 2.0, 0.04),
        ):
            y, x = torch.meshgrid(
                torch.arange(high) - high // 2, torch.arange(wide) - wide // 2, indexing="ij"
            )
            gaussians.means[:] = torch.stack(
                [x * space, y * space, torch.full_like(x, 0) + z], -1
            ).reshape(-1, 3)
            gaussians.log_scales[:] = math.log(space)
            gaussians.log_scales[:, 2] = math.log(1e-3)  # flat
            gaussians.logits[:] = 6.0
        field.moving.log_radiance[:] = torch.tensor([1.0, 0.0, -1.0])
        shifts = field.trajectories.shifts.view(TIMES, bases, 4)
        shifts[:, :, :3] = torch.arange(TIMES)[:, None, None] * STEP
        field.background[:] = math.log(0.3)
    return field


def batch_of(knot: int, offset: int, seed: int = 0) -> PixelBatch:
    """The whole picture at a time; flow is asked for towards one neighbor, seen from
    `BESIDE`.
    """
    pixels = CAMERA.pixel_grid()
    gray, flow = torch.full((len(pixels), 3), 0.5), {offset: torch.zeros(len(pixels), 2)}
    every = torch.ones(len(pixels), dtype=torch.bool)
    return PixelBatch(
        knot, float(knot), CAMERA, 0, 0, {offset: BESIDE}, pixels, gray, every, seed=seed, flow=flow
    )


def pixel_of(point: Tensor) -> int:
    """Which pixel of `CAMERA` a point lies in, row by row."""
    x, y = CAMERA.project(point)[0].long().tolist()
    return y * CAMERA.width + x


def scattered(
    seed: int = 0, static: int = 40, moving: int = 30, view_dependence: bool = False
) -> Splat:
    """Anything anywhere in view, with something in every parameter."""
    config = SplatConfig(static=static, moving=moving, bases=3, view_dependence=view_dependence)
    field = Splat(config, torch.arange(TIMES), 1.0, 6.0, 1200)
    generator = torch.Generator().manual_seed(seed)
    for p in field.parameters():
        p.data.add_(0.1 * torch.randn(p.shape, generator=generator))
    for g in (field.static, field.moving):
        place = torch.rand(len(g), 3, generator=generator)
        g.means.data = (place - 0.5) * torch.tensor([1.0, 0.8, 2.0]) + torch.tensor([0.0, 0, 3.0])
        g.log_scales.data.fill_(-2.0).add_(0.2 * torch.randn(len(g), 3, generator=generator))
        g.logits.data.fill_(0.0)
    return field


def test_scene_flow_at_the_card_is_its_step() -> None:
    render = card_field().render(CAMERA, 4.0)
    at = pixel_of(torch.tensor([0.0, 0, 2]) + 4 * STEP)
    torch.testing.assert_close(render.scene_flow[1][at], STEP, atol=1e-3, rtol=0)
    torch.testing.assert_close(render.scene_flow[-1][at], -STEP, atol=1e-3, rtol=0)
    assert float(render.depth[at]) == pytest.approx(2 + 4 * 0.03, abs=0.01)
    assert float(render.motion[at]) > 0.99 and float(render.motion[0]) < 0.01
    assert float(render.scene_flow[1][0].abs().max()) < 1e-3  # the wall


@pytest.mark.parametrize("time", [0.0, 9.0, 8.5, 0.5])
def test_at_the_ends_of_the_clip_scene_flow_goes_straight_on(time: float) -> None:
    render = card_field().render(CAMERA, time)
    at = pixel_of(torch.tensor([0.0, 0, 2]) + time * STEP)
    torch.testing.assert_close(render.scene_flow[1][at], STEP, atol=1e-3, rtol=0)
    torch.testing.assert_close(render.scene_flow[-1][at], -STEP, atol=1e-3, rtol=0)


@pytest.mark.parametrize("offset", [1, -1])
def test_flow_to_the_neighbor_is_the_projected_displacement(offset: int) -> None:
    render, _ = card_field()(batch_of(4, offset))
    (warp,) = render.warps
    z = 2 + 4 * 0.03
    at = pixel_of(torch.tensor([0.0, 0, 2]) + 4 * STEP)
    card, wall = (
        CAMERA.rays(CAMERA.pixel_grid()[k]).directions * depth for k, depth in ((at, z), (0, 4.0))
    )
    card_flow = BESIDE.project(card + offset * STEP)[0] - CAMERA.pixel_grid()[at]
    wall_flow = BESIDE.project(wall)[0] - CAMERA.pixel_grid()[0]
    assert (
        warp.offset == offset and warp.radiance is None and warp.confidence.tolist() == [1.0] * 1200
    )
    torch.testing.assert_close(
        warp.flow.detach()[at], card_flow, atol=0.1, rtol=0
    )  # Gaussians up to two pixels off shine through
    torch.testing.assert_close(warp.flow.detach()[0], wall_flow, atol=0.1, rtol=0)


def test_flow_through_a_faint_card_is_the_same() -> None:
    field = card_field()
    field.static.logits.data[:] = -20.0
    full, faint = [], []
    for logit, flows in ((6.0, full), (-3.0, faint)):
        field.moving.logits.data[:] = logit
        render = field(batch_of(4, 1))[0]
        flows += [render.warps[0].flow.detach(), render.opacity.detach()]
    at = pixel_of(torch.tensor([0.0, 0, 2]) + 4 * STEP)
    assert float(full[1][at]) > 0.99 and 0.1 < float(faint[1][at]) < 0.6
    torch.testing.assert_close(faint[0][at], full[0][at], atol=0.1, rtol=0)


def test_flow_to_one_side_and_rigidity_take_turns_as_the_seed_says() -> None:
    batch = batch_of(4, 1)
    both = replace(
        batch, neighbors={1: BESIDE, -1: BESIDE}, flow={o: batch.flow[1] for o in (1, -1)}
    )
    seen = [card_field()(replace(both, seed=s)) for s in range(5)]
    assert [[w.offset for w in render.warps] for render, _ in seen] == [[1], [], [-1], [], [1]]
    assert ["rigidity" in own for _, own in seen] == [False, True, False, True, False]
    assert card_field()(replace(both, flow={}))[0].warps == ()


def test_fractional_times_lie_between() -> None:
    field = card_field()
    for time in (3.25, 3.5, 3.75):
        at = field.positions(time).detach()
        low, high = (field.positions(k).detach() for k in (3.0, 4.0))
        torch.testing.assert_close(at, torch.lerp(low, high, time - 3))
    columns = torch.arange(1200) % 40
    middles = [
        float((r.motion * columns).sum() / r.motion.sum())
        for r in (field.render(CAMERA, t) for t in (3.0, 3.5, 4.0))
    ]
    assert middles[0] < middles[1] < middles[2]
    assert middles[1] == pytest.approx((middles[0] + middles[2]) / 2, abs=0.05)


def test_times_may_be_uneven() -> None:
    field = card_field()
    field.times[:] = torch.tensor([0.0, 1, 2, 3, 7, 8, 9, 10, 11, 12])
    torch.testing.assert_close(
        field.positions(field.knot(5.0)),
        torch.lerp(field.positions(3.0), field.positions(4.0), 0.5),
    )


@pytest.mark.parametrize("seed", range(3))
def test_shares_stay_between_0_and_1(seed: int) -> None:
    field = scattered(seed)
    for gaussians in (field.static, field.moving):
        gaussians.logits.data.fill_(9.0)
    r = field.render(CAMERA, 2.3)
    assert (
        float(r.motion.min()) >= 0 and float(r.motion.max()) <= float(r.opacity.max()) <= 1 + 1e-5
    )
    assert bool((r.motion <= r.opacity + 1e-5).all()) and float(r.motion.max()) > 0.5


def test_gradients_reach_every_parameter() -> None:
    field = scattered(view_dependence=True)
    render, own = field(batch_of(4, 1))
    total = (
        render.radiance.square().sum()
        + render.depth.sum()
        + render.motion.sum()
        + render.warps[0].flow.square().sum()
    )
    (total + sum(own.values())).backward()
    for name, p in field.named_parameters():
        assert (
            p.grad is not None and torch.isfinite(p.grad).all() and float(p.grad.abs().max()) > 0
        ), name


def test_a_step_moves_only_the_poses_near_the_drawn_frame(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    long = replace(
        toy, train=[replace(toy.train[i % 6], time=float(i), neighbors={}) for i in range(12)]
    )
    long = with_movers(replace(long, train=[replace(f, index=i) for i, f in enumerate(long.train)]))
    t = trainer(small("splat", toy_folder, tmp_path / "run"), long)
    field = t.field
    assert isinstance(field, Splat)
    trajectories = field.trajectories
    for frame in (10, 2):  # the first step leaves momentum behind, which the second must not act on
        before = [p.detach().clone() for p in (trajectories.turns, trajectories.shifts)]
        t.draw = lambda slot, k=frame: whole_frame(t.scene, k)  # type: ignore[method-assign, misc]
        t.step()
    for p, old in zip((trajectories.turns, trajectories.shifts), before, strict=True):
        moved = (p.detach() != old).view(12, -1).any(1).nonzero()[:, 0].tolist()
        assert moved and set(moved) <= set(range(2 + WINDOW + 1)) and 2 in moved
        assert float(p.grad.abs().max()) == 0  # a step clears what it used


def test_invisible_gaussians_are_left_alone_by_the_regularizers() -> None:
    field = scattered()
    field.static.logits.data[:10] = -10.0
    own = field.regularizers(field.cloud(3.0), 3.0)
    (own["opacity"] + own["scale"]).backward()
    for g in (field.static.logits.grad, field.static.log_scales.grad):
        assert g is not None and float(g[:10].abs().max()) == 0 and float(g[10:].abs().min()) > 0
    field.static.log_scales.data[:10] += 5.0
    torch.testing.assert_close(field.regularizers(field.cloud(3.0), 3.0)["scale"], own["scale"])


def test_the_regularizers_of_a_plain_field_by_hand() -> None:
    field = card_field()
    own = {k: float(v.detach()) for k, v in field.regularizers(field.cloud(3.0), 3.0).items()}
    assert own["opacity"] == pytest.approx(1 / (1 + math.exp(-6)))
    assert own["scale"] == pytest.approx(
        (825 * (0.2 + 1e-3) + 121 * (0.08 + 1e-3)) / 3 / 946, rel=1e-5
    )  # near is 1
    assert (
        own["trajectory"] < 1e-12 and own["brightness_drift"] == own["color_change"] == 0
    )  # even steps, constant colors
    # up and down between 7 times: 2 of 6 differences; 1 of 7 times
    field.moving.offsets.data[3] = 2.0
    assert float(
        field.regularizers(field.cloud(3.0), 3.0)["color_change"].detach()
    ) == pytest.approx(4 * 2 / 6 + 0.01 * 4 / 7)


@pytest.mark.parametrize(
    "config",
    [{"moving": 0}, {"static": 0}, {"color_knots": 1, "opacity_knots": 1, "brightness_knots": 1}],
)
def test_a_field_may_lack_a_kind_of_gaussian_or_all_change(config: dict[str, int]) -> None:
    field = Splat(
        replace(SplatConfig(static=20, moving=20), **config), torch.arange(TIMES), 1.0, 6.0, 1200
    )
    render, own = field(batch_of(4, 1))
    (render.radiance.sum() + sum(own.values())).backward()
    assert all(torch.isfinite(v) for v in own.values())
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in field.parameters())


def test_moving_gaussians_come_and_go() -> None:
    field = card_field()
    field.opacity_offsets.data[:7] = -20.0  # 13 knots over 10 times: gone until the middle
    before, after = field.render(CAMERA, 3.0), field.render(CAMERA, 8.0)
    assert float(before.motion.max()) < 0.01 and float(after.motion.max()) > 0.99
    assert field.gaussians(3.0).motion.sum() == 0 and field.gaussians(8.0).motion.sum() == 121


def test_chosen_pixels_are_the_whole_picture_at_them() -> None:
    field, pixels = scattered(), torch.tensor([[39.5, 29.5], [0.5, 0.5], [7.5, 12.5], [7.5, 12.5]])
    index = torch.tensor([1199, 0, 12 * 40 + 7, 12 * 40 + 7])
    whole, some = field.render(CAMERA, 3.3), field.render(CAMERA, 3.3, pixels)
    for name in ("radiance", "depth", "opacity", "motion"):
        assert torch.equal(getattr(some, name), getattr(whole, name)[index])
    assert all(torch.equal(some.scene_flow[o], whole.scene_flow[o][index]) for o in (1, -1))
    batch = batch_of(3, 1)
    trained, part = field(batch)[0], field(replace(batch, pixels=pixels))[0]
    assert torch.equal(part.warps[0].flow, trained.warps[0].flow[index]) and len(part.radiance) == 4
    assert torch.equal(part.warps[0].confidence, trained.warps[0].confidence[index])


def test_the_whole_picture_out_of_order_is_put_in_order_asked_for() -> None:
    render, grid = scattered().render(CAMERA, 3.0), CAMERA.pixel_grid()
    assert picked(render, CAMERA, grid) is render
    assert torch.equal(picked(render, CAMERA, grid.flip(0)).radiance, render.radiance.flip(0))


def test_the_background_shows_where_nothing_is() -> None:
    field = Splat(SplatConfig(static=5, moving=5), torch.arange(TIMES), 1.0, 6.0, 1200)
    field.background.data = torch.tensor([0.3, 1.0, 20.0]).log()
    render = field.render(CAMERA, 2.0)
    torch.testing.assert_close(render.radiance, torch.tensor([0.3, 1.0, 20.0]).expand(1200, 3))
    assert float(render.opacity.max()) == float(
        render.motion.max()
    ) == 0 and render.depth.unique().tolist() == [6.0]
    assert len(field.gaussians(2.0).means) == 0


def test_huge_log_radiance_stays_finite() -> None:
    field = card_field()
    for p in (
        field.background,
        field.static.log_radiance,
        field.moving.log_radiance,
        field.moving.offsets,
    ):
        p.data += 1e4
    render, own = field(batch_of(4, 1))
    assert float(render.radiance.detach().max()) == pytest.approx(math.exp(BRIGHTEST), rel=0.01)
    (render.radiance.log1p().sum() + render.depth.sum() + sum(own.values())).backward()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in field.parameters())


@pytest.mark.parametrize("z", [0.0, -1.0, 1e-9, 1e6])
def test_gaussians_behind_or_in_the_camera_give_finite_flow_and_gradients(z: float) -> None:
    field = scattered()
    field.moving.means.data[:5, 2] = z
    render, own = field(batch_of(4, 1))
    (render.radiance.sum() + render.warps[0].flow.sum() + sum(own.values())).backward()
    assert torch.isfinite(render.warps[0].flow).all()
    assert all(p.grad is None or torch.isfinite(p.grad).all() for p in field.parameters())


def test_the_cloud_is_what_render_draws() -> None:
    field = card_field()
    field.static.logits.data[:25] = -20.0
    cloud = field.gaussians(4.5)
    assert len(cloud.means) == 33 * 25 - 25 + 121 and cloud.motion.sum() == 121
    torch.testing.assert_close(cloud.means[-121:].mean(0), torch.tensor([0.0, 0, 2]) + 4.5 * STEP)
    torch.testing.assert_close(cloud.radiance[-1], torch.tensor([1.0, 0, -1]).exp())


def test_one_training_time_has_no_flow() -> None:
    field = Splat(SplatConfig(static=20, moving=20, bases=1), torch.zeros(1), 1.0, 6.0, 1200)
    for g in (field.static, field.moving):
        g.means.data[:, 2], g.logits.data[:], g.log_scales.data[:] = 2.0, 0.0, -2.0
    assert isinstance(field, RadianceField)
    render = field.render(CAMERA, 0.7)
    assert float(render.scene_flow[1].abs().max()) == float(render.scene_flow[-1].abs().max()) == 0
    assert float(render.motion.max()) > 0.1 and torch.isfinite(
        field(replace(batch_of(0, 1), flow={}))[1]["trajectory"]
    )


def test_colors_change_over_the_clip_and_static_ones_in_brightness_only() -> None:
    field = card_field()
    field.moving.offsets.data = torch.linspace(0, 1, 7)[:, None, None] * torch.tensor(
        [1.0, 0.0, -1.0]
    ).expand(121, 3)
    field.static.offsets.data = torch.linspace(0, 2, 5)[:, None, None].expand(5, 825, 1).clone()
    early, late = field.gaussians(0.0).radiance.log(), field.gaussians(9.0).radiance.log()
    torch.testing.assert_close((late - early)[-1], torch.tensor([1.0, 0.0, -1.0]))
    torch.testing.assert_close((late - early)[0], torch.tensor([2.0, 2.0, 2.0]))
    middle = field.gaussians(4.5).radiance.log()
    torch.testing.assert_close(middle, (early + late) / 2)


def test_a_trained_start_knows_the_cards_flow(toy: Scene) -> None:
    field = Splat(
        SplatConfig(static=1500, moving=400, bases=2), toy.times, toy.near, toy.far, 60 * 34
    )
    start_field(field, toy, lambda rgb, i: rgb + 0.1, 0.0, True)
    f = toy.train[2]
    offset = card_offset(2.0)
    pixel = f.camera.project(torch.tensor([*offset, CARD], dtype=torch.float32))[0]
    step = np.array([*(card_offset(3.0) - offset), 0])
    flow = field.render(f.camera, 2.0, pixel[None]).scene_flow[1][0].numpy()
    assert flow == pytest.approx(step, abs=0.03)


def test_a_picture_without_scene_flow_is_the_same_picture() -> None:
    field = scattered()
    whole, plain = field.render(CAMERA, 3.3), field.render(CAMERA, 3.3, scene_flow=False)
    assert set(whole.scene_flow) == {1, -1} and plain.scene_flow == {}
    for name in ("radiance", "depth", "opacity", "motion"):
        torch.testing.assert_close(getattr(plain, name), getattr(whole, name))


def test_flow_with_a_camera_that_learns_reaches_its_pose() -> None:
    field, batch = card_field(), batch_of(4, 1)
    pose = BESIDE.c2w.clone().requires_grad_()
    moved = field.displacements(
        replace(batch, neighbors={1: BESIDE.moved(pose)}), field.cloud(4.0).means, 4.0, 1
    )
    torch.testing.assert_close(moved, field.displacements(batch, field.cloud(4.0).means, 4.0, 1))
    moved[:, 0].sum().backward()
    assert (
        pose.grad is not None and float(pose.grad[0, 3]) < 0
    )  # a camera that goes right sees everything go left


def test_neighbors_that_mix_alike_are_rigid_and_others_pay() -> None:
    field = card_field()  # all mixtures alike; a grid of 11 x 11 Gaussians
    field.find_neighbors()
    assert set(field.neighbors[60].tolist()) == {49, 59, 61, 71}  # the middle one's four
    assert float(field.rigidity().detach()) == 0
    field.mixture_logits.data[:, 60] = torch.tensor(
        [1.0, -1.0]
    )  # 0.8808 and 0.1192 instead of halves
    pairs = (
        int((field.neighbors == 60).sum()) + 4
    )  # it looks at its four neighbors, and some look at it
    assert float(field.rigidity().detach()) == pytest.approx(
        pairs * 2 * 0.3808**2 / (121 * 4 * 2), rel=1e-3
    )
    field.rigidity().backward()
    assert field.mixture_logits.grad is not None and float(field.mixture_logits.grad[0, 60]) > 0


def test_colors_depend_on_the_direction_of_view_only_where_wanted() -> None:
    plain, shiny = (
        Splat(SplatConfig(1, 0, view_dependence=v), torch.arange(2), 1.0, 6.0, 1200)
        for v in (False, True)
    )
    assert plain.static.sh1.numel() == 0
    with torch.no_grad():
        for field in (plain, shiny):
            field.static.means[:] = torch.tensor([0.0, 0.0, 2.0])
            field.static.log_scales[:], field.static.logits[:] = 0.0, 9.0
        shiny.static.sh1[0, 1, 0] = 1.0  # green grows to the right
        beside = CAMERA.moved(
            torch.tensor([[0.8, 0, 0.6, -1.5], [0, 1, 0, 0], [-0.6, 0, 0.8, 0]])
        )  # sees it along (0.6, 0, 0.8)
        middle = torch.tensor([[20.0, 15.0]])
        for camera, direction in ((CAMERA, 0.0), (beside, 0.6)):
            ratio = (
                shiny.render(camera, 0.0, middle).radiance
                / plain.render(camera, 0.0, middle).radiance
            )
            torch.testing.assert_close(
                ratio[0], torch.tensor([1.0, math.exp(direction), 1.0]), atol=2e-3, rtol=2e-3
            )
