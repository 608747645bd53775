"""Flow by a network: frames at its working size, weights of every kind, and a sentence
for wrong ones.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.flow import networks
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.priors.flow.networks import (
    load_network,
    network_flow,
    predict_both_directions,
    read_weights,
    refine_flow,
    resize_flow,
    working_size,
)


class Constant(torch.nn.Module):
    """A network whose flow is (4, -2) of the pixels it sees, and back."""

    def __init__(self) -> None:
        super().__init__()
        self.motion = torch.nn.Parameter(torch.tensor([4.0, -2.0]))

    def predictions(self, images: torch.Tensor) -> list[torch.Tensor]:
        flow = self.motion.view(1, 2, 1, 1).expand(len(images) // 2, 2, *images.shape[2:])
        return [torch.cat([flow, -flow])]

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        self.images = images
        return self.predictions(images)[-1]


def test_frames_are_matched_near_640_pixels():
    assert working_size(180, 320) == (352, 640)  # 360 is no multiple of 32
    assert working_size(360, 640) == (352, 640)
    assert working_size(90, 160) == (256, 480)  # enlarged three times at most
    assert working_size(30, 40) == (128, 128)  # the least a network takes


def test_flow_is_returned_in_pixels_of_the_frame():
    """60 x 90 is seen as 192 x 256: 4 px of 256 are 4 * 90 / 256 of 90."""
    network = Constant()
    there, back = predict_both_directions(network, *np.zeros((2, 60, 90, 3), np.float32))
    assert network.images.shape == (2, 3, 192, 256)
    assert there.shape == (60, 90, 2)
    assert np.allclose(there, [4 * 90 / 256, -2 * 60 / 192], atol=1e-5)
    assert np.allclose(back, -there)


def test_a_constant_flow_survives_any_size():
    flow = torch.tensor([1.0, 2.0]).view(1, 2, 1, 1).expand(1, 2, 40, 30)
    assert torch.allclose(resize_flow(flow, (20, 60))[0, :, 7, 7], torch.tensor([2.0, 1.0]))


def test_a_network_is_a_flow_prior_that_checks_itself():
    """A flat video has no texture for the search to correct."""
    video, clipped = np.full((3, 60, 90, 3), 0.5, np.float32), np.zeros((3, 60, 90), bool)
    clipped[2, 30, 40] = True
    found, valid = network_flow(Constant(), video, clipped, np.array([[0, 2], [2, 0]]))
    assert np.allclose(found[0], -found[1]) and np.abs(found[0] - [1.40625, -0.625]).max() < 1e-4
    assert not valid[1, 30, 40] and valid[1, 30, 45]  # clipped; not clipped
    assert not valid[0, :, -1].any()  # leaves the frame


def test_the_search_corrects_only_flow_that_is_nearly_right():
    """Noise that slides by (3, 0): from (3.4, 0) it is found; from (9, 6), the result
    stays within half a pixel.
    """
    noise = np.random.default_rng(0).random((64, 110)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2)
    gray = np.rint(255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)
    a, b = gray[:, 5:-9].copy(), gray[:, 2:-12].copy()
    near, far = (np.broadcast_to(np.float32(f), (*a.shape, 2)).copy() for f in ((3.4, 0), (9, 6)))
    assert np.median(np.abs(refine_flow(a, b, near) - [3, 0])) < 0.1
    assert np.linalg.norm(refine_flow(a, b, far) - far, axis=-1).max() <= 0.5


def test_weights_name_their_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(networks, "GMFlow", lambda bf16: GMFlow(16, 1))
    state = GMFlow(16, 1).state_dict()
    torch.save(state, tmp_path / "flownet.pkl")
    save_file(state, tmp_path / "weights.safetensors", {"network": "gmflow"})
    for given in (tmp_path / "flownet.pkl", tmp_path / "weights.safetensors", tmp_path):
        network = load_network("gmflow", given)
        assert torch.equal(network.state_dict()["upsampler.0.bias"], state["upsampler.0.bias"])
        assert not any(p.requires_grad for p in network.parameters())
    assert isinstance(load_network(None, tmp_path), GMFlow)
    with pytest.raises(InputError, match="not of raft; choose the network gmflow"):
        load_network("raft", tmp_path)
    with pytest.raises(InputError, match="does not name its network"):
        load_network(None, tmp_path / "flownet.pkl")
    with pytest.raises(InputError, match=r"holds no weights.safetensors"):
        load_network(None, tmp_path / "unfinished")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("other.pkl", "do not fit gmflow"),
        ("list.pkl", "not the weights of a network"),
        ("numbered.pkl", "not the weights of a network"),
        ("broken.pkl", "no readable weights"),
        ("cut.pkl", "no readable weights"),
        ("broken.safetensors", "no readable weights"),
    ],
)
def test_weights_that_do_not_fit_are_refused_in_one_sentence(tmp_path: Path, name: str, words: str):
    torch.save({"something": torch.zeros(2)}, tmp_path / "other.pkl")
    torch.save([1, 2], tmp_path / "list.pkl")
    torch.save({0: torch.zeros(2)}, tmp_path / "numbered.pkl")
    torch.save({"a": torch.zeros(9)}, tmp_path / "cut.pkl", _use_new_zipfile_serialization=False)
    (tmp_path / "cut.pkl").write_bytes((tmp_path / "cut.pkl").read_bytes()[:18])
    (tmp_path / "broken.pkl").write_bytes(b"PK nothing")
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match=words):
        load_network("gmflow", tmp_path / name)


def test_weights_with_code_in_them_are_not_run(tmp_path: Path):
    torch.save({"weight": Path("x")}, tmp_path / "code.pkl")  # any object that is no tensor
    with pytest.raises(InputError, match="no readable weights"):
        read_weights(tmp_path / "code.pkl")
