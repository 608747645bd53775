"""The objective: which terms there are when, what they weigh, and where their gradients
go.
"""

import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from presets import small, trainer
from torch import Tensor

from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.fields.nsff.nsff import SceneFlowLosses
from hdr_nsff.scene.batch import PixelBatch, draw_pixels, whole_frame
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig, ToneMapLosses, ToneMapper
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training import objective
from hdr_nsff.training.objective import LossWeights, Objective
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.weighted_terms import backward, merge_weights, weighted_sum

KERNELS_ON = "hdr_nsff.training.weighted_terms.kernels_on"
N = 20
WEIGHTS = merge_weights(LossWeights(), asdict(SceneFlowLosses()), asdict(ToneMapLosses()))
OBJECTIVE = Objective(WEIGHTS, "scene", near=1.8)


@pytest.fixture
def tonemap(toy: Scene) -> ToneMapper:
    return tone_mapper_for(ToneMapConfig(kind="none"), toy)


@pytest.fixture
def batch(toy: Scene) -> PixelBatch:
    return draw_pixels(toy, 3, N, 8, torch.Generator().manual_seed(0))


def perfect(batch: PixelBatch) -> Render:
    """What an exact field without a tone mapper would answer: every term's best."""
    n, d = len(batch.pixels), batch.disparity
    assert d is not None and batch.moving is not None
    warps = tuple(
        Warp(o, batch.flow.get(o, torch.zeros(n, 2)), torch.ones(n), batch.rgb.clone())
        for o in (1, -1, 2)
    )
    still = torch.zeros(n, 3)
    return Render(
        batch.rgb.clone(), 1 / d, torch.ones(n), batch.moving.float(), {1: still, -1: still}, warps
    )


def test_a_perfect_render_costs_nothing(batch: PixelBatch, tonemap: ToneMapper) -> None:
    terms = OBJECTIVE.terms(perfect(batch), batch, tonemap, phase=2.0)
    assert set(terms) == {
        "photometric",
        "dynamic",
        "temporal",
        "chain",
        "depth",
        "flow",
        "mask",
        "flow_magnitude",
    }
    assert all(float(v) < 1e-3 for v in terms.values()), terms


def test_a_term_without_a_weight_is_an_error() -> None:
    with pytest.raises(AssertionError, match="sparkle"):
        weighted_sum({"photometric": torch.tensor(1.0), "sparkle": torch.tensor(1.0)}, WEIGHTS)


def test_the_total_is_the_weighted_sum_and_weight_zero_lets_no_gradient_through() -> None:
    a, b, c = (torch.tensor(v, requires_grad=True) for v in (2.0, 3.0, math.inf))
    weights = {"photometric": 1.0, "depth": 0.5, "mask": 0.0}
    total = weighted_sum({"photometric": a, "depth": b, "mask": c}, weights)
    total.backward()
    assert float(total.detach()) == 3.5 and float(b.grad) == 0.5 and c.grad is None


