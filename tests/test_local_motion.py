"""Flow filled from its neighborhood: only where it is uncertain, as the local model
says, sharp at outlines, and from trusted pixels.
"""

import numpy as np
import pytest

from hdr_nsff.priors.flow import local_motion
from hdr_nsff.priors.flow.local_motion import (
    LOCAL_MOTION_TUNING,
    MOVING,
    STATIC,
    UNKNOWN,
    corner_response,
    fill_flow,
    fill_uncertain_flow,
    fit_local_motion,
    solve_ridge,
    window_weights,
)

H, W = 48, 72
ALL = np.ones((H, W))
NONE = np.zeros((H, W), bool)
ALL_UNKNOWN = np.full((H, W), UNKNOWN)
Y, X = np.mgrid[:H, :W].astype(np.float32)
TUNING = LOCAL_MOTION_TUNING
LINEAR, QUADRATIC = TUNING.linear_ridge, TUNING.quadratic_ridge


def noisy(flow: np.ndarray, sigma: float = 0.2) -> np.ndarray:
    """`flow` with Gaussian noise."""
    return flow + np.random.default_rng(0).normal(0, sigma, flow.shape).astype(np.float32)


def affine() -> np.ndarray:
    """A flow (H, W, 2) that turns and grows a little."""
    return np.stack([2 + 0.01 * X - 0.02 * Y, -1 + 0.02 * X + 0.01 * Y], -1)


def halves() -> np.ndarray:
    """Two motions (H, W, 2) side by side."""
    left, right = np.float32([4, 0]), np.float32([-1, 1])
    return np.where(X[..., None] < W / 2, left, right).astype(np.float32)


def error(a: np.ndarray, b: np.ndarray, margin: int = 0) -> np.ndarray:
    """End-point errors without a margin."""
    return np.linalg.norm(a - b, axis=-1)[margin : H - margin, margin : W - margin]


