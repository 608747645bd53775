"""How close a picture, a depth map or a motion comes to the truth. Pictures are tensors
(H, W, 3), rgb in [0, 1] or linear radiance where it says so; masks (H, W) bool say
where to look, None everywhere. Every metric gives back plain floats.

Radiance is compared as METHOD.md 7 says: LDR recordings leave its scale free, so
`align` fits one scale (or one per channel) for the whole sequence on pixels that some
exposure records, and one `peak` normalizes the whole sequence; neither is ever fitted
per frame, which would hide flicker.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn
from torch.nn import functional

from hdr_nsff.core.errors import InputError
from hdr_nsff.maths.color import luminance, mu_law, pu21_encode


def psnr(a: Tensor, b: Tensor, mask: Tensor | None = None, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, `10 log10(peak^2 / mean square error)` over
    pixels of `mask` and channels; at most 100 (equal pictures).
    """
    assert a.shape == b.shape, (a.shape, b.shape)
    error = (a.double() - b.double()).square()
    mse = float(error.mean() if mask is None else error[mask].mean())
    return 10 * math.log10(peak**2 / max(mse, 1e-10 * peak**2))


def ssim(a: Tensor, b: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) in [-1, 1]: Gaussian window 11x11, sigma
    1.5, K1 0.01, K2 0.03, mean over channels.

    Over the whole picture the outer 5 pixels are left out, as published; over a mask
    the map is averaged on the mask.
    """
    assert a.shape == b.shape, (a.shape, b.shape)
    values = ssim_map(a.double().cpu().numpy(), b.double().cpu().numpy())
    return float(values[5:-5, 5:-5].mean() if mask is None else values[mask.cpu().numpy()].mean())


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM around every pixel and channel (H, W, 3)."""

    def window(x: np.ndarray) -> np.ndarray:
        return np.asarray(gaussian_filter(x, sigma=(1.5, 1.5, 0), truncate=3.5))  # radius 5

    mean_a, mean_b = window(a), window(b)
    var_a, var_b, cov = (
        window(a * a) - mean_a**2,
        window(b * b) - mean_b**2,
        window(a * b) - mean_a * mean_b,
    )
    c1, c2 = 0.01**2, 0.03**2
    return (
        (2 * mean_a * mean_b + c1)
        * (2 * cov + c2)
        / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    )


def align(radiance: Tensor, truth: Tensor, recordable: Tensor, per_channel: bool = False) -> Tensor:
    """The scale () or per-channel scales (3,) by which to multiply predicted `radiance`
    (..., 3): the median of truth / prediction over pixels of the whole sequence that
    are `recordable` (...): at least one exposure records them unclipped.

    Brighter ones cannot be known, and a least-squares scale would follow them alone. 1
    where there is nothing to compare.
    """
    use = recordable & (radiance > 0).all(-1) & (truth > 0).all(-1)
    if not use.any():
        return torch.ones(3 if per_channel else ())
    ratio = truth[use].double() / radiance[use].double()  # (n, 3)
    return (ratio.median(0).values if per_channel else ratio.flatten().median()).float()


def mu_law_psnr(
    radiance: Tensor, truth: Tensor, peak: float, mu: float = 5000.0, mask: Tensor | None = None
) -> float:
    """PSNR in dB, at most 100, of `log(1 + mu E) / log(1 + mu)` (eq. 17; Kalantari and
    Ramamoorthi 2017) of `radiance` and `truth`, both in units of the sequence's `peak`
    and clipped to it. Aligning comes before, see `align`.
    """
    return psnr(
        mu_law((radiance / peak).clip(0, 1), mu), mu_law((truth / peak).clip(0, 1), mu), mask
    )


PU21_NITS = 1000.0  # cd/m^2 that the sequence's white is taken to have
PU21_WHITE = 0.995  # quantile of the truth's luminance that is white


def pu21_white(truths: list[Tensor]) -> float:
    """The luminance that is shown at `PU21_NITS`, one for a whole sequence of true
    radiance (H, W, 3): the 99.5th percentile, so that a lamp of a few pixels does not
    decide how dark the rest is. PU21 tells luminances apart up to ten times that.
    """
    y = torch.cat([luminance(t).flatten() for t in truths]).double()
    return max(float(np.quantile(y.numpy(), PU21_WHITE)), 1e-6 * float(y.max()), 1e-12)


def pu21_psnr(radiance: Tensor, truth: Tensor, white: float, mask: Tensor | None = None) -> float:
    """PSNR in dB, at most 100, of PU21-encoded rgb (Mantiuk and Azimi 2021, banding +
    glare), over pixels of `mask` and channels.

    Aligned `radiance` and `truth` are taken for what a display emits on which luminance
    `white` has 1000 cd/m^2: an assumption that belongs beside the number. The peak
    signal is 256, the code of 100 cd/m^2, as in the authors' own PSNR.
    """
    scale = PU21_NITS / white
    return psnr(
        pu21_encode(radiance.double() * scale),
        pu21_encode(truth.double() * scale),
        mask,
        peak=256.0,
    )


