"""The preset `nerf-wt-paper` against the published formulas of NeRF in the Wild
(Martin-Brualla et al. 2021): slow oracles in plain loops and float64, on a random
field of the published kind.
"""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from presets import random_field, small
from published import affine, encoded, in_float64, last_hidden, relu
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.baselines.nerf_wt import CodedMlp, NerfWT, NerfWTConfig
from hdr_nsff.fields.nsff.two_branches import BranchPass
from hdr_nsff.scene.batch import PixelBatch, Recorder, draw_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.objective import Objective
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.weighted_terms import merge_weights, weighted_sum

RAYS = 4
IMAGE = 2
TIME = 2


@dataclass
class Case:
    """A random field of the preset in float64, a batch and its pass."""

    field: NerfWT
    batch: PixelBatch
    base: BranchPass
    render: Render
    terms: dict[str, Tensor]

    @property
    def num_samples(self) -> int:
        return self.base.samples.depths.shape[1]

    @property
    def branches(self) -> CodedMlp:
        assert isinstance(self.field.branches, CodedMlp)
        return self.field.branches


@pytest.fixture(scope="module")
def case(toy: Scene) -> Case:
    field = random_field("nerf-wt-paper", toy)
    assert isinstance(field, NerfWT)
    field.double()
    batch = draw_pixels(toy, TIME, RAYS, 0, torch.Generator().manual_seed(1))
    recorder = Recorder(lambda rgb: rgb, (IMAGE,))
    batch = replace(in_float64(batch), recorder=recorder)
    render, terms = field(batch)
    return Case(field, batch, field.query(batch, motion=False), render, terms)


def sigmoid(values: list[float]) -> list[float]:
    return [1 / (1 + math.exp(-x)) for x in values]


def softplus(x: float) -> float:
    return math.log(1 + math.exp(x))


def trunk_output(case: Case, coords: list[float]) -> list[float]:
    """The last layer of the network that both contents share."""
    return last_hidden(case.branches.static_trunk, [2 * x - 1 for x in coords])


def some_samples(case: Case) -> list[tuple[int, int, list[float]]]:
    """Samples: their ray, their place along it, their cube coordinates."""
    coords = case.base.samples.coords
    return [(i, k, coords[i, k].tolist()) for i in range(RAYS) for k in (0, 5, -1)]


def test_static_density_ignores_view_and_code_and_colors_do_not(case: Case) -> None:
    trunk = case.branches.static_trunk
    code = case.field.codes.table[IMAGE].tolist()
    for i, k, x in some_samples(case):
        h = trunk_output(case, x)
        view = encoded(case.base.samples.directions[i].tolist(), trunk.config.direction_octaves)
        density = softplus(affine(trunk.extra, h)[0])
        hidden = relu(affine(trunk.view, affine(trunk.feature, h) + view + code))
        color = sigmoid(affine(trunk.radiance, hidden))
        assert float(case.base.static.density[i, k]) == pytest.approx(density)
        assert case.base.static.radiance[i, k].tolist() == pytest.approx(color)


def test_the_transient_head_takes_the_shared_features_and_the_code_of_the_time(
    case: Case,
) -> None:
    branches = case.branches
    code = branches.time_codes[TIME].tolist()
    assert len(branches.transient_hidden) == 4
    for i, k, x in some_samples(case):
        h = affine(branches.static_trunk.feature, trunk_output(case, x)) + code
        for layer in branches.transient_hidden:
            h = relu(affine(layer, h))
        raw = affine(branches.transient, h)
        dynamic = case.base.dynamic
        assert float(dynamic.density[i, k]) == pytest.approx(softplus(raw[3]))
        assert dynamic.radiance[i, k].tolist() == pytest.approx(sigmoid(raw[:3]))


def test_between_two_times_the_code_is_linear(case: Case) -> None:
    codes = case.branches.time_codes
    expected = 0.25 * codes[1] + 0.75 * codes[2]
    torch.testing.assert_close(case.branches.time_code(1.75), expected)
    last = len(codes) - 1
    torch.testing.assert_close(case.branches.time_code(last), codes[last])


def test_each_content_has_its_own_alpha_behind_both_densities(case: Case) -> None:
    samples, static, dynamic = case.base.samples, case.base.static, case.base.dynamic
    for i in range(RAYS):
        thickness, rgb = 0.0, [0.0, 0.0, 0.0]
        for k in range(case.num_samples):
            length = float(samples.deltas[i, k]) if k + 1 < case.num_samples else 1e10
            a = 1 - math.exp(-float(static.density[i, k]) * length)
            b = 1 - math.exp(-float(dynamic.density[i, k]) * length)
            transmitted = math.exp(-thickness)
            for c in range(3):
                seen = a * float(static.radiance[i, k, c]) + b * float(dynamic.radiance[i, k, c])
                rgb[c] += transmitted * seen
            thickness += float(static.density[i, k] + dynamic.density[i, k]) * length
        assert case.render.radiance[i].tolist() == pytest.approx(rgb)


def test_the_loss_is_the_published_one_with_its_uncertainty_at_the_minimum(
    case: Case, toy: Scene
) -> None:
    beta, cost = 0.03, 0.01  # as published
    config = PRESETS["nerf-wt-paper"]
    weights = merge_weights(config.loss, case.field.loss_weights())
    error = 0.0
    rgb = case.render.radiance.tolist()
    for seen, recorded in zip(rgb, case.batch.rgb.tolist(), strict=True):
        error += sum((a - b) ** 2 for a, b in zip(seen, recorded, strict=True)) / (3 * RAYS)
    densities = [float(x) for x in case.base.dynamic.density.reshape(-1)]
    expected = error / (2 * beta**2) + cost * sum(densities) / len(densities)
    objective = Objective(weights, "scene", 1.0, squared=config.squared, published=True)
    tonemap = tone_mapper_for(small("nerf-wt-paper").tonemap, toy).double()
    found = objective.terms(case.render, case.batch, tonemap, phase=0.0) | case.terms
    counted = {name: value for name, value in found.items() if weights[name]}
    assert set(counted) == {"photometric", "transient"}
    assert float(weighted_sum(found, weights)) == pytest.approx(expected * 2 * beta**2, rel=1e-4)


def test_the_sizes_are_the_published_ones() -> None:
    field = PRESETS["nerf-wt-paper"].field
    assert isinstance(field, NerfWTConfig)
    assert (field.code_size, field.time_code_size, field.density_noise) == (48, 16, 0.0)
    assert (field.encoding.layers, field.encoding.width) == (8, 256)  # type: ignore[union-attr]