def refit(flow: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """`flow` with every pixel filled."""
    return fill_flow(flow, trust, ALL > 0, ALL_UNKNOWN)


def test_a_uniform_motion_stays_as_it_is() -> None:
    uniform = np.full((H, W, 2), 1.5, np.float32)
    assert np.array_equal(refit(uniform, ALL), uniform)


def test_motion_that_turns_and_grows_stays_and_its_noise_goes() -> None:
    noise = noisy(affine(), 0.1)
    assert error(refit(affine(), ALL), affine(), 6).max() < 1e-4
    assert error(refit(noise, ALL), affine()).mean() < 0.5 * error(noise, affine()).mean()


def test_an_outline_between_two_motions_stays_sharp() -> None:
    assert error(refit(halves(), ALL), halves()).max() < 0.05


def test_an_untrusted_patch_moves_like_its_neighborhood() -> None:
    hole = (abs(X - 30) < 4) & (abs(Y - 24) < 4)
    wrong = np.where(hole[..., None], affine() + 0.3, affine()).astype(np.float32)
    found = fill_flow(wrong, np.where(hole, 0, 1), hole, ALL_UNKNOWN)
    assert error(found, affine())[hole].max() < 0.02
    assert np.array_equal(found[~hole], wrong[~hole])


def test_moving_pixels_are_not_filled_from_static_ones_and_unknown_ones_are_filled_from_both() -> (
    None
):
    layer = np.where(X < W / 2, MOVING, STATIC)
    similar = 0.05 * halves()  # too close to each other to count as unlike
    assert error(refit(similar, ALL), similar).max() > 0.05
    separate = error(fill_flow(similar, ALL, ALL > 0, layer), similar)
    assert separate[layer == MOVING].max() < 1e-4 and separate[layer == STATIC].max() > 0.05
    middle = abs(X - W / 2) < 2
    blended = fill_flow(similar, ALL, ALL > 0, np.where(middle, UNKNOWN, layer))
    assert error(blended, similar)[middle].min() > 0.01


def test_pixels_are_moving_or_static_and_unknown_where_clipped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    zero = np.zeros((H, W, 2), np.float32)
    *_, layer = fill_inputs(
        monkeypatch, zero, zero, picture(), picture(), X < 20, NONE, moving=Y < 10
    )
    expected = np.where(X < 20, UNKNOWN, np.where(Y < 10, MOVING, STATIC))
    assert np.array_equal(layer, expected)


def test_without_trusted_pixels_flow_stays_as_it_was() -> None:
    assert np.array_equal(refit(noisy(halves()), 0 * ALL), noisy(halves()))


def test_larger_frames_have_larger_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The distance of samples is a share of the frame, but one pixel at least."""
    steps: list[int] = []
    monkeypatch.setattr(local_motion, "fit_local_motion", lambda *given: steps.append(given[5]))
    for width in (60, 128, 129, 320, 1920):
        flow, ones = np.zeros((4, width, 2), np.float32), np.ones((4, width))
        fill_flow(flow, ones, ones > 0, 0 * ones)
    assert steps == [1, 1, 2, 3, 15]


def lstsq_fit(
    place: tuple[int, int], flow: np.ndarray, trust: np.ndarray, layer: np.ndarray, step: int
) -> np.ndarray:
    """The flow (2,) of one pixel by `lstsq`: a slow twin of the kernel."""
    rows, motions, weights = [], [], []
    radius, sigma = TUNING.window_radius, TUNING.window_sigma
    for row in range(-radius, radius + 1):
        for column in range(-radius, radius + 1):
            y, x = place[0] + row * step, place[1] + column * step
            if not (0 <= y < H and 0 <= x < W):
                continue
            if layer[place] == MOVING and layer[y, x] == STATIC:
                continue
            dy, dx = row / sigma, column / sigma
            motion = flow[y, x] - flow[place]
            scale = TUNING.unlike_motion_px**2 * (1 + dx * dx + dy * dy)
            unlike = (motion**2).sum() / scale
            near = trust[y, x] * np.exp(-0.5 * (dx * dx + dy * dy))
            if near >= 1e-4:
                weights.append(near / (1 + unlike) ** 2)
                rows.append([1, dx, dy, dx * dx, dx * dy, dy * dy])
                motions.append(motion)
    root = np.sqrt(np.array(weights))[:, None]
    ridge = np.array([0, LINEAR, LINEAR, QUADRATIC, QUADRATIC, QUADRATIC])
    system = np.concatenate([root * np.array(rows), np.diag(np.sqrt(sum(weights) * ridge))])
    target = np.concatenate([root * np.array(motions), np.zeros((6, 2))])
    return flow[place] + np.linalg.lstsq(system, target, rcond=None)[0][0]


@pytest.mark.parametrize("place", [(0, 0), (20, 30), (47, 71), (3, 60)])
def test_the_kernel_equals_weighted_least_squares(place: tuple[int, int]) -> None:
    flow, step = noisy(halves()), 2
    trust = np.random.default_rng(1).random((H, W)).astype(np.float32)
    unknown = np.random.default_rng(4).random((H, W)) < 0.3
    layer = np.where(unknown, UNKNOWN, np.where(X + Y < 60, MOVING, STATIC)).astype(np.int8)
    result = flow.copy()
    fit_local_motion(
        flow,
        trust,
        ALL > 0,
        layer,
        window_weights(TUNING),
        step,
        TUNING.window_sigma,
        TUNING.unlike_motion_px,
        LINEAR,
        QUADRATIC,
        TUNING.min_weight,
        result,
    )
    assert np.allclose(result[place], lstsq_fit(place, flow, trust, layer, step), atol=1e-4)


def test_normal_equations_are_solved() -> None:
    rng = np.random.default_rng(2)
    root, sides = rng.random((20, 6)), rng.random((20, 2))
    matrix = root.T @ root
    ridge = np.diag([0, LINEAR, LINEAR, QUADRATIC, QUADRATIC, QUADRATIC]) * matrix[0, 0]
    system = np.concatenate([np.triu(matrix), root.T @ sides], 1)
    solve_ridge(system, LINEAR, QUADRATIC)
    assert np.allclose(system[:, 6:], np.linalg.solve(matrix + ridge, root.T @ sides))


def picture(seed: int = 3) -> np.ndarray:
    """Gray noise (H, W) uint8."""
    return np.random.default_rng(seed).integers(0, 255, (H, W)).astype(np.uint8)


def fill_inputs(
    monkeypatch: pytest.MonkeyPatch, *given: np.ndarray, moving: np.ndarray = NONE
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `fill_uncertain_flow` derives from these: trust, uncertain pixels and layers
    (H, W).
    """
    seen: list[np.ndarray] = []
    monkeypatch.setattr(local_motion, "fill_flow", lambda flow, *rest: seen.extend(rest) or flow)
    fill_uncertain_flow(*given, moving)
    return seen[0], seen[1], seen[2]


def test_wanted_pixels_alone_are_filled_and_as_ever() -> None:
    generator = np.random.default_rng(7)
    flow = generator.normal(0, 0.3, (H, W, 2)).astype(np.float32)
    given = flow, -flow + 0.2, picture(), picture(), NONE, generator.random((H, W)) < 0.3
    wanted = generator.random((H, W)) < 0.5
    everywhere = fill_uncertain_flow(*given, NONE)
    there = fill_uncertain_flow(*given, NONE, wanted)
    assert (everywhere != flow).any(-1)[wanted].mean() > 0.5
    assert np.array_equal(there, np.where(wanted[..., None], everywhere, flow))


def test_flow_is_trusted_that_agrees_with_its_reverse_on_texture_in_both_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    zero = np.zeros((H, W, 2), np.float32)
    trust, uncertain, _ = fill_inputs(monkeypatch, zero, zero, picture(), picture(), NONE, NONE)
    assert trust[4:-4, 4:-4].min() > 0.3 and np.median(trust) > 0.7 and not uncertain.any()
    flat = np.where(X < 20, 100, picture()).astype(np.uint8)
    for source, target in ((flat, picture()), (picture(), flat)):
        trust, *_ = fill_inputs(monkeypatch, zero, zero, source, target, NONE, NONE)
        assert trust[:, :14].max() < 1e-6
    reverse = zero + 3 * TUNING.trusted_round_trip_px
    trust, uncertain, _ = fill_inputs(monkeypatch, zero, reverse, picture(), picture(), NONE, NONE)
    assert trust.max() < 0.02 and uncertain.all()


def test_pixels_clipped_at_either_end_are_uncertain_and_hardly_trusted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    zero = np.zeros((H, W, 2), np.float32)
    unclipped, *_ = fill_inputs(monkeypatch, zero, zero, picture(), picture(), NONE, NONE)
    for at_source, at_target in ((X < 20, NONE), (NONE, X < 20)):
        trust, uncertain, _ = fill_inputs(
            monkeypatch, zero, zero, picture(), picture(), at_source, at_target
        )
        assert np.allclose(trust, np.where(X < 20, 0.1 * unclipped, unclipped))
        assert np.array_equal(uncertain, X < 20)


def test_stripes_have_no_corner_response_because_they_fix_one_direction_only() -> None:
    stripes = (127 + 100 * np.sin(X)).astype(np.uint8)
    checks = (127 + 50 * np.sin(X) + 50 * np.sin(Y)).astype(np.uint8)
    assert corner_response(stripes).max() < 1e-3
    assert corner_response(checks)[5:-5, 5:-5].min() > 100
