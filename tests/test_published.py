"""The preset `paper` against the published formulas: slow oracles in plain
loops and float64, on a random field of the published kind.
"""

import math
from dataclasses import replace

import pytest
import torch
from presets import random_field, small
from published import (
    RAYS,
    Case,
    add,
    decode,
    flow_of,
    in_float64,
    paper_case,
    paper_field,
    raw_at,
    samples_of,
    sigmoid,
)
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.fields.nsff.scene_flow import SceneFlowPass
from hdr_nsff.maths import losses, volume
from hdr_nsff.scene.batch import PixelBatch, draw_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.tonemap.curve import smoothness
from hdr_nsff.training.objective import Objective
from hdr_nsff.training.presets import PRESETS

BRIGHT = 3  # a frame of the longest exposure: much of it clips


@pytest.fixture(scope="module")
def case(toy: Scene) -> Case:
    return paper_case(toy)


# Compositing


def test_blended_weights_are_those_of_eq_6_and_7_with_v_of_the_static_branch(case: Case) -> None:
    samples, static, dynamic = case.base.samples, case.base.static, case.base.dynamic
    for i in range(RAYS):
        transmitted = 1.0
        for k in range(case.num_samples):
            length = float(samples.deltas[i, k]) if k + 1 < case.num_samples else 1e10
            v = float(static.blend[i, k].detach())
            a_st = (1 - math.exp(-float(static.density[i, k].detach()) * length)) * v
            a_dy = (1 - math.exp(-float(dynamic.density[i, k].detach()) * length)) * (1 - v)
            assert float(case.base.weights.static[i, k].detach()) == pytest.approx(
                transmitted * a_st
            )
            assert float(case.base.weights.dynamic[i, k].detach()) == pytest.approx(
                transmitted * a_dy
            )
            transmitted *= (1 - a_st) * (1 - a_dy)


def test_the_blend_weight_is_learned_by_the_static_network_alone(case: Case) -> None:
    v = case.field.query(case.batch, motion=False).static.blend
    trunk = case.field.branches.static_trunk  # type: ignore[union-attr]
    (gradient,) = torch.autograd.grad(v.sum(), trunk.extra.weight, retain_graph=True)
    assert gradient[1].abs().max() > 0  # row 0 is density
    moving = list(case.field.branches.dynamic_trunk.parameters())  # type: ignore[union-attr]
    assert all(g is None for g in torch.autograd.grad(v.sum(), moving, allow_unused=True))


def test_the_last_interval_of_a_ray_is_1e10(case: Case) -> None:
    assert (case.base.samples.deltas[:, -1] == 1e10).all()
    assert volume.step_lengths(torch.rand(2, 5, 3))[0, -1] < 10  # ours goes on as before


def test_depth_and_dynamic_radiance_are_of_the_dynamic_branch_alone(case: Case) -> None:
    render = case.scene_flow.render()
    assert render.dynamic_radiance is not None and render.dynamic_depth is not None
    samples, dynamic = case.base.samples, case.base.dynamic
    for i in range(RAYS):
        transmitted, disparity, red = 1.0, 0.0, 0.0
        for k in range(case.num_samples):
            alpha = 1 - math.exp(-float(dynamic.density[i, k].detach() * samples.deltas[i, k]))
            disparity += transmitted * alpha / float(samples.depths[i, k])
            red += transmitted * alpha * float(dynamic.radiance[i, k, 0].detach())
            transmitted *= 1 - alpha
        disparity += transmitted / case.field.far
        assert float(render.dynamic_depth[i]) == pytest.approx(1 / disparity)
        assert float(render.dynamic_radiance[i, 0]) == pytest.approx(red)


def test_rendered_flow_projects_the_weighted_sum_of_displaced_samples(case: Case) -> None:
    warps = {w.offset: w for w in case.scene_flow.render().warps}
    samples, dynamic = case.base.samples, case.base.dynamic
    for i in range(RAYS):
        transmitted, point = 1.0, [0.0, 0.0, 0.0]
        for k in range(case.num_samples):
            alpha = 1 - math.exp(-float(dynamic.density[i, k].detach() * samples.deltas[i, k]))
            moved = add(samples.coords[i, k].tolist(), case.flow(i, k, 0))
            point = add(point, [transmitted * alpha * x for x in moved])
            transmitted *= 1 - alpha
        point = add(point, [transmitted * x for x in samples.coords[i, -1].tolist()])
        place = decode(case, point)[None]
        pixel, _ = case.batch.neighbors[1].project(place, min_depth=0.05 * case.field.near)
        expected = pixel[0] - case.batch.pixels[i]
        torch.testing.assert_close(warps[1].flow[i], expected, rtol=1e-6, atol=1e-6)


