"""Dense features of frames, which change little with the exposure.

A feature source is a function `(video) -> Features`; two are here. XFeat (Potje et al.,
"XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024) is small enough
for a CPU, and a package carries its weights. DINOv2 (Oquab et al., 2023) is what the
paper matches by: ViT-L/14, layer 15, stride 7 (section 3.4). Neither is trained here:
no gradient enters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
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
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.core.tensors import CPU
from hdr_nsff.priors.pretrained import IMAGENET_MEAN, IMAGENET_STD, pretrained
from hdr_nsff.priors.weights import find

# The convolutions of XFeat's dense part: (channels in, channels out, kernel, stride),
# by the names of its weights.
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
XFEAT_STRIDE = 8  # pixels per cell
XFEAT_MULTIPLE = 32  # pixels: sides of XFeat's input are multiples of this
XFEAT_ORIGIN = 2.0  # pixels: center of the first cell's field, by its gradients (1.9 +- 0.5)


@dataclass(frozen=True)
class FeatureTuning:
    """Tuning constants of the features."""

    doubled_below_pixels: int = 100_000
    """Frames with fewer pixels are doubled for XFeat (hand-chosen on rendered scenes).
    """
    dino_longer_side_px: int = 854
    """Longer side of the frames that DINOv2 sees, as in the paper."""
    dino_depth: float = 15 / 24
    """Share of DINOv2's layers that run where no layer is named, as in the paper."""


FEATURE_TUNING = FeatureTuning()


@dataclass(frozen=True)
class Features:
    """Features of every frame on a grid of cells."""

    maps: Tensor
    """(T, C, h, w) float32, not normalized."""
    stride: float
    """Distance between cells, in pixels of the frame."""
    origin: float
    """Center of cell (0, 0) in x and in y, in pixels of the frame, where the center of
    the first pixel is 0.5.
    """


# exposure-equalized rgb (T, H, W, 3) in [0, 1] -> Features
FeatureSource = Callable[[ArrayStack], Features]
FeatureName = Literal["xfeat", "dinov2-small", "dinov2-base", "dinov2-large"]


def feature_source(
    name: FeatureName = "xfeat",
    weights: Path | None = None,
    layer: int | None = None,
    stride: int | None = None,
    tuning: FeatureTuning = FEATURE_TUNING,
    device: torch.device = CPU,
) -> FeatureSource:
    """The features called `name`, with the `weights` given, or where weights are kept.

    They are computed on `device` and stay there. `layer` (layers that run) and `stride`
    (pixels from token to token) are of DINOv2 alone. InputError where weights are
    missing, or where XFeat is given one of the two.
    """
    if name != "xfeat":
        network = pretrained("Dinov2Model", name, weights).to(device)
        return partial(dinov2_features, network, layer=layer, stride=stride, tuning=tuning)
    check_xfeat(layer, stride)
    xfeat = load_xfeat(find("xfeat", weights)).to(device)
    return partial(xfeat_features, xfeat, tuning=tuning)


def check_xfeat(layer: int | None, stride: int | None) -> None:
    """InputError where XFeat is given one of the two."""
    if layer is not None or stride is not None:
        raise InputError(
            "--semantic.layer and --semantic.stride: apply to the features of DINOv2 only; "
            "leave them out with `xfeat`"
        )


def run_per_frame(
    video: ArrayStack,
    scale: float,
    multiple: int,
    network: Callable[[Tensor], Tensor],
    device: torch.device,
) -> Tensor:
    """The maps (T, C, h, w) of `network` for each frame of `video` (T, H, W, 3).

    The network is on `device`. It sees frames `scale` times as large, padded to a
    `multiple` of pixels.
    """
    with torch.no_grad():
        frames = track(video, "features")
        maps = (network(enlarge_and_pad(frame, scale, multiple).to(device)) for frame in frames)
        return join_maps(maps, len(video))


def join_maps(maps: Iterable[Tensor], count: int) -> Tensor:
    """The maps (1, C, h, w) of `count` frames, at least one, as one (T, C, h, w). It is
    filled as they come, since a list would hold all of them a second time.
    """
    frames = iter(maps)
    first = next(frames)
    joined = first.new_empty(count, *first.shape[1:])
    joined[:1] = first
    del first
    for t, found in enumerate(frames, 1):
        joined[t : t + 1] = found
    return joined


def enlarge_and_pad(frame: np.ndarray, scale: float, multiple: int) -> Tensor:
    """A frame (H, W, 3) as (1, 3, h, w), `scale` times as large and padded.

    Its right and lower edges are repeated until its sides are multiples of `multiple`.
    """
    image = torch.from_numpy(np.ascontiguousarray(frame, np.float32)).permute(2, 0, 1)[None]
    if scale != 1:
        image = functional.interpolate(
            image,
            scale_factor=scale,
            mode="bicubic",
            recompute_scale_factor=False,
            antialias=scale < 1,
        ).clamp(0, 1)
    height, width = image.shape[-2:]
    return functional.pad(image, (0, -width % multiple, 0, -height % multiple), mode="replicate")


