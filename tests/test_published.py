"""Compositing and the terms on samples of the preset `paper` against the published
formulas: slow oracles in plain loops and float64, on a random field of that kind.
"""

import math
from dataclasses import replace

import pytest
import torch
from presets import random_field
from published import RAYS, SIDES, Case, add, decode, paper_case, raw_at, samples_of, sigmoid
from published_terms import cycle, energy, roughness, summed

from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.fields.nsff.scene_flow import SceneFlowPass
from hdr_nsff.maths import volume
from hdr_nsff.scene.scene import Scene


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
        transmitted, points = 1.0, {offset: [0.0, 0.0, 0.0] for _, offset in SIDES}
        for k in range(case.num_samples):
            alpha = 1 - math.exp(-float(dynamic.density[i, k].detach() * samples.deltas[i, k]))
            for side, offset in SIDES:
                moved = add(samples.coords[i, k].tolist(), case.flow(i, k, side))
                points[offset] = add(points[offset], [transmitted * alpha * x for x in moved])
            transmitted *= 1 - alpha
        passed = [transmitted * x for x in samples.coords[i, -1].tolist()]
        for offset, point in points.items():
            place = decode(case, add(point, passed))[None]
            camera = case.batch.neighbors[offset]
            pixel, _ = camera.project(place, min_depth=0.05 * case.field.near)
            expected = pixel[0] - case.batch.pixels[i]
            torch.testing.assert_close(warps[offset].flow[i], expected, rtol=1e-6, atol=1e-6)


# Terms on samples


def test_cycle_is_the_weighted_mean_of_each_neighbor_and_the_sum_of_both(case: Case) -> None:
    assert summed(case, "cycle") == pytest.approx(sum(cycle(case, *side) for side in SIDES))


def test_disocclusion_is_the_sum_of_both_neighbors_means(case: Case) -> None:
    total, samples = 0.0, samples_of(case)
    for i, _, x in samples:
        raw = raw_at(case, x, 2, i)
        total += (sigmoid(raw[7]) + sigmoid(raw[11])) / len(samples)
    assert summed(case, "disocclusion") == pytest.approx(total)


def test_smoothness_compares_neighboring_samples_but_for_the_far_ones(case: Case) -> None:
    total = roughness(case, 0) + roughness(case, 1)
    assert summed(case, "smoothness") == pytest.approx(total)


def test_kinetic_energy_counts_twice_and_once_along_the_chain(case: Case) -> None:
    total = 2 * energy(case) + energy(case, 1)
    assert summed(case, "kinetic") == pytest.approx(total)


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