def test_the_gradients_of_terms_in_vectors_are_those_of_their_total(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ["photometric", "depth", "mask", "flow", "dynamic"]
    weights = dict(zip(names, (1.0, 0.5, 0.0, 3.0, 2.0), strict=True))

    def gradient(with_kernels: bool) -> Tensor:
        leaf = torch.tensor([1.0, 2.0, 3.0, 4.0], requires_grad=True)
        parts, alone = (2 * leaf).unbind(), leaf.square().sum()
        monkeypatch.setattr(KERNELS_ON, lambda device: with_kernels)
        backward(dict(zip(names, (*parts, alone), strict=True)), weights, 2)
        assert leaf.grad is not None
        return leaf.grad

    torch.testing.assert_close(gradient(True), gradient(False))
    with pytest.raises(AssertionError, match="sparkle"):
        backward({"sparkle": torch.tensor(1.0)}, weights, 1)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_term_of_every_preset_has_a_weight(
    preset: str, toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    t = trainer(small(preset, toy_folder, tmp_path / "run"), toy)
    values = t.step()  # `weighted_sum` asserts that each term has a weight
    assert set(values) - {"psnr"} <= set(t.objective.weights)


def test_a_weight_is_made_in_one_place() -> None:
    with pytest.raises(AssertionError, match="depth"):
        merge_weights(LossWeights(), {"depth": 1.0})


def test_depth_and_flow_fade_by_a_tenth_every_phase(batch: PixelBatch, tonemap: ToneMapper) -> None:
    exact = perfect(batch)
    off = replace(
        exact,
        depth=exact.depth * 1.2,
        warps=tuple(replace(w, flow=w.flow + 1.5) for w in exact.warps),
    )
    at = {p: OBJECTIVE.terms(off, batch, tonemap, p) for p in (0.0, 0.99, 1.0, 2.5)}
    assert math.isclose(float(at[0.0]["flow"]), 3.0, rel_tol=1e-5)  # 1.5 px in x and in y
    expected = float((batch.disparity * (1 - 1 / 1.2)).mean()) * 1.8
    assert math.isclose(float(at[0.0]["depth"]), expected, rel_tol=1e-4)
    for name in ("depth", "flow"):
        for phase, share in ((0.99, 1.0), (1.0, 0.1), (2.5, 0.01)):
            assert math.isclose(float(at[phase][name]), share * float(at[0.0][name]), rel_tol=1e-5)


@pytest.mark.parametrize("phase", [0.0, 0.9, 2.5])
def test_whole_frames_have_the_same_terms_by_kernels(
    phase: float, toy: Scene, tonemap: ToneMapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = whole_frame(toy, 3)
    exact = perfect(whole)
    flow = exact.warps[1].flow.clone()
    flow[:, 0] += torch.linspace(0, 40, len(flow))  # beyond the limit at the end
    render = replace(
        exact,
        radiance=exact.radiance * 0.8,
        depth=exact.depth * 1.2,
        motion=0.9 * exact.motion + 0.03,
        scene_flow={},
        warps=(replace(exact.warps[1], flow=flow, radiance=None),),
    )
    found = OBJECTIVE.terms(render, whole, tonemap, phase)
    monkeypatch.setattr(objective, "losses_by_kernels", lambda rgb: None)
    expected = OBJECTIVE.terms(render, whole, tonemap, phase)
    assert set(found) == {"photometric", "depth", "mask", "flow"}
    assert min(float(term) for term in expected.values()) > 1e-4
    torch.testing.assert_close(found, expected)


def test_relative_depth_ignores_the_scale_of_the_prior(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    relative = replace(OBJECTIVE, depth_kind="relative")
    scaled = replace(batch, disparity=batch.disparity * 7 + 2)
    assert float(relative.terms(perfect(batch), scaled, tonemap, 0.0)["depth"]) < 1e-8
    assert float(OBJECTIVE.terms(perfect(batch), scaled, tonemap, 0.0)["depth"]) > 1


def test_the_two_step_chain_starts_with_phase_two(batch: PixelBatch, tonemap: ToneMapper) -> None:
    assert "chain" not in OBJECTIVE.terms(perfect(batch), batch, tonemap, 1.99)
    assert "chain" in OBJECTIVE.terms(perfect(batch), batch, tonemap, 2.0)


def test_photometric_counts_uniformly_drawn_pixels_only(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    rgb = batch.rgb.clone()
    rgb[~batch.uniform] += 0.5
    terms = OBJECTIVE.terms(replace(perfect(batch), radiance=rgb), batch, tonemap, 0.0)
    assert float(terms["photometric"]) < 1e-6
    assert math.isclose(float(terms["dynamic"]), 0.5, rel_tol=1e-4)


def test_squared_errors_as_printed(batch: PixelBatch, tonemap: ToneMapper) -> None:
    off = replace(perfect(batch), radiance=batch.rgb + 0.1)
    squared = replace(OBJECTIVE, squared=True).terms(off, batch, tonemap, 0.0)
    assert math.isclose(
        float(OBJECTIVE.terms(off, batch, tonemap, 0.0)["photometric"]), 0.1, rel_tol=1e-4
    )
    assert math.isclose(float(squared["photometric"]), 0.01, rel_tol=1e-3)


def test_the_dynamic_branch_alone_counts_everywhere_first_and_by_its_share_later(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    wrong = batch.rgb.clone()
    wrong[~batch.moving] += 0.4  # right where it moves, wrong elsewhere
    render = replace(perfect(batch), dynamic_radiance=wrong)
    plain = replace(OBJECTIVE, saturation=False)
    still = 1 - float(batch.moving.float().mean())
    assert math.isclose(
        float(plain.terms(render, batch, tonemap, 0.5)["dynamic"]), 0.4 * still, rel_tol=1e-4
    )
    assert float(plain.terms(render, batch, tonemap, 1.0)["dynamic"]) < 1e-6


def test_saturated_recordings_count_a_quarter_in_the_dynamic_term(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    rgb = torch.full_like(batch.rgb, 0.5)
    rgb[: N // 2] = 1.0
    two = replace(batch, rgb=rgb)
    wrong = rgb.clone()
    wrong[: N // 2] -= 0.3
    render = replace(perfect(two), dynamic_radiance=wrong)
    low = 0.25 * (N // 2)
    expected = 0.3 * low / (low + len(rgb) - N // 2)
    assert math.isclose(
        float(OBJECTIVE.terms(render, two, tonemap, 0.0)["dynamic"]), expected, rel_tol=1e-4
    )


def test_disoccluded_pixels_do_not_count_in_warped_terms(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    exact, hidden = perfect(batch), torch.arange(len(batch.pixels)) < 5
    wrong = batch.rgb + 0.9 * hidden[:, None]
    warps = tuple(replace(w, radiance=wrong, confidence=(~hidden).float()) for w in exact.warps)
    terms = OBJECTIVE.terms(replace(exact, warps=warps), batch, tonemap, 0.0)
    assert float(terms["temporal"]) < 1e-6


def test_the_share_that_weighs_a_term_gets_no_gradient_from_it(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    exact = perfect(batch)
    motion = exact.motion.clone().requires_grad_()
    warps = tuple(
        replace(w, radiance=w.radiance + 0.1) for w in exact.warps if w.radiance is not None
    )
    render = replace(
        exact, motion=motion, warps=warps, dynamic_radiance=(batch.rgb + 0.1).requires_grad_()
    )
    terms = OBJECTIVE.terms(render, batch, tonemap, 2.0)
    assert not terms["temporal"].requires_grad and not terms["chain"].requires_grad
    assert (
        torch.autograd.grad(terms["dynamic"], motion, allow_unused=True, retain_graph=True)[0]
        is None
    )
    assert float(torch.autograd.grad(terms["mask"], motion)[0].abs().sum()) > 0


def test_photometric_gradients_reach_radiance_response_and_exposures(
    batch: PixelBatch, toy: Scene
) -> None:
    learned = toy.manifest.model_copy(update={"bracket_ev": [None, 0.0, None]})
    tonemap = tone_mapper_for(ToneMapConfig(), replace(toy, manifest=learned))
    two = draw_pixels(
        toy, 2, N, 0, torch.Generator().manual_seed(0)
    )  # bracket 2: not the reference
    radiance = torch.full((N, 3), 0.3, requires_grad=True)
    render = replace(perfect(two), radiance=radiance)
    OBJECTIVE.terms(render, two, tonemap, 0.0)["photometric"].backward()
    assert float(radiance.grad.abs().min()) > 0
    moved = {
        n
        for n, p in tonemap.named_parameters()
        if p.grad is not None and float(p.grad.abs().sum()) > 0
    }
    assert any("response" in n for n in moved) and "bracket_gain.learned_ev" in moved, moved


def test_missing_priors_mean_missing_terms(batch: PixelBatch, tonemap: ToneMapper) -> None:
    bare = replace(
        batch,
        disparity=None,
        moving=None,
        flow={},
        flow_valid={},
        uniform=torch.ones_like(batch.uniform),
    )
    render = replace(perfect(batch), warps=(), scene_flow={})
    assert set(OBJECTIVE.terms(render, bare, tonemap, 2.0)) == {"photometric"}


def test_an_outlier_of_the_flow_prior_costs_no_more_than_the_limit(
    batch: PixelBatch, tonemap: ToneMapper
) -> None:
    exact = perfect(batch)
    wild = replace(exact, warps=tuple(replace(w, flow=w.flow + 500) for w in exact.warps))
    assert math.isclose(float(OBJECTIVE.terms(wild, batch, tonemap, 0.0)["flow"]), 20.0)
    assert math.isclose(
        float(replace(OBJECTIVE, published=True).terms(wild, batch, tonemap, 0.0)["flow"]) / 2,
        1000.0,
        rel_tol=1e-5,
    )
