"""gsplat is tried out at the door, with one Gaussian, and not after minutes of work."""

import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.splat import rasterize_gsplat
from hdr_nsff.fields.splat.rasterize import dense
from hdr_nsff.geometry.cameras import Camera

Draw = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def without_kernels(*gaussians: Tensor, **options: object) -> Any:
    """What gsplat's wheel does where there is no CUDA toolkit."""
    raise AttributeError("'NoneType' object has no attribute 'CameraModelType'")


def by_plain_torch(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    views: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    **options: object,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """What gsplat draws, by the slow twin; only for a camera at the origin."""
    camera = Camera(Ks[0], torch.eye(4)[:3], width, height)
    seen = dense(means, quaternions, scales, opacities, features, camera)
    return (
        torch.cat([seen.features, seen.depth[..., None]], -1)[None],
        seen.alpha[None, ..., None],
        {},
    )


def too_faint(*gaussians: Tensor, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Kernels that run and draw a wrong picture."""
    seen, alpha, rest = by_plain_torch(*gaussians, **options)
    return seen, alpha * 0.5, rest


@pytest.fixture
def gsplat(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Draw], None]]:
    """Installs a gsplat with this `rasterization`."""

    def install(rasterization: Draw) -> None:
        module = SimpleNamespace(rasterization=rasterization, __version__="1.5.3")
        monkeypatch.setitem(sys.modules, "gsplat", module)
        rasterize_gsplat.fault.cache_clear()

    yield install
    rasterize_gsplat.fault.cache_clear()


def test_a_gsplat_that_draws_has_no_fault(gsplat: Callable[[Draw], None]) -> None:
    gsplat(by_plain_torch)
    assert rasterize_gsplat.fault("cpu") is None


def test_a_gsplat_without_kernels_is_a_sentence_with_the_fix(
    gsplat: Callable[[Draw], None],
) -> None:
    gsplat(without_kernels)
    reason = rasterize_gsplat.fault("cpu")
    assert reason is not None and "gsplat 1.5.3 cannot draw" in reason
    assert "CameraModelType" in reason and "or the CUDA toolkit" in reason


def test_a_gsplat_that_draws_a_wrong_picture_is_not_used(gsplat: Callable[[Draw], None]) -> None:
    gsplat(too_faint)
    reason = rasterize_gsplat.fault("cpu")
    assert reason is not None and "alpha of 0.375 instead of 0.75" in reason


def test_a_missing_gsplat_is_a_sentence_with_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    rasterize_gsplat.fault.cache_clear()
    assert "pip install 'hdr-nsff[gsplat]'" in str(rasterize_gsplat.fault("cpu"))
    rasterize_gsplat.fault.cache_clear()
