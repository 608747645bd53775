"""Movers and their depth, of a turning ellipsoid before a wall in closed form: exact
flow, and depth that is one distance per time.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from estimates import video_of
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.estimate import estimate_movers, mover_without_tracks, views_by_time
from hdr_nsff.priors.movers.tracks import MovingView
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING
from hdr_nsff.scene.movers import fill_mover_depth
from hdr_nsff.scene.posed_video import PosedVideo
from hdr_nsff.scene.scene import Scene

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")

TIMES, H, W, FOCAL, WALL = 10, 64, 96, 120.0, 6.0
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]])
EYES = np.stack([0.05 * np.arange(TIMES), 0.02 * np.sin(np.arange(TIMES)), np.zeros(TIMES)], -1)
AXES = np.array([0.6, 0.3, 0.45])  # half axes of the ellipsoid
ROTATIONS = Rotation.from_rotvec(np.outer(0.12 * np.arange(TIMES), [0.2, 1.0, 0.3])).as_matrix()
PLACES = np.array([-0.1, 0.0, 3.0]) + np.outer(np.arange(TIMES), [0.05, 0.0, 0.02])
Y, X = np.mgrid[:H, :W] + 0.5
RAYS = np.stack([(X - W / 2) / FOCAL, (Y - H / 2) / FOCAL, np.ones((H, W))], -1)


def body(t: int) -> tuple[np.ndarray, np.ndarray]:
    """The ellipsoid's mask (H, W) at a time, and its z-depth there: the nearer root of
    |diag(1 / axes) R^T (x - place)| = 1.
    """
    ray, eye = RAYS @ ROTATIONS[t] / AXES, (EYES[t] - PLACES[t]) @ ROTATIONS[t] / AXES
    a, b, c = (ray**2).sum(-1), (ray * eye).sum(-1), (eye**2).sum() - 1
    inside = b**2 - a * c > 0
    return inside, (-b - np.sqrt(np.where(inside, b**2 - a * c, 0))) / a


def flow(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Exact flow (H, W, 2) from time i to j, and where its end is visible (H, W).

    Of the ellipsoid, the side that faces the camera is visible.
    """
    inside, z = body(i)
    points = EYES[i] + RAYS * np.where(inside, z, WALL)[..., None]
    local = (points - PLACES[i]) @ ROTATIONS[i]
    moved = np.where(inside[..., None], local @ ROTATIONS[j].T + PLACES[j], points)
    normal = (local / AXES**2) @ ROTATIONS[j].T
    seen = ~inside | ((normal * (EYES[j] - moved)).sum(-1) > 0)
    local = moved - EYES[j]
    return local[..., :2] / local[..., 2:] * FOCAL + [W / 2, H / 2] - np.stack([X, Y], -1), seen


class Clip:
    """The arguments of `estimate_movers`, with flat depth, and the true disparity."""

    def __init__(self, times: int = TIMES) -> None:
        order = [p for t in range(times - 1) for p in ((t, t + 1), (t + 1, t))]
        flows = [flow(i, j) for i, j in order]
        self.pairs = np.array(order).reshape(-1, 2)
        self.flow = np.array([f for f, _ in flows], np.float32).reshape(-1, H, W, 2)
        self.valid = np.array([v for _, v in flows], bool).reshape(-1, H, W)
        seen = [body(t) for t in range(times)]
        self.moving = np.array([m for m, _ in seen])
        self.true = np.array(
            [np.where(m, 1 / np.where(m, z, 1), 1 / WALL) for m, z in seen], np.float32
        )
        flat = [
            np.where(m, d[m].mean(), 1 / WALL) for d, m in zip(self.true, self.moving, strict=True)
        ]
        self.flat = np.array(flat, np.float32)
        self.confidence = np.where(self.moving, np.float32(0.3), np.float32(0.9))
        c2w = np.concatenate([np.tile(np.eye(3), (times, 1, 1)), EYES[:times, :, None]], 2)
        video = np.full((times, H, W, 3), 0.5, np.float32)
        self.clip = PosedVideo(
            np.tile(K, (times, 1, 1)),
            c2w,
            np.arange(times) * 1.0,
            video,
            np.zeros((times, H, W), bool),
            self.moving,
        )

    def relief(self, **other) -> tuple[np.ndarray, np.ndarray]:
        """Disparity and confidence with movers, with some of the arguments replaced."""
        given = {
            "clip": self.clip,
            "flow": self.flow,
            "valid": self.valid,
            "pairs": self.pairs,
            "disparity": self.flat,
        } | other
        movers = estimate_movers(**given, confidence=self.confidence)
        disparity, confidence = given["disparity"].copy(), self.confidence.copy()
        clip = given["clip"]
        for t, f in enumerate(movers[0].frames if movers else []):
            disparity[f], confidence[f] = fill_mover_depth(
                movers, t, clip.moving[f], clip.c2w[f], disparity[f], confidence[f]
            )
        return disparity, confidence

    def wrong(self, disparity: np.ndarray) -> np.ndarray:
        """Mean absolute error (T,) of disparity inside the masks."""
        return np.array(
            [
                abs(d - t)[m].mean()
                for d, t, m in zip(disparity, self.true, self.moving, strict=True)
            ]
        )


