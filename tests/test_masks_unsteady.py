"""Moving masks of what a camera that stands still never shows again."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.masks.regions import marked_regions, regions_with_disc, without_specks
from hdr_nsff.priors.masks.unsteady import (
    UnsteadyTuning,
    mark_unsteady,
    typical_deviation,
)

T, H, W = 24, 40, 60
FACE = np.s_[8:32, 18:42]
CORE = np.s_[11:29, 21:39]  # of the face, beyond the blur
K = np.array([[50.0, 0, W / 2], [0, 50.0, H / 2], [0, 0, 1]])
STILL = np.tile(np.eye(4)[:3], (T, 1, 1))
ONE_GROUP = np.zeros(T, int)
ALL = np.ones(T, bool)


def talking(seed: int = 0, frames: range = range(T)) -> np.ndarray:
    """A wall, before which a face of blotches changes in some `frames`."""
    noise = np.random.default_rng(seed)
    wall = np.repeat(np.repeat(noise.uniform(0.3, 1, (H // 4, W // 4, 3)), 4, 0), 4, 1)
    video = np.tile(wall, (T, 1, 1, 1)) + noise.normal(0, 0.01, (T, H, W, 3))
    for t in frames:
        blotches = noise.uniform(0.2, 0.8, (6, 6, 3))
        video[t][FACE] = np.repeat(np.repeat(blotches, 4, 0), 4, 1)
    return video.astype(np.float32)


def seen_by_flow(*frames: int) -> np.ndarray:
    """Masks of flow that finds the face in some `frames`."""
    moving = np.zeros((T, H, W), bool)
    for t in frames:
        moving[t][FACE] = True
    return moving


def test_what_changes_always_and_is_marked_at_times_moves_always():
    marked = mark_unsteady(seen_by_flow(3, 4, 11), talking(), ONE_GROUP, ALL, K, STILL)
    assert marked[:, *CORE].all()
    outside = np.ones((H, W), bool)
    outside[6:34, 16:44] = False
    assert not marked[:, outside].any()


def test_what_flow_never_marks_stays_static():
    before = seen_by_flow(3)  # one of 24 frames
    assert (mark_unsteady(before, talking(), ONE_GROUP, ALL, K, STILL) == before).all()


def test_somebody_who_passes_by_is_marked_no_longer_than_he_is_there():
    before = seen_by_flow(*range(8, 16))
    after = mark_unsteady(before, talking(frames=range(8, 16)), ONE_GROUP, ALL, K, STILL)
    assert (after == before).all()


def test_small_changes_and_thin_regions_are_left_alone():
    still = talking(frames=range(0))
    before = seen_by_flow(*range(0, T, 3))
    assert (mark_unsteady(before, still, ONE_GROUP, ALL, K, STILL) == before).all()
    branch = still.copy()
    branch[::2, 10:14, 5:55] = 0.05  # four rows: the blur leaves them narrow
    before = np.zeros((T, H, W), bool)
    before[::2, 10:14, 5:55] = True
    wide = UnsteadyTuning(radius_share=0.1)
    assert (mark_unsteady(before, branch, ONE_GROUP, ALL, K, STILL, wide) == before).all()


def test_a_change_below_what_is_visible_is_none_even_without_noise():
    video = np.full((T, H, W, 3), 0.5, np.float32)
    video[::2][:, *FACE] += 0.03  # a deviation of 0.022
    before = seen_by_flow(*range(0, T, 3))
    assert (mark_unsteady(before, video, ONE_GROUP, ALL, K, STILL) == before).all()
    sharper = UnsteadyTuning(min_deviation=0.02)
    assert mark_unsteady(before, video, ONE_GROUP, ALL, K, STILL, sharper)[:, *CORE].all()


def test_noise_is_no_change():
    noise = np.random.default_rng(2).normal(0.5, 0.15, (T, H, W, 3)).astype(np.float32)
    before = np.zeros((T, H, W), bool)
    before[::3] = True
    assert (mark_unsteady(before, noise, ONE_GROUP, ALL, K, STILL) == before).all()


def test_one_exposure_that_shows_the_change_is_enough():
    video, groups = talking(), np.arange(T) % 2
    video[1::2] = np.clip(video[1::2] * 40, 0, 1)  # clips everywhere
    marked = mark_unsteady(seen_by_flow(3, 4, 11), video, groups, ALL, K, STILL)
    assert marked[:, *CORE].all()


def test_a_difference_of_exposures_is_no_change():
    video, groups = talking(frames=range(0)), np.arange(T) % 2
    video[1::2] *= 0.3
    before = seen_by_flow(*range(0, T, 3))
    assert (mark_unsteady(before, video, groups, ALL, K, STILL) == before).all()


def test_held_out_frames_decide_nothing_about_training_frames():
    train = np.arange(T) % 4 != 3
    before = seen_by_flow(*np.flatnonzero(~train))
    after = mark_unsteady(before, talking(), ONE_GROUP, train, K, STILL)
    assert not after[train].any()
    assert after[~train][:, *CORE].all()


def test_few_frames_of_an_exposure_show_nothing():
    before = seen_by_flow(0, 1, 2)
    assert (mark_unsteady(before, talking(), np.arange(T) // 5, ALL, K, STILL) == before).all()


def test_memory_does_not_grow_with_the_clip():
    class Counted:
        """A clip that counts the frames that are read."""

        def __init__(self, video: np.ndarray) -> None:
            self.video, self.reads = video, 0

        def __getitem__(self, t: int) -> np.ndarray:
            self.reads += 1
            return self.video[t]

    clip = Counted(talking())
    few = UnsteadyTuning(max_frames=9)
    mark_unsteady(seen_by_flow(3, 4), clip, ONE_GROUP, ALL, K, STILL, few)  # type: ignore[arg-type]
    assert clip.reads == 9


def test_the_typical_deviation_is_that_of_a_gaussian_and_ignores_moments():
    values = np.random.default_rng(1).normal(0.5, 0.05, (400, 8, 8, 3))
    assert abs(typical_deviation(values[..., :1])[0].mean() / 0.05 - 1) < 0.05
    values[::5] = 3.0
    assert typical_deviation(values)[0].max() < 0.09


def test_regions_are_cleaned_and_chosen():
    pixels = np.zeros((24, 40), bool)
    pixels[6:16, 4:14] = True
    pixels[9:11, 8:10] = False  # a gap
    pixels[6:16, 22:32] = True
    pixels[20, 35] = True  # a speck
    clean = without_specks(pixels, 3, 5)
    assert clean[6:16, 4:14].all() and not clean[20, 35] and clean.sum() == 200
    share = np.where(np.arange(40) < 18, 0.3, 0.1) * np.ones((24, 1))
    assert marked_regions(clean, share, 0.2).sum() == 100
    assert marked_regions(clean, share, 0.05).sum() == 200
    inside = clean.copy()
    inside[9:, 22:32] = False  # three rows are left of the second
    assert regions_with_disc(clean, inside, 3.0).sum() == 100


def test_what_changes_always_is_found_before_a_camera_that_turns():
    shifts = np.tile([0.0, 3.0, -2.0], T // 3)  # pixels to the right
    angles = np.arctan(shifts / K[0, 0])
    c2w = STILL.copy()
    c2w[:, :, :3] = Rotation.from_euler("y", -angles[:, None]).as_matrix().reshape(-1, 3, 3)
    truth = seen_by_flow(*range(T))
    video, before = talking(), seen_by_flow(3, 4, 11)
    for t in range(T):
        to_pixels = K @ c2w[t, :, :3].T @ np.linalg.inv(K)
        for images in (video, before, truth):
            seen = cv2.warpPerspective(images[t].astype(np.float32), to_pixels, (W, H))
            images[t] = seen > 0.5 if images.dtype == bool else seen
    wide = UnsteadyTuning(max_turn_share=0.2)  # corners move by 0.07 of the width
    marked = mark_unsteady(before, video, ONE_GROUP, ALL, K, c2w, wide)
    assert (marked & truth).sum() / (marked | truth).sum() > 0.8
    assert mark_unsteady(before, video, ONE_GROUP, ALL, K, STILL).sum() != marked.sum()
    assert (mark_unsteady(before, video, ONE_GROUP, ALL, K, c2w) == before).all()


def test_edges_of_frames_that_are_not_well_aligned_are_steady():
    ramp = np.tile(np.linspace(0, 1, W)[None, :, None], (H, 1, 3))
    shifted = np.stack([ramp + (-1) ** t * 0.4 / (W - 1) for t in range(T)])
    assert typical_deviation(shifted)[0].max() > 0.009
    assert typical_deviation(shifted, alignment_px=0.6)[0].max() < 1e-9
