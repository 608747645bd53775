"""Depth from known poses: planes with closed forms, parts worked by hand, and what must
not be believed.
"""

import cv2
import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_exr, write_npy
from hdr_nsff.footage.depth_files import read_depth
from hdr_nsff.geometry.fill import fill
from hdr_nsff.priors.depth import geometric as depth_module
from hdr_nsff.priors.depth.fuse import carry_over, clean, vote
from hdr_nsff.priors.depth.geometric import geometric_depth
from hdr_nsff.priors.depth.parallax import choose_views, triangulate
from hdr_nsff.priors.depth.plane_sweep import aggregate, best_share, box
from hdr_nsff.priors.movers.distance import (
    differences,
    link,
    mover_depth,
    regions,
    smoothest_path,
    split,
    steps_in_time,
)
from hdr_nsff.scene.posed_video import PosedVideo

H, W, F = 48, 64, 60.0
K = np.array([[F, 0, W / 2], [0, F, H / 2], [0, 0, 1.0]])
Y, X = np.mgrid[:H, :W] + 0.5
RAYS = np.stack([(X - W / 2) / F, (Y - H / 2) / F], -1)  # (H, W, 2): x / z, y / z
NO_POINTS = np.zeros((0, 3))


def at(*eyes: tuple[float, float, float]) -> np.ndarray:
    """Cameras (T, 3, 4) at `eyes` that all look along +z."""
    return np.stack([np.concatenate([np.eye(3), np.array(e, float)[:, None]], 1) for e in eyes])


SWEEPING = at(*[(0.16 * (t - 3), 0.06 * np.sin(t), 0) for t in range(7)])


def texture(seed: int = 0) -> np.ndarray:
    """Smooth noise in [0.1, 0.9], 512 x 512."""
    noise = cv2.GaussianBlur(
        np.random.default_rng(seed).random((512, 512, 3)).astype(np.float32), (0, 0), 2
    )
    return 0.1 + 0.8 * (noise - noise.min()) / np.ptp(noise)


