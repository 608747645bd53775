"""How close a picture comes to the truth. Pictures are tensors (H, W, 3), rgb in [0, 1] or linear radiance where it says so; masks
(H, W) bool say where to look, None everywhere. Every metric gives back plain floats.

Radiance is compared as METHOD.md 7 says: LDR recordings leave its scale free, so `align` fits one scale (or one per channel) for
the whole sequence on pixels that some exposure records, and one `peak` normalises the whole sequence; neither is ever fitted
per frame, which would hide flicker."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn
from torch.nn import functional

from hdr_nsff.color import luminance, mu_law, pu21_encode
from hdr_nsff.errors import InputError

ALEXNET_URL = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
LPIPS_URL = "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/alex.pth"


def psnr(a: Tensor, b: Tensor, mask: Tensor | None = None, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, `10 log10(peak^2 / mean square error)` over pixels of `mask` and channels; at most 100 (equal pictures)."""
    assert a.shape == b.shape, (a.shape, b.shape)
    error = (a.double() - b.double()).square()
    mse = float(error.mean() if mask is None else error[mask].mean())
    return 10 * math.log10(peak**2 / max(mse, 1e-10 * peak**2))


def ssim(a: Tensor, b: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) in [-1, 1]: Gaussian window 11x11, sigma 1.5, K1 0.01, K2 0.03, mean over channels.

    Over the whole picture the outer 5 pixels are left out, as published; over a mask the map is averaged on the mask."""
    assert a.shape == b.shape, (a.shape, b.shape)
    values = ssim_map(a.double().cpu().numpy(), b.double().cpu().numpy())
    return float(values[5:-5, 5:-5].mean() if mask is None else values[mask.cpu().numpy()].mean())


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM around every pixel and channel (H, W, 3)."""

    def window(x: np.ndarray) -> np.ndarray:
        return np.asarray(gaussian_filter(x, sigma=(1.5, 1.5, 0), truncate=3.5))  # radius 5

    mean_a, mean_b = window(a), window(b)
    var_a, var_b, cov = window(a * a) - mean_a**2, window(b * b) - mean_b**2, window(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mean_a * mean_b + c1) * (2 * cov + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))


def align(radiance: Tensor, truth: Tensor, recordable: Tensor, per_channel: bool = False) -> Tensor:
    """The scale () or per-channel scales (3,) by which to multiply predicted `radiance` (..., 3): the median of truth / prediction over
    pixels of the whole sequence that are `recordable` (...): at least one exposure records them unclipped.

    Brighter ones cannot be known, and a least-squares scale would follow them alone. 1 where there is nothing to compare."""
    use = recordable & (radiance > 0).all(-1) & (truth > 0).all(-1)
    if not use.any():
        return torch.ones(3 if per_channel else ())
    ratio = truth[use].double() / radiance[use].double()  # (n, 3)
    return (ratio.median(0).values if per_channel else ratio.flatten().median()).float()


def mu_law_psnr(radiance: Tensor, truth: Tensor, peak: float, mu: float = 5000.0, mask: Tensor | None = None) -> float:
    """PSNR in dB after the mu-law (eq. 17) of aligned `radiance` and `truth`, both in units of the sequence's `peak` and clipped to it."""
    return psnr(mu_law((radiance / peak).clip(0, 1), mu), mu_law((truth / peak).clip(0, 1), mu), mask)


def pu21_psnr(radiance: Tensor, truth: Tensor, peak: float, nits: float = 1000.0, mask: Tensor | None = None) -> float:
    """PSNR in dB of PU21-encoded values (Mantiuk and Azimi 2021), aligned radiance shown so that the sequence's `peak` has `nits` cd/m^2.

    The absolute luminance is an assumption and belongs beside the number. Peak signal 256: the code of 100 cd/m^2."""
    return psnr(pu21_encode(radiance / peak * nits), pu21_encode(truth / peak * nits), mask, peak=256.0)


def flip_exposures(truths: list[Tensor]) -> tuple[float, float]:
    """The exposure range (start, stop; log2) for HDR-FLIP of a whole sequence of true radiance (H, W, 3), by the rule of the method
    (Andersson et al. 2021, section 3): the brightest, and the median, luminance come out at 0.85 of the ACES curve."""
    y = torch.cat([luminance(t).flatten() for t in truths]).double()
    a, b, c = 2.51 - 0.85 * 2.43, 0.03 - 0.85 * 0.59, -0.85 * 0.14  # ACES(x) = 0.85
    x = (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a) / 0.6  # FLIP puts 0.6 times the exposed luminance through the curve
    middle = max(float(y.median()), 1e-6 * float(y.max()), 1e-12)
    return math.log2(x / max(float(y.max()), 1e-12)), math.log2(x / middle)


