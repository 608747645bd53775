"""How close a picture, a depth map or a motion comes to the truth.

Pictures are tensors (H, W, 3): rgb in [0, 1], or linear radiance where they are called
so. Masks (H, W) bool select pixels; None selects all. Every metric returns plain
floats. docs/metrics.md lists them with their keys.

LDR recordings leave the scale of radiance free. `align` therefore fits one scale (or
one per channel) for the whole sequence, on pixels that some exposure records, and one
`peak` normalizes the whole sequence. Neither is ever fitted per frame: that would hide
flicker.
"""

from __future__ import annotations

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

MAX_PSNR_DB = 100.0  # of equal pictures
DARKEST_SHARE = 1e-6  # of the largest luminance: the least that a quantile of it may be
DARKEST = 1e-12  # luminance: the same for an all-black sequence

SSIM_SIGMA = 1.5  # pixels, Wang et al. 2004: an 11 x 11 Gaussian window
SSIM_RADIUS = 5  # pixels
SSIM_K1, SSIM_K2 = 0.01, 0.03  # Wang et al. 2004; rgb is in [0, 1]

PU21_NITS = 1000.0  # cd/m^2 at which the sequence's white is assumed to be shown
PU21_WHITE = 0.995  # quantile of the truth's luminance that is white
PU21_PEAK = 256.0  # code of 100 cd/m^2: the peak of the authors' own PSNR

# the ACES fit x (2.51 x + 0.03) / (x (2.43 x + 0.59) + 0.14) that FLIP uses, of 0.6
# times the exposed luminance, and the output at which it places the exposure range
ACES_NUMERATOR = (2.51, 0.03, 0.0)
ACES_DENOMINATOR = (2.43, 0.59, 0.14)
ACES_EXPOSURE = 0.6
FLIP_TARGET = 0.85