# Terms on samples


def test_cycle_is_the_weighted_mean_of_each_neighbor_and_the_sum_of_both(case: Case) -> None:
    total = 0.0
    for side, offset in ((0, 1), (1, -1)):
        error = weights = 0.0
        for i, k, x in samples_of(case):
            w = sigmoid(raw_at(case, x, 2, i)[4 + 4 * side + 3])
            there = case.flow(i, k, side)
            back = flow_of(raw_at(case, add(x, there), 2 + offset, i), 1 - side)
            error += (1 - w) * sum(abs(a + b) for a, b in zip(there, back, strict=True))
            weights += 1 - w
        total += error / weights
    assert summed(case, "cycle") == pytest.approx(total)


def test_disocclusion_is_the_sum_of_both_neighbors_means(case: Case) -> None:
    total, samples = 0.0, samples_of(case)
    for i, _, x in samples:
        raw = raw_at(case, x, 2, i)
        total += (sigmoid(raw[7]) + sigmoid(raw[11])) / len(samples)
    assert summed(case, "disocclusion") == pytest.approx(total)


def test_smoothness_compares_neighboring_samples_but_for_the_far_ones(case: Case) -> None:
    total, last = 0.0, round(0.95 * case.num_samples)
    for side in (0, 1):
        errors = []
        for i in range(RAYS):
            moves = []
            for k in range(last):
                x = case.base.samples.coords[i, k].tolist()
                moves.append(decode(case, add(x, case.flow(i, k, side))) - decode(case, x))
            pairs = zip(moves[1:], moves, strict=False)
            errors += [float((a - b).abs().sum()) for a, b in pairs]
        total += sum(errors) / len(errors)
    assert summed(case, "smoothness") == pytest.approx(total)


def test_kinetic_energy_counts_twice_and_once_along_the_chain(case: Case) -> None:
    here, along, count = 0.0, 0.0, 0
    for i, k, x in samples_of(case):
        if k >= round(0.9 * case.num_samples):
            continue
        count += 1
        there, back = case.flow(i, k, 0), case.flow(i, k, 1)
        start = decode(case, x)
        bend = decode(case, add(x, there)) + decode(case, add(x, back)) - 2 * start
        here += 0.5 * float(bend.square().sum())
        moved = add(x, there)
        raw = raw_at(case, moved, 3, i)
        onward, returning = flow_of(raw, 0), flow_of(raw, 1)
        bend = decode(case, add(moved, onward)) + decode(case, add(moved, returning))
        along += 0.5 * float((bend - 2 * decode(case, moved)).square().sum())
    assert summed(case, "kinetic") == pytest.approx((2 * here + along) / count)


def test_before_the_chain_one_neighbor_drawn_by_chance_counts_too(case: Case, toy: Scene) -> None:
    def kinetic(field: NSFF, **changes: int) -> list[float]:
        batch = replace(case.batch, **changes)
        base = field.query(batch, motion=True)
        values = SceneFlowPass(field, field.to_flow, batch, base).kinetic()
        return [float(v) for v in values]

    for seed, direction in ((4, -1), (5, 1)):
        before = kinetic(case.field, seed=seed, chain=0)
        assert len(before) == 3
        assert before == pytest.approx(kinetic(case.field, seed=seed, chain=direction))
    grid = random_field("grid", toy)
    assert isinstance(grid, NSFF)
    assert len(kinetic(grid.double(), chain=0)) == 4  # ours: both neighbors


def test_blend_entropy_is_the_mean_of_minus_v_log_v(case: Case) -> None:
    v = case.base.static.blend.reshape(-1).tolist()
    entropy = -sum(x * math.log(x) for x in v) / len(v)
    assert summed(case, "blend_entropy") == pytest.approx(entropy)


def test_distortion_is_that_of_mip_nerf_360_for_both_renders(case: Case) -> None:
    alone = volume.single(case.base.dynamic.density, case.base.samples.deltas)
    both = case.base.weights.static + case.base.weights.dynamic
    total, n = 0.0, case.num_samples
    for weights in (alone.tolist(), both.tolist()):
        for w in weights:
            for i in range(n):
                total += w[i] ** 2 / n / 3 / RAYS
                total += sum(w[i] * w[j] * abs(i - j) / n for j in range(n)) / RAYS
    assert summed(case, "distortion") == pytest.approx(total)


