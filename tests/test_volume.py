"""Volume rendering: closed forms, a slow loop, and what must add up."""

import math

import torch

from hdr_nsff.maths import volume


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def test_samples_are_even_in_disparity() -> None:
    z = volume.stratified_disparity(1, 2, 1.0, 4.0, None)[0]
    torch.testing.assert_close(1 / z, torch.tensor([1 - 0.25 * 0.75, 1 - 0.75 * 0.75]))


def test_jitter_stays_within_its_bin() -> None:
    z = volume.stratified_disparity(50, 8, 1.0, 10.0, random(50, 8))
    disparity = 1 / z
    edges = 1 + torch.arange(9) / 8 * (0.1 - 1)
    assert (disparity <= edges[:-1] + 1e-6).all() and (disparity >= edges[1:] - 1e-6).all()


def test_constant_density_gives_the_beer_lambert_opacity() -> None:
    density, deltas = torch.full((1, 100), 0.7), torch.full((1, 100), 0.05)
    w = volume.single(density, deltas)
    assert math.isclose(float(w.sum()), 1 - math.exp(-0.7 * 5), rel_tol=1e-4)


def test_weights_and_transmitted_light_add_up_to_one() -> None:
    static, dynamic = random(20, 16) * 5, random(20, 16, seed=1) * 5
    deltas = random(20, 16, seed=2) * 0.3
    w = volume.add(static, dynamic, deltas)
    transmitted = torch.exp(-((static + dynamic) * deltas).sum(-1))
    total = (w.static + w.dynamic).sum(-1)
    torch.testing.assert_close(total, 1 - transmitted, atol=1e-5, rtol=1e-5)


def test_blend_share_zero_is_static_alone_and_one_is_dynamic_alone() -> None:
    s, d = random(4, 9), random(4, 9, seed=1)
    deltas = random(4, 9, seed=2)
    static_only = volume.blend(s, d, torch.zeros(4, 9), deltas)
    dynamic_only = volume.blend(s, d, torch.ones(4, 9), deltas)
    torch.testing.assert_close(static_only.static, volume.single(s, deltas))
    torch.testing.assert_close(dynamic_only.dynamic, volume.single(d, deltas))
    assert float(static_only.dynamic.abs().max()) == 0
    assert float(dynamic_only.static.abs().max()) == 0


def test_blend_agrees_with_a_slow_loop() -> None:
    s, d, b, deltas = (random(1, 5, seed=i) for i in range(4))
    w, t = volume.blend(s, d, b, deltas), 1.0
    for i in range(5):
        a_dy = (1 - math.exp(-d[0, i] * deltas[0, i])) * b[0, i]
        a_st = (1 - math.exp(-s[0, i] * deltas[0, i])) * (1 - b[0, i])
        assert math.isclose(float(w.dynamic[0, i]), t * a_dy, rel_tol=1e-4)
        assert math.isclose(float(w.static[0, i]), t * a_st, rel_tol=1e-4)
        t *= (1 - a_dy) * (1 - a_st)


def test_without_dynamic_density_adding_is_the_static_render() -> None:
    s, deltas = random(4, 9), random(4, 9, seed=2)
    w = volume.add(s, torch.zeros(4, 9), deltas)
    torch.testing.assert_close(w.static, volume.single(s, deltas))
    assert float(w.dynamic.sum()) == 0


def test_an_opaque_sample_gives_its_depth_and_an_empty_ray_the_far_plane() -> None:
    weights = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    depths = torch.tensor([[1.0, 2.0, 3.0]] * 2)
    expected = volume.expected_depth(weights, depths, far=9.0)
    torch.testing.assert_close(expected, torch.tensor([2.0, 9.0]))
