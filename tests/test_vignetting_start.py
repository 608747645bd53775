"""Static points show a fall-off that is there, and none that is not."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from estimates import tone_mapper

from hdr_nsff.fields.splat.initialize_gaussians import static_points
from hdr_nsff.fields.splat.initialize_local import colors_along_flow
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapper
from hdr_nsff.tonemap.vignetting import corner, squared_tangent
from hdr_nsff.tonemap.vignetting_start import as_polynomial, robust_fit
from hdr_nsff.training.start import recorded_radiance, typical_log_radiance


def test_the_polynomial_of_a_log_share_is_that_of_the_share():
    v = as_polynomial(np.array([-0.4, 0.0, 0.0]))
    r2 = np.linspace(0, 1, 9)
    share = 1 + v[0] * r2 + v[1] * r2**2 + v[2] * r2**3
    assert np.abs(share - np.exp(-0.4 * r2)).max() < 1e-3


def test_outliers_do_not_move_the_fit():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(4000, 3))
    values = rows @ [-0.4, 0.1, 0.05] + 0.01 * rng.normal(size=4000)
    values[:400] += 3.0
    assert np.abs(robust_fit(rows, values) - [-0.4, 0.1, 0.05]).max() < 0.03


def shaded(scene: Scene, strength: float) -> Scene:
    """The scene through a lens that passes 1 - strength to the corners; gamma 2.2."""
    frames = []
    for f in scene.train:
        camera = f.camera
        r2 = squared_tangent(camera, camera.pixel_grid()) / corner(camera)
        share = (1 - strength * r2).view(camera.height, camera.width, 1)
        image = f.image * share ** (1 / 2.2)
        frames.append(replace(f, image=image, moving=torch.zeros_like(f.moving)))
    return replace(scene, train=frames)


def fitted(scene: Scene) -> ToneMapper:
    """A tone mapper, its vignetting started at what a scene shows."""
    brackets, cameras = [f.bracket for f in scene.train], [0] * len(scene.train)
    corners = (corner(scene.train[0].camera),)
    ev, reference = scene.manifest.known_ev, scene.manifest.reference_bracket
    mapper = tone_mapper(brackets, cameras, ev, reference, corners=corners)
    mapper.start_vignetting(scene)
    return mapper


def test_the_fall_off_of_a_scene_is_found_and_an_even_one_has_none(toy):
    for strength in (0.4, 0.0):
        found = -float(fitted(shaded(toy, strength)).vignetting.coefficients.detach().sum())
        assert abs(found - strength) < 0.12


def test_depth_up_to_scale_and_shift_shows_no_fall_off(toy):
    halved = [replace(f, disparity=f.disparity / 2) for f in toy.train]
    manifest = toy.manifest.model_copy(update={"depth_kind": "relative"})
    mapper = fitted(replace(toy, train=halved, manifest=manifest))
    assert not mapper.vignetting.coefficients.any()


def test_a_field_starts_as_bright_as_the_scene_is_before_the_lens(toy):
    """A gray scene, as a lens that passes 60 % to the corners records it."""
    mapper = fitted(toy)
    mapper.vignetting.coefficients.data[0] = torch.tensor([-0.4, 0.0, 0.0])
    gray = torch.full((toy.train[0].image[..., 0].numel(), 3), 0.2)
    frames = []
    for i, f in enumerate(toy.train):
        seen = mapper(mapper.shade(gray, f.camera, 0), f.bracket, 0, i, leaky=False)
        frames.append(replace(f, image=seen.detach().view_as(f.image)))
    scene = replace(toy, train=frames)
    to_radiance = partial(recorded_radiance, mapper, scene)
    f = frames[1]
    whole = to_radiance(f.image.reshape(-1, 3), 1).log()
    static = static_points(scene, to_radiance)[0].log_radiance
    along_flow, trust = colors_along_flow(scene, f, f.moving, 1, to_radiance)
    for log in (whole, static, along_flow[trust > 0]):
        torch.testing.assert_close(log, torch.full_like(log, 0.2).log(), atol=0.02, rtol=0)
    assert abs(typical_log_radiance(mapper, scene) - np.log(0.2)) < 0.02
