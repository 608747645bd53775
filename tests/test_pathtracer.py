"""Path tracing: smoothing of bounced light, and one tiny picture where Mitsuba is
installed.
"""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from synth_scene import BALL, BOX, ROOM, plane

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.pinhole import pixel_centers, project
from hdr_nsff.synth import pathtracer
from hdr_nsff.synth.pathtracer import Tracer, smooth
from hdr_nsff.synth.scenes.cloth import CLOTH
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.scenes.interior import BACK, CORD, FLOOR, ball_pose, camera_pose


def test_smoothing_keeps_even_light_and_lowers_noise() -> None:
    surface = plane(40, 40)
    np.testing.assert_allclose(smooth(np.full((40, 40, 3), 0.7), surface, 0.05), 0.7, rtol=1e-5)
    noisy = np.random.default_rng(0).normal(1, 0.2, (40, 40, 3))
    # a Gaussian of 5 pixels averages 4 pi 25 = 314 independent values: 0.2 / 17.7 =
    # 0.011; the cut at 9 pixels costs a little
    assert 0.009 < smooth(noisy, surface, 0.05)[15:25, 15:25].std() < 0.02


def test_smoothing_does_not_cross_a_mover_or_a_corner() -> None:
    light = np.zeros((12, 16, 3))
    light[:, 8:] = 1
    half = np.arange(16) >= 8
    surface = plane()
    other_body = replace(surface, bodies=np.where(half, BOX, ROOM) * np.ones((12, 1), int))
    normals = np.where(half[:, None], [1.0, 0, 0], [0, 0, -1.0]) * np.ones((12, 1, 1))
    corner = replace(surface, normals=normals)
    for parted in (other_body, corner):
        np.testing.assert_allclose(smooth(light, parted, 0.05), light, atol=1e-6)
    assert 0.2 < smooth(light, surface, 0.05)[6, 7, 0] < 0.8


def test_seeds_of_paths_have_32_bits_and_small_ones_stay() -> None:
    """The largest is that of `synth --seed 999`'s last picture and moment."""
    seeds: list[int] = []

    def render(scene: object, seed: int, **_: object) -> np.ndarray:
        seeds.append(seed)
        return np.zeros((1, 1, 3))

    mi = SimpleNamespace(load_dict=lambda kind: kind, render=render)
    for seed in (5, 999_999 + 7 * 100_003):
        Tracer.average(SimpleNamespace(mi=mi), None, None, {}, 128, seed)  # type: ignore[arg-type]
    assert seeds[:2] == [5 * 4096, 5 * 4096 + 1]
    assert all(seed < 2**32 for seed in seeds) and len(set(seeds)) == 4


def test_unusable_variants_are_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")
    monkeypatch.setattr(pathtracer, "newest_llvm", lambda: None)
    with pytest.raises(InputError, match="libllvm19"):
        pathtracer.start("llvm_ad_rgb")
    with pytest.raises(InputError, match="use auto"):
        pathtracer.start("fast")


def test_a_missing_mitsuba_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"hdr-nsff\[synth\]"):
        pathtracer.start("auto")


def test_a_tiny_picture_holds_the_range_it_promises(tracer: Tracer) -> None:
    """The bulb's 700 and the window in view; shadows four decades below."""
    size = (32, 18)
    pictures = [tracer.radiance(t, intrinsics(*size), camera_pose(t), size, 2, 0) for t in (0, 1)]
    for picture in pictures:
        assert picture.shape == (18, 32, 3) and np.isfinite(picture).all() and picture.min() >= 0
        assert picture.max() > 20 and np.percentile(picture, 5) < 0.05
    assert np.abs(pictures[0] - pictures[1]).max() > 0.1  # the room moves


def test_rows_are_traced_alone_as_within_the_picture(tracer: Tracer) -> None:
    size, pose = (32, 36), camera_pose(0)
    arguments = (0, intrinsics(*size), pose, size, 64)
    whole = [tracer.radiance(*arguments, seed)[20:24] for seed in (0, 1)]
    rows = tracer.radiance(*arguments, 2, (20, 24))
    assert rows.shape == (4, 32, 3)
    noise = np.abs(whole[0] - whole[1]).mean()
    assert np.abs(rows - whole[0]).mean() < 1.5 * noise
    alone = tracer.surface(*arguments[:-1], (20, 24))
    np.testing.assert_array_equal(alone.depth, tracer.surface(*arguments[:-1]).depth[20:24])


def test_a_ray_that_leaves_the_scene_sees_a_static_sky_of_depth_0() -> None:
    """A tall picture looks over the walls of the courtyard."""
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")
    size, c2w = (9, 16), CLOTH.camera_pose(0)
    tracer = Tracer(CLOTH, 0, "scalar_rgb")
    surface = tracer.surface(0, intrinsics(*size), c2w, size)
    sky = surface.depth == 0
    assert sky[0].all() and not sky[8:].any()
    assert (surface.bodies[sky] == ROOM).all()
    away = surface.points - c2w[:, 3]
    assert (np.linalg.norm(away, axis=-1)[sky] > 1000).all()  # no parallax
    picture = tracer.radiance(0, intrinsics(*size), c2w, size, 2, 0)
    assert np.isfinite(picture).all() and picture[sky].min() > 0.05


def test_surfaces_lie_on_the_rays_through_pixel_centers(tracer: Tracer) -> None:
    size, c2w = (32, 18), camera_pose(3)
    K = intrinsics(*size)
    surface = tracer.surface(3.0, K, c2w, size)
    pixels, depth = project(surface.points, K, c2w)
    np.testing.assert_allclose(pixels, pixel_centers(18, 32), atol=1e-6)
    np.testing.assert_allclose(depth, surface.depth, rtol=1e-6)
    assert surface.points[..., 2].max() < BACK + 0.25
    assert surface.points[..., 1].max() < FLOOR + 1e-3
    assert set(np.unique(surface.bodies)) == {ROOM, BOX, BALL}
    ball = surface.points[surface.bodies == BALL] - (ball_pose(3.0) @ [0, CORD, 0, 1])[:3]
    radii = np.linalg.norm(ball, axis=1)  # of the cord, too
    assert np.abs(radii - 0.165).min() < 0.003
