"""Lens, gain, response curve and late mixing on NVIDIA GPUs, one launch forward and one
back: the twin of `ToneMapper.record_render` that our CUDA kernels compute.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.kernels.cuda.launch import blocks_for, few_blocks, few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import MAX_KNOTS, THREADS
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import Sensor


def photograph(
    radiance: Tensor,
    sensor: Sensor,
    camera: Camera | None = None,
    pixels: Tensor | None = None,
    late: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """What a sensor records (N, 3) of `radiance` (N, 3) at `pixels` (N, 2) of a camera.

    `late` are averages (N, 3) of recorded values, and their shares (N, 1) in what is
    recorded. Camera and pixels matter for a lens that does not pass all light.
    """
    assert sensor.knots.shape[0] <= MAX_KNOTS, sensor.knots.shape
    nothing = radiance.detach()[:0]
    place = nothing, nothing
    if camera is not None and pixels is not None:
        place = pixels, camera.K
    mixed = late or (nothing, nothing)
    rgb: Tensor = Photograph.apply(radiance, *mixed, *sensor.learned(), sensor, *place)
    return rgb


class Photograph(torch.autograd.Function):
    """`photograph`; radiance, `late`, its share and what the sensor has learned get
    gradients.
    """

    @staticmethod
    def forward(
        ctx: Any,
        radiance: Tensor,
        late: Tensor,
        late_share: Tensor,
        gain: Tensor,
        curve: Tensor,
        vignetting: Tensor,
        sensor: Sensor,
        pixels: Tensor,
        K: Tensor,
    ) -> Tensor:
        tensors = radiance, late, late_share, pixels, K
        ctx.given = *(t.detach().contiguous() for t in tensors), *sensor.numbers()
        ctx.sums = gain.shape, curve.shape, vignetting.shape
        rgb = torch.empty_like(ctx.given[0])
        launch("photograph", blocks_for(len(rgb)), THREADS, *ctx.given, rgb)
        return rgb

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, d_rgb: Tensor) -> Any:
        made = [torch.empty_like(t) for t in ctx.given[:3]]
        sums = [few_zeros(d_rgb, *shape) for shape in ctx.sums]
        grid = few_blocks(len(d_rgb))
        given = *ctx.given, d_rgb.contiguous()
        launch("photograph_backward", grid, THREADS, *given, *made, *sums)
        return *made, *sums, None, None, None
