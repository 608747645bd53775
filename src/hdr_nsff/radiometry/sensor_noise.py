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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import cv2
import numpy as np
from scipy.optimize import nnls

from hdr_nsff.radiometry.log_curve import HIGH, LOW

# answers to linear and quadratic texture with 0, to white noise of deviation 1 with 1
# (Immerkaer 1996)
KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
GRADIENT = np.array([[-1, 0, 1]] * 3, np.float32) / 6
MEDIAN_SQUARE = 0.4549  # of a standard normal variable
STEP_8_BIT = 1 / 255  # between codes, as values in [0, 1]
MIN_EXPOSURE = 1e-7
MIN_MEAN_COSINE = 1e-3  # of noise, for a variance that is a number
MIN_DEVIATION = 1e-5  # of log exposure: less is rounding of float32, and no noise


@dataclass(frozen=True)
class SensorNoiseTuning:
    """Which pixels show noise, and how well a fit has to explain them.

    Hand-chosen on eight re-exposed clips with noise of 6000 electrons, three of them
    from compressed footage. Their misfit is 0.5 to 2.1, and 3.9 where the curve comes
    from auto exposure; that of compressed video 2.1 to 170, above 4.2 in seven of nine
    clips.
    """

    max_pixels: float = 6e6  # that are looked at, of all frames
    bin_width: float = 0.4  # of log radiance (natural)
    darkest: float = -7.5  # log exposure relative to saturation
    flat_share: float = 0.5  # of the pixels of a bin: those with the least texture
    max_clipped: float = 0.05  # share of those
    min_bin_pixels: int = 200  # of those
    max_deviation: float = 0.35  # of log exposure; beyond, noise is not linear in it
    clip_margin: float = 3.0  # deviations of noise between a bin and black or white
    model_error: float = 0.04  # of a bin's variance, however many pixels it has
    min_bins: int = 24
    rounds: int = 8  # of reweighting
    max_misfit: float = 4.2  # mean robust squared error per degree of freedom
    read_electrons: float = 4.0  # median of sensors, and its deviation (natural log)
    log_read_deviation: float = 0.7
    # of the natural logarithm of p: what no number of pixels reduces
    min_log_deviation: float = 0.03
    num_powers: int = 49
    num_reads: int = 9


@dataclass(frozen=True)
class NoiseBins:
    """Pixels of about one radiance, of one channel and bracket each."""

    channel: np.ndarray  # (N,) 0 to 2
    log_exposure: np.ndarray  # (N,) natural, measured, 0 at saturation
    radiance: np.ndarray  # (N,) bin of the log exposure at EV 0
    variance: np.ndarray  # (N,) of the log exposure
    rounding: np.ndarray  # (N,) variance of rounding to the codes of the images
    count: np.ndarray  # (N,) pixels


