"""A camera that stands still is recognized, whatever moves before it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from posed_clips import PLACES, H, W, panning, sliding, texture
from scipy.spatial.transform import Rotation
from test_prepare_footage import work_on

from hdr_nsff.core.errors import InputError
from hdr_nsff.prepare.prepare import check_settings
from hdr_nsff.prepare.steps.footage import exposure_step
from hdr_nsff.prepare.steps.poses import find_poses
from hdr_nsff.prepare.work import PrepareConfig
from hdr_nsff.priors.poses import estimate
from hdr_nsff.priors.poses.estimate import estimate_poses
from hdr_nsff.priors.poses.still_camera import (
    Detail,
    StillCameraTuning,
    growth_of,
    nearly_still_shifts,
    shaken_background,
    shift_of,
    shifts_if_spread,
    still_camera_shifts,
)
from hdr_nsff.radiometry.local_detail import local_detail

NUM = 12
WALL = panning(np.zeros(1))[0]


def noisy(video: np.ndarray) -> np.ndarray:
    """The clip (T, H, W, 3) with a sensor's noise."""
    noise = np.random.default_rng(0).normal(0, 0.01, video.shape)
    return np.clip(video + noise, 0, 1).astype(np.float32)


def behind_a_box() -> np.ndarray:
    """A tripod's clip (NUM, H, W, 3): a textured box covers most of the picture, and
    moves through it.
    """
    video = np.repeat(WALL[None], NUM, 0)
    box = 1.5 * (texture(7, 90, 70) - 0.5) + 0.5  # more contrast than the wall
    for t in range(NUM):
        x, y = 2 * t, t
        video[t, y : y + 70, x : x + 90] = box
    return noisy(video)


def test_a_still_camera_behind_a_mover_that_fills_the_picture(tmp_path):
    shifts = still_camera_shifts(behind_a_box())
    assert shifts is not None and len(shifts) == NUM and shifts.max() < 0.2
    poses = estimate_poses(behind_a_box(), None, tmp_path)
    assert poses.parallax == "none" and poses.registered.all()
    assert np.array_equal(poses.c2w, np.tile(np.eye(4)[:3], (NUM, 1, 1)))


def shaken(video: np.ndarray, pixels: float) -> np.ndarray:
    """The clip (T, H, W, 3) with every second frame shifted to the right."""
    matrix = np.array([[1, 0, pixels], [0, 1, 0]])
    moved = [cv2.warpAffine(f, matrix, (W, H), borderMode=cv2.BORDER_REFLECT) for f in video]
    return np.stack([moved[t] if t % 2 else video[t] for t in range(len(video))])


def test_a_camera_that_shakes_behind_a_mover_that_fills_the_picture(tmp_path):
    still = behind_a_box()
    box = still.std(0).mean(-1) > 0.05  # where it is at times
    clip = shaken(still, 1.5)
    assert still_camera_shifts(clip) is None
    background = shaken_background(clip)
    assert background is not None and (background & ~box).sum() > 0.8 * background.sum()
    poses = estimate_poses(clip, None, tmp_path)
    assert poses.parallax == "rotation" and poses.registered.all()
    assert "of the picture, shakes at most" in poses.notes[-1]
    relative = poses.c2w[:-1, :, :3].transpose(0, 2, 1) @ poses.c2w[1:, :, :3]
    angles = np.degrees(Rotation.from_matrix(relative).magnitude())
    focal = poses.K[0, 0, 0]
    sides = 1 + (W / 2 / focal) ** 2 / 3  # a turn shifts them farther, so much in the mean
    assert angles == pytest.approx(np.degrees(1.5 / focal / sides), rel=0.1)


def test_a_camera_that_moves_farther_does_not_shake():
    assert shaken_background(shaken(behind_a_box(), 4.0)) is None
    assert shaken_background(noisy(sliding(PLACES))) is None
    assert shaken_background(noisy(panning(np.linspace(-4, 4, NUM)))) is None


def grown(video: np.ndarray, growths: np.ndarray) -> np.ndarray:
    """The clip (T, H, W, 3) with every frame larger by a share (T,)."""
    frames = []
    for frame, g in zip(video, growths, strict=True):
        matrix = np.array([[1 + g, 0, -g * W / 2], [0, 1 + g, -g * H / 2]])
        frames.append(cv2.warpAffine(frame, matrix, (W, H), borderMode=cv2.BORDER_REFLECT))
    return np.stack(frames)


def test_a_camera_that_walks_towards_a_far_background_does_not_shake():
    for growth, shakes in ((0.002, True), (0.01, False)):
        clip = grown(shaken(behind_a_box(), 0.8), np.linspace(-growth, growth, NUM))
        assert (shaken_background(clip) is not None) == shakes, growth


def shaken_below(row: int, above: bool) -> np.ndarray:
    """A clip (NUM, H, W, 3) in which nothing but the rows `above` a row, or below it,
    stays in its place.
    """
    video = noisy(panning(np.linspace(-30, 30, NUM)))
    part = np.s_[:, :row] if above else np.s_[:, row:]
    video[part] = noisy(np.repeat(WALL[None], NUM, 0))[part]
    return video