@pytest.fixture(scope="module")
def clip() -> Clip:
    return Clip()


@pytest.fixture(scope="module")
def short() -> Clip:
    return Clip(6)


@pytest.fixture(scope="module")
def found(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    return clip.relief()


def test_the_clip_agrees_with_the_moving_ellipsoid(clip: Clip) -> None:
    k = clip.pairs.tolist().index([2, 3])
    y, x = np.argwhere(clip.moving[2] & clip.valid[k])[300]
    z = 1 / clip.true[2, y, x]
    point = EYES[2] + RAYS[y, x] * z
    moved = ROTATIONS[3] @ ROTATIONS[2].T @ (point - PLACES[2]) + PLACES[3] - EYES[3]
    there = moved[:2] / moved[2] * FOCAL + [W / 2, H / 2]
    assert np.linalg.norm((point - PLACES[2]) @ ROTATIONS[2] / AXES) == pytest.approx(1)
    assert clip.flow[k, y, x] == pytest.approx(there - [x + 0.5, y + 0.5], abs=1e-4)
    assert 1 / clip.true[3][tuple(there.astype(int)[::-1])] == pytest.approx(moved[2], abs=0.02)


def test_relief_is_found_from_depth_of_one_distance(
    clip: Clip, found: tuple[np.ndarray, np.ndarray]
) -> None:
    before, after = clip.wrong(clip.flat), clip.wrong(found[0])
    assert (
        before.min() > 0.009
        and (after < 0.7 * before).all()
        and after.mean() < 0.55 * before.mean()
    )
    # the distance comes from the camera's shake, not from the given depth
    distance = np.median((found[0] / clip.true)[clip.moving])
    assert distance == pytest.approx(1, abs=0.02)
    relief_alone = clip.wrong(found[0] / distance)
    assert (relief_alone < 0.3 * before).all() and relief_alone.mean() < 0.2 * before.mean()


def test_nothing_changes_outside_the_masks(
    clip: Clip, found: tuple[np.ndarray, np.ndarray]
) -> None:
    disparity, confidence = found
    assert np.array_equal(disparity[~clip.moving], clip.flat[~clip.moving])
    assert np.array_equal(confidence[~clip.moving], clip.confidence[~clip.moving])
    assert disparity.dtype == confidence.dtype == np.float32


def test_confidence_grows_at_tracks_and_never_falls(
    clip: Clip, found: tuple[np.ndarray, np.ndarray]
) -> None:
    confidence = found[1]
    assert (confidence >= clip.confidence).all()
    assert 0.46 < np.median(confidence[clip.moving]) <= confidence[clip.moving].max() <= 0.5


def test_the_arguments_are_not_changed(clip: Clip, found: tuple[np.ndarray, np.ndarray]) -> None:
    fresh = Clip()
    assert np.array_equal(clip.flat, fresh.flat) and np.array_equal(
        clip.confidence, fresh.confidence
    )


def untouched(short: Clip, **other) -> bool:
    disparity, confidence = short.relief(**other)
    return np.array_equal(disparity, other.get("disparity", short.flat)) and np.array_equal(
        confidence, short.confidence
    )


def test_without_movers_nothing_changes(short: Clip) -> None:
    assert untouched(short, clip=replace(short.clip, moving=np.zeros_like(short.moving)))


def test_without_flow_nothing_changes(short: Clip) -> None:
    assert untouched(short, valid=np.zeros_like(short.valid))
    assert untouched(short, flow=short.flow[:0], valid=short.valid[:0], pairs=short.pairs[:0])


def test_too_few_tracks_change_nothing(short: Clip) -> None:
    few = np.zeros_like(short.moving)
    few[:, 28:36, 44:52] = True
    assert untouched(short, clip=replace(short.clip, moving=few & short.moving))


@pytest.mark.parametrize("times", [1, 3])
def test_too_few_frames_change_nothing(times: int) -> None:
    assert untouched(Clip(times))


def test_a_mover_in_one_frame_alone_changes_nothing(short: Clip) -> None:
    moving = short.moving & (np.arange(6) == 2)[:, None, None]
    assert untouched(short, clip=replace(short.clip, moving=moving))


def test_of_several_frames_of_one_time_only_the_first_is_used(short: Clip) -> None:
    again = [0, 1, 2, 3, 4, 5, 3]  # one more frame of time 3
    s = short.clip
    clip = PosedVideo(
        s.K[again], s.c2w[again], s.times[again], s.video[again], s.clipped[again], s.moving[again]
    )
    twice = Clip(6)
    twice.confidence = short.confidence[again]
    disparity, _ = twice.relief(clip=clip, disparity=short.flat[again])
    assert np.array_equal(disparity[:6], short.relief()[0]) and np.array_equal(
        disparity[6], short.flat[3]
    )


def test_wild_flow_is_no_error(short: Clip) -> None:
    wild = np.random.default_rng(0).normal(0, 6, short.flow.shape).astype(np.float32)
    disparity, confidence = short.relief(flow=wild)
    assert np.isfinite(disparity).all() and np.isfinite(confidence).all()
    assert (abs(np.log(disparity / short.flat)) < np.log(1.5) + 1e-6).all()


def test_the_tuning_reaches_tracks_and_segmentation(short: Clip) -> None:
    tracks = replace(MOVERS_TUNING.tracks, stride_px=2 * MOVERS_TUNING.tracks.stride_px)
    segmentation = replace(MOVERS_TUNING.segmentation, min_shape_tracks=10**6)
    tuning = replace(MOVERS_TUNING, tracks=tracks, segmentation=segmentation)
    given = (short.clip, short.flow, short.valid, short.pairs, short.flat, short.confidence)
    dense, sparse = estimate_movers(*given), estimate_movers(*given, tuning)
    assert any(mover.has_shape for mover in dense)
    assert not any(mover.has_shape for mover in sparse)
    assert {mover.spacing for mover in dense} == {3} and {mover.spacing for mover in sparse} == {6}
    # a quarter of the tracks start
    assert sum(len(m.trust) for m in sparse) < 0.3 * sum(len(m.trust) for m in dense)


def scene_views(scene: Scene) -> tuple[list[int], list[MovingView]]:
    clip, flow, valid, pairs = video_of(scene)
    disparity = np.stack([f.disparity.numpy() for f in scene.train])
    return views_by_time(clip, flow, valid, pairs, disparity, np.ones_like(disparity))


def test_a_second_camera_counts_where_the_first_has_no_frame(toy: Scene) -> None:
    twin = replace(toy.train[2], camera_id=1, neighbors={}, flow={}, flow_valid={})
    chosen, views = scene_views(replace(toy, train=[*toy.train, twin]))
    assert chosen == [0, 1, 2, 3, 4, 5] and len(views) == 6


def test_flow_to_a_frame_that_is_not_the_first_of_its_time_is_left_out(toy: Scene) -> None:
    train = [*toy.train]
    train[2] = replace(train[2], camera_id=1, neighbors={}, flow={}, flow_valid={})
    train.append(toy.train[2])  # frames 1 and 3 have flow to it
    for i, o in ((1, 1), (3, -1)):
        train[i] = replace(train[i], neighbors=train[i].neighbors | {o: 6})
    chosen, views = scene_views(replace(toy, train=train))
    assert chosen == [0, 1, 2, 3, 4, 5]
    assert [sorted(v.flow) for v in views] == [[1], [-1], [], [1], [-1, 1], [-1]]


def test_without_tracks_the_path_fills_times_without_moving_pixels(toy: Scene) -> None:
    hidden = torch.zeros(34, 60, dtype=torch.bool)
    train = [replace(f, moving=hidden) if f.time in (0, 3, 5) else f for f in toy.train]
    frames, views = scene_views(replace(toy, train=train))
    mover = mover_without_tracks(np.array(frames), np.arange(6.0), views)
    assert mover.known.tolist() == [False, True, True, False, True, False]
    steps = np.diff(mover.translations[:, 0])
    assert np.isfinite(steps).all() and (steps[1:4] > 0.03).all()  # 0.1 a time, smoothed
