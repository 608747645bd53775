"""The networks of the preset `paper` and what they render, against the published
formulas: slow oracles in plain loops and float64, on a random field of that kind.
"""

import math

import pytest
import torch
from presets import random_field
from published import (
    RAYS,
    SIDES,
    TIME,
    Case,
    add,
    answer,
    decode,
    disocclusion_of,
    flow_of,
    paper_case,
    raw_at,
    samples_of,
    sigmoid,
)

from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.scene.batch import draw_pixels
from hdr_nsff.scene.scene import Scene


@pytest.fixture(scope="module")
def case(toy: Scene) -> Case:
    return paper_case(toy)


def test_both_networks_answer_as_published(case: Case) -> None:
    base, last = case.base, len(case.field.times) - 1
    for i, k, x in samples_of(case)[::7]:
        view = base.samples.directions[i].tolist()
        ndc = [2 * c - 1 for c in x]
        static = answer(case.branches.static_trunk, ndc, view)
        dynamic = answer(case.branches.dynamic_trunk, [*ndc, TIME / last], view)
        for raw, found in ((static, base.static), (dynamic, base.dynamic)):
            assert float(found.density[i, k]) == pytest.approx(max(raw[3], 0.0))
            color = [sigmoid(c) for c in raw[:3]]
            assert found.radiance[i, k].tolist() == pytest.approx(color)
        assert float(base.static.blend[i, k]) == pytest.approx(sigmoid(static[4]))
        assert raw_at(case, x, TIME, i) == pytest.approx(dynamic)


def test_density_has_unit_noise_and_samples_are_jittered_while_training_only(toy: Scene) -> None:
    field = random_field("paper", toy)
    assert isinstance(field, NSFF)
    batch = draw_pixels(toy, TIME, RAYS, 0, torch.Generator().manual_seed(1))
    field.train()
    depths = []
    for seed in (1, 2):
        field.generator = torch.Generator().manual_seed(seed)
        depths.append(field.sample(batch.camera, batch.pixels, 12, field.generator).depths)
        edges = torch.linspace(1 / field.near, 1 / field.far, 13)
        disparity = 1 / depths[-1]
        assert (disparity <= edges[:-1] + 1e-5).all() and (disparity >= edges[1:] - 1e-5).all()
    assert (depths[0] != depths[1]).all()
    raw = torch.full((20_000,), 9.0)
    noisy = field.to_density(raw, 0.0)
    assert float(noisy.std()) == pytest.approx(1, rel=0.03)
    assert float(noisy.mean()) == pytest.approx(9, abs=0.05)
    first, again = (field.render(batch.camera, TIME, batch.pixels).radiance for _ in range(2))
    assert torch.equal(first, again)


def composite(case: Case, ray: int, raws: list[list[float]]) -> tuple[list[float], list[float]]:
    """Weights, and rgb, of the dynamic network's answers along a ray."""
    transmitted, weights, rgb = 1.0, [], [0.0, 0.0, 0.0]
    for k, raw in enumerate(raws):
        alpha = 1 - math.exp(-max(raw[3], 0.0) * float(case.base.samples.deltas[ray, k]))
        weights.append(transmitted * alpha)
        rgb = [c + weights[-1] * sigmoid(r) for c, r in zip(rgb, raw[:3], strict=True)]
        transmitted *= 1 - alpha
    return weights, rgb


def test_warped_renders_are_eq_2_and_3_for_both_neighbors_and_the_chain(case: Case) -> None:
    """Content comes from the other time, confidence from the weights at this one."""
    warps = {w.offset: w for w in case.scene_flow.render().warps}
    assert set(warps) == {1, -1, 2}
    for i in range(RAYS):
        places = [x for ray, _, x in samples_of(case) if ray == i]
        here = [raw_at(case, x, TIME, i) for x in places]
        hidden = {}
        for side, offset in SIDES:
            moved = [add(x, flow_of(raw, side)) for x, raw in zip(places, here, strict=True)]
            there = [raw_at(case, x, TIME + offset, i) for x in moved]
            _, rgb = composite(case, i, there)
            assert warps[offset].radiance[i].tolist() == pytest.approx(rgb)
            hidden[offset] = [disocclusion_of(raw, side) for raw in here]
            if offset == 1:
                again = [add(x, flow_of(raw, 0)) for x, raw in zip(moved, there, strict=True)]
                _, rgb = composite(case, i, [raw_at(case, x, TIME + 2, i) for x in again])
                assert warps[2].radiance[i].tolist() == pytest.approx(rgb)
                second = [disocclusion_of(raw, 0) for raw in there]
                either = zip(hidden[1], second, strict=True)
                hidden[2] = [1 - (1 - a) * (1 - b) for a, b in either]
        weights, _ = composite(case, i, here)
        for offset, disocclusion in hidden.items():
            seen = 1 - sum(w * p for w, p in zip(weights, disocclusion, strict=True))
            assert float(warps[offset].confidence[i]) == pytest.approx(seen)


def test_scene_flow_is_rendered_with_the_dynamic_branchs_own_weights(case: Case) -> None:
    render = case.scene_flow.render()
    for i in range(RAYS):
        places = [x for ray, _, x in samples_of(case) if ray == i]
        here = [raw_at(case, x, TIME, i) for x in places]
        weights, _ = composite(case, i, here)
        for side, offset in SIDES:
            total = torch.zeros(3, dtype=torch.float64)
            for w, x, raw in zip(weights, places, here, strict=True):
                moved = decode(case, add(x, flow_of(raw, side)))
                total += w * (moved - decode(case, x))
            torch.testing.assert_close(render.scene_flow[offset][i].detach(), total)
    share = case.base.weights.dynamic.sum(-1)  # of the blended render, eq. 6
    torch.testing.assert_close(render.motion, share)
