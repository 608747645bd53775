"""The start of a tone mapper: measured where static points allow it, brightness where
they do not.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from test_debevec import EV, GAMMA22, S_CURVE, rmse
from test_static_samples import HEIGHT, WIDTH, wall_view

from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Frame, Manifest, Scene
from hdr_nsff.tonemap.initialize import initialize
from hdr_nsff.tonemap.tonemapper import ToneMapConfig, ToneMapper


def scene_of(views, bracket_ev):
    """A scene of frames with these recordings, cameras and maps."""
    frames = [
        Frame(
            index=i,
            time=v.time,
            camera=Camera(torch.from_numpy(v.K), torch.from_numpy(v.c2w), WIDTH, HEIGHT),
            camera_id=0,
            bracket=v.bracket,
            exposure=bracket_ev[v.bracket],
            image=torch.from_numpy(v.image).float(),
            moving=torch.from_numpy(v.moving),
            disparity=torch.from_numpy(v.disparity),
        )
        for i, v in enumerate(views)
    ]
    manifest = Manifest(
        source="wall",
        width=WIDTH,
        height=HEIGHT,
        cycle=3,
        reference_bracket=2,
        bracket_ev=bracket_ev,
    )
    return Scene(Path("."), frames, [], 1.0, 10.0, torch.zeros(0, 3), manifest)


def test_initialize_finds_the_curve_through_noisy_depth():
    rng = np.random.default_rng(0)
    scene = scene_of([wall_view(i, S_CURVE, rng, depth_noise=0.02) for i in range(18)], EV)
    tonemapper = ToneMapper.for_scene(ToneMapConfig(), scene)
    note = initialize(tonemapper, scene, num=1800)
    x, y = tonemapper.curve()
    assert rmse(x.numpy(), y.numpy(), S_CURVE) < 0.01
    assert "static points" in note and "as given" in note
    assert tonemapper.anchored  # what was measured is held from the first step on


def test_initialize_falls_back_on_brightness_and_says_so():
    rng = np.random.default_rng(0)
    views = [wall_view(i, GAMMA22, rng) for i in range(6)]
    for v in views:
        v.moving[:] = True
    scene = scene_of(views, [None, None, None])
    tonemapper = ToneMapper.for_scene(ToneMapConfig(), scene)
    note = initialize(tonemapper, scene)
    assert "too few static points" in note and "brightness" in note
    assert not tonemapper.anchored
    assert tonemapper.exposures().tolist() == pytest.approx(EV, abs=0.4)
    x, y = tonemapper.curve()
    torch.testing.assert_close(y, (x ** (1 / 2.2)).expand(3, -1), atol=1e-5, rtol=0)


def test_the_papers_tone_mapper_is_left_as_published():
    rng = np.random.default_rng(0)
    scene = scene_of([wall_view(i, S_CURVE, rng) for i in range(3)], [None, None, None])
    tonemapper = ToneMapper.for_scene(
        ToneMapConfig(kind="per_image", knots="even", from_recordings=False), scene
    )
    assert "published" in initialize(tonemapper, scene)
    assert (tonemapper.gains() == 0).all()
