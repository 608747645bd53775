"""Terms on renders, and the weights of all terms, of the presets `paper` and
`nsff-paper` against the published formulas: slow oracles in plain loops and float64.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from presets import small
from published import RAYS, SIDES, Case, in_float64, paper_case, paper_field
from published_terms import accelerations, cycle_errors, flow_steps, summed
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.maths import losses
from hdr_nsff.scene.batch import PixelBatch, draw_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.tonemap.curve import smoothness
from hdr_nsff.training.objective import Objective
from hdr_nsff.training.presets import PRESETS

BRIGHT = 3  # a frame of the longest exposure: much of it clips
BOTH = ["paper", "nsff-paper"]


@pytest.fixture(scope="module")
def case(toy: Scene) -> Case:
    return paper_case(toy)


def saturation(c: float) -> float:
    """The published trust in a recorded value."""
    low, high = 0.15, 0.9
    if c < low:
        return ((c + low) / (2 * low)) ** 2
    if c > high:
        return ((2 - high - c) / (2 * (1 - high))) ** 2
    return 1.0


def test_saturation_weight_is_the_published_one() -> None:
    for c in torch.linspace(0, 1, 41, dtype=torch.float64).tolist():
        found = losses.saturation_weight(torch.tensor([c], dtype=torch.float64))
        assert float(found) == pytest.approx(saturation(c))


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
    valid = {1: torch.arange(RAYS) < 4, -1: torch.arange(RAYS) > 1}
    batch = replace(case.batch, flow_valid=valid)
    terms = pictured("paper", render, batch, toy, phase=0.0)
    flow = magnitude = 0.0
    for _, offset in SIDES:
        errors = flow_errors(batch, render, offset)
        flow += sum(x + y for x, y in errors) / len(errors)
        rendered = render.scene_flow[offset].tolist()
        magnitude += sum(abs(x) for flow in rendered for x in flow) / RAYS
    assert float(terms["flow"]) == pytest.approx(flow)
    assert float(terms["flow_magnitude"]) == pytest.approx(magnitude)


def flow_errors(batch: PixelBatch, render: Render, offset: int) -> list[list[float]]:
    """Errors (2,) in pixels of the rendered flow to a neighbor, where flow is valid."""
    (warp,) = (w for w in render.warps if w.offset == offset)
    target, valid = batch.flow[offset].tolist(), batch.flow_valid[offset].tolist()
    rows = zip(warp.flow.tolist(), target, valid, strict=True)
    return [[abs(a - b) for a, b in zip(f, t, strict=True)] for f, t, v in rows if v]


@pytest.mark.parametrize("preset", BOTH)
@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0])
def test_trust_weighs_errors_of_dynamic_terms_and_not_their_normalizer(
    toy: Scene, preset: str, phase: float
) -> None:
    field, batch = clipped(toy, preset)
    render, _ = field(batch)
    terms = pictured(preset, render, batch, toy, phase)
    motion = render.motion.tolist() if phase >= 1 else [1.0] * len(batch.rgb)
    trust = {"paper": saturation, "nsff-paper": fully}[preset]

    def term(radiance: Tensor | None, shares: Sequence[float]) -> float:
        assert radiance is not None
        rgb = recorded(preset, radiance, batch, toy)
        shares = [a * b for a, b in zip(shares, motion, strict=True)]
        return weighted_mean(preset, rgb, batch.rgb, shares, trust)

    dynamic = term(render.dynamic_radiance, [1.0] * len(motion))
    assert float(terms["dynamic"]) == pytest.approx(dynamic)
    sums = {1: 0.0, 2: 0.0}  # over both neighbors; over the chain
    for warp in render.warps:
        sums[abs(warp.offset)] += term(warp.radiance, warp.confidence.tolist())
    assert float(terms["temporal"]) == pytest.approx(sums[1])
    assert ("chain" in terms) == (phase >= 2)
    if phase >= 2:
        assert float(terms["chain"]) == pytest.approx(sums[2])


@pytest.mark.parametrize("preset", BOTH)
def test_eq_12_trusts_all_values_of_uniform_pixels_alone(toy: Scene, preset: str) -> None:
    field, batch = clipped(toy, preset)
    render, _ = field(batch)
    rgb = recorded(preset, render.radiance, batch, toy)
    uniform = [float(u) for u in batch.uniform.tolist()]
    assert 0 < sum(uniform) < len(uniform)
    expected = weighted_mean(preset, rgb, batch.rgb, uniform, fully)
    terms = pictured(preset, render, batch, toy, phase=0.0)
    assert float(terms["photometric"]) == pytest.approx(expected)


def clipped(scene: Scene, preset: str) -> tuple[NSFF, PixelBatch]:
    """A field and pixels of a bright frame, with a chain backward."""
    batch = draw_pixels(scene, BRIGHT, 6, 3, torch.Generator().manual_seed(2))
    trust = [saturation(c) for rgb in batch.rgb.tolist() for c in rgb]
    assert min(trust) < 0.6 and max(trust) == 1
    return paper_field(scene, preset), replace(in_float64(batch), chain=-1)


def fully(c: float) -> float:
    return 1.0


def weighted_mean(
    preset: str,
    rgb: Tensor,
    target: Tensor,
    shares: Sequence[float],
    trust: Callable[[float], float],
) -> float:
    """Errors of all pixels and channels, by trust and by the pixels' shares; only the
    shares divide. Those of `nsff-paper` are squared.
    """
    total = 0.0
    for pixel, there, share in zip(rgb.tolist(), target.tolist(), shares, strict=True):
        for x, c in zip(pixel, there, strict=True):
            d = abs(x - c)
            total += share * trust(c) * (d * d if preset == "nsff-paper" else d)
    return total / (3 * sum(shares))


def recorded(preset: str, radiance: Tensor, batch: PixelBatch, scene: Scene) -> Tensor:
    """Radiance (N, 3) as the preset's tone mapper records it, before its first step."""
    tonemap = tone_mapper_for(small(preset).tonemap, scene).double()
    return tonemap(radiance, batch.bracket, batch.camera_id, batch.frame, leaky=True)


