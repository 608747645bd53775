"""A rasterizer is tried out at the door, with one Gaussian, and not after minutes of
work.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from hdr_nsff import cli
from hdr_nsff.core import tensors
from hdr_nsff.core.errors import InputError
from hdr_nsff.fields import build
from hdr_nsff.fields.build import device_for
from hdr_nsff.fields.nsff.nsff import NSFFConfig
from hdr_nsff.fields.splat import cuda_backends, rasterize_cuda, rasterize_gsplat
from hdr_nsff.fields.splat.config import SplatConfig


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What the choice of a rasterizer says."""
    said: list[str] = []
    monkeypatch.setattr(cuda_backends, "say", said.append)
    cuda_backends.find_backend.cache_clear()
    cuda_backends.composite_on.cache_clear()
    yield said
    cuda_backends.find_backend.cache_clear()
    cuda_backends.composite_on.cache_clear()


def faults(monkeypatch: pytest.MonkeyPatch, kernels: str | None, gsplat: str | None) -> None:
    """What our kernels and gsplat cannot do."""
    monkeypatch.setattr(rasterize_cuda, "fault", lambda device: kernels)
    monkeypatch.setattr(rasterize_gsplat, "fault", lambda device: gsplat)


def test_our_kernels_draw_where_they_can(
    messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults(monkeypatch, None, None)
    assert cuda_backends.find_backend().composite is rasterize_cuda.composite
    assert cuda_backends.fault() is None and not messages


def test_gsplat_draws_where_our_kernels_cannot_and_says_why(
    messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults(monkeypatch, "no compiler", None)
    assert cuda_backends.find_backend().composite is rasterize_gsplat.composite
    assert messages == ["Gaussians are drawn by gsplat: no compiler"]


def test_the_fault_names_gsplat_only_where_it_is_installed(
    messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults(monkeypatch, "no compiler", "no kernels")
    monkeypatch.setattr(rasterize_gsplat, "installed", lambda: False)
    assert cuda_backends.fault() == "no compiler"
    monkeypatch.setattr(rasterize_gsplat, "installed", lambda: True)
    assert cuda_backends.fault("cuda:1") == "no compiler; no kernels"


def test_a_device_without_a_rasterizer_is_reported_once(
    messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults(monkeypatch, "no compiler", "no kernels")
    for _ in range(2):
        assert cuda_backends.composite_on(torch.device("cuda")) is None
    assert len(messages) == 1 and "on the CPU, which is slower: no compiler" in messages[0]


def test_kernels_of_a_step_that_cannot_be_loaded_are_reported_once(
    messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(device: torch.device) -> None:
        raise RuntimeError("no room\nand more")

    faults(monkeypatch, None, None)
    monkeypatch.setattr(cuda_backends, "load_all", broken)
    cuda_backends.kernels_on.cache_clear()
    for _ in range(2):
        assert not cuda_backends.kernels_on(torch.device("cuda"))
    cuda_backends.kernels_on.cache_clear()
    assert messages == ["training steps are plain torch, which is slower: RuntimeError: no room"]


def test_kernels_that_draw_nothing_leave_a_step_to_plain_torch(
    messages: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    faults(monkeypatch, "no compiler", None)
    cuda_backends.kernels_on.cache_clear()
    assert not cuda_backends.kernels_on(torch.device("cuda"))
    cuda_backends.kernels_on.cache_clear()
    assert messages == ["training steps are plain torch, which is slower: no compiler"]


def test_the_cpu_has_no_kernels_of_a_gpu() -> None:
    assert not cuda_backends.kernels_on(torch.device("cpu"))


@pytest.fixture
def broken_cuda(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A CUDA device on which nothing draws Gaussians, and the messages to the user."""
    said: list[str] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(tensors, "cuda_fault", lambda name: None)
    monkeypatch.setattr(cuda_backends, "fault", lambda device="cuda": "nothing draws")
    monkeypatch.setattr(build, "say", said.append)
    return said


def test_gaussians_fall_back_to_the_cpu_loudly(broken_cuda: list[str]) -> None:
    assert device_for(SplatConfig(), "auto") == torch.device("cpu")
    assert len(broken_cuda) == 1 and "using the CPU" in broken_cuda[0]


def test_gaussians_on_cuda_are_refused_where_cuda_was_requested(broken_cuda: list[str]) -> None:
    with pytest.raises(InputError, match="--device cuda: nothing draws, or use --device cpu"):
        device_for(SplatConfig(), "cuda")


def test_other_fields_need_no_rasterizer(broken_cuda: list[str]) -> None:
    assert device_for(NSFFConfig(), "auto") == torch.device("cuda") and not broken_cuda


@pytest.mark.parametrize("verb", ["run", "train"])
def test_rasterizers_are_tried_before_anything_is_prepared_or_trained(
    verb: str,
    broken_cuda: list[str],
    toy_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = str(tmp_path / "out")
    arguments = {
        "run": ["run", str(toy_folder / "images"), out],
        "train": ["train", "splat", "--scene", str(toy_folder), "--out", out],
    }
    with pytest.raises(SystemExit) as stop:
        cli.main([*arguments[verb], "--device", "cuda"])
    assert stop.value.code == 2 and "nothing draws" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
