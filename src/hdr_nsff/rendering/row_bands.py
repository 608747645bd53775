"""A view rendered in bands of rows, which can be given up between two of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.export_gaussians import GaussianField
from hdr_nsff.rendering.stills import Still, render_still
from hdr_nsff.training.run_folder import Run

BAND_PIXELS = 4096  # hand-chosen: a third of a second of `grid` on a CPU


def render_in_bands(
    run: Run, view: PathView, motion: bool, awaited: Callable[[], bool]
) -> Still | None:
    """Render one view at its own time, with `motion` vectors or without.

    None as soon as it is not `awaited` any more. Gaussians are rendered in one piece,
    as their shape depends on where the picture ends.
    """
    bands = [view] if isinstance(run.field, GaussianField) else row_bands(view)
    stills = []
    for band in bands:
        if not awaited():
            return None
        stills.append(render_still(run, band, "direct", motion))
    return join(stills)


def row_bands(view: PathView) -> list[PathView]:
    """The view cut into bands of about `BAND_PIXELS`, from the top."""
    camera = view.camera
    height = max(BAND_PIXELS // camera.width, 1)
    bands = []
    for top in range(0, camera.height, height):
        K = camera.K - torch.tensor([[0, 0, 0], [0, 0, top], [0, 0, 0]]).to(camera.K)
        rows = min(height, camera.height - top)
        bands.append(replace(view, camera=replace(camera, K=K, height=rows)))
    return bands


def join(bands: Sequence[Still]) -> Still:
    """The still of a whole view from those of its bands."""
    stack = np.concatenate
    return Still(
        radiance=stack([band.radiance for band in bands]),
        opacity=stack([band.opacity for band in bands]),
        depth=stack([band.depth for band in bands]),
        motion=stack([band.motion for band in bands]),
        flow={offset: stack([band.flow[offset] for band in bands]) for offset in bands[0].flow},
    )
