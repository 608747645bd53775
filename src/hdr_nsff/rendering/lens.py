"""Rendered views as the clip's lens would have recorded them: `render --lens original`.

The view is rendered by a pinhole camera that sees all that the lens does, and the
picture is then distorted, with depth, opacity, mattes and motion. It is read linearly
between pixels, because a cubic would draw rings around highlights; depth is that of the
nearest pixel, because between a near and a far surface there is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.lens import Lens, sample, sample_nearest
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.geometry.pinhole import pixel_centers
from hdr_nsff.rendering.stills import Still
from hdr_nsff.scene.manifest import Manifest


def original_lens(manifest: Manifest, camera_id: int) -> Lens:
    """The lens of a camera of a scene; InputError where it distorted nothing."""
    entry = manifest.lens.get(camera_id)
    if entry is None:
        raise InputError(
            "--lens original: the frames of this scene were recorded without distortion; "
            "leave it out"
        )
    return entry.lens()


@dataclass(frozen=True)
class LensView:
    """A view through a lens: what to render, and how to distort it."""

    view: PathView  # of a pinhole camera that sees all that the lens does
    lens: Lens  # of the picture's size

    @staticmethod
    def of(view: PathView, lens: Lens) -> LensView:
        """The same for a `view` of an undistorted camera of the scene."""
        camera = view.camera
        width, height = camera.width, camera.height
        K = lens.unzoomed(camera.K.double().cpu().numpy())
        own = replace(lens.resized(width, height), K=K)
        wide_K, wide_width, wide_height = own.wide_pinhole()
        wide = replace(
            camera, K=torch.from_numpy(wide_K).to(camera.K), width=wide_width, height=wide_height
        )
        return LensView(replace(view, camera=wide), own)

    @cached_property
    def intrinsics(self) -> np.ndarray:
        """K (3, 3) of the camera of `view`."""
        return self.view.camera.K.double().cpu().numpy()

    @cached_property
    def places(self) -> np.ndarray:
        """Where `view` sees (H, W, 2) what the pixels of the lens record."""
        pixels = pixel_centers(self.lens.height, self.lens.width)
        return self.lens.undistort(pixels, self.intrinsics)

    def distort(self, picture: np.ndarray) -> np.ndarray:
        """A picture (h, w[, C]) of `view` as the lens records it, (H, W[, C])."""
        return sample(picture, self.places, linear=True)

    def distort_motion(self, vectors: np.ndarray) -> np.ndarray:
        """Motion (h, w, 2) of `view`, in pixels, as that of the lens (H, W, 2)."""
        pixels = pixel_centers(self.lens.height, self.lens.width)
        landing = self.places + self.distort(vectors)
        return (self.lens.distort(landing, self.intrinsics) - pixels).astype(np.float32)

    def distort_still(self, still: Still) -> Still:
        """All of a still of `view`."""
        return Still(
            radiance=self.distort(still.radiance),
            opacity=self.distort(still.opacity),
            depth=sample_nearest(still.depth, self.places),
            motion=self.distort(still.motion),
            flow={side: self.distort_motion(v) for side, v in still.flow.items()},
            screen_motion={s: self.distort_motion(v) for s, v in still.screen_motion.items()},
        )

    def distort_mattes(self, mattes: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Mattes {name: (h, w)} of `view`."""
        return {name: self.distort(matte) for name, matte in mattes.items()}
