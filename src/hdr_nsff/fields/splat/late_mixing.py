"""Pixels that average recorded values instead of light.

A pixel of a sensor averages light, which is recorded then: f(sum w E) for parts of
radiance E that cover shares w of it. A pixel of footage that was shrunk or compressed
averages what finer pixels recorded: sum w f(E). Where a leaf stands before a sky that
clips, the two are far apart, and exposures then contradict each other.

A share of the averaging comes late:

    rgb = (1 - s) f(sum w E) + s sum w f(E),    s = (1 - m) s0

with one number s0 for a clip and the share m of movers in the pixel: what shines
through a mover is an error, which the average of light does not forgive. The parts are
the Gaussians and the background. Radiance is averaged as ever.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.core.tensors import constant
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import Recorder

START_SHARE = 0.5  # real clips that were shrunk end at 0.4 to 0.9, rendered ones at 0


@dataclass(frozen=True)
class Parts:
    """What is recorded of the parts of a picture, as if each filled a pixel."""

    gaussians: Tensor  # (G, 3)
    background: Tensor  # (1, 3)

    def average(self, drawn: Tensor, opacity: Tensor) -> Tensor:
        """The average (S, 3) of what is recorded, of pixels in which Gaussians cover
        `opacity` (S,) in all; `drawn` (S, 3) is their share in it.
        """
        return torch.addcmul(drawn, (1 - opacity)[:, None], self.background)


def shares(share: Tensor, motion: Tensor) -> Tensor:
    """The share (S, 1) of every pixel's averaging that comes late.

    It is that of the clip (1,), as far as the pixel shows what is at rest, by its
    `motion` (S,) in [0, 1].
    """
    return share * (1 - motion.detach())[:, None]


def record_parts(
    recorder: Recorder, camera: Camera, radiance: Tensor, means: Tensor, background: Tensor
) -> Parts:
    """Gaussians of `radiance` (G, 3) at `means` (G, 3), and the `background` (3,),
    recorded. What lies outside the picture counts as on its edge.
    """
    if recorder.shade is not None:
        with torch.no_grad():
            size = constant((camera.width, camera.height), means.device, means.dtype)
            pixels = camera.project(means)[0].clamp_min(0).minimum(size)
        radiance = recorder.shade(radiance, camera, pixels)
    recorded = recorder.rgb(torch.cat([radiance, background[None]]))
    return Parts(*recorded.split([len(means), 1]))