class XFeat(nn.Module):
    """XFeat's dense descriptors: 64 channels at an eighth of the image's size.

    Each normalization is folded into its convolution.
    """

    def __init__(self, state: dict[str, Tensor]) -> None:
        """Load the published weights by their names, except the keypoint heads."""
        super().__init__()
        for block, layers in BLOCKS.items():
            for i, (channels_in, channels_out, kernel, _) in enumerate(layers):
                layer = f"{block}.{i}.layer"
                weight = state[f"{layer}.0.weight"]
                assert weight.shape == (channels_out, channels_in, kernel, kernel), (
                    f"{block}.{i}: {tuple(weight.shape)}"
                )
                mean = state[f"{layer}.1.running_mean"]
                variance = state[f"{layer}.1.running_var"]
                gain = (variance + NORM_EPSILON).rsqrt()
                self.add_convolution(
                    f"{block}_{i}", weight * gain[:, None, None, None], -mean * gain
                )
        for name, (channels_in, channels_out) in LINEAR.items():
            weight = state[f"{name}.weight"]
            assert weight.shape == (channels_out, channels_in, 1, 1), (
                f"{name}: {tuple(weight.shape)}"
            )
            self.add_convolution(name.replace(".", "_"), weight, state[f"{name}.bias"])

    def add_convolution(self, name: str, weight: Tensor, bias: Tensor) -> None:
        """Register a convolution's numbers, which are not trained."""
        self.register_buffer(f"{name}_weight", weight.float())
        self.register_buffer(f"{name}_bias", bias.float())

    def convolve(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        """The registered convolution `name`, with zeros around the image."""
        weight = getattr(self, f"{name}_weight")
        bias = getattr(self, f"{name}_bias")
        return functional.conv2d(x, weight, bias, stride, padding=weight.shape[-1] // 2)

    def block(self, x: Tensor, name: str) -> Tensor:
        """The chain `name` of convolutions and ReLUs."""
        for i, (_, _, _, stride) in enumerate(BLOCKS[name]):
            x = functional.relu(self.convolve(x, f"{name}_{i}", stride))
        return x

    def forward(self, rgb: Tensor) -> Tensor:
        """Descriptors (T, 64, H/8, W/8) of rgb (T, 3, H, W).

        Scale and offset of brightness do not matter; sides are multiples of 32.
        """
        gray = functional.instance_norm(rgb.mean(1, keepdim=True), eps=NORM_EPSILON)
        skip = self.convolve(functional.avg_pool2d(gray, 4), "skip1_1")
        quarter = self.block(gray, "block1") + skip
        eighth = self.block(self.block(quarter, "block2"), "block3")
        sixteenth = self.block(eighth, "block4")
        coarse = self.block(sixteenth, "block5")
        size = list(eighth.shape[-2:])
        enlarged = [functional.interpolate(x, size, mode="bilinear") for x in (sixteenth, coarse)]
        fused = eighth + sum(enlarged)
        return self.convolve(self.block(fused, "block_fusion"), "block_fusion_2")


def load_xfeat(path: Path) -> XFeat:
    """XFeat with the weights of a file; InputError where they are not XFeat's."""
    try:
        return XFeat(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # of many types: no archive, other names, other shapes
        reason = type(error).__name__  # torch's message is a page
        raise InputError(
            f"{path}: no weights of XFeat ({reason}); name its xfeat.pt, or copy it again"
        ) from error


def xfeat_features(
    network: XFeat, video: ArrayStack, tuning: FeatureTuning = FEATURE_TUNING
) -> Features:
    """`FeatureSource` by XFeat: 64 channels every 8 pixels, every 4 of small frames."""
    height, width = video.shape[1:3]
    scale = 2 if height * width < tuning.doubled_below_pixels else 1
    device = next(network.buffers()).device
    maps = run_per_frame(video, scale, XFEAT_MULTIPLE, network, device)
    return Features(maps, XFEAT_STRIDE / scale, XFEAT_ORIGIN / scale)


def dinov2_features(
    network: Any,
    video: ArrayStack,
    layer: int | None = None,
    stride: int | None = None,
    tuning: FeatureTuning = FEATURE_TUNING,
) -> Features:
    """`FeatureSource` by the patch tokens of transformers' `Dinov2Model`.

    Tokens are taken after `layer` layers, `stride` pixels apart in the resized frame
    (default: half a patch). InputError for a layer or stride out of the network's
    range.
    """
    depth = network.config.num_hidden_layers
    patch = network.config.patch_size
    layer = round(tuning.dino_depth * depth) if layer is None else layer
    stride = patch // 2 if stride is None else stride
    if not 1 <= layer <= depth:
        raise InputError(
            f"--semantic.layer {layer}: this network has {depth} layers; choose 1 to {depth}"
        )
    if not 1 <= stride <= patch:
        raise InputError(
            f"--semantic.stride {stride}: the patches are {patch} pixels wide; choose 1 to {patch}"
        )
    scale = tuning.dino_longer_side_px / max(video.shape[1:3])
    tokens = partial(patch_tokens, network, layer, stride)
    maps = run_per_frame(video, scale, patch, tokens, network.device)
    return Features(maps, stride / scale, patch / 2 / scale)


def patch_tokens(network: Any, layer: int, stride: int, rgb: Tensor) -> Tensor:
    """DINOv2's patch tokens (1, C, h, w) of rgb (1, 3, H, W) after `layer` layers.

    Patches are `stride` pixels apart, so they overlap; position encodings are
    interpolated to their number.
    """
    embeddings = network.embeddings
    projection = embeddings.patch_embeddings.projection
    normalized = (rgb - IMAGENET_MEAN.to(rgb)) / IMAGENET_STD.to(rgb)
    patches = functional.conv2d(normalized, projection.weight, projection.bias, stride)
    size = list(patches.shape[-2:])  # (1, C, h, w)

    encodings = embeddings.position_embeddings  # (1, 1 + n * n, C), the class token's first
    n = round((encodings.shape[1] - 1) ** 0.5)
    grid = encodings[:, 1:].unflatten(1, (n, n)).permute(0, 3, 1, 2)
    grid = functional.interpolate(grid, size, mode="bicubic", align_corners=False)
    tokens = (patches + grid).flatten(2).mT

    class_token = embeddings.cls_token + encodings[:, :1]
    x = torch.cat([class_token, tokens], 1)
    for block in network.encoder.layer[:layer]:
        x = block(x)
    return x[:, 1:].mT.unflatten(2, size)