def test_a_wall_above_somebody_who_fills_the_picture_is_a_background():
    clip = shaken_below(H // 3, above=True)
    assert still_camera_shifts(clip) is not None
    spread_out = StillCameraTuning(min_share_above=1.0)
    assert still_camera_shifts(clip, tuning=spread_out) is None


@pytest.mark.parametrize("hidden, still", [(0.2, True), (0.5, False)])
def test_a_wall_that_is_hidden_for_a_while_is_a_background(hidden: float, still: bool):
    clip = shaken_below(H // 3, above=True)
    covered = np.s_[: round(hidden * NUM), : H // 3]
    clip[covered] = noisy(panning(np.linspace(-30, 30, NUM)))[covered]
    assert (still_camera_shifts(clip) is not None) == still


def before_a_plain_wall(shake: float = 0.0, passing: bool = False) -> np.ndarray:
    """A clip (NUM, H, W, 3): something large moves in the middle, before a wall with a
    few spots. The camera is shaken by `shake` pixels; something may be `passing` on the
    right side.
    """
    spots = np.zeros((H, W), bool)
    for x in (W // 20, W - W // 20):
        for y in (H // 8, H // 3, 5 * H // 8):
            spots[y - 1 : y + 2, x - 1 : x + 2] = True
    wall = np.where(spots[..., None], WALL, np.float32(0.5))
    box = texture(7, W // 2, H)
    video = []
    for t in range(NUM):
        frame = wall.copy()
        left, top = W // 8 + 2 * t, H // 6 + t
        part = frame[top : top + 2 * H // 3, left : left + W // 2]
        part[:] = box[: len(part)]
        if passing:
            frame[:, -W // 8 :] = texture(t, W // 8, H)
        matrix = np.array([[1, 0, shake * (t % 2)], [0, 1, 0]])
        frame = cv2.warpAffine(frame, matrix, (W, H), borderMode=cv2.BORDER_REPLICATE)
        video.append(frame)
    noise = np.random.default_rng(0).normal(0, 0.002, (NUM, H, W, 3))
    return np.clip(np.stack(video) + noise, 0, 1).astype(np.float32)


def test_somebody_before_a_plain_wall_is_filmed_by_a_still_camera():
    shifts = still_camera_shifts(before_a_plain_wall())
    assert shifts is not None and np.median(shifts) < 0.2
    never_calm = StillCameraTuning(max_change_calm=0.0)
    assert still_camera_shifts(before_a_plain_wall(), tuning=never_calm) is None


def test_before_a_plain_wall_a_shaken_camera_or_a_moving_side_is_no_tripod():
    assert still_camera_shifts(before_a_plain_wall(shake=1.0)) is None
    assert still_camera_shifts(before_a_plain_wall(passing=True)) is None


def no_poses(*_):
    raise InputError("nothing matches")


def test_what_has_no_other_poses_may_shake_a_little(tmp_path, monkeypatch):
    monkeypatch.setattr(estimate, "parallax_free_share", lambda *_: None)
    monkeypatch.setattr(estimate.Mapper, "poses", no_poses)
    shaken = before_a_plain_wall(shake=0.5)
    shifts = nearly_still_shifts(shaken)
    assert still_camera_shifts(shaken) is None
    assert shifts is not None and 0.1 < shifts.max() < 0.003 * W
    poses = estimate_poses(shaken, None, tmp_path)
    assert poses.parallax == "none" and poses.registered.all()
    assert poses.notes[0] == "treated as a camera that stands still, since nothing matches"
    with pytest.raises(InputError, match="nothing matches"):
        estimate_poses(panning(np.linspace(-30, 30, NUM)), None, tmp_path)


@pytest.mark.parametrize(
    ("share", "count", "rests"), [(0.6, 19, True), (0.6, 200, False), (0.4, 19, False)]
)
def test_a_turn_that_explains_much_counts_for_more_than_few_points(
    share, count, rests, tmp_path, monkeypatch
):
    """Two people hide most of what a shaken camera sees: their parallax is none."""
    angles = np.linspace(-12, 12, NUM)
    found = replace(estimate_poses(panning(angles), None, tmp_path), parallax="full")
    found = replace(found, points=np.ones((count, 3)), notes=("mapped",))
    monkeypatch.setattr(estimate, "parallax_free_share", lambda *_: share)
    monkeypatch.setattr(estimate.Mapper, "poses", lambda *_: found)
    poses = estimate_poses(panning(angles), None, tmp_path)
    assert (poses.parallax == "rotation") == rests
    assert poses.notes[0] == (
        "treated as a camera that turns in place, since structure from motion finds 19 points only"
        if rests
        else "mapped"
    )


def test_what_hardly_shows_a_background_or_moves_does_not_stand_nearly_still():
    assert nearly_still_shifts(before_a_plain_wall(shake=2.0)) is None
    assert nearly_still_shifts(panning(np.linspace(-30, 30, NUM))) is None
    more_detail = StillCameraTuning(min_share_last=0.5)
    assert nearly_still_shifts(before_a_plain_wall(), tuning=more_detail) is None


def test_a_dashboard_is_no_background():
    assert still_camera_shifts(shaken_below(2 * H // 3, above=False)) is None


@pytest.mark.parametrize(("columns", "still"), [(10, True), (60, False)])
def test_little_that_sways_in_a_quarter_does_not_move_the_camera(columns, still):
    """Hair sways in the right half, before a wall that shows on the left alone."""
    background = local_detail(WALL)
    kept = np.zeros((H, W), bool)
    kept[:, : W // 2] = True
    hair = np.s_[-H // 2 :, -columns:]
    kept[hair] = True
    frames = np.repeat(background[None], NUM, 0)
    frames[:, *hair] = np.roll(background, 1, axis=1)[hair]
    found = Detail(frames, np.ones_like(frames, bool), background, kept, scale=1.0)
    assert np.median(found.shifts(kept & (np.arange(W) > W // 2))) > 0.8
    assert (shifts_if_spread(found, StillCameraTuning()) is not None) == still


def zoomed(factors: np.ndarray) -> np.ndarray:
    """The wall (T, H, W, 3) as a zoom shows it, by `factors` (T,)."""
    center = np.array([W, H]) / 2 - 0.5
    frames = []
    for factor in factors:
        matrix = np.concatenate([factor * np.eye(2), ((1 - factor) * center)[:, None]], 1)
        frames.append(cv2.warpAffine(WALL, matrix, (W, H), borderMode=cv2.BORDER_REFLECT))
    return np.stack(frames)


@pytest.mark.parametrize(
    "video",
    [
        panning(np.linspace(-4, 4, NUM)),
        sliding(PLACES),
        panning(np.tile([0.0, 0.6], NUM // 2)),
        zoomed(np.linspace(0.97, 1.03, NUM)),
    ],
    ids=["pan", "slide", "shake of 1.6 pixels", "zoom"],
)
def test_a_camera_that_moves_does_not_stand_still(video):
    assert still_camera_shifts(noisy(video)) is None


def test_clipped_pixels_are_left_out():
    video = noisy(np.repeat(WALL[None], NUM, 0))
    clipped = np.zeros(video.shape[:3], bool)
    for t in range(NUM):  # every frame shows something else in a part of its own
        part = np.s_[t, :, W // 4 * (t % 3) : W // 4 * (t % 3 + 1)]
        video[part], clipped[part] = 0.5 + 0.5 * texture(t, W // 4, H), True
    assert still_camera_shifts(video, clipped) is not None
    assert still_camera_shifts(video, np.ones_like(clipped)) is None


def test_one_color_tells_nothing():
    assert still_camera_shifts(np.full((NUM, H, W, 3), 0.5, np.float32)) is None


@pytest.mark.parametrize("shift", [0.0, 0.2, 0.5])
def test_a_shift_comes_back(shift):
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    waves = lambda x: np.sin(x / 3) * np.cos(y / 4)  # noqa: E731
    background, moved = waves(x), waves(x - shift)
    assert shift_of(moved, background, np.ones((H, W), bool)) == pytest.approx(shift, abs=0.02)
    assert shift_of(moved, background, np.zeros((H, W), bool)) == np.inf


@pytest.mark.parametrize("growth", [0.0, 0.003, 0.01])
def test_a_growth_comes_back(growth):
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    waves = lambda x, y: np.sin(x / 6) * np.cos(y / 8)  # noqa: E731
    background, moved = waves(x, y), waves(x / (1 + growth) - 0.3, y / (1 + growth))
    assert growth_of(moved, background, np.ones((H, W), bool)) == pytest.approx(growth, abs=5e-4)
    assert growth_of(moved, background, np.zeros((H, W), bool)) == np.inf


def test_detail_does_not_depend_on_contrast():
    dim = 0.3 + 0.4 * (WALL - 0.5)
    same = np.corrcoef(local_detail(WALL).ravel(), local_detail(dim).ravel())[0, 1]
    assert same > 0.99


def test_the_user_may_say_that_the_camera_stood_still(tmp_path):
    video = np.full((6, 24, 32, 3), 0.5, np.float32)  # nothing that could be matched
    work = work_on(tmp_path, video, tripod=True, ev="0,2")
    exposure_step(work)
    found = find_poses(work)
    assert found.note == "6 of 6 frames placed, parallax: none"
    assert all(np.array_equal(c2w, np.eye(4)[:3]) for c2w in found.frames["c2w"].values())


def test_a_tripod_holds_one_camera(tmp_path):
    work = work_on(tmp_path, np.full((6, 24, 32, 3), 0.5, np.float32), tripod=True, rig=3)
    exposure_step(work)
    with pytest.raises(InputError, match="--tripod is for one camera"):
        find_poses(work)


def test_a_tripod_with_poses_is_refused(tmp_path):
    with pytest.raises(InputError, match="--tripod and --poses both given"):
        check_settings(PrepareConfig(tmp_path, tmp_path / "out", poses=tmp_path, tripod=True))
