"""GMFlow (Xu et al., "GMFlow: Learning Optical Flow via Global Matching", CVPR 2022),
the variant with two scales, in plain torch.

Features of both images pass a transformer that attends to both. At 1/8 of the size they
are matched globally, by a softmax over all positions, and self-attention propagates the
flow to where nothing matched. At 1/4 a match within 9 x 9 positions corrects it. Names
of parameters are those of the published weights, which load as they are.

Conventions: a *pair batch* (2B, ...) holds B images or features and, in its second
half, their partners. The flow of the first half leads to the second and the other way
round, so both directions come at once. Features are (N, C, H, W), tokens (N, H, W, C),
flow (N, 2, H, W) in pixels (x, y) of its own size.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

from hdr_nsff.priors.pretrained import IMAGENET_MEAN, IMAGENET_STD

CHANNELS = 128
BLOCKS = 6
MULTIPLE = 32  # pixels: sides of images are multiples of this, for 8 windows a side at 1/4
WINDOWS_COARSE = 2  # windows a side at 1/8, within which tokens attend to each other
WINDOWS_FINE = 8  # windows a side at 1/4
REACH = 4  # positions to each side that the local match covers
WAVELENGTH_BASE = 1e4  # of the position encoding (Vaswani et al. 2017)


class GMFlow(nn.Module):
    """A pair of images to the flow between them, both ways."""

    def __init__(self, channels: int = CHANNELS, blocks: int = BLOCKS, bf16: bool = False) -> None:
        """The published network by default; tests use fewer `channels` and `blocks`.

        `bf16` computes features in bfloat16, in half the time where the processor
        supports it; matching stays in float32.
        """
        super().__init__()
        self.bf16 = bf16
        self.backbone = Encoder(channels)
        self.transformer = Transformer(channels, blocks)
        self.feature_flow_attn = nn.ModuleDict(
            {f"{name}_proj": nn.Linear(channels, channels) for name in ("q", "k")}
        )
        self.upsampler = nn.Sequential(
            nn.Conv2d(channels + 2, 256, 3, padding=1), nn.ReLU(), nn.Conv2d(256, 9 * 4 * 4, 1)
        )

    def forward(self, images: Tensor) -> Tensor:
        """Flow (2B, 2, H, W) px of a pair batch of `images` (2B, 3, H, W) in [0, 1].

        Their sides are multiples of `MULTIPLE`.
        """
        return self.predictions(images)[-1]

    def predictions(self, images: Tensor) -> list[Tensor]:
        """Flow (2B, 2, H, W) px after each of the four stages; the last is the result.

        The stages: matched globally, propagated, matched locally, propagated. No
        gradient runs through flow from one stage to those before: each is trained by
        its own prediction.
        """
        assert images.shape[0] % 2 == 0, f"images {tuple(images.shape)}: no pairs"
        assert not any(side % MULTIPLE for side in images.shape[2:]), (
            f"images {tuple(images.shape)}: sides"
        )
        with self.precision(images):
            fine, coarse = self.backbone(normalize_images(images))
        fine = fine.to(images.dtype)
        coarse = coarse.to(images.dtype)

        features = self.attend(coarse, WINDOWS_COARSE)
        matched = match_globally(features)
        propagated = self.propagate_globally(features, matched.detach())

        start = upsample_flow(propagated.detach(), 2)
        partners = warp(swap_halves(fine), start)
        attended = self.attend(torch.cat([fine, partners]), WINDOWS_FINE)
        own, other = attended.chunk(2)
        corrected = start + match_locally(own, other, REACH)
        final = self.propagate_locally(own, corrected.detach())
        return [
            upsample_flow(matched, 8),
            upsample_flow(propagated, 8),
            upsample_flow(corrected, 4),
            self.upsample_convex(final, own),
        ]

    def attend(self, features: Tensor, windows: int) -> Tensor:
        """A pair batch of features (2B, C, H, W) after the transformer.

        The transformer attends to the image itself and to its partner.
        """
        with self.precision(features):
            encoded = features + position_encoding(features, windows)
            tokens = self.transformer(encoded.permute(0, 2, 3, 1), windows)
        return tokens.to(features.dtype).permute(0, 3, 1, 2)

    def precision(self, like: Tensor) -> torch.autocast:
        """The precision in which features are computed, on the device of `like`."""
        return torch.autocast(like.device.type, torch.bfloat16, enabled=self.bf16)

    def propagate_globally(self, features: Tensor, flow: Tensor) -> Tensor:
        """Flow (N, 2, H, W) at 1/8, averaged over positions with similar features.

        `features` are (N, C, H, W).
        """
        n, channels, h, w = features.shape
        query = self.feature_flow_attn["q_proj"](features.flatten(2).mT)
        # of the query, not of the features: the published weights were trained so
        key = self.feature_flow_attn["k_proj"](query)
        weights = torch.softmax(query @ key.mT / channels**0.5, -1)
        return (weights @ flow.flatten(2).mT).mT.reshape(n, 2, h, w)

    def propagate_locally(self, features: Tensor, flow: Tensor) -> Tensor:
        """Flow (N, 2, H, W) at 1/4, averaged over the 3 x 3 positions around.

        Features and flow are 0 outside the image, as in training.
        """
        channels = features.shape[1]
        tokens = features.permute(0, 2, 3, 1)
        query = self.feature_flow_attn["q_proj"](tokens).permute(0, 3, 1, 2)
        key = self.feature_flow_attn["k_proj"](tokens).permute(0, 3, 1, 2)
        products = [(query * shifted).sum(1) for shifted in shifted_views(key, 1)]
        scores = torch.stack(products, 1) / channels**0.5  # (N, 9, H, W)
        around = torch.stack(list(shifted_views(flow, 1)), 1)  # (N, 9, 2, H, W)
        return (torch.softmax(scores, 1)[:, :, None] * around).sum(1)

    def upsample_convex(self, flow: Tensor, features: Tensor) -> Tensor:
        """Flow (N, 2, 4H, 4W) from flow (N, 2, H, W) and features (N, C, H, W).

        Each pixel is its own convex combination of the 3 x 3 positions around.
        """
        n, _, h, w = flow.shape
        logits = self.upsampler(torch.cat([flow, features], 1))
        weights = torch.softmax(logits.view(n, 9, 1, 4, 4, h, w), 1)
        around = torch.stack(list(shifted_views(4 * flow, 1)), 1).view(n, 9, 2, 1, 1, h, w)
        combined = (weights * around).sum(1)  # (N, 2, 4, 4, H, W)
        return combined.permute(0, 1, 4, 2, 5, 3).reshape(n, 2, 4 * h, 4 * w)


class Encoder(nn.Module):
    """Images (N, 3, H, W) to features (N, C, H/4, W/4) and (N, C, H/8, W/8).

    The last convolution of both shares its weights.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.layer1 = nn.Sequential(Residual(64, 64), Residual(64, 64))
        self.layer2 = nn.Sequential(Residual(64, 96, stride=2), Residual(96, 96))
        self.layer3 = nn.Sequential(Residual(96, 128), Residual(128, 128))
        self.conv2 = nn.Conv2d(128, channels, 1)
        self.trident_conv = nn.Conv2d(channels, channels, 3, padding=1, bias=False)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        x = functional.relu(functional.instance_norm(self.conv1(images)))
        x = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        fine = self.trident_conv(x)
        coarse = functional.conv2d(x, self.trident_conv.weight, stride=2, padding=1)
        return fine, coarse


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut, each with instance normalization."""

    def __init__(self, channels: int, out: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, out, 3, stride, 1, bias=False)
        self.conv2 = nn.Conv2d(out, out, 3, 1, 1, bias=False)
        self.downsample = nn.Sequential()  # the identity
        if stride != 1 or channels != out:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, out, 1, stride), nn.InstanceNorm2d(out)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(functional.instance_norm(self.conv1(x)))
        y = functional.relu(functional.instance_norm(self.conv2(y)))
        return functional.relu(self.downsample(x) + y)


class Transformer(nn.Module):
    """Blocks in a row; the windows of every second one are shifted."""

    def __init__(self, channels: int, blocks: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Block(channels, shifted=k % 2 == 1) for k in range(blocks))

    def forward(self, tokens: Tensor, windows: int) -> Tensor:
        """A pair batch of tokens (2B, H, W, C) -> the same shape."""
        for block in self.layers:
            tokens = block(tokens, windows)
        return tokens


class Block(nn.Module):
    """Attention within the image, then to its partner, then a perceptron.

    It works in windows, which are shifted by half a window if `shifted`.
    """

    def __init__(self, channels: int, shifted: bool) -> None:
        super().__init__()
        self.shifted = shifted
        self.self_attn = Attention(channels, perceptron=False)
        self.cross_attn_ffn = Attention(channels, perceptron=True)

    def forward(self, tokens: Tensor, windows: int) -> Tensor:
        """A pair batch of tokens (2B, H, W, C) -> the same shape."""
        partners = swap_halves(tokens)  # as they were before this block
        tokens = self.self_attn(tokens, tokens, windows, self.shifted)
        return self.cross_attn_ffn(tokens, partners, windows, self.shifted)


class Attention(nn.Module):
    """Attention in windows, with a residual connection."""

    def __init__(self, channels: int, perceptron: bool) -> None:
        super().__init__()
        self.q_proj = nn.Linear(channels, channels, bias=False)
        self.k_proj = nn.Linear(channels, channels, bias=False)
        self.v_proj = nn.Linear(channels, channels, bias=False)
        self.merge = nn.Linear(channels, channels, bias=False)
        self.norm1 = nn.LayerNorm(channels)
        self.perceptron = perceptron
        if perceptron:
            hidden = 8 * channels
            self.mlp = nn.Sequential(
                nn.Linear(2 * channels, hidden, bias=False),
                nn.GELU(),
                nn.Linear(hidden, channels, bias=False),
            )
            self.norm2 = nn.LayerNorm(channels)

    def forward(self, tokens: Tensor, others: Tensor, windows: int, shifted: bool) -> Tensor:
        """`tokens` (N, H, W, C) plus what they read from `others` (N, H, W, C).

        Each token reads from the tokens of its window.
        """
        shift = (0, 0)
        mask = None
        if shifted:
            shift = (tokens.shape[1] // windows // 2, tokens.shape[2] // windows // 2)
            mask = shifted_window_mask(tokens.shape[1:3], shift, windows, tokens.device)

        def project(layer: nn.Linear, x: Tensor) -> Tensor:
            rolled = layer(x).roll((-shift[0], -shift[1]), (1, 2))
            return split_windows(rolled, windows)

        query = project(self.q_proj, tokens)
        key = project(self.k_proj, others)
        value = project(self.v_proj, others)
        read = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        merged = merge_windows(read, tokens.shape, windows).roll(shift, (1, 2))
        message = self.norm1(self.merge(merged))
        if self.perceptron:
            message = self.norm2(self.mlp(torch.cat([tokens, message], -1)))
        return tokens + message


def normalize_images(images: Tensor) -> Tensor:
    """Images (N, 3, H, W) in [0, 1], normalized as for training.

    ImageNet's mean is removed, and its standard deviation is the unit.
    """
    return (images - IMAGENET_MEAN.to(images)) / IMAGENET_STD.to(images)


def swap_halves(batch: Tensor) -> Tensor:
    """The partner of each entry of a pair batch."""
    return batch.roll(len(batch) // 2, 0)


def split_windows(tokens: Tensor, windows: int) -> Tensor:
    """Tokens (N, H, W, C) -> (N, windows^2, H W / windows^2, C)."""
    n, h, w, c = tokens.shape
    split = tokens.view(n, windows, h // windows, windows, w // windows, c).transpose(2, 3)
    return split.reshape(n, windows * windows, -1, c)


def merge_windows(split: Tensor, shape: torch.Size, windows: int) -> Tensor:
    """The inverse of `split_windows`, to tokens of `shape` (N, H, W, C)."""
    n, h, w, c = shape
    split = split.view(n, windows, windows, h // windows, w // windows, c)
    return split.transpose(2, 3).reshape(shape)


def shifted_window_mask(
    size: tuple[int, ...], shift: tuple[int, int], windows: int, device: torch.device
) -> Tensor:
    """Pairs of tokens of a window (windows^2, L, L) bool that may attend to each other.

    They were neighbors before the image of `size` (H, W) was rolled by `shift`; other
    pairs lie across its edge.
    """
    below = torch.arange(size[0], device=device) >= size[0] - shift[0]
    right = torch.arange(size[1], device=device) >= size[1] - shift[1]
    part = (2 * below[:, None] + right)[None, ..., None]  # (1, H, W, 1): one of four parts
    part = split_windows(part, windows)[0, ..., 0]  # (windows^2, L)
    return part[:, :, None] == part[:, None]


def position_encoding(features: Tensor, windows: int) -> Tensor:
    """Sines and cosines (C, H, W) of the position within a window.

    C/2 channels are of y and C/2 of x, scaled so that a whole window is one turn.
    """
    _, c, h, w = features.shape
    half = c // 2
    channel = torch.arange(0, half, 2, device=features.device)
    rates = WAVELENGTH_BASE ** -(channel / half)  # (half / 2,)

    def waves(length: int) -> Tensor:
        position = torch.arange(1, length + 1, device=features.device)[:, None]
        angle = position * (2 * torch.pi / length) * rates
        return torch.stack([angle.sin(), angle.cos()], -1).flatten(1).mT  # (half, length)

    waves_y = waves(h // windows)
    waves_x = waves(w // windows)
    encoding_y = waves_y[:, :, None].expand(-1, -1, waves_x.shape[1])
    encoding_x = waves_x[:, None].expand(-1, waves_y.shape[1], -1)
    return torch.cat([encoding_y, encoding_x]).repeat(1, windows, windows)


def pixel_grid(features: Tensor) -> Tensor:
    """The pixel positions (2, H, W) of features (..., H, W), x then y, from 0."""
    h, w = features.shape[-2:]
    y = torch.arange(h, device=features.device, dtype=features.dtype)
    x = torch.arange(w, device=features.device, dtype=features.dtype)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))


def match_globally(features: Tensor) -> Tensor:
    """Flow (2B, 2, H, W) of a pair batch of features (2B, C, H, W).

    The end of each is the mean of all positions, weighted by the softmax of similarity.
    """
    n, c, h, w = features.shape
    positions = pixel_grid(features)
    tokens = features.flatten(2)
    similarity = tokens.mT @ swap_halves(tokens) / c**0.5  # (2B, HW, HW)
    found = torch.softmax(similarity, -1) @ positions.flatten(1).mT  # (2B, HW, 2)
    return found.mT.reshape(n, 2, h, w) - positions


def match_locally(own: Tensor, other: Tensor, reach: int) -> Tensor:
    """Flow (N, 2, H, W) from features `own` to `other` (N, C, H, W).

    It covers the K = (2 reach + 1)^2 positions around that are inside the image.
    """
    products = [(own * shifted).sum(1) for shifted in shifted_views(other, reach)]
    similarity = torch.stack(products, 1) / own.shape[1] ** 0.5
    ones = torch.ones_like(own[:1, :1])
    inside = torch.cat(list(shifted_views(ones, reach)), 1) > 0  # (1, K, H, W)
    weights = torch.softmax(similarity.masked_fill(~inside, -torch.inf), 1)
    window = torch.empty(2 * reach + 1, 2 * reach + 1, device=own.device, dtype=own.dtype)
    offsets = pixel_grid(window).flatten(1) - reach  # (2, K)
    return torch.einsum("nkhw,ck->nchw", weights, offsets)


def shifted_views(field: Tensor, reach: int) -> Iterator[Tensor]:
    """A field (N, C, H, W) shifted by -reach to reach in y and x; 0 outside.

    The order is row by row from the top left.
    """
    h, w = field.shape[-2:]
    padded = functional.pad(field, [reach] * 4)
    for y in range(2 * reach + 1):
        for x in range(2 * reach + 1):
            yield padded[..., y : y + h, x : x + w]


def warp(field: Tensor, flow: Tensor) -> Tensor:
    """`field` (N, C, H, W) read where `flow` (N, 2, H, W) leads; 0 outside.

    Reading is bilinear.
    """
    size = flow.new_tensor([field.shape[-1] - 1, field.shape[-2] - 1])
    ends = (pixel_grid(field) + flow).permute(0, 2, 3, 1)
    return functional.grid_sample(
        field, ends * (2 / size) - 1, padding_mode="zeros", align_corners=True
    )


def upsample_flow(flow: Tensor, factor: int) -> Tensor:
    """Flow (N, 2, factor H, factor W) from (N, 2, H, W), bilinearly."""
    return factor * functional.interpolate(
        flow, scale_factor=float(factor), mode="bilinear", align_corners=True
    )
