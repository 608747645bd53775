"""Laws of learned vignetting: none at the start, on the axis and without a moving
camera; its gradient; what it explains and what it leaves alone.
"""

import pytest
import torch
from estimates import tone_mapper

from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.tonemap.vignetting import Vignetting, corner, radial_spread, squared_tangent

CAMERA = Camera(torch.tensor([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]]), torch.eye(4)[:3], 40, 30)


def learned(*coefficients):
    lens = Vignetting((corner(CAMERA),))
    with torch.no_grad():
        lens.coefficients.copy_(torch.tensor([coefficients]))
    return lens


def test_there_is_none_at_the_start_and_never_any_on_the_axis():
    grid = CAMERA.pixel_grid()
    assert torch.equal(learned(0.0, 0.0, 0.0)(CAMERA, grid, 0), torch.ones(len(grid), 1))
    axis = torch.tensor([[20.0, 15.0]])
    assert learned(-0.4, 0.1, -0.1)(CAMERA, axis, 0) == 1


def test_a_corner_gets_one_plus_the_sum_of_the_coefficients():
    corners = torch.tensor([[0.0, 0.0], [40.0, 30.0]])
    torch.testing.assert_close(learned(-0.4, 0.1, -0.1)(CAMERA, corners, 0).flatten(),
                               torch.full((2,), 0.6))  # fmt: skip


def test_a_picture_of_another_size_has_the_same_vignetting():
    lens, half = learned(-0.4, 0.1, 0.0), CAMERA.resized(20, 15)
    pixels = torch.tensor([[31.0, 9.0]])
    torch.testing.assert_close(lens(half, pixels / 2, 0), lens(CAMERA, pixels, 0))


def test_the_gradient_is_that_of_finite_differences():
    lens = learned(-0.3, 0.1, -0.05).double()
    pixels = CAMERA.pixel_grid().double()[::37]

    def total(coefficients):
        r2 = squared_tangent(CAMERA, pixels)[:, None] / lens.corners[0]
        return torch.func.functional_call(lens, {"coefficients": coefficients}, (
            CAMERA, pixels, 0)) * (1 + r2)  # fmt: skip

    assert torch.autograd.gradcheck(total, (lens.coefficients.detach().requires_grad_(),))


def test_points_move_along_the_radius_only_where_the_camera_moves(toy):
    still = [toy.train[0]] * 3
    assert radial_spread(still, depth=2.0) < 1e-6
    assert radial_spread(list(toy.train), depth=2.0) > 0


def test_a_tone_mapper_shades_what_is_recorded_and_not_what_is_developed():
    mapper = tone_mapper([0, 1], [0, 0], [0.0, 1.0], reference=0, corners=(corner(CAMERA),))
    with torch.no_grad():
        mapper.vignetting.coefficients.fill_(-0.1)
    radiance = torch.full((1200, 3), 0.5)
    shaded = mapper.shade(radiance, CAMERA, 0).detach()
    assert 0.35 < shaded.min() < 0.37
    flat = mapper.develop(radiance, ev=0.0)
    assert torch.equal(flat, flat[:1].expand_as(flat))
    assert mapper.regularizers()["vignetting"].item() == pytest.approx(0.01)


def test_a_run_from_before_vignetting_has_none():
    corners = (corner(CAMERA),)
    mapper = tone_mapper([0, 1], [0, 0], [0.0, 1.0], reference=0, corners=corners)
    state = mapper.state_dict()
    del state["vignetting.coefficients"]
    mapper.load_state_dict(state)
    assert not mapper.vignetting.coefficients.any()
