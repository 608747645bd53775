"""Flow by a network: frames at the size it wants, weights of every kind, RAFT without
torchvision, and a sentence for what is wrong.
"""

import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.flow import networks as flow_networks
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.priors.flow.networks import (
    both_ways,
    load,
    matched_flow,
    mended,
    read_weights,
    resized_flow,
    working_size,
)
from hdr_nsff.priors.flow.raft import Raft


class Constant(torch.nn.Module):
    """Says that everything moves by (4, -2) of the pixels it sees, and back."""

    def __init__(self) -> None:
        super().__init__()
        self.own = torch.nn.Parameter(torch.tensor([4.0, -2.0]))

    def predictions(self, images: torch.Tensor) -> list[torch.Tensor]:
        flow = self.own.view(1, 2, 1, 1).expand(len(images) // 2, 2, *images.shape[2:])
        return [torch.cat([flow, -flow])]

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.saw = images
        return self.predictions(images)[-1]


def test_frames_are_matched_near_640_pixels():
    assert working_size(180, 320) == (352, 640)  # 360 is no multiple of 32
    assert working_size(360, 640) == (352, 640)
    assert working_size(90, 160) == (256, 480)  # enlarged three times at most
    assert working_size(30, 40) == (128, 128)  # the least a network takes


def test_flow_comes_back_in_pixels_of_the_frame():
    """60 x 90 is seen as 192 x 256: 4 px of 256 are 4 * 90 / 256 of 90."""
    network = Constant()
    there, back = both_ways(network, *np.zeros((2, 60, 90, 3), np.float32))
    assert network.saw.shape == (2, 3, 192, 256)
    assert there.shape == (60, 90, 2) and np.allclose(
        there, [4 * 90 / 256, -2 * 60 / 192], atol=1e-5
    )
    assert np.allclose(back, -there)


def test_a_constant_flow_survives_any_size():
    flow = torch.tensor([1.0, 2.0]).view(1, 2, 1, 1).expand(1, 2, 40, 30)
    assert torch.allclose(resized_flow(flow, (20, 60))[0, :, 7, 7], torch.tensor([2.0, 1.0]))


def test_a_network_is_a_flow_prior_that_checks_itself():
    video, clipped = (
        np.full((3, 60, 90, 3), 0.5, np.float32),
        np.zeros((3, 60, 90), bool),
    )  # flat: nothing to mend
    clipped[2, 30, 40] = True
    found, valid = matched_flow(Constant(), video, clipped, np.array([[0, 2], [2, 0]]))
    assert np.allclose(found[0], -found[1]) and np.abs(found[0] - [1.40625, -0.625]).max() < 1e-4
    assert (
        not valid[1, 30, 40] and valid[1, 30, 45] and not valid[0, :, -1].any()
    )  # clipped; believed; leaves the frame


def test_the_search_mends_what_is_nearly_right_and_leaves_the_rest():
    """Noise that slides by (3, 0): from (3.4, 0) it is found; from (9, 6), whatever the
    search says is no more than half a pixel away.
    """
    noise = cv2.GaussianBlur(
        np.random.default_rng(0).random((64, 110)).astype(np.float32), (0, 0), 2
    )
    gray = np.rint(255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)
    a, b = gray[:, 5:-9].copy(), gray[:, 2:-12].copy()
    near, far = (np.broadcast_to(np.float32(f), (*a.shape, 2)).copy() for f in ((3.4, 0), (9, 6)))
    assert np.median(np.abs(mended(a, b, near) - [3, 0])) < 0.1
    assert np.linalg.norm(mended(a, b, far) - far, axis=-1).max() <= 0.5


def test_weights_say_which_network_they_are_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(flow_networks, "GMFlow", lambda bf16: GMFlow(16, 1))
    state = GMFlow(16, 1).state_dict()
    torch.save(state, tmp_path / "flownet.pkl")
    save_file(state, tmp_path / "weights.safetensors", {"network": "gmflow"})
    for given in (tmp_path / "flownet.pkl", tmp_path / "weights.safetensors", tmp_path):
        network = load("gmflow", given)
        assert torch.equal(network.state_dict()["upsampler.0.bias"], state["upsampler.0.bias"])
        assert not any(p.requires_grad for p in network.parameters())
    assert isinstance(load(None, tmp_path), GMFlow)
    with pytest.raises(InputError, match="weights of gmflow, not of raft"):
        load("raft", tmp_path)
    with pytest.raises(InputError, match="does not say which network"):
        load(None, tmp_path / "flownet.pkl")


def test_weights_that_do_not_fit_are_refused_in_one_sentence(tmp_path: Path):
    torch.save({"something": torch.zeros(2)}, tmp_path / "other.pkl")
    torch.save([1, 2], tmp_path / "list.pkl")
    (tmp_path / "broken.pkl").write_bytes(b"PK nothing")
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    for name, said in (
        ("other.pkl", "do not fit gmflow"),
        ("list.pkl", "something else"),
        ("broken.pkl", "no readable weights"),
    ):
        with pytest.raises(InputError, match=said):
            load("gmflow", tmp_path / name)
    with pytest.raises(InputError, match="no readable weights"):
        read_weights(tmp_path / "broken.safetensors")


def test_weights_with_code_in_them_are_not_run(tmp_path: Path):
    torch.save({"weight": Path("x")}, tmp_path / "code.pkl")  # any object that is no tensor
    with pytest.raises(InputError, match="no readable weights"):
        read_weights(tmp_path / "code.pkl")


def test_raft_without_torchvision_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(
        InputError, match=r"--flow raft: torchvision cannot be imported .* use --flow gmflow or dis"
    ):
        Raft()


def test_raft_sees_signed_images_and_their_partners(monkeypatch: pytest.MonkeyPatch):
    """A stand-in for torchvision's network says the first two channels of the
    difference of what it was shown.
    """

    class Shown(torch.nn.Module):
        def forward(self, first: torch.Tensor, second: torch.Tensor) -> list[torch.Tensor]:
            return [torch.zeros_like(first[:, :2]), (second - first)[:, :2]]

    module = ModuleType("torchvision.models.optical_flow")
    module.raft_large = lambda weights, progress: Shown()  # type: ignore[attr-defined]
    for name in ("torchvision", "torchvision.models"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "torchvision.models.optical_flow", module)
    images = torch.rand(4, 3, 128, 160)
    flow = Raft()(images)
    assert flow.shape == (4, 2, 128, 160)
    assert torch.allclose(
        flow[1], 2 * (images[3] - images[1])[:2], atol=1e-6
    )  # [0, 1] became [-1, 1]
    assert torch.allclose(flow[3], -flow[1])
