"""The common power of exposures, from the noise of the sensor.

The variance of a sensor's noise is affine in the light: read-out noise, and the noise
of photons (Takamatsu, Matsushita and Ikeuchi 2008). A response that is off by a power p
bends this line. With G the measured log exposure of a recorded value, p G the true one
(0 at saturation), N the electrons that saturate the sensor and r those of the read-out
noise, a pixel's variance in units of G is

    V(G) = texture + rounding + (exp(-p G) + r^2 exp(-2 p G) / N) / (N p^2)

p, N and the texture (of every channel and radiance its own, equal in all exposures) are
fitted, r has a prior. Compressed, denoised or shrunk footage no longer shows this
noise. So lossy footage is not asked, and where the fit is bad nothing is concluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import nnls

from hdr_nsff.radiometry.debevec import HIGH, LOW

# answers to linear and quadratic texture with 0, to white noise of deviation 1 with 1
# (Immerkaer 1996)
KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
SLOPE = np.array([[-1, 0, 1]] * 3, np.float32) / 6
MEDIAN_SQUARE = 0.4549  # of a standard normal variable
STEP_8_BIT = 1 / 255  # between codes, as values in [0, 1]
MIN_EXPOSURE = 1e-7


@dataclass(frozen=True)
class SensorNoiseTuning:
    """Which pixels show noise, and how well a fit has to explain them.

    Hand-chosen on five re-exposed clips with noise of 6000 electrons. Their misfit is
    1.4 to 4.3, that of shrunk JPEG photographs 7 to 200, of compressed video mostly
    above 20.
    """

    max_pixels: float = 2e6  # that are looked at, of all frames
    bin_width: float = 0.4  # of log exposure (natural)
    darkest: float = -7.5  # log exposure relative to saturation
    flat_share: float = 0.3  # of the pixels of a bin: those with the least slope
    min_bin_pixels: int = 400
    max_deviation: float = 0.35  # of log exposure; beyond, noise is not linear in it
    clip_margin: float = 3.0  # deviations of noise between a bin and black or white
    model_error: float = 0.05  # of a bin's variance, however many pixels it has
    min_bins: int = 24
    rounds: int = 8  # of reweighting
    max_misfit: float = 5.0  # mean robust squared error per degree of freedom
    read_electrons: float = 4.0  # median of sensors, and its deviation (natural log)
    log_read_deviation: float = 0.7
    # of the natural logarithm of p: what no number of pixels reduces
    min_log_deviation: float = 0.03
    num_powers: int = 49
    num_reads: int = 9


@dataclass(frozen=True)
class NoiseBins:
    """Pixels of about one exposure, of one channel and bracket each."""

    channel: np.ndarray  # (N,) 0 to 2
    log_exposure: np.ndarray  # (N,) natural, measured, 0 at saturation
    log_radiance: np.ndarray  # (N,) the same at the reference bracket
    variance: np.ndarray  # (N,) of the log exposure
    rounding: np.ndarray  # (N,) variance of rounding to the codes of the images
    count: np.ndarray  # (N,) pixels


def noise_log_likelihood(
    images: Sequence[np.ndarray],
    brackets: Sequence[int],
    x: np.ndarray,
    y: np.ndarray,
    ev: np.ndarray,
    factors: np.ndarray,
    tuning: SensorNoiseTuning = SensorNoiseTuning(),
) -> np.ndarray | None:
    """The log likelihood (F,) of each of `factors` (F,) on log exposures, or None where
    the images do not show the noise of a sensor.

    `images` (H, W, 3) in [0, 1] of `brackets`; the measured curves `y` (3, K) over `x`
    (K,), and EVs `ev` (B,).
    """
    bins = measure_noise(images, brackets, x, y, ev, tuning)
    if len(bins.variance) < tuning.min_bins:
        return None
    powers = np.geomspace(factors[0], factors[-1], tuning.num_powers)
    spread = 3 * tuning.log_read_deviation
    log_reads = np.linspace(-spread, spread, tuning.num_reads)
    reads = tuning.read_electrons * np.exp(log_reads)
    cost = np.array([[fit_cost(bins, p, r, tuning) for r in reads] for p in powers])
    degrees_of_freedom = len(bins.variance) - texture_columns(bins, tuning).shape[1] - 2
    if degrees_of_freedom < 1 or cost.min() / degrees_of_freedom > tuning.max_misfit:
        return None
    log_prior = -((log_reads / tuning.log_read_deviation) ** 2) / 2
    misfit = max(cost.min() / degrees_of_freedom, 1.0)
    log_joint = -cost / 2 / misfit + log_prior
    log_likelihood = np.logaddexp.reduce(log_joint, axis=1)
    apart = np.log(factors)[:, None] - np.log(powers)
    blurred = log_likelihood - (apart / tuning.min_log_deviation) ** 2 / 2
    return np.logaddexp.reduce(blurred, axis=1)


def measure_noise(
    images: Sequence[np.ndarray],
    brackets: Sequence[int],
    x: np.ndarray,
    y: np.ndarray,
    ev: np.ndarray,
    tuning: SensorNoiseTuning = SensorNoiseTuning(),
) -> NoiseBins:
    """Noise of log exposure in flat places of the `images`, by exposure."""
    size = images[0].shape[0] * images[0].shape[1]
    stride = max(1, int(np.ceil(3 * len(images) * size / tuning.max_pixels)))
    num_levels = int(np.ceil(-tuning.darkest / tuning.bin_width)) - 1
    rows = []
    for bracket in sorted(set(brackets)):
        of_bracket = [k for k, b in enumerate(brackets) if b == bracket]
        step = max(1, min(stride, len(of_bracket) // 3))
        own = [images[k] for k in of_bracket[::step]]
        code = min(code_step(image) for image in own)
        for channel in range(3):
            pixels = [channel_noise(image[..., channel], x, y[channel]) for image in own]
            g, noise, slope, z, gain = np.concatenate(pixels, axis=1)
            level = np.floor((g - tuning.darkest) / tuning.bin_width).astype(int)
            for k in range(num_levels):
                members = np.flatnonzero(level == k)
                if len(members) < tuning.min_bin_pixels:
                    continue
                flat = slope[members] <= np.quantile(slope[members], tuning.flat_share)
                members = members[flat]
                deviation = np.sqrt(np.median(noise[members] ** 2) / MEDIAN_SQUARE)
                margin = tuning.clip_margin * deviation / np.median(gain[members])
                value = np.median(z[members])
                is_clipped = value - margin < LOW or value + margin > HIGH
                is_measured = 0 < deviation <= tuning.max_deviation
                if is_clipped or not is_measured:
                    continue
                log_exposure = np.median(g[members])
                rounding = (np.median(gain[members]) * code) ** 2 / 12
                log_radiance = log_exposure - ev[bracket] * np.log(2)
                count = len(members)
                rows.append((channel, log_exposure, log_radiance, deviation**2, rounding, count))
    return NoiseBins(*np.array(rows).reshape(-1, 6).T)


def code_step(image: np.ndarray) -> float:
    """The step between neighboring codes of an `image` (H, W, 3): the smallest between
    values that occur, at most that of 8 bits.
    """
    return float(np.diff(np.unique(image)).min(initial=STEP_8_BIT))


def channel_noise(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of each unclipped pixel of an `image` (H, W) the log exposure, the noise and the
    slope in units of it, the recorded value, and log exposure per value: (5, N).
    """
    image = np.ascontiguousarray(image, np.float32)
    value = np.linspace(0, 1, 1025)
    log_exposure = np.log(np.maximum(np.interp(value, y, x), MIN_EXPOSURE))
    gain_at_value = np.gradient(log_exposure, value)
    window = np.ones((3, 3), np.uint8)
    unclipped = (np.asarray(cv2.erode(image, window)) >= LOW) & (
        np.asarray(cv2.dilate(image, window)) <= HIGH
    )
    unclipped[[0, -1]] = False
    unclipped[:, [0, -1]] = False
    z = np.asarray(cv2.blur(image, (3, 3)))[unclipped]
    gain = np.interp(z, value, gain_at_value)
    noise = np.asarray(cv2.filter2D(image, -1, KERNEL))[unclipped] * gain
    horizontal = np.asarray(cv2.filter2D(image, -1, SLOPE))[unclipped]
    vertical = np.asarray(cv2.filter2D(image, -1, np.ascontiguousarray(SLOPE.T)))[unclipped]
    slope = np.hypot(horizontal, vertical) * gain
    return np.stack([np.interp(z, value, log_exposure), noise, slope, z, gain])


