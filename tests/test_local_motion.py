"""Flow told by what is around: only where it is not sure, as the model says, sharp at
outlines, by what can be trusted.
"""

import numpy as np
import pytest

from hdr_nsff.priors.flow import local_motion
from hdr_nsff.priors.flow.dense import MISSED, detail, told
from hdr_nsff.priors.flow.local_motion import LINEAR, QUADRATIC, SAMPLES, filled, fit, solve

H, W = 48, 72
ALL = np.ones((H, W))
NOTHING = np.zeros((H, W), bool)
Y, X = np.mgrid[:H, :W].astype(np.float32)


def noisy(flow: np.ndarray, sigma: float = 0.2) -> np.ndarray:
    return flow + np.random.default_rng(0).normal(0, sigma, flow.shape).astype(np.float32)


def affine() -> np.ndarray:
    """A flow (H, W, 2) that turns and grows a little."""
    return np.stack([2 + 0.01 * X - 0.02 * Y, -1 + 0.02 * X + 0.01 * Y], -1)


def halves() -> np.ndarray:
    """Two motions (H, W, 2) side by side."""
    return np.where(X[..., None] < W / 2, np.float32([4, 0]), np.float32([-1, 1])).astype(
        np.float32
    )


def error(a: np.ndarray, b: np.ndarray, margin: int = 0) -> np.ndarray:
    return np.linalg.norm(a - b, axis=-1)[margin : H - margin, margin : W - margin]


def smoothed(flow: np.ndarray, trusted: np.ndarray) -> np.ndarray:
    """All of `flow` told anew."""
    return filled(flow, trusted, ALL > 0, NOTHING)


def test_a_uniform_motion_stays_as_it_is() -> None:
    uniform = np.full((H, W, 2), 1.5, np.float32)
    assert np.array_equal(smoothed(uniform, ALL), uniform)


def test_motion_that_turns_and_grows_stays_and_its_noise_goes() -> None:
    assert error(smoothed(affine(), ALL), affine(), 6).max() < 1e-4
    assert (
        error(smoothed(noisy(affine(), 0.1), ALL), affine()).mean()
        < 0.5 * error(noisy(affine(), 0.1), affine()).mean()
    )


def test_an_outline_between_two_motions_stays_sharp() -> None:
    assert error(smoothed(halves(), ALL), halves()).max() < 0.05


def test_a_patch_that_shows_nothing_moves_as_what_is_around_it() -> None:
    hole = (abs(X - 30) < 4) & (abs(Y - 24) < 4)
    lost = np.where(hole[..., None], affine() + 0.3, affine()).astype(np.float32)
    found = filled(lost, np.where(hole, 0, 1), hole, NOTHING)
    assert error(found, affine())[hole].max() < 0.02
    assert np.array_equal(found[~hole], lost[~hole])


def test_what_stands_still_tells_nothing_of_what_moves_and_what_is_unknown_is_told_by_both() -> (
    None
):
    side = np.where(X < W / 2, 1, -1)
    alike = 0.05 * halves()  # nearer to each other than what counts as unlike
    assert error(smoothed(alike, ALL), alike).max() > 0.05
    told_apart = error(filled(alike, ALL, ALL > 0, side), alike)
    assert told_apart[side == 1].max() < 1e-4 and told_apart[side == -1].max() > 0.05
    middle = abs(X - W / 2) < 2
    blurred = filled(alike, ALL, ALL > 0, np.where(middle, 0, side))
    assert error(blurred, alike)[middle].min() > 0.01


def test_movers_and_the_rest_are_told_apart_but_where_nothing_shows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    still = np.zeros((H, W, 2), np.float32)
    side = asked(monkeypatch, still, still, picture(), picture(), X < 20, NOTHING, moving=Y < 10)[2]
    assert np.array_equal(side, np.where(X < 20, 0, np.where(Y < 10, 1, -1)))


def test_without_anything_trusted_flow_stays_as_it_was() -> None:
    assert np.array_equal(smoothed(noisy(halves()), 0 * ALL), noisy(halves()))


def test_larger_pictures_have_larger_windows() -> None:
    """The window is a share of the picture, but one pixel at least."""
    steps = []
    original, local_motion.fit = fit, lambda *given: steps.append(given[5])
    try:
        for width in (60, 128, 129, 320, 1920):
            filled(
                np.zeros((4, width, 2), np.float32),
                np.ones((4, width)),
                np.ones((4, width), bool),
                np.zeros((4, width)),
            )
    finally:
        local_motion.fit = original
    assert steps == [1, 1, 2, 3, 15]


