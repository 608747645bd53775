"""GMFlow (Xu et al., "GMFlow: Learning Optical Flow via Global Matching", CVPR 2022),
the variant with two scales, in plain torch.

A flow is found by comparing every pixel with every pixel: features of both images, made
to know each other by a transformer, are matched by a softmax over all places at 1/8 of
the size, spread by self-attention to where nothing matched, then corrected by a match
within 9 x 9 places at 1/4. Names of parameters are those of the published weights,
which load as they are.

Conventions: a *pair batch* (2B, ...) holds B images or features and, in its second
half, their partners. What the network says of the first half is the flow to the second,
and the other way round, so both directions come at once. Features are (N, C, H, W),
tokens (N, H, W, C), flow (N, 2, H, W) in pixels (x, y) of its own size.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

CHANNELS = 128
MULTIPLE = 32  # images have sides of a multiple of this: 8 windows a side at 1/4
WINDOWS = (2, 8)  # windows a side at 1/8 and at 1/4, within which tokens attend to each other
REACH = 4  # places a side that the second match looks at
MEAN, DEVIATION = (
    (0.485, 0.456, 0.406),
    (0.229, 0.224, 0.225),
)  # of the images that the encoder was trained on


class GMFlow(nn.Module):
    """Two images to the flow between them, both ways."""

    def __init__(self, channels: int = CHANNELS, blocks: int = 6, bf16: bool = False) -> None:
        """`channels` of the features and `blocks` of the transformer are the published
        network's by default, and smaller in tests.

        `bf16`: features in bfloat16, matching in float32 all the same; half the time
        where the processor knows it.
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
        """Flow (2B, 2, H, W) px of a pair batch of `images` (2B, 3, H, W) in [0, 1],
        sides a multiple of `MULTIPLE`.
        """
        return self.predictions(images)[-1]

    def predictions(self, images: Tensor) -> list[Tensor]:
        """The flow (2B, 2, H, W) after each of the four parts, the last one being the
        answer: matched, spread, corrected, spread.

        No gradient runs from one part to those before through flow: each is trained by
        its own prediction.
        """
        assert images.shape[0] % 2 == 0 and not any(s % MULTIPLE for s in images.shape[2:]), (
            f"images {tuple(images.shape)}"
        )
        with self.arithmetic(images):
            fine, coarse = (f.to(images.dtype) for f in self.backbone(normalized(images)))
        features = self.acquainted(coarse, WINDOWS[0])
        matched = match_everywhere(features)
        spread = self.spread_everywhere(features, matched.detach())
        start = 2 * functional.interpolate(
            spread.detach(), scale_factor=2.0, mode="bilinear", align_corners=True
        )
        own, there = self.acquainted(
            torch.cat([fine, warped(swapped(fine), start)]), WINDOWS[1]
        ).chunk(2)
        corrected = start + match_nearby(own, there, REACH)
        final = self.spread_nearby(own, corrected.detach())
        return [
            enlarged(matched, 8),
            enlarged(spread, 8),
            enlarged(corrected, 4),
            self.enlarged_convex(final, own),
        ]

    def acquainted(self, features: Tensor, windows: int) -> Tensor:
        """A pair batch of features (2B, C, H, W) after the transformer: each has looked
        at itself and at its partner.
        """
        with self.arithmetic(features):
            tokens = self.transformer(
                (features + position(features, windows)).permute(0, 2, 3, 1), windows
            )
        return tokens.to(features.dtype).permute(0, 3, 1, 2)

    def arithmetic(self, where: Tensor) -> torch.autocast:
        """The precision that features are computed in."""
        return torch.autocast(where.device.type, torch.bfloat16, enabled=self.bf16)

    def spread_everywhere(self, features: Tensor, flow: Tensor) -> Tensor:
        """Flow (N, 2, H, W) at 1/8, averaged over places whose features (N, C, H, W)
        are alike.
        """
        n, _, h, w = features.shape
        query = self.feature_flow_attn["q_proj"](features.flatten(2).mT)
        key = self.feature_flow_attn["k_proj"](
            query
        )  # of the query, not of the features: so were the published weights trained
        weights = torch.softmax(query @ key.mT / features.shape[1] ** 0.5, -1)
        return (weights @ flow.flatten(2).mT).mT.reshape(n, 2, h, w)

    def spread_nearby(self, features: Tensor, flow: Tensor) -> Tensor:
        """Flow (N, 2, H, W) at 1/4, averaged over the 3 x 3 places around; outside of
        the image features and flow are 0, as trained.
        """
        query, key = (
            self.feature_flow_attn[f"{k}_proj"](features.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
            for k in "qk"
        )
        scores = (
            torch.stack([(query * there).sum(1) for there in shifts(key, 1)], 1)
            / features.shape[1] ** 0.5
        )  # (N, 9, H, W)
        around = torch.stack(list(shifts(flow, 1)), 1)  # (N, 9, 2, H, W)
        return (torch.softmax(scores, 1)[:, :, None] * around).sum(1)

    def enlarged_convex(self, flow: Tensor, features: Tensor) -> Tensor:
        """Flow (N, 2, H, W) at four times the size: every pixel its own convex mixture
        of the 3 x 3 places around.
        """
        n, _, h, w = flow.shape
        weights = torch.softmax(
            self.upsampler(torch.cat([flow, features], 1)).view(n, 9, 1, 4, 4, h, w), 1
        )
        around = torch.stack(list(shifts(4 * flow, 1)), 1).view(n, 9, 2, 1, 1, h, w)
        return (weights * around).sum(1).permute(0, 1, 4, 2, 5, 3).reshape(n, 2, 4 * h, 4 * w)


class Encoder(nn.Module):
    """Images (N, 3, H, W) to features (N, C, H/4, W/4) and (N, C, H/8, W/8), whose last
    convolution has the same weights.
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
        return self.trident_conv(x), functional.conv2d(
            x, self.trident_conv.weight, stride=2, padding=1
        )


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut, every one normalized over its image."""

    def __init__(self, channels: int, out: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, out, 3, stride, 1, bias=False)
        self.conv2 = nn.Conv2d(out, out, 3, 1, 1, bias=False)
        same = stride == 1 and channels == out
        self.downsample = (
            nn.Sequential()
            if same
            else nn.Sequential(nn.Conv2d(channels, out, 1, stride), nn.InstanceNorm2d(out))
        )

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu(functional.instance_norm(self.conv1(x)))
        return functional.relu(
            self.downsample(x) + functional.relu(functional.instance_norm(self.conv2(y)))
        )


class Transformer(nn.Module):
    """Blocks in a row."""

    def __init__(self, channels: int, blocks: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Block(channels, shifted=k % 2 == 1) for k in range(blocks))

    def forward(self, tokens: Tensor, windows: int) -> Tensor:
        """A pair batch of tokens (2B, H, W, C) -> the same."""
        for block in self.layers:
            tokens = block(tokens, windows)
        return tokens


class Block(nn.Module):
    """Attention to one's own image, then to the partner's, then a perceptron; in
    windows, every second block's moved by half a window.
    """

    def __init__(self, channels: int, shifted: bool) -> None:
        super().__init__()
        self.shifted = shifted
        self.self_attn = Attention(channels, perceptron=False)
        self.cross_attn_ffn = Attention(channels, perceptron=True)

    def forward(self, tokens: Tensor, windows: int) -> Tensor:
        """A pair batch of tokens (2B, H, W, C) -> the same."""
        partner = swapped(tokens)  # as it was before this block
        return self.cross_attn_ffn(
            self.self_attn(tokens, tokens, windows, self.shifted), partner, windows, self.shifted
        )


class Attention(nn.Module):
    """What tokens read from others, added to them."""

    def __init__(self, channels: int, perceptron: bool) -> None:
        super().__init__()
        self.q_proj, self.k_proj, self.v_proj, self.merge = (
            nn.Linear(channels, channels, bias=False) for _ in range(4)
        )
        self.norm1 = nn.LayerNorm(channels)
        self.perceptron = perceptron
        if perceptron:
            wide = 8 * channels
            self.mlp = nn.Sequential(
                nn.Linear(2 * channels, wide, bias=False),
                nn.GELU(),
                nn.Linear(wide, channels, bias=False),
            )
            self.norm2 = nn.LayerNorm(channels)

    def forward(self, tokens: Tensor, others: Tensor, windows: int, shifted: bool) -> Tensor:
        """`tokens` (N, H, W, C) after reading from `others` (N, H, W, C) in the same
        window.
        """
        size = tokens.shape[1] // windows, tokens.shape[2] // windows
        move = (size[0] // 2, size[1] // 2) if shifted else (0, 0)
        q, k, v = (
            in_windows(project(x).roll((-move[0], -move[1]), (1, 2)), windows)
            for project, x in ((self.q_proj, tokens), (self.k_proj, others), (self.v_proj, others))
        )
        allowed = together(tokens.shape[1:3], move, windows, tokens.device) if shifted else None
        read = functional.scaled_dot_product_attention(q, k, v, attn_mask=allowed)
        message = self.norm1(
            self.merge(out_of_windows(read, tokens.shape, windows).roll(move, (1, 2)))
        )
        if self.perceptron:
            message = self.norm2(self.mlp(torch.cat([tokens, message], -1)))
        return tokens + message


def normalized(images: Tensor) -> Tensor:
    """Images (N, 3, H, W) in [0, 1] in units of the deviation from the mean that the
    encoder was trained with.
    """
    return (images - images.new_tensor(MEAN).view(3, 1, 1)) / images.new_tensor(DEVIATION).view(
        3, 1, 1
    )


def swapped(batch: Tensor) -> Tensor:
    """A pair batch with its halves exchanged: everyone's partner."""
    return batch.roll(len(batch) // 2, 0)


def in_windows(tokens: Tensor, windows: int) -> Tensor:
    """Tokens (N, H, W, C) -> (N, windows^2, H W / windows^2, C)."""
    n, h, w, c = tokens.shape
    cut = tokens.view(n, windows, h // windows, windows, w // windows, c).transpose(2, 3)
    return cut.reshape(n, windows * windows, -1, c)


def out_of_windows(cut: Tensor, shape: torch.Size, windows: int) -> Tensor:
    """The inverse of `in_windows`, to tokens of `shape` (N, H, W, C)."""
    n, h, w, c = shape
    return (
        cut.view(n, windows, windows, h // windows, w // windows, c).transpose(2, 3).reshape(shape)
    )


def together(
    size: tuple[int, ...], move: tuple[int, int], windows: int, device: torch.device
) -> Tensor:
    """Which tokens of a window (windows^2, L, L) bool were neighbors before the image
    of `size` (H, W) was rolled by `move`.
    """
    down, right = (torch.arange(s, device=device) >= s - m for s, m in zip(size, move, strict=True))
    part = in_windows((2 * down[:, None] + right)[None, ..., None], windows)[
        0, ..., 0
    ]  # (windows^2, L)
    return part[:, :, None] == part[:, None]


def position(features: Tensor, windows: int) -> Tensor:
    """Sines and cosines (C, H, W) of where a place is in its window, C/2 for y and C/2
    for x, each the whole window in one turn.
    """
    _, c, h, w = features.shape
    half = c // 2
    rates = 1e4 ** -(torch.arange(0, half, 2, device=features.device) / half)  # (half / 2,)

    def waves(length: int) -> Tensor:
        angle = (
            torch.arange(1, length + 1, device=features.device)[:, None]
            * (2 * torch.pi / length)
            * rates
        )
        return torch.stack([angle.sin(), angle.cos()], -1).flatten(1).mT  # (half, length)

    y, x = waves(h // windows), waves(w // windows)
    one = torch.cat(
        [y[:, :, None].expand(-1, -1, x.shape[1]), x[:, None].expand(-1, y.shape[1], -1)]
    )
    return one.repeat(1, windows, windows)


def places(features: Tensor) -> Tensor:
    """The pixel positions (2, H, W) of features (..., H, W), x then y, from 0."""
    h, w = (
        torch.arange(s, device=features.device, dtype=features.dtype) for s in features.shape[-2:]
    )
    return torch.stack(torch.meshgrid(w, h, indexing="xy"))


def match_everywhere(features: Tensor) -> Tensor:
    """Flow (2B, 2, H, W) of a pair batch of features: the mean of all places, weighted
    by the softmax of their likeness.
    """
    n, c, h, w = features.shape
    there = places(features)
    flat = features.flatten(2)
    likeness = flat.mT @ swapped(flat) / c**0.5  # (2B, HW, HW)
    found = torch.softmax(likeness, -1) @ there.flatten(1).mT  # (2B, HW, 2)
    return found.mT.reshape(n, 2, h, w) - there


def match_nearby(own: Tensor, other: Tensor, reach: int) -> Tensor:
    """Flow (N, 2, H, W) from features `own` to `other` (N, C, H, W), over the (2 reach
    + 1)^2 places around that are in the image.
    """
    likeness = (
        torch.stack([(own * there).sum(1) for there in shifts(other, reach)], 1)
        / own.shape[1] ** 0.5
    )
    inside = torch.cat(list(shifts(torch.ones_like(own[:1, :1]), reach)), 1) > 0  # (1, K, H, W)
    weights = torch.softmax(likeness.masked_fill(~inside, -torch.inf), 1)
    steps = (
        places(
            torch.empty(2 * reach + 1, 2 * reach + 1, device=own.device, dtype=own.dtype)
        ).flatten(1)
        - reach
    )  # (2, K)
    return torch.einsum("nkhw,ck->nchw", weights, steps)


def shifts(field: Tensor, reach: int) -> Iterator[Tensor]:
    """A field (N, C, H, W) as seen from 1, 2, ... places away, row by row from the top
    left to the bottom right; 0 outside.
    """
    h, w = field.shape[-2:]
    padded = functional.pad(field, [reach] * 4)
    for y in range(2 * reach + 1):
        for x in range(2 * reach + 1):
            yield padded[..., y : y + h, x : x + w]


def warped(field: Tensor, flow: Tensor) -> Tensor:
    """`field` (N, C, H, W) read bilinearly where `flow` (N, 2, H, W) leads; 0 outside."""
    size = flow.new_tensor([field.shape[-1] - 1, field.shape[-2] - 1])
    where = (places(field) + flow).permute(0, 2, 3, 1) * (2 / size) - 1
    return functional.grid_sample(field, where, padding_mode="zeros", align_corners=True)


def enlarged(flow: Tensor, times: int) -> Tensor:
    """Flow (N, 2, H, W) at `times` its size, bilinearly."""
    return times * functional.interpolate(
        flow, scale_factor=float(times), mode="bilinear", align_corners=True
    )
