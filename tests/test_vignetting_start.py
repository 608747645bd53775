"""Static points show a fall-off that is there, and none that is not."""

from dataclasses import replace

import numpy as np
import torch
from estimates import tone_mapper

from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.vignetting import corner, squared_tangent
from hdr_nsff.tonemap.vignetting_start import as_polynomial, robust_fit


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


def test_the_fall_off_of_a_scene_is_found_and_an_even_one_has_none(toy):
    brackets, cameras = [f.bracket for f in toy.train], [0] * len(toy.train)
    for strength in (0.4, 0.0):
        corners = (corner(toy.train[0].camera),)
        ev, reference = toy.manifest.known_ev, toy.manifest.reference_bracket
        mapper = tone_mapper(brackets, cameras, ev, reference, corners=corners)
        mapper.start_vignetting(shaded(toy, strength))
        found = -float(mapper.vignetting.coefficients.detach().sum())
        assert abs(found - strength) < 0.12
