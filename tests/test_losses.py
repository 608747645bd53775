"""The terms of the objective against values computed by hand."""

import math

import torch

from hdr_nsff.maths import losses


def test_photometric_is_the_mean_absolute_or_squared_difference() -> None:
    a, b = torch.tensor([[0.5, 0.5, 0.5]]), torch.tensor([[0.3, 0.5, 0.9]])
    assert math.isclose(float(losses.photometric(a, b)), 0.6 / 3, rel_tol=1e-5)
    squared = float(losses.photometric(a, b, squared=True))
    assert math.isclose(squared, (0.04 + 0.16) / 3, rel_tol=1e-5)


def test_photometric_ignores_pixels_of_weight_zero() -> None:
    a, b = torch.tensor([[1.0] * 3, [9.0] * 3]), torch.zeros(2, 3)
    assert math.isclose(float(losses.photometric(a, b, torch.tensor([1.0, 0.0]))), 1.0)


def test_trust_weighs_errors_and_not_the_sum_that_they_are_divided_by() -> None:
    a, b = torch.ones(2, 3), torch.zeros(2, 3)
    trust = torch.tensor([[0.5] * 3, [0.1] * 3])
    share = torch.tensor([1.0, 3.0])
    found = losses.photometric(a, b, share, trust=trust)
    assert math.isclose(float(found), (0.5 + 3 * 0.1) / 4, rel_tol=1e-6)


def test_saturation_weight_is_one_inside_and_a_quarter_at_the_ends() -> None:
    w = losses.saturation_weight(torch.tensor([0.0, 0.15, 0.5, 0.9, 1.0]))
    torch.testing.assert_close(w, torch.tensor([0.25, 1.0, 1.0, 1.0, 0.25]))
    halfway = losses.saturation_weight(torch.tensor([0.075, 0.95]))  # (1 - 1/4)^2
    torch.testing.assert_close(halfway, torch.full((2,), 0.5625))


def test_opposite_flows_close_the_cycle_and_cost_no_kinetic_energy() -> None:
    f = torch.randn(7, 3, generator=torch.Generator().manual_seed(0))
    assert float(losses.cycle(f, -f, torch.ones(7))) == 0 and float(losses.kinetic(f, -f)) == 0


def test_kinetic_energy_of_a_bend() -> None:
    forward, backward = torch.tensor([[1.0, 0, 0]]), torch.tensor([[0.0, 1.0, 0]])
    assert math.isclose(float(losses.kinetic(forward, backward)), 0.5 * 2)
    assert float(losses.kinetic(forward[:0], backward[:0])) == 0  # as in `smoothness`


def test_flow_magnitude_does_not_cancel_between_axes() -> None:
    assert float(losses.flow_magnitude(torch.tensor([[1.0, -1.0, 0.0]]))) == 2


def test_blend_entropy_is_zero_for_certain_shares() -> None:
    assert float(losses.blend_entropy(torch.tensor([0.0, 1.0]))) == 0
    half = float(losses.blend_entropy(torch.tensor([0.5])))
    assert math.isclose(half, 0.5 * math.log(2), rel_tol=1e-5)


def test_relative_depth_ignores_scale_and_shift_of_the_prior() -> None:
    depth = torch.rand(50, generator=torch.Generator().manual_seed(0)) + 1
    assert float(losses.depth_relative(depth, 3 / depth + 5)) < 1e-10
    assert float(losses.depth_scene(depth, 1 / depth, torch.ones(50), 1.0)) < 1e-7


def test_scene_depth_is_weighted_by_the_confidence() -> None:
    depth, prior = torch.tensor([1.0, 1.0]), torch.tensor([0.5, 0.9])
    loss = losses.depth_scene(depth, prior, torch.tensor([0.0, 1.0]), near=2.0)
    assert math.isclose(float(loss), 0.1 / 2 * 2, rel_tol=1e-5)
    everywhere = losses.depth_scene(depth, prior, None, near=2.0)
    assert float(everywhere) == float(losses.depth_scene(depth, prior, torch.ones(2), near=2.0))


def test_optical_flow_counts_valid_pixels_only_and_caps_outliers() -> None:
    flow, target = torch.zeros(3, 2), torch.tensor([[1.0, 1.0], [100.0, 0.0], [50.0, 50.0]])
    valid = torch.tensor([True, True, False])
    assert float(losses.optical_flow(flow, target, valid, limit=20.0)) == (2 + 20) / 2


def test_a_correct_motion_mask_costs_almost_nothing() -> None:
    moving = torch.tensor([True, False])
    correct = losses.motion_mask(torch.tensor([1.0, 0.0]), moving)
    wrong = losses.motion_mask(torch.tensor([0.0, 1.0]), moving)
    assert float(correct) < 1e-3 < float(wrong)


def test_untrusted_pixels_of_the_motion_mask_get_no_gradient() -> None:
    motion = torch.tensor([0.3, 0.3], requires_grad=True)
    losses.motion_mask(motion, torch.tensor([True, True]), torch.tensor([1.0, 0.0])).backward()
    assert motion.grad is not None and motion.grad[0] < 0 and motion.grad[1] == 0
