"""RAFT behind the interface of GMFlow, and a sentence where torchvision is missing."""

import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tiny_networks import random_flow_network

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.flow.networks import load_network
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


def test_raft_has_the_weights_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = random_flow_network("raft", tmp_path, monkeypatch)
    network = load_network("raft", path)
    for name, weights in torch.load(path).items():
        assert torch.equal(network.state_dict()[name], weights)
    assert not network.training and not any(p.requires_grad for p in network.parameters())


def test_weights_of_another_network_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = random_flow_network("gmflow", tmp_path, monkeypatch)
    with pytest.raises(InputError, match=r"these weights do not fit raft \(.*layer\.weight"):
        load_network("raft", path)


def test_torchvisions_own_network_is_loaded_and_predicts(tmp_path: Path):
    try:
        own = Raft()
    except InputError as error:
        pytest.skip(str(error))
    torch.save(own.state_dict(), tmp_path / "raft.pth")
    network = load_network("raft", tmp_path / "raft.pth")
    images = torch.rand(2, 3, 128, 160)
    assert torch.equal(network(images), own.eval()(images))
