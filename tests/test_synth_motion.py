"""The exact motion of the synthetic room, pixel by pixel, and that every held-out view
comes with it.
"""

import numpy as np
from synth_scene import BALL, BOX, ROOM

from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr
from hdr_nsff.geometry.pinhole import project
from hdr_nsff.scene.truth import GEOMETRY, Truth
from hdr_nsff.synth.motion import exact_flow, view_geometry
from hdr_nsff.synth.pathtracer import Tracer
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.scenes.interior import CORD, INTERIOR, ball_pose, box_pose, camera_pose
from hdr_nsff.synth.settings import SynthConfig
from hdr_nsff.synth.synth import synth

POSES = {0: lambda t: np.eye(4), 1: box_pose, 2: ball_pose}


def test_every_pixel_moves_as_its_body_does() -> None:
    """One pixel at a time: out along the ray, from world to body, body to world a frame
    later and earlier, into the picture again.
    """
    K, c2w, time = intrinsics(12, 9), camera_pose(3.0), 7.5
    rng = np.random.default_rng(0)
    depth, bodies = rng.uniform(1.5, 3, (9, 12)), rng.integers(0, 3, (9, 12))
    channels = view_geometry(INTERIOR, {"Z": depth, "body": bodies}, time, K, c2w)
    np.testing.assert_array_equal(channels["Z"], depth)
    for side, name in MOTION_DIRECTIONS.items():
        for y, x in np.ndindex(9, 12):
            ray = np.linalg.inv(K) @ [x + 0.5, y + 0.5, 1]
            point = c2w[:, :3] @ (depth[y, x] * ray) + c2w[:, 3]
            pose = POSES[bodies[y, x]]
            there = (pose(time + side) @ np.linalg.inv(pose(time)) @ [*point, 1])[:3]
            seen = K @ c2w[:, :3].T @ (there - c2w[:, 3])
            np.testing.assert_allclose(
                [channels[f"{name}.{a}"][y, x] for a in "xyz"], there - point, atol=1e-9
            )
            np.testing.assert_allclose(
                [channels[f"{name}.{a}"][y, x] for a in "uv"],
                seen[:2] / seen[2] - [x + 0.5, y + 0.5],
                atol=1e-7,
            )


def test_the_room_rests_exactly() -> None:
    channels = view_geometry(
        INTERIOR,
        {"Z": np.full((6, 8), 2.5, np.float32), "body": np.full((6, 8), ROOM)},
        4.0,
        intrinsics(8, 6),
        camera_pose(9),
    )
    assert all((m == 0).all() for n, m in channels.items() if n != "Z")


def test_every_held_out_view_and_half_time_has_depth_and_motion(flat: SynthConfig) -> None:
    synth(flat)
    truth = Truth.open(flat.out / "truth")
    assert len(truth.views) == 16 and sum(v.time % 1 == 0.5 for v in truth.views) == 6
    for view in truth.views:
        channels = read_exr(flat.out / "truth" / str(view.geometry))
        assert sorted(channels) == sorted(GEOMETRY) and (channels["Z"] == 3).all()
        assert (np.abs(channels["forward.x"][:, :4]) > 0).all() and (
            channels["forward.x"][:, 4:] == 0
        ).all()  # a box, a wall


def test_the_balls_surface_stays_on_the_ball(tracer: Tracer) -> None:
    """What the ray through a pixel hits of the ball is carried to the ball of the next
    frame, and back to that of the one before.
    """
    size, c2w, time = (96, 54), camera_pose(3), 9.5
    surface = tracer.surface(time, intrinsics(*size), c2w, size)
    channels = view_geometry(
        INTERIOR, {"Z": surface.depth, "body": surface.bodies}, time, intrinsics(*size), c2w
    )
    center = {s: (ball_pose(time + s) @ [0, CORD, 0, 1])[:3] for s in (0, 1, -1)}
    distance = np.linalg.norm(surface.points - center[0], axis=-1)
    ball = (surface.bodies == BALL) & (distance < 0.17)  # and not its cord
    assert ball.sum() > 20 and (surface.bodies == BOX).any()
    for side, name in MOTION_DIRECTIONS.items():
        moved = surface.points + np.stack([channels[f"{name}.{a}"] for a in "xyz"], -1)
        assert np.linalg.norm(center[side] - center[0]) > 0.02
        np.testing.assert_allclose(
            np.linalg.norm(moved - center[side], axis=-1)[ball], distance[ball], atol=1e-5
        )
        np.testing.assert_allclose(distance[ball], 0.165, atol=1e-3)


def test_flow_of_a_known_point_is_exact() -> None:
    """A pixel that shows the ball's center flows to where the next camera projects the
    next position of that center.
    """
    K, center = intrinsics(240, 136), [0, CORD, 0, 1]
    pixel, _ = project((ball_pose(7) @ center)[:3], K, camera_pose(7))
    after, _ = project((ball_pose(8) @ center)[:3], K, camera_pose(8))
    points = np.broadcast_to((ball_pose(7) @ center)[:3], (136, 240, 3))
    x, y = np.floor(pixel).astype(int)
    there = INTERIOR.moved(points, np.full((136, 240), BALL), np.zeros((136, 240, 2)), 7, 8)
    flow = exact_flow(there, K, camera_pose(8))[y, x]
    np.testing.assert_allclose(flow, after - (np.array([x, y]) + 0.5), atol=1e-9)