def pictured(
    preset: str, render: Render, batch: PixelBatch, scene: Scene, phase: float
) -> dict[str, Tensor]:
    """The terms of a render, as the preset forms them."""
    config = PRESETS[preset]
    tonemap = tone_mapper_for(small(preset).tonemap, scene).double()
    objective = Objective(
        weights={},
        depth_kind="scene",
        near=scene.near,
        squared=config.squared,
        saturation=config.saturation,
        published=config.published,
    )
    return objective.terms(render, batch, tonemap, phase)


# Weights


def test_weighted_terms_are_the_published_means_over_axes(case: Case, toy: Scene) -> None:
    """Cycles are published in NDC of [-1, 1], which are twice the cube's units."""
    render, config = case.scene_flow.render(), PRESETS["paper"]
    cycle = roughness = flow = 0.0
    for side, offset in SIDES:
        errors = cycle_errors(case, side, offset)
        total = sum(seen * mean([2 * abs(x) for x in residual]) for seen, residual in errors)
        cycle += total / sum(seen for seen, _ in errors)
        roughness += mean([abs(x) for step in flow_steps(case, side) for x in step])
        flow += mean([x for error in flow_errors(case.batch, render, offset) for x in error])
    energy = mean([0.5 * x * x for bend in accelerations(case) for x in bend])
    weights = config.field.loss  # type: ignore[union-attr]
    assert weights.cycle * summed(case, "cycle") == pytest.approx(1.0 * cycle)
    assert weights.smoothness * summed(case, "smoothness") == pytest.approx(0.1 * roughness)
    assert weights.kinetic * float(case.terms["kinetic"][0]) == pytest.approx(0.1 * energy)
    terms = pictured("paper", render, case.batch, toy, phase=0.0)
    assert config.loss.flow * float(terms["flow"]) == pytest.approx(0.02 * flow)


def mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


@pytest.mark.parametrize("preset", BOTH)
def test_both_presets_form_the_published_terms(preset: str) -> None:
    config = PRESETS[preset]
    assert config.published and config.field.opaque_end  # type: ignore[union-attr]
    assert config.field.loss.distortion == 1e-3  # type: ignore[union-attr]
