"""Dense features of frames: what a place looks like to a network, nearly whatever the
exposure.

A source is a function `features(video) -> Features`; two are here. XFeat (Potje et al.,
CVPR 2024) is small enough for a CPU, and a package carries its weights. DINOv2 (Oquab
et al., 2023) is what the paper matches by: ViT-L/14, layer 15, stride 7 (its section
3.4). Neither learns here: no gradient enters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import track
from hdr_nsff.priors.pretrained import pretrained
from hdr_nsff.priors.weights import find

# The convolutions of XFeat's dense part: (channels in, channels out, kernel, stride),
# by the names its weights have.
BLOCKS: dict[str, tuple[tuple[int, int, int, int], ...]] = {
    "block1": ((1, 4, 3, 1), (4, 8, 3, 2), (8, 8, 3, 1), (8, 24, 3, 2)),
    "block2": ((24, 24, 3, 1), (24, 24, 3, 1)),
    "block3": ((24, 64, 3, 2), (64, 64, 3, 1), (64, 64, 1, 1)),
    "block4": ((64, 64, 3, 2), (64, 64, 3, 1), (64, 64, 3, 1)),
    "block5": ((64, 128, 3, 2), (128, 128, 3, 1), (128, 128, 3, 1), (128, 64, 1, 1)),
    "block_fusion": ((64, 64, 3, 1), (64, 64, 3, 1)),
}
LINEAR = {"skip1.1": (1, 24), "block_fusion.2": (64, 64)}  # 1x1 convolutions without normalization
NORM_EPSILON = 1e-5  # of torch's normalization layers, with which the weights were trained
XFEAT_STRIDE, XFEAT_MULTIPLE = (
    8,
    32,
)  # pixels per cell; the sides of its input are multiples of that
# pixels: the middle of what its first cell looks at, measured by gradients (1.9 +- 0.5)
XFEAT_ORIGIN = 2.0
SMALL = 100_000  # frames of fewer pixels are doubled before XFeat sees them
DINO_SIDE = 854  # pixels of the longer side of the frames that DINOv2 sees, as in the paper
DINO_DEPTH = 15 / 24  # the share of the layers after which features are taken, if none is named
IMAGENET_MEAN, IMAGENET_STD = (
    (0.485, 0.456, 0.406),
    (0.229, 0.224, 0.225),
)  # what DINOv2 was trained with


@dataclass(frozen=True)
class Features:
    """Features of every frame on a grid of cells."""

    maps: Tensor  # (T, C, h, w) float32, not normalized
    stride: float  # pixels of the frame from cell to cell
    # pixel coordinate (centers at +0.5), in x and y, of the middle of what cell (0, 0)
    # looks at
    origin: float


Source = Callable[
    [np.ndarray], Features
]  # exposure-equalized rgb (T, H, W, 3) in [0, 1] -> Features
FeatureName = Literal["xfeat", "dinov2-small", "dinov2-base", "dinov2-large"]


def feature_source(
    name: FeatureName = "xfeat",
    weights: Path | None = None,
    layer: int | None = None,
    stride: int | None = None,
) -> Source:
    """The features called `name`, their weights from `weights` or wherever they are
    found.

    `layer`, `stride` are DINOv2's: how many of its layers to run, and pixels from token
    to token; XFeat's are fixed.
    """
    if name != "xfeat":
        network = pretrained("Dinov2Model", name, weights)
        return partial(dinov2_features, network, layer=layer, stride=stride)
    if layer is not None or stride is not None:
        raise InputError(
            "--semantic.layer and --semantic.stride: are for the features of DINOv2; leave them out with `xfeat`"
        )
    return partial(xfeat_features, load_xfeat(find("xfeat", weights)))


def per_frame(
    video: np.ndarray, scale: float, multiple: int, network: Callable[[Tensor], Tensor]
) -> Tensor:
    """What `network` makes of each frame of `video` (T, H, W, 3), magnified: (T, C, h,
    w).
    """
    with torch.no_grad():
        return torch.cat(
            [network(magnified(frame, scale, multiple)) for frame in track(video, "features")]
        )


def magnified(frame: np.ndarray, scale: float, multiple: int) -> Tensor:
    """A frame (H, W, 3) as (1, 3, h, w), `scale` times as large, its right and lower
    edges repeated to sides that are multiples.
    """
    image = torch.from_numpy(np.ascontiguousarray(frame, np.float32)).permute(2, 0, 1)[None]
    if scale != 1:
        image = functional.interpolate(
            image, scale_factor=scale, mode="bicubic", recompute_scale_factor=False
        ).clamp(0, 1)
    return functional.pad(
        image, (0, -image.shape[-1] % multiple, 0, -image.shape[-2] % multiple), mode="replicate"
    )


class XFeat(nn.Module):
    """XFeat's dense descriptors: 64 channels at an eighth of the picture. Each
    normalization is folded into its convolution.
    """

    def __init__(self, state: dict[str, Tensor]) -> None:
        """`state` holds the published weights by their names; those of its keypoint
        heads are not used.
        """
        super().__init__()
        for block, layers in BLOCKS.items():
            for i, (inside, outside, kernel, _) in enumerate(layers):
                weight = state[f"{block}.{i}.layer.0.weight"]
                assert weight.shape == (outside, inside, kernel, kernel), (
                    f"{block}.{i}: {tuple(weight.shape)}"
                )
                mean, variance = (
                    state[f"{block}.{i}.layer.1.running_{s}"] for s in ("mean", "var")
                )
                shrink = (variance + NORM_EPSILON).rsqrt()
                self.keep(f"{block}_{i}", weight * shrink[:, None, None, None], -mean * shrink)
        for name, (inside, outside) in LINEAR.items():
            weight = state[f"{name}.weight"]
            assert weight.shape == (outside, inside, 1, 1), f"{name}: {tuple(weight.shape)}"
            self.keep(name.replace(".", "_"), weight, state[f"{name}.bias"])

    def keep(self, name: str, weight: Tensor, bias: Tensor) -> None:
        """Hold a convolution, not to be learned."""
        self.register_buffer(f"{name}_weight", weight.float())
        self.register_buffer(f"{name}_bias", bias.float())

    def convolve(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        """One convolution of what is held, with zeros around."""
        weight, bias = getattr(self, f"{name}_weight"), getattr(self, f"{name}_bias")
        return functional.conv2d(x, weight, bias, stride, padding=weight.shape[-1] // 2)

    def block(self, x: Tensor, name: str) -> Tensor:
        """A chain of convolutions and ReLUs."""
        for i, (_, _, _, stride) in enumerate(BLOCKS[name]):
            x = functional.relu(self.convolve(x, f"{name}_{i}", stride))
        return x

    def forward(self, rgb: Tensor) -> Tensor:
        """Descriptors (T, 64, H/8, W/8) of rgb (T, 3, H, W), any scale and offset of
        brightness; sides are multiples of 32.
        """
        gray = functional.instance_norm(rgb.mean(1, keepdim=True), eps=NORM_EPSILON)
        quarter = self.block(gray, "block1") + self.convolve(
            functional.avg_pool2d(gray, 4), "skip1_1"
        )
        eighth = self.block(self.block(quarter, "block2"), "block3")
        sixteenth = self.block(eighth, "block4")
        coarse = self.block(sixteenth, "block5")
        size = list(eighth.shape[-2:])
        mixed = eighth + sum(
            functional.interpolate(x, size, mode="bilinear") for x in (sixteenth, coarse)
        )
        return self.convolve(self.block(mixed, "block_fusion"), "block_fusion_2")


def load_xfeat(path: Path) -> XFeat:
    """XFeat with the weights in a file; InputError where they are not its."""
    try:
        return XFeat(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # of many types: no archive, other names, other shapes
        raise InputError(
            f"{path}: no weights of XFeat ({type(error).__name__}: {error}); name its xfeat.pt"
        ) from error


def xfeat_features(network: XFeat, video: np.ndarray) -> Features:
    """`Source` by XFeat: 64 channels every 8 pixels, or every 4 pixels of small frames."""
    scale = 2 if video.shape[1] * video.shape[2] < SMALL else 1
    maps = per_frame(video, scale, XFEAT_MULTIPLE, network)
    return Features(maps, XFEAT_STRIDE / scale, XFEAT_ORIGIN / scale)


def dinov2_features(
    network: Any,
    video: np.ndarray,
    layer: int | None = None,
    stride: int | None = None,
    side: int = DINO_SIDE,
) -> Features:
    """`Source` by transformers' `Dinov2Model`: the tokens after `layer` layers (0.625
    of them), one every `stride` pixels (half a patch) of frames whose longer side is
    `side`. InputError for a layer or stride that it has not.
    """
    depth, patch = network.config.num_hidden_layers, network.config.patch_size
    layer, stride = layer or round(DINO_DEPTH * depth), stride or patch // 2
    if not 1 <= layer <= depth:
        raise InputError(
            f"--semantic.layer {layer}: this network has {depth} layers; choose 1 to {depth}"
        )
    if not 1 <= stride <= patch:
        raise InputError(
            f"--semantic.stride {stride}: the patches are {patch} pixels wide; choose 1 to {patch}"
        )
    scale = side / max(video.shape[1:3])
    maps = per_frame(video, scale, patch, partial(tokens, network, layer, stride))
    return Features(maps, stride / scale, patch / 2 / scale)


def tokens(network: Any, layer: int, stride: int, rgb: Tensor) -> Tensor:
    """What DINOv2's patch tokens are after `layer` layers: (1, C, h, w) of rgb (1, 3,
    H, W), patches `stride` pixels apart, so that they overlap; the position encodings
    are interpolated to as many.
    """
    embeddings, shape = network.embeddings, (1, 3, 1, 1)
    normalized = (rgb - torch.tensor(IMAGENET_MEAN).view(shape)) / torch.tensor(IMAGENET_STD).view(
        shape
    )
    projection = embeddings.patch_embeddings.projection
    patches = functional.conv2d(
        normalized, projection.weight, projection.bias, stride
    )  # (1, C, h, w)
    position = embeddings.position_embeddings  # (1, 1 + n * n, C), the class token's first
    n = round((position.shape[1] - 1) ** 0.5)
    grid = position[:, 1:].unflatten(1, (n, n)).permute(0, 3, 1, 2)
    patches = patches + functional.interpolate(
        grid, list(patches.shape[-2:]), mode="bicubic", align_corners=False
    )
    x = torch.cat([embeddings.cls_token + position[:, :1], patches.flatten(2).mT], 1)
    for block in network.encoder.layer[:layer]:
        x = block(x)
    return x[:, 1:].mT.unflatten(2, patches.shape[-2:])
