"""RAFT behind the interface of GMFlow, and a sentence where torchvision is missing."""

import sys
from types import ModuleType

import pytest
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.flow.raft import Raft


def test_raft_without_torchvision_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    words = r"^raft: torchvision cannot be imported .* another network, such as gmflow"
    with pytest.raises(InputError, match=words):
        Raft()


class Difference(torch.nn.Module):
    """A stand-in for torchvision's network: the first two channels of the difference of
    its images.
    """

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> list[torch.Tensor]:
        return [torch.zeros_like(first[:, :2]), (second - first)[:, :2]]


def test_raft_sees_signed_images_and_their_partners(monkeypatch: pytest.MonkeyPatch):
    """Images in [0, 1] become [-1, 1], so differences double."""
    module = ModuleType("torchvision.models.optical_flow")
    module.raft_large = lambda weights, progress: Difference()  # type: ignore[attr-defined]
    for name in ("torchvision", "torchvision.models"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "torchvision.models.optical_flow", module)
    images = torch.rand(4, 3, 128, 160)
    flow = Raft()(images)
    assert flow.shape == (4, 2, 128, 160)
    assert torch.allclose(flow[1], 2 * (images[3] - images[1])[:2], atol=1e-6)
    assert torch.allclose(flow[3], -flow[1])