def summed(case: Case, name: str) -> float:
    """A term of the field as the preset's objective adds it up."""
    objective = Objective({}, "scene", 1.0, published=PRESETS["paper"].published)
    return float(objective.reduce({name: case.terms[name]})[name])


# Terms on renders


def test_saturation_weight_is_the_published_one() -> None:
    low, high = 0.15, 0.9
    for c in torch.linspace(0, 1, 41, dtype=torch.float64).tolist():
        expected = 1.0
        if c < low:
            expected = ((c + low) / (2 * low)) ** 2
        elif c > high:
            expected = ((2 - high - c) / (2 * (1 - high))) ** 2
        found = losses.saturation_weight(torch.tensor([c], dtype=torch.float64))
        assert float(found) == pytest.approx(expected)


def test_eq_15_is_a_sum_over_images_channels_and_points(toy: Scene) -> None:
    tonemap = tone_mapper_for(small("paper").tonemap, toy)
    for p in tonemap.parameters():
        p.data.add_(0.1 * torch.randn_like(p))
    total = 0.0
    curves = tonemap.response.values(slice(None)).double()  # type: ignore[union-attr]
    for image in curves.tolist():
        for g in image:
            total += sum((g[k - 1] - 2 * g[k] + g[k + 1]) ** 2 for k in range(1, len(g) - 1))
    found = tonemap.regularizers()["response_smoothness"].item()
    assert found == pytest.approx(total, rel=1e-4)
    assert found == pytest.approx(float(smoothness(curves)) * len(toy.train) * 3, rel=1e-4)


def test_free_curves_end_at_0_and_1_and_may_leave_them_between(toy: Scene) -> None:
    tonemap = tone_mapper_for(small("paper").tonemap, toy)
    for p in tonemap.parameters():
        p.data.add_(3 * torch.randn_like(p))
    curves = tonemap.response.values(slice(None))  # type: ignore[union-attr]
    assert curves.shape == (len(toy.train), 3, 256)
    assert (curves[..., 0] == 0).all() and (curves[..., -1] == 1).all()
    assert float(curves.min()) < 0 and float(curves.max()) > 1
    assert torch.allclose(tonemap.knots, torch.linspace(0, 1, 256))


@pytest.mark.parametrize("kind", ["scene", "relative"])
def test_depth_is_compared_up_to_scale_and_shift_whatever_the_prior(
    case: Case, toy: Scene, kind: str
) -> None:
    objective = Objective({}, kind, toy.near, published=True)
    render = case.scene_flow.render()
    prior = torch.tensor([0.1, 0.5, 0.2, 0.7, 0.3])
    assert render.dynamic_depth is not None
    batch = replace(case.batch, disparity=prior)
    found = objective.priors(render, batch, phase=0.0)["depth"]
    a, b = normalized((1 / render.dynamic_depth).tolist()), normalized(prior.tolist())
    expected = sum((x - y) ** 2 for x, y in zip(a, b, strict=True)) / len(a)
    assert float(found) == pytest.approx(expected, rel=1e-4)


