"""The shared tone mapper's numbers by CUDA kernels, on a CPU by the simulator of
numba-cuda: against plain torch. `test_cuda_step.py` runs these tests in a process with
NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.kernels.cuda import tone_kernels
from hdr_nsff.tonemap import base, bracketed, fused_tone
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig
from hdr_nsff.tonemap.bracketed import SharedToneMapper
from hdr_nsff.tonemap.curve import knot_positions
from hdr_nsff.tonemap.fused_tone import Recording, fused_recording

FEW = 32  # knots; the simulator has a thread of the CPU for each


def use_few_knots(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many knots and threads as one launch takes, but of blocks that are smaller."""
    for module in (fused_tone, tone_kernels):
        monkeypatch.setattr(module, "MAX_KNOTS", FEW)
    monkeypatch.setattr(base, "knot_positions", lambda spacing: knot_positions(spacing, FEW))


@pytest.fixture
def few_knots(monkeypatch: pytest.MonkeyPatch) -> None:
    use_few_knots(monkeypatch)


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


@pytest.mark.usefixtures("few_knots")
@pytest.mark.parametrize(
    ("frame", "num_cameras", "anchored", "residual", "vignetting"),
    [(2, 1, True, True, True), (None, 2, False, True, True), (2, 2, True, False, False),
     (None, 1, False, False, False)],
)  # fmt: skip
def test_gain_curve_and_regularizers(
    frame: int | None, num_cameras: int, anchored: bool, residual: bool, vignetting: bool
) -> None:
    settings = {"residual": residual, "vignetting": vignetting}
    tonemapper, camera = random_tone_mapper(num_cameras, anchored, **settings), num_cameras - 1
    ours = tonemapper.recording(2, camera, frame)
    terms = tonemapper.regularizers()
    theirs = tonemapper.log_gain(2, camera, frame).exp(), tonemapper.curve_values(camera, frame)
    assert list(ours.terms) == list(terms)
    compare(
        gradients(tonemapper, [ours.gain, ours.curve, *ours.terms.values()]),
        gradients(tonemapper, [*theirs, *terms.values()]),
    )


@pytest.mark.usefixtures("few_knots")
@pytest.mark.parametrize("wanted", ["terms", "curve"])
def test_gradients_of_some_results(wanted: str) -> None:
    tonemapper = random_tone_mapper(1, True)
    recording = fused_recording(tonemapper.learned(), tonemapper.held(), 2, 0, 2)
    theirs = [tonemapper.curve_values(0, 2)]
    ours = [recording.curve]
    if wanted == "terms":
        ours, theirs = list(recording.terms.values()), list(tonemapper.regularizers().values())
    compare(gradients(tonemapper, ours), gradients(tonemapper, theirs))


def test_a_curve_of_as_many_knots_as_there_are() -> None:
    tonemapper = random_tone_mapper(1, True)
    ours, theirs = tonemapper.recording(2, 0, 2).curve, tonemapper.curve_values(0, 2)
    compare(gradients(tonemapper, [ours]), gradients(tonemapper, [theirs]))


def test_the_terms_of_a_recording_are_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tonemapper = random_tone_mapper(1, True)
    gain, curve = torch.ones(3), tonemapper.curve_values(0, 0)
    made = [Recording(gain, curve, {"gain_residual": gain[0]}) for _ in range(4)]
    remaining = iter(made)
    monkeypatch.setattr(bracketed, "kernels_on", lambda device: True)
    monkeypatch.setattr(bracketed, "fused_recording", lambda *arguments: next(remaining))
    for _ in range(2):
        tonemapper(torch.rand(2, 3), 2, 0, 2)
    with torch.no_grad():
        tonemapper(torch.rand(2, 3), 2, 0, 2)
    assert tonemapper.regularizers() is made[1].terms
    assert tonemapper.regularizers() is made[3].terms