def texture_columns(bins: NoiseBins, tuning: SensorNoiseTuning = SensorNoiseTuning()) -> np.ndarray:
    """Which bins (N, M) share each of M textures: those of a channel and radiance."""
    radiance = np.floor(bins.log_radiance / tuning.bin_width)
    _, texture = np.unique(np.stack([bins.channel, radiance]), axis=1, return_inverse=True)
    return np.eye(texture.max() + 1)[texture.ravel()]


def fit_cost(
    bins: NoiseBins,
    power: float,
    read_electrons: float,
    tuning: SensorNoiseTuning = SensorNoiseTuning(),
) -> float:
    """The robust squared error of the best noise with this power and read-out noise:
    twice the sum of sqrt(1 + e^2) - 1 over errors e of log variance in deviations.
    """
    texture = texture_columns(bins, tuning)
    deviation = np.sqrt(2.7 / bins.count + tuning.model_error**2)  # 2.7: of a median
    photons = np.exp(-power * bins.log_exposure) / power**2
    read = read_electrons**2 * np.exp(-2 * power * bins.log_exposure) / power**2
    target = np.maximum(bins.variance - bins.rounding, 0)
    fitted, per_electron = bins.variance, 1e-4
    for _ in range(tuning.rounds):
        weight = 1 / (deviation * fitted)
        noise = (photons + per_electron * read)[:, None]
        design = np.concatenate([texture, noise], axis=1) * weight[:, None]
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
        solution, _ = nnls(design / scale, target * weight)
        solution = solution / scale
        per_electron = max(float(solution[-1]), 1e-9)
        fitted = bins.rounding + texture @ solution[:-1] + noise[:, 0] * solution[-1] + 1e-12
    error = np.log(bins.variance / fitted) / deviation
    return float(2 * (np.sqrt(1 + error**2) - 1).sum())