def psnr(a: Tensor, b: Tensor, mask: Tensor | None = None, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, over pixels of `mask` and channels.

    `10 log10(peak^2 / mean square error)`; at most 100, for equal pictures, and -inf
    for an infinite error.
    """
    assert a.shape == b.shape, (a.shape, b.shape)
    error = (a.double() - b.double()).square()
    mse = float(error.mean() if mask is None else error[mask].mean())
    if math.isinf(mse):
        return -math.inf
    least_mse = 10 ** (-MAX_PSNR_DB / 10) * peak**2
    return 10 * math.log10(peak**2 / max(mse, least_mse))


def ssim(a: Tensor, b: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (Wang et al. 2004) in [-1, 1], mean over channels.

    Without a mask the outer 5 pixels are left out, as published; with one, the map is
    averaged on the mask.
    """
    assert a.shape == b.shape, (a.shape, b.shape)
    values = ssim_map(a.double().cpu().numpy(), b.double().cpu().numpy())
    if mask is None:
        inner = slice(SSIM_RADIUS, -SSIM_RADIUS)
        return float(values[inner, inner].mean())
    return float(values[mask.cpu().numpy()].mean())


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM around every pixel, for each channel of pictures in [0, 1]: (H, W, 3)."""

    def window_mean(x: np.ndarray) -> np.ndarray:
        sigma = (SSIM_SIGMA, SSIM_SIGMA, 0)
        return np.asarray(gaussian_filter(x, sigma, radius=(SSIM_RADIUS, SSIM_RADIUS, 0)))

    mean_a, mean_b = window_mean(a), window_mean(b)
    variance_a = window_mean(a * a) - mean_a**2
    variance_b = window_mean(b * b) - mean_b**2
    covariance = window_mean(a * b) - mean_a * mean_b
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    similarity = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    largest = (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    return similarity / largest


def align(radiance: Tensor, truth: Tensor, recordable: Tensor, per_channel: bool = False) -> Tensor:
    """The scale () by which to multiply predicted `radiance` (..., 3), or scales (3,).

    It is the median of truth / prediction over the whole sequence; 1 where there is
    nothing to compare. Only pixels that are `recordable` (...) count: at least one
    exposure records them unclipped. Brighter ones cannot be known, and a least-squares
    scale would follow them alone.
    """
    use = recordable & (radiance > 0).all(-1) & (truth > 0).all(-1)
    if not use.any():
        return torch.ones(3 if per_channel else ())
    ratio = truth[use].double() / radiance[use].double()  # (n, 3)
    scale = ratio.median(0).values if per_channel else ratio.flatten().median()
    return scale.float()


def mu_law_psnr(
    radiance: Tensor, truth: Tensor, peak: float, mu: float = 5000.0, mask: Tensor | None = None
) -> float:
    """PSNR in dB, at most 100, of mu-law compressed radiance (HDR-NSFF, eq. 17).

    `radiance` is aligned before (see `align`). It and `truth` are compared in units of
    the sequence's `peak`, clipped to it (Kalantari and Ramamoorthi 2017).
    """
    compressed = mu_law((radiance / peak).clip(0, 1), mu)
    compressed_truth = mu_law((truth / peak).clip(0, 1), mu)
    return psnr(compressed, compressed_truth, mask)


def pu21_white(truths: list[Tensor]) -> float:
    """The luminance that is shown at `PU21_NITS`, one for a whole sequence.

    `truths` are pictures (H, W, 3) of true radiance. The 99.5th percentile keeps a lamp
    of a few pixels from deciding how dark the rest is; PU21 distinguishes luminances up
    to ten times that.
    """
    y = torch.cat([luminance(t).flatten() for t in truths]).double()
    quantile = float(np.quantile(y.numpy(), PU21_WHITE))
    return max(quantile, DARKEST_SHARE * float(y.max()), DARKEST)


def pu21_psnr(radiance: Tensor, truth: Tensor, white: float, mask: Tensor | None = None) -> float:
    """PSNR in dB, at most 100, of PU21-encoded rgb, over pixels of `mask` and channels.

    Mantiuk and Azimi 2021, banding + glare. Aligned `radiance` and `truth` are taken as
    the light of a display on which luminance `white` has 1000 cd/m^2: an assumption to
    report beside the number.
    """
    scale = PU21_NITS / white
    encoded = pu21_encode(radiance.double() * scale)
    encoded_truth = pu21_encode(truth.double() * scale)
    return psnr(encoded, encoded_truth, mask, peak=PU21_PEAK)


def flip_exposures(truths: list[Tensor]) -> tuple[float, float]:
    """The exposure range (start, stop; log2) of a whole sequence for HDR-FLIP.

    `truths` are pictures (H, W, 3) of true radiance. At `start` the brightest, at
    `stop` the median luminance comes out at 0.85 of the ACES curve (Andersson et al.
    2021, section 3).
    """
    y = torch.cat([luminance(t).flatten() for t in truths]).double()
    # ACES(x) = 0.85 is the quadratic a x^2 + b x + c = 0
    polynomials = zip(ACES_NUMERATOR, ACES_DENOMINATOR, strict=True)
    a, b, c = [above - FLIP_TARGET * below for above, below in polynomials]
    root = (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a)
    exposed = root / ACES_EXPOSURE
    brightest = max(float(y.max()), DARKEST)
    median = max(float(y.median()), DARKEST_SHARE * float(y.max()), DARKEST)
    return math.log2(exposed / brightest), math.log2(exposed / median)


def hdr_flip_map(radiance: Tensor, truth: Tensor, exposures: tuple[float, float]) -> Tensor | None:
    """HDR-FLIP: the largest visible difference (H, W) in [0, 1] over exposures.

    Of aligned linear radiance (Andersson et al. 2021), at 67 pixels per degree.
    `exposures` (start, stop; log2) are those of the whole sequence, see
    `flip_exposures`. None where flip-evaluator is not installed.
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
    reference = np.ascontiguousarray(truth.float().cpu().numpy().clip(0))
    test = np.ascontiguousarray(radiance.float().cpu().numpy().clip(0))
    error, _, _ = flip_evaluator.evaluate(
        reference, test, "HDR", applyMagma=False, computeMeanError=False, parameters=settings
    )
    height, width = truth.shape[:2]
    channels = np.asarray(error).reshape(height, width, -1)
    return torch.from_numpy(channels[..., 0].copy())


def hdr_tae(radiance: Tensor, other: Tensor, flow: Tensor, mask: Tensor) -> tuple[float, int]:
    """HDR-TAE in [0, 1], 0 for a steady picture, and the number of pixels it is over.

    The mean of `|H1 - warp(H2)| / (H1 + warp(H2))` over `mask` (H, W) and channels of
    two pictures in linear radiance (H, W, 3) (Mono4DGS-HDR, arXiv 2510.18489). `flow`
    (H, W, 2), in pixels, leads from `radiance` to `other`, which is read bilinearly;
    pixels that leave the picture do not count. Two zeros do not differ. A scale of the
    radiance, also per channel, cancels. NaN where no pixel is left.
    """
    height, width = mask.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    x = columns + flow[..., 0].double()
    y = rows + flow[..., 1].double()
    inside = mask & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    grid_x = 2 * x / max(width - 1, 1) - 1  # in [-1, 1], as grid_sample takes it
    grid_y = 2 * y / max(height - 1, 1) - 1
    grid = torch.stack([grid_x, grid_y], -1)
    image = other.double().permute(2, 0, 1)
    sampled = functional.grid_sample(image[None], grid[None], align_corners=True)
    warped = sampled[0].permute(1, 2, 0)  # (H, W, 3)
    here, there = radiance.double()[inside], warped[inside]
    change = (here - there).abs() / (here + there).clamp_min(1e-12)
    return float(change.mean()), int(inside.sum())


def depth_errors(depth: Tensor, truth: Tensor, known: Tensor) -> tuple[float, float]:
    """AbsRel and RMSE of `depth` over pixels that are `known` (Eigen et al. 2014).

    `mean |d - d*| / d*` and `sqrt(mean (d - d*)^2)`, the latter in units of `truth`; 0
    for equal maps. All are (H, W). `depth` is aligned before by one scale per sequence,
    see `median_ratio`.
    """
    error = (depth.double() - truth.double())[known]
    abs_rel = (error.abs() / truth.double()[known]).mean()
    rmse = error.square().mean().sqrt()
    return float(abs_rel), float(rmse)


def median_ratio(values: Tensor, truth: Tensor) -> float:
    """The median of `truth / values` over entries where both are above 0.

    One scale for a whole sequence; 1 where there are none.
    """
    use = (values > 0) & (truth > 0)
    if not use.any():
        return 1.0
    return float((truth[use].double() / values[use].double()).median())


def end_point_error(motion: Tensor, truth: Tensor, known: Tensor) -> float:
    """Mean Euclidean distance of two motions (H, W, D) over pixels that are `known`.

    In pixels for optical flow (D = 2; Baker et al. 2011), in world units for scene flow
    (D = 3; FlowNet3D, Liu et al. 2019).
    """
    return float((motion.double() - truth.double()).norm(dim=-1)[known].mean())


class Lpips(nn.Module):
    """LPIPS (Zhang et al. 2018), AlexNet, version 0.1: a distance of deep features.

    It is 0 for equal and about 0.7 for unrelated pictures. `weights`: a `.pth` file
    with both the AlexNet features (as torchvision names them) and the linear layers (as
    the authors' package names them), a folder of such files, or a list of them.
    """

    CHANNELS = (64, 192, 384, 256, 256)  # of AlexNet's convolutions, and what follows
    KERNELS = (11, 5, 3, 3, 3)
    STRIDES = (4, 1, 1, 1, 1)
    PADDINGS = (2, 2, 1, 1, 1)
    LAYERS = (0, 3, 6, 8, 10)  # positions of the convolutions in torchvision's AlexNet
    UNPOOLED = (0, 3, 4)  # convolutions that no max pooling precedes
    SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of rgb in [-1, 1]
    MIN_SIZE = 64  # pixels: below, the last layers have next to nothing left

    def __init__(self, weights: Path | str | Sequence[Path]) -> None:
        super().__init__()
        inputs = (3, *self.CHANNELS[:-1])
        layers = zip(inputs, self.CHANNELS, self.KERNELS, self.STRIDES, self.PADDINGS, strict=True)
        self.convolutions = nn.ModuleList(nn.Conv2d(*layer) for layer in layers)
        self.importance = nn.ParameterList(torch.zeros(c) for c in self.CHANNELS)
        state = lpips_state(weights)
        for name, parameter in self.state_dict().items():
            if state[name].shape != parameter.shape:
                raise InputError(
                    f"{weights}: {name} has the size of another network than LPIPS's AlexNet; "
                    "name the files of AlexNet alone"
                )
        self.load_state_dict(state)
        self.requires_grad_(False).eval()

    def forward(self, a: Tensor, b: Tensor) -> float:
        """The distance of two rgb pictures (H, W, 3) in [0, 1].

        Both sides are at least 64 pixels.
        """
        return sum(float(distance.mean()) for distance in self.distances(a, b))

    def on_mask(self, a: Tensor, b: Tensor, mask: Tensor) -> float:
        """The distance where `mask` (H, W) is true.

        Every layer's distances are resized to the pictures' size (bilinear, as the
        authors' `spatial` option does), added up and averaged over the mask.
        """
        maps = [
            functional.interpolate(d[None, None], size=a.shape[:2], mode="bilinear")
            for d in self.distances(a, b)
        ]
        total = torch.cat(maps).sum(0)[0]  # (H, W)
        return float(total[mask].mean())

    def distances(self, a: Tensor, b: Tensor) -> list[Tensor]:
        """Weighted square distances (h, w) of each of the five layers."""
        assert a.shape == b.shape and min(a.shape[:2]) >= self.MIN_SIZE, (a.shape, b.shape)
        maps = []
        for x, y, weight in zip(self.features(a), self.features(b), self.importance, strict=True):
            weighted = (x - y).square() * weight[:, None, None]
            maps.append(weighted.sum(0))
        return maps

    def features(self, rgb: Tensor) -> list[Tensor]:
        """The five layers' activations (C, h, w), of unit length across channels."""
        shift, scale = rgb.new_tensor(self.SHIFT), rgb.new_tensor(self.SCALE)
        x = ((rgb * 2 - 1 - shift) / scale).permute(2, 0, 1)[None].float()
        features = []
        for i, convolution in enumerate(self.convolutions):
            if i not in self.UNPOOLED:
                x = functional.max_pool2d(x, 3, 2)
            x = functional.relu(convolution(x))
            features.append(x[0] / (x[0].norm(dim=0, keepdim=True) + 1e-10))
        return features


def lpips_state(weights: Path | str | Sequence[Path]) -> dict[str, Tensor]:
    """`Lpips` parameters from a file, a folder of files, or several files.

    InputError where they do not hold all of them.
    """
    files = list_weights(weights)
    found: dict[str, Tensor] = {}
    for file in files:
        found |= read_weights(file)
    state = {}
    for key, value in found.items():
        name = lpips_name(key)
        if name is not None:
            state[name] = value.flatten() if name.startswith("importance") else value
    layers = range(len(Lpips.LAYERS))
    wanted = {f"convolutions.{i}.{part}" for i in layers for part in ("weight", "bias")}
    wanted |= {f"importance.{i}" for i in layers}
    if missing := sorted(wanted - set(state)):
        raise InputError(
            f"{', '.join(map(str, files))}: no complete LPIPS weights (AlexNet and linear "
            f"layers), {missing[0]} is missing"
        )
    return {name: state[name] for name in wanted}


def list_weights(weights: Path | str | Sequence[Path]) -> list[Path]:
    """The files of a file, of a folder's `.pth` files, or of a list of files.

    InputError for a folder without any.
    """
    if not isinstance(weights, Path | str):
        return list(weights)
    path = Path(weights)
    files = sorted(path.glob("*.pth")) if path.is_dir() else [path]
    if not files:
        raise InputError(f"{path}: holds no .pth file; name a file or folder of LPIPS weights")
    return files


def lpips_name(key: str) -> str | None:
    """Our name of a parameter that AlexNet or the authors' package calls `key`.

    None for one that LPIPS does not use.
    """
    if match := re.search(r"(?:features|slice\d)\.(\d+)\.(weight|bias)$", key):
        position = int(match[1])
        if position not in Lpips.LAYERS:
            return None
        return f"convolutions.{Lpips.LAYERS.index(position)}.{match[2]}"
    if match := re.search(r"lins?\.?(\d)\.model\.\d\.weight$", key):
        return f"importance.{match[1]}"
    return None


def read_weights(file: Path) -> dict[str, Tensor]:
    """The tensors of a `.pth` state dict, nothing else unpickled.

    InputError where the file is none.
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
