"""The distance of a moving point by its smoothest path, in closed form."""

import numpy as np
from posed_planes import F, H, W, X, Y, cameras_at, neighbors, posed_video
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.distance import mover_depth, smoothest_path
from hdr_nsff.priors.movers.regions import FlowStep, region_growth

FORWARD = np.tile([0.0, 0, 1], (24, 1))
UNKNOWN_SIZE = np.stack([np.ones(24), np.arange(24)])  # every frame is a run by itself


def path(shake: float, count: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z-depth of a point on a straight line at z = 2 to 2.5, the eyes of a shaking
    camera, and the rays of z-depth 1 between them.
    """
    t = np.arange(count, dtype=float)
    point = np.stack([0.03 * t - 0.3, 0.01 * t, 2 + 0.02 * t], -1)
    eyes = shake * np.random.default_rng(0).standard_normal((count, 3)) + np.stack(
        [0.02 * t, 0 * t, 0 * t], -1
    )
    local = point - eyes
    return point[:, 2] - eyes[:, 2], eyes, local / local[:, 2:]


def test_a_shaking_camera_determines_the_distance_of_a_moving_point() -> None:
    z, eyes, rays = path(shake=0.02)
    found, sigma = smoothest_path(
        eyes,
        FORWARD,
        rays,
        np.arange(24.0),
        np.ones(23, bool),
        prior=np.full(24, 3.5),
        size=UNKNOWN_SIZE,
    )
    assert np.abs(found / z - 1).mean() < 0.03 and np.median(sigma) < 0.03


def test_a_smooth_camera_leaves_the_prior() -> None:
    _, eyes, rays = path(shake=0.0)
    noisy = rays + 0.003 * np.random.default_rng(1).standard_normal(rays.shape) * [1, 1, 0]
    found, sigma = smoothest_path(
        eyes,
        FORWARD,
        noisy,
        np.arange(24.0),
        np.ones(23, bool),
        prior=np.full(24, 3.5),
        size=UNKNOWN_SIZE,
    )
    assert np.allclose(found, 3.5, rtol=0.02) and np.median(sigma) > 0.15


def test_an_object_that_grows_in_the_picture_comes_nearer() -> None:
    """From z = 4 to 2 before a camera at rest: the path determines nothing."""
    z = np.linspace(4, 2, 24)
    rays = np.tile([0.1, 0.0, 1.0], (24, 1))
    size = np.stack([1 / z / np.mean(1 / z), np.zeros(24)])
    fixed = np.zeros((24, 3)), FORWARD, rays, np.arange(24.0), np.ones(23, bool)
    unknown, _ = smoothest_path(*fixed, prior=np.full(24, 3.0), size=UNKNOWN_SIZE)
    found, _ = smoothest_path(*fixed, prior=np.full(24, 3.0), size=size)
    assert np.ptp(np.log(unknown / z)) > 0.6 and np.ptp(np.log(found / z)) < 0.2


def test_growth_is_read_from_flow_whose_limbs_move_otherwise() -> None:
    """A square that grows by 4 % a frame; a quarter of it swings."""
    center = np.array([W / 2, H / 2])
    pixels = np.stack([X, Y], -1) + 0.5
    flow = (0.04 * (pixels - center)).astype(np.float32)
    flow[: H // 2, : W // 2] += [3, -2]
    back = (-0.04 / 1.04 * (pixels - center)).astype(np.float32)
    everywhere = np.ones((H, W), bool)
    region = (np.abs(X - W / 2) < 14) & (np.abs(Y - H / 2) < 14)
    flows, valid = np.stack([flow, back]), np.stack([everywhere, everywhere])
    growth = region_growth(FlowStep(0, 1, flows, valid, 0, 1), region, region)
    assert growth is not None and abs(growth - np.log(1.04)) < 0.004
    assert region_growth(FlowStep(0, 1, flows, ~valid, 0, 1), region, region) is None


def drifting_square(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mask, disparity and confidence (T, H, W) of a square at z = 2 before a wall at
    z = 4, moving by 0.03 per frame; the world is turned (3, 3).
    """
    rng = np.random.default_rng(3)
    eyes = np.concatenate([0.03 * rng.standard_normal((20, 2)), np.zeros((20, 1))], 1)
    place = np.stack([0.03 * np.arange(20) - 0.3, np.zeros(20)], -1)
    center = (place - eyes[:, :2]) / 2 * F + [W / 2, H / 2]  # (20, 2) px
    moving = np.stack([(np.abs(X - x) < 7) & (np.abs(Y - y) < 7) for x, y in center])
    pairs = neighbors(20)
    motions = [np.broadcast_to(center[j] - center[i], (H, W, 2)) for i, j in pairs]
    flow = np.stack(motions).astype(np.float32)
    wall = np.full((20, H, W), 0.25, np.float32)
    clip, valid = posed_video(turn @ cameras_at(*eyes), moving), np.ones(flow.shape[:3], bool)
    return moving, *map(np.asarray, mover_depth(clip, flow, valid, pairs, wall))


def test_a_drifting_object_seen_by_a_shaking_camera_gets_its_own_depth() -> None:
    moving, disparity, confidence = drifting_square(np.eye(3))
    assert np.abs(disparity[moving] * 2 - 1).mean() < 0.03
    assert (disparity[~moving] == 0.25).all()
    assert confidence[~moving].max() == 0 and 0.4 < confidence[moving].mean() <= 0.5


def test_the_axes_of_the_world_are_of_no_matter() -> None:
    turn = Rotation.from_rotvec([0.5, -1.0, 0.8]).as_matrix()
    for found, expected in zip(drifting_square(turn), drifting_square(np.eye(3)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4)