def plane(c2w: np.ndarray, z0: float, slope: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The plane z = z0 + slope x seen by untilted cameras: video (T, H, W, 3) and true
    z-depth (T, H, W).
    """
    video, depth = [], []
    for ex, ey, ez in c2w[:, :, 3]:
        z = (z0 + slope * ex - ez) / (1 - slope * RAYS[..., 0])
        u, v = ((RAYS[..., k] * z + e) * 60 + 256 for k, e in ((0, ex), (1, ey)))
        video.append(
            cv2.remap(texture(seed), u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC)
        )
        depth.append(z)
    return np.stack(video), np.stack(depth)


def exact_flow(c2w: np.ndarray, depth: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Flow (P, H, W, 2) px of a static scene seen by untilted cameras."""
    point = [
        np.concatenate([RAYS * z[..., None], z[..., None]], -1) + c2w[i, :, 3]
        for i, z in enumerate(depth)
    ]
    moved = [point[i] - c2w[j, :, 3] for i, j in pairs]
    return np.stack(
        [m[..., :2] / m[..., 2:] * F + [W / 2, H / 2] - np.stack([X, Y], -1) for m in moved]
    ).astype(np.float32)


def neighbors(count: int) -> np.ndarray:
    """Pairs (P, 2) of neighbors, both ways."""
    return np.array([p for i in range(count - 1) for p in ((i, i + 1), (i + 1, i))])


def solve(c2w, video, depth, moving=None, clipped=None, **given):
    """`geometric_depth` with exact flow of the static scene."""
    nothing = np.zeros(video.shape[:3], bool)
    moving, clipped = (nothing if m is None else m for m in (moving, clipped))
    pairs = neighbors(len(c2w))
    flow = exact_flow(c2w, depth, pairs)
    valid = ~clipped[pairs[:, 0]] & ~clipped[pairs[:, 1]]
    return geometric_depth(
        K, c2w, flow, valid, pairs, moving, given.pop("points", NO_POINTS), video, clipped, **given
    )


def clip(c2w, moving=None, video=None) -> PosedVideo:
    """Frames with poses, gray unless given."""
    size = (len(c2w), H, W)
    video = np.full((*size, 3), 0.5, np.float32) if video is None else video
    moving = np.zeros(size, bool) if moving is None else moving
    return PosedVideo(
        np.broadcast_to(K, (len(c2w), 3, 3)),
        c2w,
        np.arange(len(c2w), dtype=float),
        video,
        np.zeros(size, bool),
        moving,
    )


@pytest.mark.parametrize(("z0", "slope"), [(4.0, 0.0), (4.0, 0.6), (2.5, -0.4)])
def test_a_plane_seen_by_a_moving_camera_has_its_disparity_everywhere(z0, slope):
    video, depth = plane(SWEEPING, z0, slope)
    disparity, confidence, near, far = solve(SWEEPING, video, depth)
    error = np.abs(disparity * depth - 1)
    assert np.median(error) < 0.01 and np.quantile(error[:, 4:-4, 4:-4], 0.95) < 0.04
    assert np.median(confidence) > 0.7
    assert near < depth.min() * 1.02 and far > depth.max() * 0.98


def test_exposure_does_not_change_the_disparity():
    """Correlation is blind to gain and offset."""
    video, depth = plane(SWEEPING, 4.0, 0.3)
    video[::2] = 0.1 + 0.5 * video[::2]
    disparity, *_ = solve(SWEEPING, video, depth)
    assert np.median(np.abs(disparity * depth - 1)) < 0.015


def test_two_frames_are_enough():
    c2w = at((0, 0, 0), (0.3, 0, 0))
    video, depth = plane(c2w, 4.0, 0.0)
    disparity, *_ = solve(c2w, video, depth)
    assert np.median(np.abs(disparity * depth - 1)) < 0.03


def test_what_is_clipped_in_one_frame_is_filled_from_the_others_and_believed_less():
    video, depth = plane(SWEEPING, 4.0, 0.3)
    clipped = np.zeros(video.shape[:3], bool)
    clipped[3, 10:30, 20:40] = True
    video[clipped] = 1.0
    disparity, confidence, *_ = solve(SWEEPING, video, depth, clipped=clipped)
    inside = np.s_[3, 12:28, 22:38]
    assert np.median(np.abs(disparity * depth - 1)[inside]) < 0.02
    assert confidence[inside].mean() < confidence[3, 12:28, 42:58].mean()


def test_a_moving_region_is_believed_little_and_never_behind_the_scene():
    video, depth = plane(SWEEPING, 4.0, 0.0)
    moving = np.zeros(video.shape[:3], bool)
    moving[:, 16:32, 24:40] = True
    drifting = SWEEPING.copy()
    drifting[:, 1, 3] += (
        0.3 * np.arange(7) ** 1.5
    )  # as if its camera went elsewhere: no one depth explains it
    video[moving] = plane(drifting, 3.0, 0.0, seed=5)[0][moving]
    disparity, confidence, *_ = solve(SWEEPING, video, depth, moving=moving)
    assert confidence[moving].max() <= 0.5 < np.median(confidence[~moving])
    assert disparity[moving].min() > 0.98 / 4.0


def test_cameras_at_one_instant_see_movers_stand_still():
    """Five cameras, one time: the 'moving' region has exact parallax."""
    c2w = SWEEPING[1:6]
    video, depth = plane(c2w, 4.0, 0.0)
    moving = np.zeros(video.shape[:3], bool)
    moving[:, 16:32, 24:40] = True
    disparity, confidence, *_ = solve(c2w, video, depth, moving=moving, times=np.zeros(5))
    assert np.median(np.abs(disparity * depth - 1)[moving]) < 0.02
    assert np.median(confidence[moving]) > 0.6


def test_without_parallax_everything_is_at_distance_one_and_it_is_said(monkeypatch):
    said = []
    monkeypatch.setattr(depth_module, "say", said.append)
    c2w = at(*[(0.001 * t, 0, 0) for t in range(4)])
    video, depth = plane(c2w, 4.0, 0.0)
    disparity, confidence, near, far = solve(c2w, video, depth)
    assert (disparity == 1).all() and (confidence == 0).all() and (near, far) == (0.5, 2.0)
    assert "parallax" in said[0]


def test_frames_without_anything_to_match_do_not_crash():
    """All is clipped: only structure from motion's points are left; nothing is
    believed.
    """
    video, depth = plane(SWEEPING, 4.0, 0.0)
    points = np.stack(
        [RAYS[::4, ::4, 0] * 4, RAYS[::4, ::4, 1] * 4, np.full((12, 16), 4.0)], -1
    ).reshape(-1, 3)
    clipped = np.ones(video.shape[:3], bool)
    disparity, confidence, near, far = solve(SWEEPING, video, depth, points=points, clipped=clipped)
    assert (
        np.isfinite(disparity).all()
        and (disparity > 0).all()
        and confidence.max() < 0.5
        and 0 < near < far
    )


def test_points_triangulated_from_exact_flow_are_exact():
    c2w = SWEEPING[:3]
    _, depth = plane(c2w, 4.0, 0.5)
    pairs = neighbors(3)
    points = triangulate(clip(c2w), exact_flow(c2w, depth, pairs), np.ones((4, H, W), bool), pairs)
    assert len(points) > 500
    assert np.abs(points[:, 2] - (4.0 + 0.5 * points[:, 0])).max() < 1e-3


def test_transfer_is_projection_of_the_unprojected_pixel():
    s = clip(at((0, 0, 0), (0.3, -0.2, 0.5)))
    turn, shift = s.transfer(0, 1)
    pixel, disparity = np.array([[20.5, 11.5]]), np.array([0.4])
    q = turn @ [20.5, 11.5, 1] + disparity * shift
    expected, z, inside = s.project(1, s.unproject(0, pixel, disparity))
    assert np.allclose(q[:2] / q[2], expected[0], atol=1e-4) and inside[0]
    assert np.isclose(q[2] / disparity[0], z[0], atol=1e-4)


def test_views_with_good_parallax_are_chosen_first():
    """Points at z = 4, focal 60: baselines of 0.01, 0.2 and 2 move them by 0.15, 3 and
    30 px; 5 % of 64 px is 3.2 px.
    """
    points = np.stack([RAYS[..., 0] * 4, RAYS[..., 1] * 4, np.full((H, W), 4.0)], -1)[
        ::8, ::8
    ].reshape(-1, 3)
    views, largest = choose_views(
        clip(at((0, 0, 0), (0.01, 0, 0), (0.2, 0, 0), (2, 0, 0))), points, 12
    )
    assert views[0][0] == 2
    assert np.isclose(largest, 30, rtol=0.02)


def test_box_is_the_mean_over_the_window_inside_the_image():
    image, result = np.arange(12, dtype=np.float32).reshape(3, 4), np.empty((3, 4), np.float32)
    box(image, 1, result)
    assert np.isclose(result[0, 0], (0 + 1 + 4 + 5) / 4)
    assert np.isclose(result[1, 1], 5)


def test_only_the_best_three_quarters_of_the_views_count():
    assert np.isclose(best_share(np.array([0.9, 0.1, 0.3, 0.2], np.float32), 4), 0.2)
    assert best_share(np.zeros(2, np.float32), 0) == 1.0


def test_matching_is_smooth_where_costs_say_nothing():
    """One pixel knows that candidate 3 is right; all others follow."""
    costs = np.full((5, 5, 6), 0.5, np.float32)
    costs[2, 2] = [1, 1, 1, 0, 1, 1]
    assert (aggregate(costs, np.zeros((5, 5), np.float32))[2].argmin(-1) == 3).all()


def test_a_map_carried_over_shifts_by_its_parallax_and_the_nearer_surface_wins():
    """Baseline 1, focal 60: disparity 0.05 moves by 3 px, 0.1 by 6 px; both land on
    column 20, the nearer stays.
    """
    s = clip(at((0, 0, 0), (-1, 0, 0)))
    disparity, weight = np.zeros((H, W), np.float32), np.zeros((H, W), np.float32)
    disparity[10, 17], disparity[10, 14] = 0.05, 0.1
    weight[10, 17], weight[10, 14] = 1.0, 0.5
    result, result_weight = np.empty_like(disparity), np.empty_like(weight)
    carry_over(disparity, weight, *s.transfer(0, 1), result, result_weight)
    assert np.isclose(result[10, 20], 0.1) and result_weight[10, 20] == 0.5
    assert (result > 0).sum() == 1


def test_the_vote_is_the_mean_of_those_near_the_weighted_median():
    """Weights 1, 1, 1, 2.5: the total is 5.5, the median is the third value; the
    outlier at 9 has no say.
    """
    disparities = np.array([1.0, 1.02, 1.01, 9.0], np.float32).reshape(4, 1, 1)
    fused, agreeing, everything = vote(
        disparities, np.array([1, 1, 1, 2.5], np.float32).reshape(4, 1, 1)
    )
    assert np.isclose(fused[0, 0], 1.01) and agreeing[0, 0] == 3 and everything[0, 0] == 5.5


def test_cleaning_moves_a_depth_edge_onto_the_image_edge():
    """The image changes at column 16, the map at column 18: columns 16 and 17 are given
    back to the far side.
    """
    rgb, disparity = np.full((32, 32, 3), 0.2, np.float32), np.full((32, 32), 0.2, np.float32)
    rgb[:, :16], disparity[:, :18] = 0.8, 0.5
    cleaned = clean(disparity, np.ones((32, 32), np.float32), rgb)
    assert (cleaned[:, :16] == 0.5).all() and (cleaned[:, 16:] == 0.2).all()


def test_holes_take_the_values_around_them():
    known = np.ones((H, W), bool)
    known[5:40, 10:50] = False
    filled = fill(np.where(known, 2.0, 0.0).astype(np.float32), known)
    assert np.allclose(filled, 2.0, atol=1e-5)


def test_third_differences_vanish_on_parabolas_whatever_the_spacing():
    t = np.array([0, 1, 3, 4, 5, 7.0])
    D = differences(t, np.ones(5, bool))
    assert D.shape == (3, 6)
    assert np.allclose(D @ (2 - t + 0.3 * t**2), 0, atol=1e-9)
    assert np.allclose(differences(np.arange(4.0), np.ones(3, bool)), [[-1, 3, -3, 1]])
    assert (
        len(differences(t, np.array([1, 1, 0, 1, 1], bool))) == 0
    )  # a step is unknown in every run of four


FORWARD = np.tile([0.0, 0, 1], (24, 1))


def path(shake: float, count: int = 24) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point on a straight line at z = 2 to 2.5, the eyes of a shaking camera, and the
    rays of z-depth 1 between them.
    """
    t = np.arange(count, dtype=float)
    point = np.stack([0.03 * t - 0.3, 0.01 * t, 2 + 0.02 * t], -1)
    eyes = shake * np.random.default_rng(0).standard_normal((count, 3)) + np.stack(
        [0.02 * t, 0 * t, 0 * t], -1
    )
    local = point - eyes
    return point[:, 2] - eyes[:, 2], eyes, local / local[:, 2:]


def test_a_shaking_camera_tells_how_far_a_moving_point_is():
    z, eyes, rays = path(shake=0.02)
    found, sigma = smoothest_path(
        eyes, FORWARD, rays, np.arange(24.0), np.ones(23, bool), prior=np.full(24, 3.5)
    )
    assert np.abs(found / z - 1).mean() < 0.03 and np.median(sigma) < 0.03


def test_a_smooth_camera_leaves_the_prior():
    _, eyes, rays = path(shake=0.0)
    noisy = rays + 0.003 * np.random.default_rng(1).standard_normal(rays.shape) * [1, 1, 0]
    found, sigma = smoothest_path(
        eyes, FORWARD, noisy, np.arange(24.0), np.ones(23, bool), prior=np.full(24, 3.5)
    )
    assert np.allclose(found, 3.5, rtol=0.02) and np.median(sigma) > 0.15


def crossing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A large square drifts right in front of a small still one; they touch from frame
    3. Masks (6, H, W), flow, pairs.
    """
    moving, owner = np.zeros((6, H, W), bool), np.zeros((6, H, W), int)
    for t in range(6):
        owner[t, 20:28, 34:44] = 2
        owner[t, 16:32, 10 + 3 * t : 26 + 3 * t] = 1
        moving[t] = owner[t] > 0
    pairs = neighbors(6)
    speed = np.array([0, 3, 0])
    flow = np.zeros((len(pairs), H, W, 2), np.float32)
    for k, (i, j) in enumerate(pairs):
        flow[k, ..., 0] = speed[owner[i]] * (j - i)
    return moving, flow, pairs


def test_regions_are_followed_and_touching_ones_stay_two():
    moving, flow, pairs = crossing()
    labels, steps = (
        regions(moving),
        steps_in_time(np.arange(6.0), flow, np.ones(flow.shape[:3], bool), pairs),
    )
    assert labels[2].max() == 2 and labels[3].max() == 1
    split(labels, steps)
    assert labels[3].max() == 2
    tracks = link(labels, np.arange(6.0), steps)
    longest = max(tracks, key=lambda t: len(t.frames))
    assert longest.frames == [0, 1, 2, 3, 4, 5] and np.allclose(longest.motions[0], [3, 0])


def test_a_region_that_does_not_flow_back_is_another_object():
    moving, flow, pairs = crossing()
    flow[1::2] = 40.0  # all backward flow leads elsewhere
    steps = steps_in_time(np.arange(6.0), flow, np.ones(flow.shape[:3], bool), pairs)
    assert all(len(t.frames) == 1 for t in link(regions(moving), np.arange(6.0), steps))


def test_a_mask_over_the_static_scene_is_seen_through():
    """A region that was called moving but obeys the plane's depth in all frames gets
    the plane's disparity and its confidence.
    """
    video, depth = plane(SWEEPING, 4.0, 0.0)
    moving = np.zeros(video.shape[:3], bool)
    moving[3, 16:32, 24:40] = True
    disparity, confidence, *_ = solve(SWEEPING, video, depth, moving=moving)
    assert np.median(np.abs(disparity * depth - 1)[moving]) < 0.01
    assert np.median(confidence[moving]) > 0.6


def test_a_drifting_object_seen_by_a_shaking_camera_gets_its_own_depth():
    """A square at z = 2 before a wall at z = 4, moving by 0.03 per frame."""
    rng = np.random.default_rng(3)
    eyes = np.concatenate([0.03 * rng.standard_normal((20, 2)), np.zeros((20, 1))], 1)
    center = (np.stack([0.03 * np.arange(20) - 0.3, np.zeros(20)], -1) - eyes[:, :2]) / 2 * F + [
        W / 2,
        H / 2,
    ]  # (20, 2) px
    moving = np.stack([(np.abs(X - x) < 7) & (np.abs(Y - y) < 7) for x, y in center])
    pairs = neighbors(20)
    flow = np.stack([np.broadcast_to(center[j] - center[i], (H, W, 2)) for i, j in pairs]).astype(
        np.float32
    )
    wall = np.full((20, H, W), 0.25, np.float32)
    disparity, confidence = mover_depth(
        clip(at(*eyes), moving), flow, np.ones(flow.shape[:3], bool), pairs, wall
    )
    assert np.abs(disparity[moving] * 2 - 1).mean() < 0.03
    assert (disparity[~moving] == 0.25).all()
    assert confidence[~moving].max() == 0 and 0.4 < confidence[moving].mean() <= 0.5


def test_given_maps_become_disparity_by_their_kind(tmp_path):
    values = np.full((H, W), 4.0, np.float32)
    values[0, 0] = 0  # not measured
    write_npy(tmp_path / "0.npy", values)
    write_exr(tmp_path / "1.exr", {"Z": values})
    files = [tmp_path / "0.npy", tmp_path / "1.exr"]
    disparity, confidence = read_depth(files, "metric", (H, W))
    assert np.allclose(disparity, 0.25) and confidence[0, 0, 0] == 0 and confidence[:, 1:].all()
    assert np.allclose(read_depth(files, "disparity", (H, W))[0][:, 1:], 4.0)
    assert np.allclose(read_depth(files, "relative", (H, W))[0][0], values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.ones((H, W + 1)), "shape"),
        (np.full((H, W), np.inf), "NaN or Inf"),
        (np.zeros((H, W)), "no depth above 0"),
    ],
)
def test_a_bad_depth_map_is_one_sentence(tmp_path, values, words):
    write_npy(tmp_path / "0.npy", values)
    with pytest.raises(InputError, match=words):
        read_depth([tmp_path / "0.npy"], "metric", (H, W))