def hdr_flip(radiance: Tensor, truth: Tensor, exposures: tuple[float, float], mask: Tensor | None = None) -> float | None:
    """HDR-FLIP in [0, 1], 0 equal (Andersson et al. 2021): the largest visible difference over `exposures` (start, stop; log2), averaged.

    `exposures` are those of the whole sequence, see `flip_exposures`; 67 pixels per degree. None where flip-evaluator is not installed."""
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
    reference, test = (np.ascontiguousarray(x.float().cpu().numpy().clip(0)) for x in (truth, radiance))
    error, _, _ = flip_evaluator.evaluate(reference, test, "HDR", applyMagma=False, computeMeanError=False, parameters=settings)
    error = np.asarray(error).reshape(truth.shape[0], truth.shape[1], -1)[..., 0]
    return float(error.mean() if mask is None else error[mask.cpu().numpy()].mean())


class Lpips(nn.Module):
    """LPIPS (Zhang et al. 2018), AlexNet, version 0.1: a distance of deep features, 0 equal, about 0.7 for unlike pictures.

    `weights`: a `.pth` file with both the AlexNet features (as torchvision names them) and the linear layers (as the authors' package
    names them), a folder with such files side by side, or "hub" to download both."""

    CHANNELS = (64, 192, 384, 256, 256)
    LAYERS = (0, 3, 6, 8, 10)  # positions of the convolutions in torchvision's AlexNet

    def __init__(self, weights: Path | str) -> None:
        super().__init__()
        kernels, strides, paddings = (11, 5, 3, 3, 3), (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
        inputs = (3, *self.CHANNELS[:-1])
        shapes = zip(inputs, self.CHANNELS, kernels, strides, paddings, strict=True)
        self.convolutions = nn.ModuleList(nn.Conv2d(i, o, k, s, p) for i, o, k, s, p in shapes)
        self.importance = nn.ParameterList(torch.zeros(c) for c in self.CHANNELS)
        self.load_state_dict(lpips_state(weights))
        self.requires_grad_(False).eval()

    def forward(self, a: Tensor, b: Tensor) -> float:
        """The distance of two rgb pictures (H, W, 3) in [0, 1], at least 64 pixels high and wide."""
        assert a.shape == b.shape and min(a.shape[:2]) >= 64, (a.shape, b.shape)
        distance = 0.0
        for x, y, weight in zip(self.features(a), self.features(b), self.importance, strict=True):
            distance += float(((x - y).square() * weight[:, None, None]).sum(0).mean())
        return distance

    def features(self, rgb: Tensor) -> list[Tensor]:
        """The five layers' activations (C, h, w), of unit length across channels."""
        shift, scale = rgb.new_tensor([-0.030, -0.088, -0.188]), rgb.new_tensor([0.458, 0.448, 0.450])
        x = ((rgb * 2 - 1 - shift) / scale).permute(2, 0, 1)[None].float()
        seen = []
        for i, convolution in enumerate(self.convolutions):
            x = functional.relu(convolution(x if i in (0, 3, 4) else functional.max_pool2d(x, 3, 2)))
            seen.append(x[0] / (x[0].norm(dim=0, keepdim=True) + 1e-10))
        return seen


def lpips_state(weights: Path | str) -> dict[str, Tensor]:
    """`Lpips` parameters from a file, a folder of files, or "hub"; InputError where they do not hold all of them."""
    found: dict[str, Tensor] = {}
    if str(weights) == "hub":
        try:
            for url in (ALEXNET_URL, LPIPS_URL):
                name = f"lpips-{url.rsplit('/', 1)[1]}"
                found |= torch.hub.load_state_dict_from_url(url, map_location="cpu", weights_only=True, file_name=name)
        except OSError as error:
            raise InputError(f"LPIPS: its weights could not be downloaded ({error}); give a file by `--lpips FILE`") from error
    else:
        for file in sorted(Path(weights).glob("*.pth")) if Path(weights).is_dir() else [Path(weights)]:
            found |= read_weights(file)
    state = {}
    for key, value in found.items():
        if match := re.search(r"(?:features|slice\d)\.(\d+)\.(weight|bias)$", key):
            if int(match[1]) in Lpips.LAYERS:
                state[f"convolutions.{Lpips.LAYERS.index(int(match[1]))}.{match[2]}"] = value
        elif match := re.search(r"lins?\.?(\d)\.model\.\d\.weight$", key):
            state[f"importance.{match[1]}"] = value.flatten()
    wanted = {f"convolutions.{i}.{p}": None for i, p in itertools.product(range(5), ("weight", "bias"))}
    wanted |= {f"importance.{i}": None for i in range(5)}
    if missing := sorted(set(wanted) - set(state)):
        raise InputError(f"{weights}: no complete LPIPS weights (AlexNet and linear layers), {missing[0]} is missing")
    return state


def read_weights(file: Path) -> dict[str, Tensor]:
    """The tensors of a `.pth` state dict, nothing else unpickled; InputError where it is none."""
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such weights file") from error
    except Exception as error:  # torch raises several unrelated types
        raise InputError(f"{file}: not a readable torch state dict ({type(error).__name__})") from error
    if not isinstance(state, dict):
        raise InputError(f"{file}: holds a {type(state).__name__}, not a state dict")
    return {str(k): v for k, v in state.items() if isinstance(v, Tensor)}
