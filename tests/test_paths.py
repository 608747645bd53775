"""Camera paths: they begin where they should, look where they should, and path files
are read or refused in a sentence.
"""

from __future__ import annotations

import json
import math

import pytest
import torch
from mutations import check_json_reader, check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry import paths
from hdr_nsff.geometry.cameras import Camera

K = torch.tensor([[50.0, 0, 16], [0, 50, 12], [0, 0, 1]])


def pose(degrees: float = 0.0, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> torch.Tensor:
    """Turned about the y axis, then placed."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z]])


def camera(*place: float) -> Camera:
    return Camera(K, pose(*place), 32, 24)


def test_bullet_time_starts_at_the_frame_and_keeps_the_focus_point_centered() -> None:
    start = camera(20.0, 1.0, 2.0, 3.0)
    views = paths.bullet_time(start, 7.0, 4.0, torch.tensor([0.5, 0.3, 0.2]), num_views=12)
    focus = start.c2w[:, 3] + 4.0 * start.c2w[:, 2]
    assert torch.allclose(views[0].camera.c2w, start.c2w, atol=1e-5)
    for view in views:
        pixels, _ = view.camera.project(focus)
        assert torch.allclose(pixels, torch.tensor([16.0, 12.0]), atol=1e-3)
        rotation = view.camera.c2w[:, :3]
        assert torch.allclose(rotation.T @ rotation, torch.eye(3), atol=1e-5) and view.time == 7.0


def test_bullet_time_stays_within_its_radius_and_uses_it() -> None:
    radius = torch.tensor([0.5, 0.3, 0.2])
    views = paths.bullet_time(camera(), 0.0, 4.0, radius, num_views=96)
    centers = torch.stack([v.camera.c2w[:, 3] for v in views]).abs().amax(0)
    assert (centers <= radius + 1e-6).all() and (centers > 0.6 * radius).all()


def test_reach_is_half_the_range_in_the_axes_of_the_camera() -> None:
    cameras = [
        camera(0.0, x, 0.0, 0.0) for x in torch.linspace(0, 1, 11).tolist()
    ]  # 10th to 90th percentile: 0.1 to 0.9
    assert torch.allclose(
        paths.center_spread(cameras, camera()), torch.tensor([0.4, 0, 0]), atol=1e-6
    )
    assert torch.allclose(
        paths.center_spread(cameras, camera(90.0)), torch.tensor([0, 0, 0.4]), atol=1e-6
    )  # now it looks along x


def test_slow_motion_divides_uneven_intervals_and_glides_the_camera() -> None:
    views = paths.slow_motion(
        [camera(), camera(30.0, 1.0), camera(30.0, 1.0)], [0.0, 1.0, 3.0], factor=2
    )
    assert [v.time for v in views] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    assert torch.allclose(
        views[1].camera.c2w, pose(15.0, 0.5), atol=1e-6
    )  # half the angle, half the way


def test_training_path_and_fixed_camera_pair_cameras_with_times() -> None:
    a, b = camera(), camera(5.0)
    assert [(v.camera, v.time) for v in paths.training_path([a, b], [0, 2])] == [(a, 0.0), (b, 2.0)]
    assert [(v.camera, v.time, v.ev) for v in paths.fixed_path(b, [0, 2])] == [
        (b, 0.0, None),
        (b, 2.0, None),
    ]


def test_videos_pass_held_out_frames_at_the_same_speed() -> None:
    times = [t for t in range(20) if t % 8 != 4]
    fixed = [v.time for v in paths.fixed_path(camera(), times)]
    assert fixed == list(range(20))
    slow = [v.time for v in paths.slow_motion([camera()] * len(times), times, 2)]
    assert slow == [t / 2 for t in range(39)]
    # the last step is shorter where the clip does not end on an even one
    assert [v.time for v in paths.fixed_path(camera(), [1, 3, 5, 8])] == [1, 3, 5, 7, 8]
    assert [v.time for v in paths.fixed_path(camera(), [3])] == [3]


def test_resizing_a_view_keeps_what_it_sees() -> None:
    small = paths.PathView(camera(), 1.0).resized(0.5).camera
    point = torch.tensor([0.3, -0.2, 2.0])
    assert (small.width, small.height) == (16, 12)
    assert torch.allclose(small.project(point)[0] * 2, camera().project(point)[0])


def test_path_file_is_read_back(tmp_path) -> None:
    other = [[60.0, 0, 10], [0, 60, 9], [0, 0, 1]]
    entries = [
        {"time": 0.5, "c2w": pose(10.0, 1.0).tolist()},
        {"time": 2, "c2w": pose().tolist(), "K": other, "ev": -2},
    ]
    file = tmp_path / "weg übers Feld.json"
    file.write_text(json.dumps(entries))
    first, second = paths.read_path(file, camera())
    file.write_text(json.dumps(entries), encoding="utf-8-sig")  # as Windows Notepad does
    assert len(paths.read_path(file, camera())) == 2
    assert first.time == 0.5 and first.ev is None and torch.equal(first.camera.K, K)
    assert torch.allclose(first.camera.c2w, pose(10.0, 1.0))
    assert (
        second.ev == -2.0
        and torch.equal(second.camera.K, torch.tensor(other))
        and second.camera.width == 32
    )


GOOD = {"time": 0.0, "c2w": pose().tolist()}
BAD = {
    "not a JSON file": "time: 0",
    "at least one": "[]",
    "view 0 is not an object": "[3]",
    "has no 'time'": json.dumps([{"c2w": GOOD["c2w"]}]),
    "unknown key 'fov'": json.dumps([{**GOOD, "fov": 60}]),
    "view 1: c2w must be 3x4": json.dumps([GOOD, {**GOOD, "c2w": [[1, 0, 0, 0]]}]),
    "c2w must be 3x4 finite": json.dumps([{**GOOD, "c2w": [[math.nan] * 4] * 3}]),
    "not a rotation": json.dumps([{**GOOD, "c2w": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]}]),
    "positive focal": json.dumps([{**GOOD, "K": [[0, 0, 1], [0, 0, 1], [0, 0, 1]]}]),
    "time must be one finite": json.dumps([{**GOOD, "time": "soon"}]),
    "ev must be one finite": json.dumps([{**GOOD, "ev": [1, 2]}]),
    "ev 61 must be an exposure in stops": json.dumps([{**GOOD, "ev": 61}]),
    "time must be one finite number up to 1e": json.dumps([{**GOOD, "time": 10**400}]),
    "K must be 3x3 finite numbers up to": json.dumps([{**GOOD, "K": [[1e300] * 3] * 3}]),
}


@pytest.mark.parametrize("sentence", BAD)
def test_bad_path_files_are_refused_in_a_sentence(tmp_path, sentence: str) -> None:
    (tmp_path / "path.json").write_text(BAD[sentence])
    with pytest.raises(InputError, match=sentence):
        paths.read_path(tmp_path / "path.json", camera())


def test_damaged_path_files_are_read_or_refused(tmp_path) -> None:
    file = tmp_path / "path.json"
    file.write_text(json.dumps([GOOD, {**GOOD, "K": K.tolist(), "ev": -2}]))
    check_reader(file, lambda: paths.read_path(file, camera()), 200)
    check_json_reader(file, lambda: paths.read_path(file, camera()), 200)


def test_missing_and_binary_path_files_are_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="No such file"):
        paths.read_path(tmp_path / "none.json", camera())
    (tmp_path / "film.json").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match="not a JSON file"):
        paths.read_path(tmp_path / "film.json", camera())
