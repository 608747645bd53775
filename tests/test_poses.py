"""Poses from frames: painted clips with known cameras, and the parts they are made of."""

import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff import cli
from hdr_nsff.core import io
from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.colmap import ColmapCamera, ColmapImage, ColmapModel
from hdr_nsff.geometry.poses import Poses, interpolate, project, ranges, trusted_points
from hdr_nsff.priors.poses import estimate as module
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.estimate import estimate_poses, plausible, worth
from hdr_nsff.priors.poses.matching import (
    PairMatches,
    keypoints,
    match_all,
    picture,
    spread_pairs,
    usable,
    view_pairs,
)
from hdr_nsff.priors.poses.rotation import derivatives, panorama, turned

W, H, FOCAL = 160, 96, 150.0
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1.0]])
HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # array index -> pixel center


def texture(seed: int, width: int, height: int) -> np.ndarray:
    """Blotches of several sizes, rgb (height, width, 3) in [0, 1]."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.random((height, width, 3)), (0, 0), s) for s in (1.2, 2.5, 5.0)]
    total = sum((x - x.mean()) / x.std() for x in layers)
    return np.clip(0.5 + 0.15 * total, 0, 1).astype(np.float32)


def seen(texture: np.ndarray, to_pixels: np.ndarray) -> np.ndarray:
    """A frame (H, W, 3) from a texture whose index coordinates map to pixels by a
    homography; NaN outside.
    """
    matrix = np.linalg.inv(HALF) @ to_pixels @ HALF
    return cv2.warpPerspective(
        texture, matrix, (W, H), flags=cv2.INTER_AREA, borderValue=(np.nan,) * 3
    )


def panning(angles: np.ndarray) -> np.ndarray:
    """A clip (T, H, W, 3) of a camera that turns by `angles` (T) degrees about the
    vertical, before a far wall.
    """
    wall = texture(0, 400, 240)
    place = K @ np.array(
        [[1, 0, -200], [0, 1, -120], [0, 0, FOCAL]]
    )  # a pixel of the wall per pixel straight ahead
    turns = Rotation.from_euler("y", angles[:, None], degrees=True).as_matrix().reshape(-1, 3, 3)
    return np.stack(
        [np.nan_to_num(seen(wall, K @ turn.T @ np.linalg.inv(K) @ place)) for turn in turns]
    )


def sliding(places: np.ndarray) -> np.ndarray:
    """A clip (T, H, W, 3) of a camera at `places` (T, 3) looking along +z at a wall and
    three boards before it.
    """
    clip = []
    boards = [
        (6.0, (-5, -3, 10, 6), 0),
        (3.5, (-1.6, -0.9, 1.1, 0.8), 1),
        (2.6, (0.3, -0.3, 0.6, 0.9), 2),
        (4.5, (0.4, -1.2, 1.5, 0.8), 3),
    ]
    for place in places:
        frame = np.zeros((H, W, 3), np.float32)
        for depth, (x, y, width, height), seed in sorted(boards, reverse=True):
            scale = 60.0  # texture pixels per scene unit
            image = texture(seed, int(width * scale), int(height * scale))
            plane = np.array(
                [
                    [1 / scale, 0, x - place[0]],
                    [0, 1 / scale, y - place[1]],
                    [0, 0, depth - place[2]],
                ]
            )
            layer = seen(image, K @ plane)
            frame = np.where(np.isnan(layer), frame, layer)
        clip.append(frame)
    return np.stack(clip)


PLACES = np.stack(
    [np.linspace(-0.5, 0.5, 8), 0.15 * np.sin(np.arange(8)), 0.1 * np.cos(np.arange(8))], 1
)


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
    assert (
        np.array_equal(again.c2w, mapped.c2w)
        and np.array_equal(again.K, mapped.K)
        and np.array_equal(again.points, mapped.points)
    )


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


def test_a_tripod_stands_still(tmp_path):
    video = np.repeat(panning(np.zeros(1)), 9, 0) + 0.01 * np.random.default_rng(0).normal(
        size=(9, H, W, 3)
    )
    for t in range(9):
        video[t, 30:60, 10 * t : 10 * t + 30] = texture(9, 30, 30)  # someone walks by
    poses = estimate_poses(video.astype(np.float32), None, tmp_path)
    assert poses.parallax == "none"
    assert np.array_equal(poses.c2w, np.tile(np.eye(4)[:3], (9, 1, 1)))
    assert "60 degrees" in poses.notes[1]  # nothing tells the focal length


def test_parallax_is_told_from_a_turn():
    nothing = np.zeros((8, H, W), bool)
    assert module.turning_share(panning(np.linspace(-10, 10, 8)), nothing) > 0.95
    assert module.turning_share(sliding(PLACES), nothing) < module.ROTATION


def test_a_slide_past_a_flat_wall_is_no_turn():
    wall = texture(0, 400, 240)
    slide = np.stack(
        [seen(wall, np.array([[1, 0, -200 + 8.0 * t], [0, 1, -70], [0, 0, 1]])) for t in range(8)]
    )
    matches = match_all(keypoints(slide, np.zeros((8, H, W), bool)), view_pairs([list(range(8))]))
    assert panorama(matches, 8, W, H).slides


def test_frames_without_texture_fail_in_a_sentence(tmp_path):
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError, match=r"no two frames could be tied together.*--poses"):
        estimate_poses(np.full((6, H, W, 3), 0.5, np.float32), None, tmp_path)


def test_two_frames_are_too_few(tmp_path):
    with pytest.raises(InputError, match="at least 3"):
        estimate_poses(np.zeros((2, H, W, 3), np.float32), None, tmp_path)


def test_cameras_of_a_rig_that_stand_still_share_one_view():
    rng = np.random.default_rng(0)
    left, right = panning(np.zeros(1))[0], panning(np.array([20.0]))[0]
    video = np.stack([f + 0.005 * rng.normal(size=f.shape) for f in [left, right] * 6]).astype(
        np.float32
    )
    video[4, 20:50, 20:50] = 0  # something passes the left camera once
    views = module.collapse(
        video, np.zeros(video.shape[:3], bool), [list(range(0, 12, 2)), list(range(1, 12, 2))]
    )
    assert len(views.pictures) == 2 and views.of_frame.tolist() == [0, 1] * 6
    assert np.abs(views.pictures[0] - left).max() < 0.03  # the median does not know the passer-by


def test_missing_poses_lie_between_their_neighbors():
    c2w = np.tile(np.eye(4)[:3], (4, 1, 1))
    c2w[2, :, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    c2w[2, 0, 3] = 2.0
    filled = interpolate(
        Poses(np.tile(K, (4, 1, 1)), c2w, np.array([True, False, True, False]), "full"),
        [[0, 1, 2, 3]],
    )
    assert np.allclose(filled.c2w[1, :, 3], (1, 0, 0))
    assert np.degrees(Rotation.from_matrix(filled.c2w[1, :, :3]).magnitude()) == pytest.approx(45)
    assert np.allclose(filled.c2w[3], c2w[2])  # held beyond the last
    assert filled.notes == (
        "2 of 4 frames did not register; their poses are interpolated (frames 1, 3)",
    )


def test_points_seen_twice_or_badly_are_not_trusted():
    points = np.array([[0, 0, 4.0], [0, 0, 4], [0, 0, 4]])
    tracks = np.array([[t, p, W / 2, H / 2] for p, n in enumerate((3, 2, 3)) for t in range(n)])
    poses = Poses(
        np.tile(K, (3, 1, 1)),
        np.tile(np.eye(4)[:3], (3, 1, 1)),
        np.ones(3, bool),
        "full",
        points,
        np.array([0.1, 0.1, 5]),
        tracks,
    )
    kept = trusted_points(poses)
    assert len(kept.points) == 1 and kept.tracks[:, 1].tolist() == [0, 0, 0]
    assert np.allclose(kept.frame_errors, 0)


def model(focal: float, images: int) -> ColmapModel:
    """A reconstruction of `images` images, 240 pixels wide."""
    camera = ColmapCamera("SIMPLE_PINHOLE", 240, 136, np.diag([focal, focal, 1.0]), np.zeros(0))
    return ColmapModel(
        {1: camera},
        dict.fromkeys(range(images)),
        np.zeros(0),
        np.zeros((0, 3)),
        np.zeros(0),
        np.zeros(0),
    )


def test_a_plausible_lens_counts_more_than_images():
    assert not plausible(model(89, 36))  # 107 degrees: what movers left unmasked once made of 50
    assert worth(model(250, 20), 36) > worth(model(89, 36), 36)
    assert worth(model(250, 34), 36) > worth(model(250, 20), 36)


def views_of(count: int) -> module.Views:
    """`count` black frames of one camera, 240x136."""
    return module.Views(
        np.zeros((count, 136, 240, 3)),
        np.zeros((count, 136, 240), bool),
        [list(range(count))],
        np.arange(count),
    )


def test_failure_names_the_lens_or_the_frames():
    images = {
        k: ColmapImage(f"{k:05d}.png", 1, np.eye(4)[:3], np.zeros((0, 2)), np.zeros(0))
        for k in (0, 1, 2, 6)
    }
    assert "impossible 45 px" in module.sentence(
        replace(model(90, 0), images=images), views_of(5), []
    )  # doubled frames: 90 / 2
    assert "6 of 10 frames could not be placed (frames 3-5, 7-9)" in module.sentence(
        replace(model(500, 0), images=images), views_of(10), []
    )


def test_ranges_of_frames_read_well():
    assert ranges([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert ranges(list(range(0, 40, 2))).endswith("...")


def test_turning_derivatives_agree_with_differences():
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(0.1 * rng.normal(size=(2, 3))).as_matrix()
    ends, p = np.tile([0, 1], (5, 1)), rng.uniform(-40, 40, (5, 2))
    exact = derivatives(rotations, FOCAL, ends, p, turned(rotations, FOCAL, ends, p)[1])
    step = 1e-6
    for k in range(7):
        moved, focal = rotations.copy(), FOCAL
        if k < 6:
            moved[k // 3] = (
                moved[k // 3] @ Rotation.from_rotvec(step * np.eye(3)[k % 3]).as_matrix()
            )
        else:
            focal = FOCAL * np.exp(step)
        slope = (turned(moved, focal, ends, p)[0] - turned(rotations, FOCAL, ends, p)[0]) / step
        assert np.allclose(exact[:, :, k], slope, atol=1e-2)


def test_keypoints_keep_away_from_what_is_ignored():
    ignore = np.zeros((1, H, W), bool)
    ignore[0, :, : W // 2] = True
    found = keypoints(panning(np.zeros(1)), ignore)[0]
    assert len(found.xy) > 20 and found.xy[:, 0].min() > W / 2 + 1


def test_keypoints_know_pixel_centers():
    dot = np.zeros((1, H, W, 3), np.float32)
    y, x = np.mgrid[:H, :W] + 0.5
    dot[0] = np.exp(-((x - 60.5) ** 2 + (y - 40.5) ** 2) / 2 / 3**2)[
        ..., None
    ]  # a blob whose middle is pixel (60, 40)
    xy = keypoints(dot, np.zeros((1, H, W), bool))[0].xy
    assert np.linalg.norm(xy - (60.5, 40.5), axis=1).min() < 0.15


def test_small_frames_are_doubled_with_their_masks():
    ignore = np.zeros((H, W), bool)
    ignore[10, 10] = True
    assert picture(np.zeros((H, W, 3)), 2, True).shape == (2 * H, 2 * W)
    assert (usable(ignore, 2, margin=0) == 0).sum() == 4


def test_every_frame_meets_its_own_exposure():
    pairs = spread_pairs(20)
    assert {(0, 1), (0, 2), (0, 3), (0, 4), (0, 6), (0, 8), (0, 12), (0, 16)} == {
        p for p in pairs if p[0] == 0
    }
    assert all(i < j < 20 for i, j in pairs)


def test_many_views_of_two_cameras_meet_at_the_same_time():
    pairs = view_pairs([list(range(20)), list(range(20, 40))])
    assert {(k, 20 + k) for k in range(20)} <= set(pairs) and (0, 25) not in pairs


def test_matches_nobody_else_supports_give_no_panorama():
    rng = np.random.default_rng(0)
    noise = PairMatches(0, 1, rng.uniform(0, 90, (50, 2)), rng.uniform(0, 90, (50, 2)))
    assert panorama([noise], 2, W, H) is None


def test_a_worker_that_breaks_down_says_why(tmp_path):
    pytest.importorskip("pycolmap")
    (tmp_path / "images").mkdir()
    job = sfm.Job(str(tmp_path), [["missing.png"]], [], 100.0, "nonsense")  # type: ignore[arg-type]
    with pytest.raises(sfm.SfmError):
        sfm.run(job)


def test_a_worker_does_not_outlive_its_parent(tmp_path):
    code = (
        "import subprocess, sys, time\n"
        "worker = 'import time; from hdr_nsff.priors.poses.sfm import die_with_parent; die_with_parent(); time.sleep(60)'\n"
        "print(subprocess.Popen([sys.executable, '-c', worker]).pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    time.sleep(2.0)  # until it watches
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    for _ in range(100):
        if not os.path.exists(f"/proc/{worker}"):
            return
        time.sleep(0.1)
    os.kill(worker, signal.SIGKILL)
    pytest.fail("the worker lives on")


FULL_DISK = """
import errno, os, pathlib
write = pathlib.Path.write_text

