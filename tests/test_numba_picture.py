"""Pictures and their losses by numba kernels on the CPU, against plain torch."""

import pytest
import torch
from moments import random_field
from pictures import PRIORS, compare_composites, compare_losses
from torch import Tensor

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.splat import draw
from hdr_nsff.fields.splat.numba_picture import numba_composite
from hdr_nsff.fields.splat.rasterize import Planes
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.training.fused_losses import NumbaLosses


def over_background(
    field: Splat, drawn: list[Tensor], with_flow: bool, with_late: bool
) -> tuple[Render, Tensor, Tensor]:
    """Planes, depth and alpha of a picture over the background of a field."""
    planes = Planes(torch.cat([drawn[0], drawn[1][None]]), drawn[2])
    numbers = field.bounded, field.far, draw.MIN_DEPTH_SHARE, draw.MIN_ALPHA
    return numba_composite(planes, field.background, with_flow, with_late, numbers)


@pytest.mark.parametrize("radiance", ["exp", "sigmoid"])
@pytest.mark.parametrize("channels", [4, 6])
def test_maps_over_the_background(radiance: str, channels: int) -> None:
    def ours(field: Splat, drawn: list[Tensor]) -> tuple[Render, Tensor]:
        render, flow, late = over_background(field, drawn, channels == 6, False)
        assert late.shape == (0, 3)
        return render, flow

    compare_composites(ours, random_field(radiance=radiance), channels)


@pytest.mark.parametrize("with_flow", [True, False])
def test_what_is_recorded_late_passes_unchanged(with_flow: bool) -> None:
    first = 6 if with_flow else 4
    drawn = torch.rand(first + 3, 5, 7), torch.rand(5, 7), torch.rand(5, 7)
    leaves = [m.requires_grad_() for m in drawn]
    _, flow, late = over_background(random_field(), leaves, with_flow, True)
    assert flow.shape == (35 if with_flow else 0, 2)
    assert torch.equal(late, leaves[0][first:].flatten(1).T)
    weight = torch.rand(35, 3)
    (gradient,) = torch.autograd.grad((weight * late).sum(), leaves[:1])
    assert torch.equal(gradient[first:].flatten(1).T, weight)
    assert (gradient[:first] == 0).all()


@pytest.mark.parametrize("names", PRIORS)
def test_losses(names: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    compare_losses(NumbaLosses, names, monkeypatch)