def flip_exposures(truths: list[Tensor]) -> tuple[float, float]:
    """The exposure range (start, stop; log2) for HDR-FLIP of a whole sequence of true
    radiance (H, W, 3), by the rule of the method (Andersson et al. 2021, section 3):
    the brightest, and the median, luminance come out at 0.85 of the ACES curve.
    """
    y = torch.cat([luminance(t).flatten() for t in truths]).double()
    a, b, c = 2.51 - 0.85 * 2.43, 0.03 - 0.85 * 0.59, -0.85 * 0.14  # ACES(x) = 0.85
    x = (
        (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a) / 0.6
    )  # FLIP puts 0.6 times the exposed luminance through the curve
    middle = max(float(y.median()), 1e-6 * float(y.max()), 1e-12)
    return math.log2(x / max(float(y.max()), 1e-12)), math.log2(x / middle)


def hdr_flip_map(radiance: Tensor, truth: Tensor, exposures: tuple[float, float]) -> Tensor | None:
    """The largest visible difference (H, W) in [0, 1] of aligned linear radiance over a
    range of exposures (Andersson et al. 2021).

    `exposures` (start, stop; log2) are those of the whole sequence, see
    `flip_exposures`; 67 pixels per degree. None where flip-evaluator is not installed.
    """
    try:
        import flip_evaluator
    except ModuleNotFoundError:
        return None
    start, stop = exposures
    settings = {
        "startExposure": start,
        "stopExposure": stop,
        "numExposures": max(2, math.ceil(stop - start)),
        "tonemapper": "ACES",
    }
    reference, test = (
        np.ascontiguousarray(x.float().cpu().numpy().clip(0)) for x in (truth, radiance)
    )
    error, _, _ = flip_evaluator.evaluate(
        reference, test, "HDR", applyMagma=False, computeMeanError=False, parameters=settings
    )
    return torch.from_numpy(
        np.asarray(error).reshape(truth.shape[0], truth.shape[1], -1)[..., 0].copy()
    )


def hdr_tae(radiance: Tensor, other: Tensor, flow: Tensor, mask: Tensor) -> tuple[float, int]:
    """HDR-TAE in [0, 1], 0 steady, of two pictures in linear radiance (H, W, 3), and
    over how many pixels: the mean of `|H1 - warp(H2)| / (H1 + warp(H2))` over `mask`
    (H, W) and channels (Mono4DGS-HDR, arXiv 2510.18489).

    `flow` (H, W, 2), pixels, leads from pixels of `radiance` to `other`, which is read
    there bilinearly; pixels that leave the picture do not count. Where both are 0
    nothing differs. A scale of the radiance, also per channel, cancels. NaN where no
    pixel is left.
    """
    height, width = mask.shape
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    x, y = x + flow[..., 0].double(), y + flow[..., 1].double()
    inside = mask & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    grid = torch.stack([2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1], -1)
    warped = functional.grid_sample(
        other.double().permute(2, 0, 1)[None], grid[None], align_corners=True
    )[0].permute(1, 2, 0)
    here, there = radiance.double()[inside], warped[inside]
    change = (here - there).abs() / (here + there).clamp_min(1e-12)
    return float(change.mean()), int(inside.sum())


def depth_errors(depth: Tensor, truth: Tensor, known: Tensor) -> tuple[float, float]:
    """AbsRel, `mean |d - d*| / d*`, and RMSE, `sqrt(mean (d - d*)^2)` in units of
    `truth`, over pixels that are `known` (H, W) (Eigen et al. 2014); both from 0,
    equal, upwards. `depth` (H, W) is aligned before, by one scale per sequence, see
    `median_ratio`.
    """
    error = (depth.double() - truth.double())[known]
    return float((error.abs() / truth.double()[known]).mean()), float(error.square().mean().sqrt())


def median_ratio(values: Tensor, truth: Tensor) -> float:
    """The median of `truth / values` over entries where both are above 0: one scale for
    a whole sequence. 1 where there are none.
    """
    use = (values > 0) & (truth > 0)
    return float((truth[use].double() / values[use].double()).median()) if use.any() else 1.0


def end_point_error(motion: Tensor, truth: Tensor, known: Tensor) -> float:
    """Mean Euclidean distance of two motions (H, W, D) over pixels that are `known` (H,
    W), in their unit, from 0 upwards: pixels for optical flow (D = 2; Baker et al.
    2011), units of the world for scene flow (D = 3; FlowNet3D, Liu et al. 2019).
    """
    return float((motion.double() - truth.double()).norm(dim=-1)[known].mean())


