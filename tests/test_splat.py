"""A field of Gaussians: exact flows of a moving card, gradients and their reach, the
background.
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

from hdr_nsff.fields.build import initialize_field
from hdr_nsff.fields.outputs import select_pixels
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.gaussians import MAX_LOG_RADIANCE, Gaussians
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.fields.splat.terms import mixture_difference, regularizers
from hdr_nsff.fields.splat.training_view import TrainingView, flow_to_neighbor
from hdr_nsff.fields.splat.trajectories import WINDOW
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, Recorder, whole_frame
from hdr_nsff.scene.scene import Scene

TIMES = 10
STEP = torch.tensor([0.05, 0.02, 0.03])  # scene units from one time to the next
CAMERA = Camera(torch.tensor([[60.0, 0, 20], [0, 60, 15], [0, 0, 1]]), torch.eye(4)[:3], 40, 30)
BESIDE = CAMERA.moved(torch.tensor([[1.0, 0, 0, 0.2], [0, 1, 0, -0.1], [0, 0, 1, 0.05]]))


def card_field(bases: int = 2, times: int = TIMES) -> Splat:
    """A card of opaque Gaussians at z = 2 that moves by `STEP`, in front of a wall at z
    = 4 that fills the view.
    """
    config = SplatConfig(static=33 * 25, moving=121, bases=bases)
    field = Splat(config, torch.arange(times), 1.0, 6.0, 1200)
    with torch.no_grad():
        tile_plane(field.static, 33, 25, z=4.0, spacing=0.1)
        tile_plane(field.moving, 11, 11, z=2.0, spacing=0.04)
        field.moving.log_radiance[:] = torch.tensor([1.0, 0.0, -1.0])
        shifts = field.trajectories.translations.view(times, bases, 4)
        shifts[:, :, :3] = torch.arange(times)[:, None, None] * STEP
        field.background[:] = math.log(0.3)
    return field


def tile_plane(gaussians: Gaussians, columns: int, rows: int, z: float, spacing: float) -> None:
    """Place flat opaque Gaussians on a grid about the optical axis."""
    y, x = torch.meshgrid(
        torch.arange(rows) - rows // 2, torch.arange(columns) - columns // 2, indexing="ij"
    )
    points = torch.stack([x * spacing, y * spacing, torch.full(x.shape, z)], -1)
    gaussians.means[:] = points.reshape(-1, 3)
    gaussians.log_scales[:] = math.log(spacing)
    gaussians.log_scales[:, 2] = math.log(1e-3)  # flat
    gaussians.opacity_logits[:] = 6.0


def batch_of(knot: int, offset: int, seed: int = 0) -> PixelBatch:
    """The whole picture at a time, with flow to a neighbor whose camera is `BESIDE`."""
    pixels = CAMERA.pixel_grid()
    gray, every = torch.full((len(pixels), 3), 0.5), torch.ones(len(pixels), dtype=torch.bool)
    batch = PixelBatch(knot, float(knot), CAMERA, 0, 0, {offset: BESIDE}, pixels, gray, every)
    return replace(batch, seed=seed, flow={offset: torch.zeros(len(pixels), 2)})


def pixel_of(point: Tensor) -> int:
    """The pixel of `CAMERA` that a point lies in, counted row by row."""
    x, y = CAMERA.project(point)[0].long().tolist()
    return y * CAMERA.width + x


def scattered(
    seed: int = 0, static: int = 40, moving: int = 30, view_dependence: bool = False
) -> Splat:
    """Random Gaussians in view, no parameter of which is 0."""
    views = view_dependence
    config = SplatConfig(static=static, moving=moving, local=20, bases=3, view_dependence=views)
    field = Splat(config, torch.arange(TIMES), 1.0, 6.0, 1200)
    generator = torch.Generator().manual_seed(seed)
    for p in field.parameters():
        p.data.add_(0.1 * torch.randn(p.shape, generator=generator))
    for g in (field.static, field.moving):
        place = torch.rand(len(g), 3, generator=generator)
        g.means.data = (place - 0.5) * torch.tensor([1.0, 0.8, 2.0]) + torch.tensor([0.0, 0, 3.0])
        g.log_scales.data.fill_(-2.0).add_(0.2 * torch.randn(len(g), 3, generator=generator))
        g.opacity_logits.data.fill_(0.0)
    local = field.local
    place = torch.rand(len(local), 3, generator=generator)
    local.means.data[:, :3] = (place - 0.5) + torch.tensor([0.0, 0, 3.0])
    local.means.data[:, 3] = 3.0
    local.log_scales.data[:, :3].fill_(-2.0)
    local.log_scales.data[:, 3] = 1.0
    local.colors.data[:, 3] = 0.0
    local.find_neighbors(1.0)
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
def test_at_the_ends_of_the_clip_scene_flow_continues_straight(time: float) -> None:
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
    card = CAMERA.rays(CAMERA.pixel_grid()[at]).directions * z
    wall = CAMERA.rays(CAMERA.pixel_grid()[0]).directions * 4.0
    card_flow = BESIDE.project(card + offset * STEP)[0] - CAMERA.pixel_grid()[at]
    wall_flow = BESIDE.project(wall)[0] - CAMERA.pixel_grid()[0]
    assert warp.offset == offset and warp.radiance is None
    assert warp.confidence.tolist() == [1.0] * 1200
    # 0.1: Gaussians up to two pixels off shine through
    torch.testing.assert_close(warp.flow.detach()[at], card_flow, atol=0.1, rtol=0)
    torch.testing.assert_close(warp.flow.detach()[0], wall_flow, atol=0.1, rtol=0)


def test_flow_through_a_faint_card_is_the_same() -> None:
    field = card_field()
    field.static.opacity_logits.data[:] = -20.0
    full, faint = [], []
    for logit, flows in ((6.0, full), (-3.0, faint)):
        field.moving.opacity_logits.data[:] = logit
        render = field(batch_of(4, 1))[0]
        flows += [render.warps[0].flow.detach(), render.opacity.detach()]
    at = pixel_of(torch.tensor([0.0, 0, 2]) + 4 * STEP)
    assert float(full[1][at]) > 0.99 and 0.1 < float(faint[1][at]) < 0.6
    torch.testing.assert_close(faint[0][at], full[0][at], atol=0.1, rtol=0)


def test_flow_to_one_side_and_rigidity_take_turns_by_the_seed() -> None:
    batch = batch_of(4, 1)
    flow = {1: batch.flow[1], -1: batch.flow[1]}
    both = replace(batch, neighbors={1: BESIDE, -1: BESIDE}, flow=flow)
    passes = [card_field()(replace(both, seed=s)) for s in range(5)]
    assert [[w.offset for w in render.warps] for render, _ in passes] == [[1], [], [-1], [], [1]]
    assert ["rigidity" in own for _, own in passes] == [False, True, False, True, False]
    assert card_field()(replace(both, flow={}))[0].warps == ()


@pytest.mark.parametrize("seed", range(3))
def test_shares_stay_between_0_and_1(seed: int) -> None:
    field = scattered(seed)
    for gaussians in (field.static, field.moving):
        gaussians.opacity_logits.data.fill_(9.0)
    r = field.render(CAMERA, 2.3)
    assert float(r.motion.min()) >= 0
    assert float(r.motion.max()) <= float(r.opacity.max()) <= 1 + 1e-5
    assert bool((r.motion <= r.opacity + 1e-5).all()) and float(r.motion.max()) > 0.5


def test_gradients_reach_every_parameter() -> None:
    field = scattered(view_dependence=True)
    recorder = Recorder(lambda radiance: (radiance / 2).clamp(0, 1), (0,))
    render, own = field(replace(batch_of(4, 1), recorder=recorder))
    own |= field(replace(batch_of(4, 1), seed=1))[1]  # with rigidity and evenness
    flow = render.warps[0].flow
    own["late"] = render.radiance.lerp(render.late, render.late_share).square().mean()
    linear, squared = (render.depth, render.motion), (render.radiance, flow)
    total = sum(v.sum() for v in linear) + sum(v.square().sum() for v in squared)
    (total + sum(own.values())).backward()
    for name, p in field.named_parameters():
        assert p.grad is not None and torch.isfinite(p.grad).all(), name
        assert float(p.grad.abs().max()) > 0, name


def test_a_step_moves_only_the_poses_near_the_drawn_frame(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    frames = [replace(toy.train[i % 6], time=float(i), neighbors={}) for i in range(12)]
    frames = [replace(f, index=i) for i, f in enumerate(frames)]
    long = with_movers(replace(toy, train=frames))
    t = trainer(small("splat", toy_folder, tmp_path / "run"), long)
    field = t.field
    assert isinstance(field, Splat)
    trajectories = field.trajectories
    for frame in (10, 2):  # the second step must not act on the first one's momentum
        before = [p.detach().clone() for p in (trajectories.rotations, trajectories.translations)]
        t.draw = lambda slot, k=frame: whole_frame(t.scene, k)  # type: ignore[method-assign, misc]
        t.step()
    for p, old in zip((trajectories.rotations, trajectories.translations), before, strict=True):
        moved = (p.detach() != old).view(12, -1).any(1).nonzero()[:, 0].tolist()
        assert moved and set(moved) <= set(range(2 + WINDOW + 1)) and 2 in moved
        assert float(p.grad.abs().max()) == 0  # a step clears what it used


def test_invisible_gaussians_are_left_alone_by_the_regularizers() -> None:
    field = scattered()
    field.static.opacity_logits.data[:10] = -10.0
    own = regularizers(field.model(), field.cloud(3.0), 3.0)
    (own["opacity"] + own["scale"]).backward()
    for g in (field.static.opacity_logits.grad, field.static.log_scales.grad):
        assert g is not None and float(g[:10].abs().max()) == 0 and float(g[10:].abs().min()) > 0
    field.static.log_scales.data[:10] += 5.0
    torch.testing.assert_close(
        regularizers(field.model(), field.cloud(3.0), 3.0)["scale"], own["scale"]
    )


def test_the_regularizers_of_a_plain_field_by_hand() -> None:
    field = card_field()
    own = {
        k: float(v.detach()) for k, v in regularizers(field.model(), field.cloud(3.0), 3.0).items()
    }
    assert own["opacity"] == pytest.approx(1 / (1 + math.exp(-6)))
    scale = (825 * (0.2 + 1e-3) + 121 * (0.08 + 1e-3)) / 3 / 946  # near is 1
    assert own["scale"] == pytest.approx(scale, rel=1e-5)
    assert own["trajectory"] < 1e-12  # even steps
    assert own["brightness_drift"] == own["color_change"] == 0  # constant colors


def test_the_color_change_by_hand() -> None:
    field = card_field()
    field.moving.log_radiance_offsets.data[3] = 2.0  # up and down: 2 of 6 differences; 1 of 7 times
    change = regularizers(field.model(), field.cloud(3.0), 3.0)["color_change"].detach()
    assert float(change) == pytest.approx(4 * 2 / 6 + 0.01 * 4 / 7)


@pytest.mark.parametrize(
    "config",
    [{"moving": 0}, {"static": 0}, {"color_knots": 1, "opacity_knots": 1, "brightness_knots": 1}],
)
def test_a_field_may_lack_a_kind_of_gaussian_or_all_change(config: dict[str, int]) -> None:
    settings = replace(SplatConfig(static=20, moving=20), **config)
    field = Splat(settings, torch.arange(TIMES), 1.0, 6.0, 1200)
    render, own = field(batch_of(4, 1))
    (render.radiance.sum() + sum(own.values())).backward()
    assert all(torch.isfinite(v) for v in own.values())
    assert has_finite_gradients(field)


def has_finite_gradients(field: Splat) -> bool:
    return all(p.grad is None or bool(torch.isfinite(p.grad).all()) for p in field.parameters())


def test_moving_gaussians_appear_and_vanish() -> None:
    field = card_field()
    field.opacity_offsets.data[:7] = -20.0  # 13 knots over 10 times: gone until the middle
    before, after = field.render(CAMERA, 3.0), field.render(CAMERA, 8.0)
    assert float(before.motion.max()) < 0.01 and float(after.motion.max()) > 0.99
    assert field.gaussians(3.0).motion.sum() == 0 and field.gaussians(8.0).motion.sum() == 121


def test_chosen_pixels_are_the_whole_picture_at_them() -> None:
    field = scattered()
    pixels = torch.tensor([[39.5, 29.5], [0.5, 0.5], [7.5, 12.5], [7.5, 12.5]])
    index = torch.tensor([1199, 0, 12 * 40 + 7, 12 * 40 + 7])
    whole, some = field.render(CAMERA, 3.3), field.render(CAMERA, 3.3, pixels)
    for name in ("radiance", "depth", "opacity", "motion"):
        assert torch.equal(getattr(some, name), getattr(whole, name)[index])
    assert all(torch.equal(some.scene_flow[o], whole.scene_flow[o][index]) for o in (1, -1))
    batch = batch_of(3, 1)
    trained, part = field(batch)[0], field(replace(batch, pixels=pixels))[0]
    assert len(part.radiance) == 4
    assert torch.equal(part.warps[0].flow, trained.warps[0].flow[index])
    assert torch.equal(part.warps[0].confidence, trained.warps[0].confidence[index])


def test_pixels_are_rendered_in_the_order_of_the_request() -> None:
    render, grid = scattered().render(CAMERA, 3.0), CAMERA.pixel_grid()
    assert select_pixels(render, CAMERA, grid) is render
    flipped = select_pixels(render, CAMERA, grid.flip(0))
    assert torch.equal(flipped.radiance, render.radiance.flip(0))


def test_the_background_shows_where_nothing_is() -> None:
    field = Splat(SplatConfig(static=5, moving=5), torch.arange(TIMES), 1.0, 6.0, 1200)
    field.background.data = torch.tensor([0.3, 1.0, 20.0]).log()
    render = field.render(CAMERA, 2.0)
    torch.testing.assert_close(render.radiance, torch.tensor([0.3, 1.0, 20.0]).expand(1200, 3))
    assert float(render.opacity.max()) == float(render.motion.max()) == 0
    assert render.depth.unique().tolist() == [6.0]
    assert len(field.gaussians(2.0).means) == 0


def test_huge_log_radiance_stays_finite() -> None:
    field = card_field()
    static, moving = field.static, field.moving
    for p in (
        field.background,
        static.log_radiance,
        moving.log_radiance,
        moving.log_radiance_offsets,
    ):
        p.data += 1e4
    render, own = field(batch_of(4, 1))
    largest = float(render.radiance.detach().max())
    assert largest == pytest.approx(math.exp(MAX_LOG_RADIANCE), rel=0.01)
    (render.radiance.log1p().sum() + render.depth.sum() + sum(own.values())).backward()
    assert has_finite_gradients(field)


@pytest.mark.parametrize("z", [0.0, -1.0, 1e-9, 1e6])
def test_gaussians_behind_or_in_the_camera_give_finite_flow_and_gradients(z: float) -> None:
    field = scattered()
    field.moving.means.data[:5, 2] = z
    render, own = field(batch_of(4, 1))
    (render.radiance.sum() + render.warps[0].flow.sum() + sum(own.values())).backward()
    assert torch.isfinite(render.warps[0].flow).all()
    assert has_finite_gradients(field)


def test_the_cloud_is_what_render_draws() -> None:
    field = card_field()
    field.static.opacity_logits.data[:25] = -20.0
    cloud = field.gaussians(4.5)
    assert len(cloud.means) == 33 * 25 - 25 + 121 and cloud.motion.sum() == 121
    torch.testing.assert_close(cloud.means[-121:].mean(0), torch.tensor([0.0, 0, 2]) + 4.5 * STEP)
    torch.testing.assert_close(cloud.radiance[-1], torch.tensor([1.0, 0, -1]).exp())


def test_colors_change_over_the_clip_and_static_ones_in_brightness_only() -> None:
    field = card_field()
    redder = torch.tensor([1.0, 0.0, -1.0]).expand(121, 3)
    field.moving.log_radiance_offsets.data = torch.linspace(0, 1, 7)[:, None, None] * redder
    field.static.log_radiance_offsets.data = (
        torch.linspace(0, 2, 5)[:, None, None].expand(5, 825, 1).clone()
    )
    early, late = field.gaussians(0.0).radiance.log(), field.gaussians(9.0).radiance.log()
    torch.testing.assert_close((late - early)[-1], torch.tensor([1.0, 0.0, -1.0]))
    torch.testing.assert_close((late - early)[0], torch.tensor([2.0, 2.0, 2.0]))
    middle = field.gaussians(4.5).radiance.log()
    torch.testing.assert_close(middle, (early + late) / 2)


def test_an_initialized_field_has_the_cards_flow(toy: Scene) -> None:
    config = SplatConfig(static=1500, moving=400, bases=2)
    field = Splat(config, toy.times, toy.near, toy.far, 60 * 34)
    initialize_field(field, toy, lambda rgb, *frame: rgb + 0.1, 0.0, True)
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


def test_flow_has_a_gradient_to_the_neighbors_pose() -> None:
    field, batch = card_field(), batch_of(4, 1)
    pose = BESIDE.c2w.clone().requires_grad_()
    learned = replace(batch, neighbors={1: BESIDE.moved(pose)})
    means = field.cloud(4.0).means
    view = TrainingView(learned, 4.0, field.alive(4.0), [1], rigidity=False)
    living = field.local.living(view.alive)
    flow = flow_to_neighbor(field.model(), view, living, means, 1)
    given = flow_to_neighbor(field.model(), replace(view, batch=batch), living, means, 1)
    torch.testing.assert_close(flow, given)
    flow[:, 0].sum().backward()
    # a camera that goes right sees everything go left
    assert pose.grad is not None and float(pose.grad[0, 3]) < 0


def test_neighbors_with_equal_mixtures_are_rigid_and_others_cost() -> None:
    field = card_field()  # equal mixtures; a grid of 11 x 11 Gaussians
    field.find_neighbors()
    assert set(field.neighbors[60].tolist()) == {49, 59, 61, 71}  # the middle one's four
    assert float(mixture_difference(field.mixture_logits, field.neighbors).detach()) == 0
    # 0.8808 and 0.1192 instead of halves
    field.mixture_logits.data[:, 60] = torch.tensor([1.0, -1.0])
    pairs = int((field.neighbors == 60).sum()) + 4  # those whose neighbor it is, and its own
    expected = pairs * 2 * 0.3808**2 / (121 * 4 * 2)
    assert float(
        mixture_difference(field.mixture_logits, field.neighbors).detach()
    ) == pytest.approx(expected, rel=1e-3)
    mixture_difference(field.mixture_logits, field.neighbors).backward()
    assert field.mixture_logits.grad is not None and float(field.mixture_logits.grad[0, 60]) > 0


def test_colors_depend_on_the_view_only_where_the_settings_ask() -> None:
    times = torch.arange(2)
    plain = Splat(SplatConfig(1, 0), times, 1.0, 6.0, 1200)
    shiny = Splat(SplatConfig(1, 0, view_dependence=True), times, 1.0, 6.0, 1200)
    assert plain.static.sh1.numel() == 0
    with torch.no_grad():
        for field in (plain, shiny):
            field.static.means[:] = torch.tensor([0.0, 0.0, 2.0])
            field.static.log_scales[:], field.static.opacity_logits[:] = 0.0, 9.0
        shiny.static.sh1[0, 1, 0] = 1.0  # green grows to the right
        # sees it along (0.6, 0, 0.8)
        beside = CAMERA.moved(torch.tensor([[0.8, 0, 0.6, -1.5], [0, 1, 0, 0], [-0.6, 0, 0.8, 0]]))
        middle = torch.tensor([[20.0, 15.0]])
        for camera, direction in ((CAMERA, 0.0), (beside, 0.6)):
            shiny_rgb, rgb = (f.render(camera, 0.0, middle).radiance[0] for f in (shiny, plain))
            expected = torch.tensor([1.0, math.exp(direction), 1.0])
            torch.testing.assert_close(shiny_rgb / rgb, expected, atol=2e-3, rtol=2e-3)
