"""The oracle scene: what it gives fits together, is as noisy as asked, and links the
cameras of a rig that take turns.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.geometry.pinhole import project
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.synth import oracle as synth_oracle
from hdr_nsff.synth.motion import depth_there, exact_flow
from hdr_nsff.synth.oracle import OracleNoise, visible, write_oracle
from hdr_nsff.synth.scenes.geometry import back_project, intrinsics, look_at
from hdr_nsff.synth.scenes.interior import INTERIOR, box_pose, camera_pose

SIZE, FRAMES = (48, 32), 4
K = intrinsics(*SIZE)
POSES = [INTERIOR.pose("rig", t) for t in range(FRAMES)]
EXACT = OracleNoise(depth=0.0, grain=0.0, flow=0.0)


def wall(t: int) -> dict[str, np.ndarray]:
    """What frame `t` of a rig renders of a wall at z = 3, of which the left quarter of
    the picture moves as the box does.
    """
    height, width = SIZE[::-1]
    rays = back_project(np.ones((height, width)), K, POSES[t]) - POSES[t][:, 3]
    depth = (3 - POSES[t][2, 3]) / rays[..., 2]
    bodies = np.where(np.arange(width) < width // 4, 1, 0) * np.ones((height, 1), int)
    channels = {"Z": depth.astype(np.float32), "body": bodies.astype(np.float32)}
    for side, name in ((1, "forward"), (-1, "backward")):
        there = INTERIOR.moved(
            back_project(depth, K, POSES[t]), bodies, np.zeros((height, width, 2)), t, t + side
        )
        flow = exact_flow(there, K, INTERIOR.pose("rig", t + side))
        channels |= {f"{name}.u": flow[..., 0], f"{name}.v": flow[..., 1]}
    return channels


def oracle(out: Path, noise: OracleNoise) -> list[Frame]:
    """The frames of an oracle scene of `wall`."""
    video = np.zeros((FRAMES, *SIZE[::-1], 3), np.float32)
    write_oracle(
        out, INTERIOR, [wall(t) for t in range(FRAMES)], video, K, POSES, [-2.0, 0.0, 2.0], 1, noise
    )
    return Scene.open(out / "oracle").train


def test_a_static_pixel_reprojected_by_its_depth_agrees_with_its_flow(tmp_path: Path) -> None:
    frames = oracle(tmp_path, EXACT)
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), -1)
    for k, frame in enumerate(frames):
        for side, j in frame.neighbors.items():
            points = back_project(1 / frame.disparity.double().numpy(), K, POSES[k])
            landed, _ = project(points, K, POSES[j])
            error = np.linalg.norm(landed - pixels - frame.flow[side].numpy(), axis=-1)
            still, inside = (
                ~frame.moving.numpy(),
                ((landed > 1) & (landed < np.array(SIZE) - 1)).all(-1),
            )
            assert error[still].max() < 0.05  # half precision
            assert error[~still].mean() > 0.3  # a mover has gone elsewhere
            assert frame.flow_valid[side].numpy()[still & inside].all()
            assert (still & inside).sum() > 500


def test_cameras_of_a_rig_are_neighbors_in_time_and_share_one_response(tmp_path: Path) -> None:
    frames = oracle(tmp_path, EXACT)
    assert [f.neighbors for f in frames] == [{1: 1}, {-1: 0, 1: 2}, {-1: 1, 1: 3}, {-1: 2}]
    assert {f.camera_id for f in frames} == {0}
    assert all(set(f.flow) == set(f.neighbors) for f in frames)
    eyes = np.array([f.camera.c2w[:, 3].tolist() for f in frames])
    assert (
        np.linalg.norm(np.diff(eyes, axis=0), axis=1) > 0.25
    ).all()  # and are not the same camera


@pytest.mark.parametrize(
    "noise", [OracleNoise(), OracleNoise(0.0, 0.05, 0.5), OracleNoise(0.03, 0.03, 0.5)]
)
def test_depth_and_flow_have_the_requested_noise(tmp_path: Path, noise: OracleNoise) -> None:
    exact, noisy = oracle(tmp_path / "exact", EXACT), oracle(tmp_path / "noisy", noise)
    error = np.stack([np.log(n.disparity / e.disparity) for n, e in zip(noisy, exact, strict=True)])
    # the smooth part is interpolated between 8 x 8 values, which costs it up to a third
    # of its spread, and hardly differs next door
    assert (
        np.hypot(0.6 * noise.depth, 0.95 * noise.grain)
        < error.std()
        < np.hypot(1.15 * noise.depth, 1.05 * noise.grain)
    )
    assert (
        0.95 * noise.grain
        < np.diff(error, axis=2).std() / np.sqrt(2)
        < np.hypot(0.3 * noise.depth, 1.05 * noise.grain)
    )
    flow = np.stack(
        [(n.flow[s] - e.flow[s]).numpy() for n, e in zip(noisy, exact, strict=True) for s in n.flow]
    )
    assert flow.std() == pytest.approx(noise.flow, rel=0.03)


def test_movers_are_judged_by_their_flow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judged = []

    def judge(movers: Sequence[Mover], *arguments: object) -> Sequence[Mover]:
        judged.append(len(movers))
        return [replace(mover, rigid=False) for mover in movers]

    monkeypatch.setattr(synth_oracle, "judge_rigidity", judge)
    oracle(tmp_path, EXACT)
    assert len(judged) == 1
    assert not any(mover.rigid for mover in Scene.open(tmp_path / "oracle").movers)


def test_the_seed_decides_the_noise(tmp_path: Path) -> None:
    noise = OracleNoise(0.03, 0.03, 0.5, seed=4)
    a, b, c = (
        oracle(tmp_path / str(i), n)[1]
        for i, n in enumerate((noise, noise, replace(noise, seed=5)))
    )
    assert a.disparity.equal(b.disparity) and a.flow[1].equal(b.flow[1])
    assert not a.disparity.isclose(c.disparity, rtol=1e-3).all() and not a.flow[1].equal(c.flow[1])


def test_a_mover_has_the_depth_of_its_new_position() -> None:
    """Two cameras that look straight at the box, ten frames apart: the middle of three
    pixels shows its center.
    """
    eye, (before, after) = np.array([0.4, -0.1, 0.2]), (box_pose(t)[:3, 3] for t in (0, 10))
    channels = {"Z": np.full((3, 3), np.linalg.norm(before - eye)), "body": np.ones((3, 3))}
    poses = [look_at(eye, before)] * 10 + [look_at(eye, after)]
    assert depth_there(INTERIOR, channels, intrinsics(3, 3), poses, 0, 10)[1, 1] == pytest.approx(
        np.linalg.norm(after - eye)
    )


def test_a_point_that_approaches_the_next_camera_stays_visible() -> None:
    """A camera two thirds of a meter nearer sees the wall a quarter nearer: other
    depth, same surface. A pole hides it.
    """
    near = camera_pose(0).copy()
    near[:, 3] += 0.7 * near[:, 2]
    channels = {"Z": np.full(SIZE[::-1], 3.0), "body": np.zeros(SIZE[::-1])}
    expected = depth_there(INTERIOR, channels, K, [camera_pose(0), near], 0, 1)
    np.testing.assert_allclose(expected, 2.3, rtol=1e-6)
    still = np.zeros((*SIZE[::-1], 2))
    assert visible(still, expected, np.full(SIZE[::-1], 2.3))[:-1, :-1].all()
    assert not visible(still, expected, np.full(SIZE[::-1], 2.0)).any()


def test_visible_is_false_outside_of_the_frame_and_behind_surfaces() -> None:
    """Everything moves two pixels to the right, where a pole now stands in columns 4
    and 5 of eight.
    """
    flow = np.zeros((6, 8, 2))
    flow[..., 0] = 2.0
    there = np.full((6, 8), 3.0)
    there[:, 4:6] = 1.0
    seen = visible(flow, np.full((6, 8), 3.0), there)
    np.testing.assert_array_equal(seen[0], [True, True, False, True, True, False, False, False])
