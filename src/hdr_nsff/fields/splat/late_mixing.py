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
from typing import Any

import torch
from torch import Tensor, nn

from hdr_nsff.core.tensors import constant
from hdr_nsff.fields.base import Render
from hdr_nsff.fields.splat.rasterize import Maps
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import Recorder

START_SHARE = 0.5  # real clips that were shrunk end at 0.4 to 0.8, rendered ones at 0


@dataclass(frozen=True)
class Parts:
    """What is recorded of the parts of a picture, as if each filled a pixel."""

    gaussians: Tensor  # (G, 3)
    background: Tensor  # (1, 3)

    @staticmethod
    def of(
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

    def average(self, drawn: Tensor, opacity: Tensor) -> Tensor:
        """The average (S, 3) of what is recorded, of pixels in which Gaussians cover
        `opacity` (S,) in all; `drawn` (S, 3) is their share in it.
        """
        return torch.addcmul(drawn, (1 - opacity)[:, None], self.background)


class LateMixing(nn.Module):
    """The share s0 of a clip, learned; the field keeps it in [0, 1]."""

    def __init__(self) -> None:
        super().__init__()
        self.share = nn.Parameter(torch.full((1,), START_SHARE))
        self.register_load_state_dict_pre_hook(none_before)

    def forward(self, parts: Parts, drawn: Tensor, render: Render) -> tuple[Tensor, Tensor]:
        """The averages (S, 3) of what is recorded of the `parts`, and their shares
        (S, 1) in the pixels of a `render`; `drawn` (S, 3) are those of the Gaussians.
        """
        at_rest = (1 - render.motion.detach())[:, None]
        return parts.average(drawn, render.opacity), self.share * at_rest


def none_before(mixing: LateMixing, state: dict[str, Tensor], prefix: str, *args: Any) -> None:
    """Runs from before late mixing was learned have none."""
    state.setdefault(f"{prefix}share", torch.zeros_like(mixing.share))


def split_late(maps: Maps, parts: Parts | None) -> tuple[Maps, Tensor | None]:
    """Drawn maps without the last three features, and these (S, 3), which are what was
    recorded of the Gaussians; all maps and None where there are no `parts`.
    """
    if parts is None:
        return maps, None
    features, late = maps.features.split([maps.features.shape[-1] - 3, 3], -1)
    return maps._replace(features=features), late.flatten(0, 1)