def normalized(values: list[float]) -> list[float]:
    """Values minus their (lower) median, over their mean absolute deviation from it."""
    median = sorted(values)[(len(values) - 1) // 2]
    deviation = sum(abs(v - median) for v in values) / len(values)
    return [(v - median) / deviation for v in values]


def test_flow_terms_are_sums_over_both_neighbors(case: Case, toy: Scene) -> None:
    render = case.scene_flow.render()
    terms = pictured(render, case.batch, toy, phase=0.0)
    flow = magnitude = 0.0
    for warp in render.warps:
        if abs(warp.offset) != 1:
            continue
        target, valid = case.batch.flow[warp.offset], case.batch.flow_valid[warp.offset]
        error = (warp.flow - target).abs().sum(-1)
        flow += float(error[valid].sum() / max(int(valid.sum()), 1))
        rendered = render.scene_flow[warp.offset].tolist()
        magnitude += sum(abs(x) for flow in rendered for x in flow) / RAYS
    assert float(terms["flow"]) == pytest.approx(flow, rel=1e-4)
    assert float(terms["flow_magnitude"]) == pytest.approx(magnitude, rel=1e-4)


@pytest.fixture(scope="module")
def clipped(toy: Scene) -> tuple[NSFF, PixelBatch]:
    """A field and pixels of a bright frame, with a chain backward."""
    batch = draw_pixels(toy, BRIGHT, 6, 3, torch.Generator().manual_seed(2))
    return paper_field(toy), replace(in_float64(batch), chain=-1)


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0])
def test_trust_weighs_errors_of_dynamic_terms_and_not_their_normalizer(
    clipped: tuple[NSFF, PixelBatch], toy: Scene, phase: float
) -> None:
    field, batch = clipped
    render, _ = field(batch)
    terms = pictured(render, batch, toy, phase)
    tonemap = tone_mapper_for(small("paper").tonemap, toy).double()
    trust = losses.saturation_weight(batch.rgb)
    assert float(trust.min()) < 0.6 and float(trust.max()) == 1
    which = batch.bracket, batch.camera_id, batch.frame

    def error(radiance: Tensor) -> Tensor:
        return (tonemap(radiance, *which, leaky=True) - batch.rgb).abs()

    def weighted(radiance: Tensor, share: Tensor) -> float:
        if phase >= 1:
            share = share * render.motion
        return float((error(radiance) * trust * share[:, None]).sum() / (3 * share.sum()))

    plain = error(render.radiance)[batch.uniform].mean()
    assert float(terms["photometric"]) == pytest.approx(float(plain), rel=1e-4)
    assert render.dynamic_radiance is not None
    dynamic = weighted(render.dynamic_radiance, torch.ones_like(render.motion))
    assert float(terms["dynamic"]) == pytest.approx(dynamic, rel=1e-4)
    sums = {1: 0.0, 2: 0.0}  # over both neighbors; over the chain
    for warp in render.warps:
        assert warp.radiance is not None
        sums[abs(warp.offset)] += weighted(warp.radiance, warp.confidence)
    assert float(terms["temporal"]) == pytest.approx(sums[1], rel=1e-4)
    assert ("chain" in terms) == (phase >= 2)
    if phase >= 2:
        assert float(terms["chain"]) == pytest.approx(sums[2], rel=1e-4)


def pictured(render: Render, batch: PixelBatch, scene: Scene, phase: float) -> dict[str, Tensor]:
    """The terms of a render, as the preset forms them."""
    tonemap = tone_mapper_for(small("paper").tonemap, scene).double()
    objective = Objective({}, "scene", scene.near, published=PRESETS["paper"].published)
    return objective.terms(render, batch, tonemap, phase)


# Weights


def test_weighted_terms_are_the_published_means_over_axes(case: Case, toy: Scene) -> None:
    """Cycles are published in NDC of [-1, 1], which are twice the cube's units."""
    scene_flow, near = case.scene_flow, round(0.95 * case.num_samples)
    cycle = smoothness = flow = 0.0
    for side, offset in ((0, 1), (1, -1)):
        back = case.field.to_flow(scene_flow.neighbor_motion[offset])[:, 1 - side]
        seen = (1 - scene_flow.disocclusion[:, side])[:, None].expand(-1, 3)
        error = 2 * (scene_flow.flow[:, side] + back).abs()
        cycle += float((seen * error).sum() / seen.sum())
        moves = scene_flow.displacement[offset].view(RAYS, -1, 3)[:, :near]
        smoothness += float(moves.diff(dim=1).abs().mean())
        target, valid = case.batch.flow[offset], case.batch.flow_valid[offset]
        (warp,) = (w for w in scene_flow.render().warps if w.offset == offset)
        flow += float((warp.flow - target).abs()[valid].mean())
    both = (scene_flow.displacement[1] + scene_flow.displacement[-1]).view(RAYS, -1, 3)
    here = 0.5 * both[:, : round(0.9 * case.num_samples)].square().mean()
    config = PRESETS["paper"]
    weights = config.field.loss  # type: ignore[union-attr]
    assert weights.cycle * summed(case, "cycle") == pytest.approx(1.0 * cycle)
    assert weights.smoothness * summed(case, "smoothness") == pytest.approx(0.1 * smoothness)
    kinetic = weights.kinetic * float(case.terms["kinetic"][0])
    assert kinetic == pytest.approx(0.1 * float(here))
    terms = pictured(scene_flow.render(), case.batch, toy, phase=0.0)
    assert config.loss.flow * float(terms["flow"]) == pytest.approx(0.02 * flow, rel=1e-4)


@pytest.mark.parametrize("preset", ["paper", "nsff-paper"])
def test_both_presets_form_the_published_terms(preset: str) -> None:
    config = PRESETS[preset]
    assert config.published and config.field.opaque_end  # type: ignore[union-attr]
    assert config.field.loss.distortion == 1e-3  # type: ignore[union-attr]
