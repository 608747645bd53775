"""Views through the clip's lens: pixels come from where the lens bends their rays
to.
"""

import numpy as np
import pytest
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.geometry.pinhole import camera_rays, intrinsics, pixel_centers
from hdr_nsff.rendering.lens import LensView, original_lens
from hdr_nsff.rendering.stills import Still
from hdr_nsff.scene.manifest import LensEntry, Manifest

W, H = 64, 48
LENS = Lens(intrinsics(60.0, W, H), (-0.15, 0.02, 0.0, 0.0), W, H)
VIEW = PathView(Camera(torch.from_numpy(LENS.pinhole()).float(), torch.eye(4)[:3], W, H), time=1.5)
SEEN = LensView.of(VIEW, LENS)
WIDE = SEEN.view.camera


def test_a_recorded_pixel_shows_what_lies_on_its_bent_ray():
    K = WIDE.K.double().numpy()
    rays = camera_rays(pixel_centers(WIDE.height, WIDE.width), K)[..., :2]
    pixels = pixel_centers(H, W)
    bent = LENS.bend(SEEN.distort(rays))  # the picture of rays, as the lens records it
    assert (
        np.abs(bent - camera_rays(pixels, LENS.K)[..., :2]).max() < 1e-3
    )  # a sixteenth of a pixel
    assert (WIDE.width, WIDE.height) > (W, H) and SEEN.view.time == 1.5


def test_motion_is_that_between_recorded_pixels():
    steady = np.zeros((WIDE.height, WIDE.width, 2), np.float32)
    assert np.abs(SEEN.distort_motion(steady)).max() < 1e-5
    right = steady + np.array([1, 0], np.float32)
    motion = SEEN.distort_motion(right)
    middle, edge = motion[H // 2, W // 2, 0], motion[H // 2, 0, 0]
    assert middle == pytest.approx(1, abs=0.01) and edge < 0.9  # a barrel lens shrinks the edge


def test_a_lamp_has_no_dark_ring_and_no_depth_between_it_and_the_wall():
    x, y = np.moveaxis(pixel_centers(WIDE.height, WIDE.width), -1, 0)
    lamp = np.hypot(x - 40, y - 20) < 6
    bright = np.where(lamp, 50, 0.2).astype(np.float32)
    bright[0, 0] = 0  # elsewhere it is darker
    depth = np.where(lamp, 2, 50).astype(np.float32)
    flat = np.zeros_like(depth)
    rgb = np.stack([bright] * 3, -1)
    recorded = SEEN.distort_still(Still(rgb, flat, depth, flat, {}))
    assert recorded.radiance[2:-2, 2:-2].min() >= 0.2 - 1e-6 and recorded.radiance.max() == 50
    assert set(np.unique(recorded.depth)) == {2, 50}


def test_a_scene_without_distortion_has_no_original_lens():
    manifest = Manifest(source="clip", width=W, height=H)
    with pytest.raises(InputError, match="without distortion"):
        original_lens(manifest, 0)
    manifest.lens = {0: LensEntry.of(LENS, given=False)}
    assert original_lens(manifest, 0).distortion == LENS.distortion