def write_text(self, *arguments, **named):
    if self.name == "pairs.txt":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    return write(self, *arguments, **named)

pathlib.Path.write_text = write_text
"""


def test_a_worker_on_a_full_disk_ends_in_one_sentence_that_says_so(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap")
    (tmp_path / "inject").mkdir()
    (tmp_path / "inject/sitecustomize.py").write_text(
        FULL_DISK
    )  # what Python imports first: in the worker only
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "inject"), *sys.path]))
    for t, frame in enumerate(sliding(PLACES)):
        io.write_png(tmp_path / f"clip/{t:03d}.png", frame)
    with pytest.raises(SystemExit) as stop:
        cli.main(["prepare", str(tmp_path / "clip"), str(tmp_path / "scene"), "--ev", "0"])
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("hdr-nsff: ")]
    assert stop.value.code == 2 and len(said) == 1 and "scene/poses: the disk is full" in said[0]
    assert not list((tmp_path / "scene/poses").glob(".sfm-*"))


def test_a_disk_without_room_is_full_whatever_the_worker_said(tmp_path):
    sfm.need_room(tmp_path, "all went well")
    before, handler = (
        resource.getrlimit(resource.RLIMIT_FSIZE),
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
    )
    resource.setrlimit(resource.RLIMIT_FSIZE, (sfm.ROOM // 2, before[1]))
    try:
        with pytest.raises(OSError) as full:
            sfm.need_room(tmp_path, "all went well")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert full.value.errno in io.FULL and not list(tmp_path.iterdir())
