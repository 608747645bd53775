"""The shared tone mapper's numbers by CUDA kernels, on a CPU by the simulator of
numba-cuda: against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

import pytest
import torch
from torch import Tensor

from hdr_nsff.tonemap.base import Recordings, ToneMapConfig
from hdr_nsff.tonemap.bracketed import SharedToneMapper
from hdr_nsff.tonemap.fused_tone import fused_recording, fused_regularizers


def random_tone_mapper(num_cameras: int, anchored: bool, **settings: bool) -> SharedToneMapper:
    """A tone mapper of seven frames, no number of which is 0."""
    recordings = Recordings(
        (0, 1, 2, 0, 1, 2, 0),
        (0,) * 7,
        (-2.0, 0.0, None),
        1,
        num_cameras,
        drift=(0.1, 0, 0.2, 0.3, 0, 0, 0.1),
        balance=((0.05, 0, -0.05), (0.1, -0.2, 0.1)) + ((0, 0, 0),) * 4 + ((0.2, 0, -0.2),),
        corners=(0.4,) * num_cameras,
    )
    found = SharedToneMapper(ToneMapConfig(**settings), recordings)
    generator = torch.Generator().manual_seed(0)
    for p in found.parameters():
        p.data.add_(0.3 * torch.randn(p.shape, generator=generator))
    if anchored:
        found.anchor()
    for p in found.parameters():
        p.data.add_(0.1 * torch.randn(p.shape, generator=generator))
    return found


def gradients(tonemapper: SharedToneMapper, outputs: list[Tensor]) -> dict[str, Tensor]:
    """Values by their place, and gradients by the names of parameters."""
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(v.shape, generator=generator) for v in outputs]
    names, leaves = zip(*tonemapper.named_parameters(), strict=True)
    used = [n for n, leaf in zip(names, leaves, strict=True) if leaf.requires_grad]
    loss = torch.stack([(w * v).sum() for w, v in zip(weights, outputs, strict=True)]).sum()
    learned = [leaf for leaf in leaves if leaf.requires_grad]
    found = torch.autograd.grad(loss, learned, allow_unused=True, materialize_grads=True)
    values = {str(i): v.detach() for i, v in enumerate(outputs)}
    return {**values, **dict(zip(used, found, strict=True))}


def compare(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    for name, b in theirs.items():
        largest = float(b.abs().max()) if b.numel() else 0.0
        # second differences of float32 curves: both are 1e-5 off the same in float64
        off = 5e-5 if name.endswith("logits") else 1e-5
        torch.testing.assert_close(ours[name], b, rtol=1e-4, atol=off * largest)


@pytest.mark.parametrize(
    ("frame", "num_cameras", "residual"),
    [(2, 1, True), (None, 2, True), (2, 2, False), (None, 1, False)],
)
def test_gain_and_curve(frame: int | None, num_cameras: int, residual: bool) -> None:
    tonemapper = random_tone_mapper(num_cameras, True, residual=residual)
    state, camera = (tonemapper.learned(), tonemapper.held()), num_cameras - 1
    ours = fused_recording(*state, 2, camera, frame)
    theirs = tonemapper.log_gain(2, camera, frame).exp(), tonemapper.curve_values(camera, frame)
    compare(gradients(tonemapper, [*ours]), gradients(tonemapper, [*theirs]))


@pytest.mark.parametrize(
    ("anchored", "num_cameras", "vignetting"),
    [(True, 1, True), (False, 2, True), (True, 2, False), (False, 1, False)],
)
def test_regularizers(anchored: bool, num_cameras: int, vignetting: bool) -> None:
    tonemapper = random_tone_mapper(num_cameras, anchored, vignetting=vignetting)
    ours = fused_regularizers(tonemapper.learned(), tonemapper.held())
    theirs = tonemapper.regularizers()
    assert list(ours) == list(theirs)
    compare(
        gradients(tonemapper, list(ours.values())), gradients(tonemapper, list(theirs.values()))
    )
