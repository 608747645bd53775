"""Poses from frames: painted clips with known cameras."""

import numpy as np
import pytest
from posed_clips import FOCAL, PLACES, H, K, W, panning, sliding, texture
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.lens import Lens, distorted_picture
from hdr_nsff.geometry.poses import Poses, project
from hdr_nsff.priors.poses.estimate import PosesTuning, estimate_poses, parallax_free_share


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Poses:
    """Poses of the sliding clip, found once."""
    pytest.importorskip("pycolmap")
    return estimate_poses(sliding(PLACES), None, tmp_path_factory.mktemp("sfm"))


def test_structure_from_motion_finds_the_path(mapped):
    assert mapped.parallax == "full" and mapped.registered.all()
    assert mapped.K[0, 0, 0] == pytest.approx(FOCAL, rel=0.1)
    found, true = mapped.c2w[:, :, 3] - mapped.c2w[:, :, 3].mean(0), PLACES - PLACES.mean(0)
    scale = np.linalg.norm(true) / np.linalg.norm(found)
    turn = Rotation.align_vectors(true, found)[0].as_matrix()
    assert np.abs(scale * found @ turn.T - true).max() < 0.03  # of a path 1 long


@pytest.mark.parametrize("threads", [1, 3])
def test_structure_from_motion_is_the_same_with_any_number_of_threads(mapped, tmp_path, threads):
    again = estimate_poses(sliding(PLACES), None, tmp_path, threads=threads)
    for field in ("c2w", "K", "points"):
        assert np.array_equal(getattr(again, field), getattr(mapped, field))


def test_an_ill_conditioned_clip_has_the_same_poses_in_every_run(tmp_path):
    pytest.importorskip("pycolmap")
    lens = Lens(K, (0.15, 0.0, 0.0, 0.0), W, H)  # which pinhole cameras have to explain
    bent = np.stack([distorted_picture(frame, K, lens) for frame in sliding(PLACES)])
    one, many = [estimate_poses(bent, None, tmp_path, threads=n) for n in (1, 4)]
    for field in ("c2w", "K", "points"):
        assert np.array_equal(getattr(one, field), getattr(many, field))


def test_points_project_where_they_were_seen_and_near_is_one(mapped):
    frames, rows = mapped.tracks[:, 0].astype(int), mapped.tracks[:, 1].astype(int)
    pixels, depth = project(mapped, frames, mapped.points[rows])
    assert len(mapped.points) > 100
    assert np.median(np.linalg.norm(pixels - mapped.tracks[:, 2:], axis=1)) < 0.3
    assert mapped.near == 1 and (depth > 1).mean() > 0.98 and (depth < mapped.far).mean() > 0.98
    assert np.nanmax(mapped.frame_errors) < 0.5


def test_nothing_is_left_in_the_working_folder(tmp_path):
    pytest.importorskip("pycolmap")
    (tmp_path / ".sfm-old").mkdir()  # of a killed run
    estimate_poses(sliding(PLACES[:5]), None, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_pan_gives_its_angles_and_focal_length(tmp_path):
    angles = np.linspace(-12, 12, 10)
    poses = estimate_poses(panning(angles), None, tmp_path)
    assert poses.parallax == "rotation" and not poses.c2w[:, :, 3].any()
    assert poses.K[0, 0, 0] == pytest.approx(FOCAL, rel=0.03)
    across = Rotation.from_matrix(poses.c2w[-1, :, :3] @ poses.c2w[0, :, :3].T).magnitude()
    assert np.degrees(across) == pytest.approx(24, rel=0.03)


def test_a_tripod_has_no_camera_motion(tmp_path):
    noise = np.random.default_rng(0).normal(size=(9, H, W, 3))
    video = np.repeat(panning(np.zeros(1)), 9, 0) + 0.01 * noise
    for t in range(9):
        video[t, 30:60, 10 * t : 10 * t + 30] = texture(9, 30, 30)  # someone walks by
    poses = estimate_poses(video.astype(np.float32), None, tmp_path)
    assert poses.parallax == "none"
    assert np.array_equal(poses.c2w, np.tile(np.eye(4)[:3], (9, 1, 1)))
    assert "60 degrees" in poses.notes[1]  # nothing fixes the focal length
    upright = estimate_poses(np.rot90(video, axes=(1, 2)).astype(np.float32), None, tmp_path)
    assert upright.parallax == "none" and upright.K[0, 0, 0] == poses.K[0, 0, 0]


def test_parallax_is_distinguished_from_a_turn():
    nothing = np.zeros((8, H, W), bool)
    assert parallax_free_share(panning(np.linspace(-10, 10, 8)), nothing) > 0.95
    assert parallax_free_share(sliding(PLACES), nothing) < PosesTuning().min_rotation_share


def test_a_short_slide_past_boards_is_no_turn_behind_a_long_lens() -> None:
    """The wall, most of the picture, shifts as a whole; the boards do not."""
    clip, tuning = sliding(PLACES[:5]), PosesTuning()
    share = parallax_free_share(clip, np.zeros(clip.shape[:3], bool))
    assert share == tuning.min_rotation_share_fallback < tuning.min_rotation_share


def test_frames_without_texture_fail_in_a_sentence(tmp_path):
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError, match=r"no two frames could be matched.*--poses"):
        estimate_poses(np.full((6, H, W, 3), 0.5, np.float32), None, tmp_path)


def test_two_frames_are_too_few(tmp_path):
    with pytest.raises(InputError, match="at least 3"):
        estimate_poses(np.zeros((2, H, W, 3), np.float32), None, tmp_path)