@dataclass(frozen=True)
class Pixels:
    """Pixels of one channel, with what is measured in the 3x3 around each."""

    log_exposure: np.ndarray  # (N,)
    log_radiance: np.ndarray  # (N,) the same at EV 0
    noise: np.ndarray  # (N,) of log exposure
    texture: np.ndarray  # (N,) how fast log exposure changes across the picture, per pixel
    value: np.ndarray  # (N,) recorded, in [0, 1]
    slope: np.ndarray  # (N,) of log exposure, per recorded value
    clipped: np.ndarray  # (N,) bool: some of them black or white

    @classmethod
    def joined(cls, parts: Sequence[Pixels]) -> Pixels:
        """The pixels of all `parts`."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def __getitem__(self, chosen: np.ndarray) -> Pixels:
        return Pixels(*(getattr(self, field.name)[chosen] for field in fields(self)))


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

    `images` (H, W, 3) in [0, 1] of `brackets`, those of about one exposure; the
    measured curves `y` (3, K) over `x` (K,), and the EVs `ev` (V,) of the images.
    """
    bins = measure_noise(images, brackets, x, y, ev, tuning)
    if len(bins.variance) < tuning.min_bins:
        return None
    powers = np.geomspace(factors[0], factors[-1], tuning.num_powers)
    spread = 3 * tuning.log_read_deviation
    log_reads = np.linspace(-spread, spread, tuning.num_reads)
    reads = tuning.read_electrons * np.exp(log_reads)
    cost = np.array([[fit_cost(bins, p, r, tuning) for r in reads] for p in powers])
    degrees_of_freedom = len(bins.variance) - texture_columns(bins).shape[1] - 2
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
    """Noise of log exposure in flat places of the `images`, by bracket and radiance."""
    size = images[0].shape[0] * images[0].shape[1]
    stride = max(1, int(np.ceil(3 * len(images) * size / tuning.max_pixels)))
    rows, noises = [], []
    for bracket in sorted(set(brackets)):
        of_bracket = [k for k, b in enumerate(brackets) if b == bracket]
        step = max(1, min(stride, len(of_bracket) // 3))
        chosen = of_bracket[::step]
        own = [images[k] for k in chosen]
        code = min(code_step(image) for image in own)
        log_gains = [float(ev[k] * np.log(2)) for k in chosen]
        for channel in range(3):
            pixels = [
                channel_pixels(image[..., channel], x, y[channel], log_gain)
                for image, log_gain in zip(own, log_gains, strict=True)
            ]
            for radiance, flat in flat_places(Pixels.joined(pixels), tuning):
                log_exposure, slope = np.median(flat.log_exposure), np.median(flat.slope)
                rounding = (slope * code) ** 2 / 12
                rows.append((channel, log_exposure, radiance, rounding, len(flat.noise)))
                noises.append(flat.noise)
    channels, log_exposures, radiances, roundings, counts = np.array(rows).reshape(-1, 5).T
    variances = noise_variances(noises, texture_of(channels, radiances))
    return NoiseBins(channels, log_exposures, radiances, variances, roundings, counts)


def flat_places(pixels: Pixels, tuning: SensorNoiseTuning) -> Iterator[tuple[int, Pixels]]:
    """The flattest unclipped `pixels` of every bin of radiance in which noise can be
    measured.

    Bins are of radiance, so that all exposures see the same texture in one. Where some
    pixels of a bin are clipped, the others are those with the least noise and texture.
    """
    radiance = np.floor(pixels.log_radiance / tuning.bin_width).astype(int)
    for k in np.unique(radiance).tolist():
        own = pixels[radiance == k]
        flat = own[own.texture <= np.quantile(own.texture, tuning.flat_share)]
        if flat.clipped.mean() > tuning.max_clipped or own.log_exposure.min() < tuning.darkest:
            continue
        flat = flat[~flat.clipped]
        if len(flat.noise) < tuning.min_bin_pixels:
            continue
        deviation = robust_deviation(flat.noise)
        margin = tuning.clip_margin * deviation / np.median(flat.slope)
        value = np.median(flat.value)
        is_unclipped = value - margin >= LOW and value + margin <= HIGH
        if is_unclipped and MIN_DEVIATION <= deviation <= tuning.max_deviation:
            yield k, flat


def robust_deviation(noise: np.ndarray) -> float:
    """The standard deviation of normal `noise` (N,), from the median of its square."""
    return float(np.sqrt(np.median(noise**2) / MEDIAN_SQUARE))


def noise_variances(noises: Sequence[np.ndarray], texture: np.ndarray) -> np.ndarray:
    """The variances (N,) of the `noises` of bins, which have a `texture` (N,) each.

    They come from the characteristic function, -2 ln E[cos(w n)] / w^2, at one
    frequency w for all bins of a texture. So they are robust, and the variance of
    normal noise adds to what texture contributes, however texture is distributed. A
    median square does not: compressed footage has smooth blocks beside detailed ones,
    and the more noise there is, the more of their mean texture would show.
    """
    variances = np.empty(len(noises))
    deviation = np.array([robust_deviation(noise) for noise in noises])
    for each in np.unique(texture):
        members = np.flatnonzero(texture == each).tolist()
        frequency = 1 / deviation[members].max()
        for k in members:
            mean = np.cos(frequency * noises[k]).mean()
            variances[k] = -2 * np.log(max(mean, MIN_MEAN_COSINE)) / frequency**2
    return variances


def code_step(image: np.ndarray) -> float:
    """The step between neighboring codes of an `image` (H, W, 3): the smallest between
    values that occur, at most that of 8 bits.
    """
    return float(np.diff(np.unique(image)).min(initial=STEP_8_BIT))


def channel_pixels(image: np.ndarray, x: np.ndarray, y: np.ndarray, log_gain: float) -> Pixels:
    """The pixels of an `image` (H, W), but for those at its border; `log_gain` is that
    of its exposure (natural).
    """
    image = np.ascontiguousarray(image, np.float32)
    value = np.linspace(0, 1, 1025)
    log_exposure = np.log(np.maximum(np.interp(value, y, x), MIN_EXPOSURE))
    slope_at_value = np.gradient(log_exposure, value)
    window = np.ones((3, 3), np.uint8)
    clipped = (np.asarray(cv2.erode(image, window)) < LOW) | (
        np.asarray(cv2.dilate(image, window)) > HIGH
    )
    mean = np.asarray(cv2.blur(image, (3, 3)))
    noise = np.asarray(cv2.filter2D(image, -1, KERNEL))
    horizontal = np.asarray(cv2.filter2D(image, -1, GRADIENT))
    vertical = np.asarray(cv2.filter2D(image, -1, np.ascontiguousarray(GRADIENT.T)))
    z = inner(mean)
    slope = np.interp(z, value, slope_at_value)
    of_pixels = np.interp(z, value, log_exposure)
    return Pixels(
        log_exposure=of_pixels,
        log_radiance=of_pixels - log_gain,
        noise=inner(noise) * slope,
        texture=inner(np.hypot(horizontal, vertical)) * slope,
        value=z,
        slope=slope,
        clipped=inner(clipped),
    )


def inner(values: np.ndarray) -> np.ndarray:
    """All `values` (H, W) but those at the border, in a row."""
    return values[1:-1, 1:-1].ravel()


def texture_of(channel: np.ndarray, radiance: np.ndarray) -> np.ndarray:
    """Which of M textures (N,) bins have: every `channel` (N,) and bin of `radiance`
    (N,) has its own.
    """
    _, texture = np.unique(np.stack([channel, radiance]), axis=1, return_inverse=True)
    return texture.ravel()


def texture_columns(bins: NoiseBins) -> np.ndarray:
    """Which bins (N, M) share each of M textures."""
    texture = texture_of(bins.channel, bins.radiance)
    return np.eye(texture.max() + 1)[texture]


def fit_cost(
    bins: NoiseBins,
    power: float,
    read_electrons: float,
    tuning: SensorNoiseTuning = SensorNoiseTuning(),
) -> float:
    """The robust squared error of the best noise with this power and read-out noise:
    twice the sum of sqrt(1 + e^2) - 1 over errors e of log variance in deviations.
    """
    texture = texture_columns(bins)
    deviation = np.sqrt(2.2 / bins.count + tuning.model_error**2)  # 2.2: of normal noise
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