@pytest.mark.parametrize("place", [(0, 0), (20, 30), (47, 71), (3, 60)])
def test_the_kernel_is_the_weighted_least_squares_it_says(place: tuple[int, int]) -> None:
    """A slow twin of one pixel, by `lstsq`."""
    flow, trusted, step = (
        noisy(halves()),
        np.random.default_rng(1).random((H, W)).astype(np.float32),
        2,
    )
    sides_of = np.where(
        np.random.default_rng(4).random((H, W)) < 0.3, 0, np.where(X + Y < 60, 1, -1)
    ).astype(np.int8)
    rows, sides, weights = [], [], []
    for row in range(-SAMPLES, SAMPLES + 1):
        for column in range(-SAMPLES, SAMPLES + 1):
            y, x = place[0] + row * step, place[1] + column * step
            if not (0 <= y < H and 0 <= x < W):
                continue
            dy, dx = row / local_motion.WIDTH, column / local_motion.WIDTH
            if sides_of[place] == 1 and sides_of[y, x] == -1:
                continue
            other = flow[y, x] - flow[place]
            unlike = (other**2).sum() / (local_motion.ALIKE**2 * (1 + dx * dx + dy * dy))
            near = trusted[y, x] * np.exp(-0.5 * (dx * dx + dy * dy))
            if near >= 1e-4:
                weights.append(near / (1 + unlike) ** 2)
                rows.append([1, dx, dy, dx * dx, dx * dy, dy * dy])
                sides.append(other)
    root = np.sqrt(np.array(weights))[:, None]
    ridge = np.diag(
        np.sqrt(sum(weights) * np.array([0, LINEAR, LINEAR, QUADRATIC, QUADRATIC, QUADRATIC]))
    )
    system = np.concatenate([root * np.array(rows), ridge])
    expected = (
        flow[place]
        + np.linalg.lstsq(
            system, np.concatenate([root * np.array(sides), np.zeros((6, 2))]), rcond=None
        )[0][0]
    )
    offsets = np.arange(-SAMPLES, SAMPLES + 1)
    window = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2) / local_motion.WIDTH**2)
    result = flow.copy()
    fit(flow, trusted, ALL > 0, sides_of, window, step, result)
    assert np.allclose(result[place], expected, atol=1e-4)


def test_normal_equations_are_solved() -> None:
    rng = np.random.default_rng(2)
    root, sides = rng.random((20, 6)), rng.random((20, 2))
    matrix = root.T @ root
    ridge = np.diag([0, LINEAR, LINEAR, QUADRATIC, QUADRATIC, QUADRATIC]) * matrix[0, 0]
    system = np.concatenate([np.triu(matrix), root.T @ sides], 1)
    solve(system)
    assert np.allclose(system[:, 6:], np.linalg.solve(matrix + ridge, root.T @ sides))


def picture(seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (H, W)).astype(np.uint8)


def asked(
    monkeypatch: pytest.MonkeyPatch, *given: np.ndarray, moving: np.ndarray = NOTHING
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `told` says of these: trust (H, W), where flow is not sure, and which side
    pixels are on.
    """
    seen: list[np.ndarray] = []
    monkeypatch.setattr(
        "hdr_nsff.priors.flow.dense.filled", lambda flow, *rest: seen.extend(rest) or flow
    )
    told(*given, moving)
    return seen[0], seen[1], seen[2]


def test_flow_is_trusted_where_it_agrees_with_its_reverse_and_something_shows_in_both(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    still = np.zeros((H, W, 2), np.float32)
    sure, unsure, _ = asked(monkeypatch, still, still, picture(), picture(), NOTHING, NOTHING)
    assert sure[4:-4, 4:-4].min() > 0.3 and np.median(sure) > 0.7 and not unsure.any()
    plain = np.where(X < 20, 100, picture()).astype(np.uint8)
    for one, other in ((plain, picture()), (picture(), plain)):
        assert (
            asked(monkeypatch, still, still, one, other, NOTHING, NOTHING)[0][:, :14].max() < 1e-6
        )
    lost, unsure, _ = asked(
        monkeypatch, still, still + 3 * MISSED, picture(), picture(), NOTHING, NOTHING
    )
    assert lost.max() < 0.02 and unsure.all()


def test_what_is_clipped_at_either_end_is_not_sure_and_hardly_trusted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    still = np.zeros((H, W, 2), np.float32)
    sure, *_ = asked(monkeypatch, still, still, picture(), picture(), NOTHING, NOTHING)
    for one, other in ((X < 20, NOTHING), (NOTHING, X < 20)):
        trusted, unsure, _ = asked(monkeypatch, still, still, picture(), picture(), one, other)
        assert np.allclose(trusted, np.where(X < 20, 0.1 * sure, sure)) and np.array_equal(
            unsure, X < 20
        )


def test_detail_of_stripes_is_nothing_for_they_show_one_direction() -> None:
    stripes = (127 + 100 * np.sin(X)).astype(np.uint8)
    checks = (127 + 50 * np.sin(X) + 50 * np.sin(Y)).astype(np.uint8)
    assert detail(stripes).max() < 1e-3 < 100 < detail(checks)[5:-5, 5:-5].min()
