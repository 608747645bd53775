"""What is recorded of the Gaussians one by one, by CUDA kernels, one launch forward and
one back: the twin of `late_mixing.py:Parts.of`.
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


def fused_parts(
    features: Tensor,
    means: Tensor,
    camera: Camera,
    background: Tensor,
    bounded: bool,
    sensor: Sensor,
) -> tuple[Tensor, Tensor]:
    """The `features` (G, F + 3) of Gaussians with what is recorded of their radiance,
    which is the first three, and what is recorded of the `background` (3,).

    `means` (G, 3) say where in the picture they are: what lies outside counts as on its
    edge. The background is stored radiance.
    """
    assert sensor.knots.shape[0] <= MAX_KNOTS, sensor.knots.shape
    tensors = features, background, *sensor.learned()
    made, behind = RecordParts.apply(*tensors, means, camera, bounded, sensor)
    return made, behind


class RecordParts(torch.autograd.Function):
    """`fused_parts`; means and camera get no gradients."""

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        background: Tensor,
        gain: Tensor,
        curve: Tensor,
        vignetting: Tensor,
        means: Tensor,
        camera: Camera,
        bounded: bool,
        sensor: Sensor,
    ) -> tuple[Tensor, Tensor]:
        tensors = features, background, means, camera.K, camera.c2w
        size = camera.width, camera.height, int(bounded)
        ctx.given = *(t.detach().contiguous() for t in tensors), *size, *sensor.numbers()
        ctx.sums = background.shape, gain.shape, curve.shape, vignetting.shape
        count, num_features = features.shape
        made = features.new_empty(count, num_features + 3), features.new_empty(3)
        # a thread for each Gaussian, and one for the background
        launch("record_parts", blocks_for(count + 1), THREADS, *ctx.given, *made)
        return made

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:
        features = ctx.given[0]
        g_features = torch.empty_like(features)
        sums = [few_zeros(features, *shape) for shape in ctx.sums]
        given = *ctx.given, *(g.contiguous() for g in grads)
        grid = few_blocks(len(features) + 1)
        launch("record_parts_backward", grid, THREADS, *given, g_features, *sums)
        return g_features, *sums, None, None, None, None