class Lpips(nn.Module):
    """LPIPS (Zhang et al. 2018), AlexNet, version 0.1: a distance of deep features, 0
    equal, about 0.7 for unlike pictures.

    `weights`: a `.pth` file with both the AlexNet features (as torchvision names them)
    and the linear layers (as the authors' package names them), a folder with such files
    side by side, or those files.
    """

    CHANNELS = (64, 192, 384, 256, 256)
    LAYERS = (0, 3, 6, 8, 10)  # positions of the convolutions in torchvision's AlexNet

    def __init__(self, weights: Path | str | Sequence[Path]) -> None:
        super().__init__()
        kernels, strides, paddings = (11, 5, 3, 3, 3), (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
        inputs = (3, *self.CHANNELS[:-1])
        shapes = zip(inputs, self.CHANNELS, kernels, strides, paddings, strict=True)
        self.convolutions = nn.ModuleList(nn.Conv2d(i, o, k, s, p) for i, o, k, s, p in shapes)
        self.importance = nn.ParameterList(torch.zeros(c) for c in self.CHANNELS)
        self.load_state_dict(lpips_state(weights))
        self.requires_grad_(False).eval()

    def forward(self, a: Tensor, b: Tensor) -> float:
        """The distance of two rgb pictures (H, W, 3) in [0, 1], at least 64 pixels high
        and wide.
        """
        return sum(float(distance.mean()) for distance in self.distances(a, b))

    def on_mask(self, a: Tensor, b: Tensor, mask: Tensor) -> float:
        """The same where `mask` (H, W) is true: the distances of every layer are
        brought to the pictures' size (bilinear, as the authors' `spatial` option does)
        and averaged over the mask.
        """
        maps = [
            functional.interpolate(d[None, None], size=a.shape[:2], mode="bilinear")
            for d in self.distances(a, b)
        ]
        return float(torch.cat(maps).sum(0)[0][mask].mean())

    def distances(self, a: Tensor, b: Tensor) -> list[Tensor]:
        """Weighted square distances (h, w) of each of the five layers."""
        assert a.shape == b.shape and min(a.shape[:2]) >= 64, (a.shape, b.shape)
        layers = zip(self.features(a), self.features(b), self.importance, strict=True)
        return [((x - y).square() * weight[:, None, None]).sum(0) for x, y, weight in layers]

    def features(self, rgb: Tensor) -> list[Tensor]:
        """The five layers' activations (C, h, w), of unit length across channels."""
        shift, scale = (
            rgb.new_tensor([-0.030, -0.088, -0.188]),
            rgb.new_tensor([0.458, 0.448, 0.450]),
        )
        x = ((rgb * 2 - 1 - shift) / scale).permute(2, 0, 1)[None].float()
        seen = []
        for i, convolution in enumerate(self.convolutions):
            x = functional.relu(
                convolution(x if i in (0, 3, 4) else functional.max_pool2d(x, 3, 2))
            )
            seen.append(x[0] / (x[0].norm(dim=0, keepdim=True) + 1e-10))
        return seen


def lpips_state(weights: Path | str | Sequence[Path]) -> dict[str, Tensor]:
    """`Lpips` parameters from a file, a folder of files, or several files; InputError
    where they do not hold all of them.
    """
    found: dict[str, Tensor] = {}
    if isinstance(weights, Path | str):
        weights = sorted(Path(weights).glob("*.pth")) if Path(weights).is_dir() else [Path(weights)]
    for file in weights:
        found |= read_weights(file)
    state = {}
    for key, value in found.items():
        if match := re.search(r"(?:features|slice\d)\.(\d+)\.(weight|bias)$", key):
            if int(match[1]) in Lpips.LAYERS:
                state[f"convolutions.{Lpips.LAYERS.index(int(match[1]))}.{match[2]}"] = value
        elif match := re.search(r"lins?\.?(\d)\.model\.\d\.weight$", key):
            state[f"importance.{match[1]}"] = value.flatten()
    wanted = {
        f"convolutions.{i}.{p}": None for i, p in itertools.product(range(5), ("weight", "bias"))
    }
    wanted |= {f"importance.{i}": None for i in range(5)}
    if missing := sorted(set(wanted) - set(state)):
        raise InputError(
            f"{', '.join(map(str, weights))}: no complete LPIPS weights (AlexNet and linear layers), {missing[0]} is missing"
        )
    return state


def read_weights(file: Path) -> dict[str, Tensor]:
    """The tensors of a `.pth` state dict, nothing else unpickled; InputError where it
    is none.
    """
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such weights file") from error
    except Exception as error:  # torch raises several unrelated types
        raise InputError(
            f"{file}: not a readable torch state dict ({type(error).__name__})"
        ) from error
    if not isinstance(state, dict):
        raise InputError(f"{file}: holds a {type(state).__name__}, not a state dict")
    return {str(k): v for k, v in state.items() if isinstance(v, Tensor)}
