"""Devices by name, and functions mapped over the tensors of a dataclass."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from hdr_nsff.core import tensors
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.tensors import cuda_fault, generator_for, pick_device, tree_map


@dataclass(frozen=True)
class Pair:
    first: Tensor
    others: dict[str, tuple[Tensor, ...]]
    name: str


def test_a_function_is_applied_to_every_tensor_and_nothing_else() -> None:
    pair = Pair(torch.tensor(1.0), {"a": (torch.tensor(2.0), torch.tensor(3.0))}, "pair")
    doubled = tree_map(lambda t: 2 * t, pair)
    assert (doubled.first, doubled.others, doubled.name) == (2.0, {"a": (4.0, 6.0)}, "pair")


def test_random_numbers_for_cuda_are_drawn_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert generator_for(torch.device("cpu"), 7).initial_seed() == 7
    assert generator_for(torch.device("meta"), 7).device.type == "cpu"
    asked: list[torch.device] = []
    on_cpu = torch.Generator

    def generator(device: torch.device) -> torch.Generator:
        asked.append(device)
        return on_cpu()

    monkeypatch.setattr(torch, "Generator", generator)
    assert generator_for(torch.device("cuda:1"), 7).initial_seed() == 7
    assert asked == [torch.device("cuda:1")]


def with_cuda_devices(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """A torch that reports `count` CUDA devices."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    monkeypatch.setattr(tensors, "cuda_fault", lambda name: None)


def test_auto_is_cuda_where_there_is_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    with_cuda_devices(monkeypatch, 0)
    assert pick_device("auto") == pick_device("cpu") == torch.device("cpu")
    with_cuda_devices(monkeypatch, 2)
    assert pick_device("auto") == pick_device("cuda") == torch.device("cuda")
    assert pick_device("cuda:1") == torch.device("cuda", 1)


@pytest.mark.parametrize(("count", "name", "reason"), [
    (0, "cuda", "sees no CUDA device"),
    (0, "cuda:0", "sees no CUDA device"),
    (2, "cuda:2", "there are 2, counted from cuda:0"),
])  # fmt: skip
def test_a_cuda_device_that_is_not_there_is_an_error(
    count: int, name: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_cuda_devices(monkeypatch, count)
    with pytest.raises(InputError, match=f"--device {name}: .*{reason}"):
        pick_device(name)


def test_a_cuda_device_on_which_torch_computes_nothing_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with_cuda_devices(monkeypatch, 1)
    monkeypatch.setattr(tensors, "cuda_fault", cuda_fault)

    def too_old(*size: int, device: str) -> Tensor:
        raise RuntimeError("CUDA error: no kernel image is available\nCompile with ...")

    monkeypatch.setattr(torch, "ones", too_old)
    for cached in (cuda_fault, tensors.say_once):
        cached.cache_clear()
    assert pick_device("auto") == pick_device("auto") == torch.device("cpu")
    said = capsys.readouterr().err
    assert said.count("using the CPU although there is a CUDA device: CUDA error: no kernel") == 1
    with pytest.raises(InputError, match=r"--device cuda:0: .*no kernel image is available\);"):
        pick_device("cuda:0")
    for cached in (cuda_fault, tensors.say_once):
        cached.cache_clear()


NAMES = ["mps", "hip", "xla", "meta", "privateuseone", "gpu7", "", "cuda:", "cuda:-1", "cuda:x"]


@pytest.mark.parametrize("name", NAMES)
def test_other_devices_are_refused_with_the_list(name: str) -> None:
    with pytest.raises(InputError, match="choose auto, cpu, cuda or cuda:N"):
        pick_device(name)
