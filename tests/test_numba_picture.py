"""Pictures and their losses by numba kernels on the CPU, against plain torch."""

import pytest
import torch
from moments import random_field
from pictures import PRIORS, compare_composites, compare_losses, compare_mixing
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.splat import draw
from hdr_nsff.fields.splat.numba_picture import numba_composite
from hdr_nsff.fields.splat.rasterize import Planes
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.training.fused_losses import NumbaLosses


def over_background(
    field: Splat, drawn: list[Tensor], late: tuple[Tensor, Tensor] | None, with_flow: bool
) -> tuple[Render, Tensor]:
    """Planes, depth and alpha of a picture over the background of a field."""
    planes = Planes(torch.cat([drawn[0], drawn[1][None]]), drawn[2])
    numbers = field.bounded, field.far, draw.MIN_DEPTH_SHARE, draw.MIN_ALPHA
    return numba_composite(planes, field.background, late, with_flow, numbers)


@pytest.mark.parametrize("radiance", ["exp", "sigmoid"])
@pytest.mark.parametrize("channels", [4, 6])
def test_maps_over_the_background(radiance: str, channels: int) -> None:
    def ours(field: Splat, drawn: list[Tensor]) -> tuple[Render, Tensor]:
        render, flow = over_background(field, drawn, None, channels == 6)
        assert render.late is None
        return render, flow

    compare_composites(ours, random_field(radiance=radiance), channels)


@pytest.mark.parametrize("with_flow", [True, False])
def test_late_mixing_over_the_background(with_flow: bool) -> None:
    compare_mixing(over_background, with_flow)


@pytest.mark.parametrize("names", PRIORS)
def test_losses(names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    compare_losses(NumbaLosses, names, monkeypatch)
