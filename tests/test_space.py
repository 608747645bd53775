"""The cube a field lives in: invertible, bounded, with cells of a pixel."""

import math

import pytest
import torch

from hdr_nsff.fields.space import (
    ContractedSpace,
    FrustumSpace,
    build_space,
    frustum_corners,
    mean_pose,
)
from hdr_nsff.geometry.cameras import Camera

K = torch.tensor([[50.0, 0, 32], [0, 50.0, 18], [0, 0, 1]])


def camera(x: float = 0.0, turn: float = 0.0) -> Camera:
    """At (x, 0, 0), turned about the vertical by `turn` radians."""
    c, s = math.cos(turn), math.sin(turn)
    rotation = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return Camera(K, torch.cat([rotation, torch.tensor([[x], [0.0], [0.0]])], 1), 64, 36)


def forward_facing() -> list[Camera]:
    return [camera(-0.3), camera(0.0, 0.05), camera(0.3)]


def all_round() -> list[Camera]:
    return [camera(0.2 * k, 2 * math.pi * k / 5) for k in range(5)]


def test_cameras_side_by_side_get_a_frustum_and_cameras_all_round_a_ball() -> None:
    assert isinstance(build_space(forward_facing(), 1.0, 20.0), FrustumSpace)
    assert isinstance(build_space(all_round(), 1.0, 20.0), ContractedSpace)


@pytest.mark.parametrize("cameras", [forward_facing(), all_round()], ids=["frustum", "ball"])
def test_decode_inverts_encode_for_everything_the_cameras_see(cameras: list[Camera]) -> None:
    space = build_space(cameras, 1.0, 20.0)
    points = torch.cat([frustum_corners(cameras, z, z) for z in (1.0, 3.0, 20.0)])
    coords = space.encode(points)
    assert float(coords.min()) >= 0 and float(coords.max()) <= 1
    torch.testing.assert_close(space.decode(coords), points, atol=2e-3, rtol=2e-3)


def test_frustum_cells_are_even_in_pixels_and_in_disparity() -> None:
    space = build_space([camera()], 1.0, 20.0)
    near = space.encode(torch.tensor([[0.15, 0.0, 1.5], [0.3, 0.0, 1.5]]))
    far = space.encode(torch.tensor([[1.5, 0.0, 15.0], [3.0, 0.0, 15.0]]))
    # 5 pixels are as wide at both depths
    torch.testing.assert_close(near[1, 0] - near[0, 0], far[1, 0] - far[0, 0])
    z = 1 / torch.tensor([0.2, 0.4, 0.6])
    third = space.encode(torch.stack([0 * z, 0 * z, z], -1))[:, 2]
    torch.testing.assert_close(third[2] - third[1], third[1] - third[0])


def test_frustum_of_one_camera_spans_its_picture_with_a_small_margin() -> None:
    space = build_space([camera()], 1.0, 20.0)
    corner = space.encode(camera().rays(torch.tensor([[0.0, 0.0]])).directions * 5.0)
    torch.testing.assert_close(corner[0, :2], torch.full((2,), 0.02 / 1.04))


def test_contraction_is_linear_inside_and_bounded_outside() -> None:
    space = ContractedSpace(torch.tensor([1.0, 0, 0]), torch.tensor(2.0))
    inside, outside, far = space.encode(torch.tensor([[2.0, 0, 0], [1, 4, 0], [1e9, 0, 0]]))
    torch.testing.assert_close(inside, torch.tensor([0.5 + 0.5 / 4, 0.5, 0.5]))
    # at twice the radius: 2 - 1/2
    torch.testing.assert_close(outside, torch.tensor([0.5, 0.5 + 1.5 / 4, 0.5]))
    assert float(far.max()) <= 1.0


def test_mean_pose_is_a_rotation_at_the_mean_center() -> None:
    pose = mean_pose([camera(-1.0, -0.3), camera(2.0, 0.3)])
    torch.testing.assert_close(pose, camera(0.5).c2w, atol=1e-6, rtol=0)
    tilted = mean_pose(all_round()[:2])
    torch.testing.assert_close(tilted[:, :3].T @ tilted[:, :3], torch.eye(3), atol=1e-6, rtol=0)
    assert math.isclose(float(torch.linalg.det(tilted[:, :3])), 1.0, abs_tol=1e-5)


def test_gradients_pass_through_both_maps() -> None:
    for space in (build_space(forward_facing(), 1.0, 20.0), build_space(all_round(), 1.0, 20.0)):
        x = torch.tensor(
            [[0.4, 0.6, 0.3], [0.55, 0.5, 0.7]], dtype=torch.float64, requires_grad=True
        )
        assert torch.autograd.gradcheck(space.double().decode, (x,), atol=1e-4)
        points = space.decode(x).detach().requires_grad_()
        assert torch.autograd.gradcheck(space.encode, (points,), atol=1e-4)
