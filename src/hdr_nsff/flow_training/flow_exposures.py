"""Pairs of known flow as an alternating-exposure camera would have recorded them.

They get random exposures, responses, noise, white balance and crops. All randomness
comes from the generator that is passed in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hdr_nsff.flow_training.flow_sets import Sample
from hdr_nsff.priors.flow.networks import resize_flow, resize_images, working_size
from hdr_nsff.radiometry.common_range import LUMA, common_rgb, recorded_range
from hdr_nsff.radiometry.exposure_cycle import equalize
from hdr_nsff.radiometry.recording import POINTS, Curve, Noise, film, record, response_curve

# The cameras that record the pairs. All numbers are hand-chosen: the range of consumer
# cameras and a margin.
MIDDLE_GRAY = 0.18  # sensor exposure of the median of a pair, on average
MIDDLE_RANGE_EV = 1.0  # largest distance from it, in either direction
MIN_RADIANCE = 1e-6  # linear HDR, so that the EV of a black pair is finite
# share of pairs brought to a common brightness, as `prepare` matches them; the others
# stay as recorded
EQUALIZED_SHARE = 0.75
WHITE_BALANCE_SPREAD = 0.1  # standard deviation of the log of each channel's gain
NOISE_RANGE_LOG2 = (-1.0, 2.0)  # log2 of the noise relative to `Noise`
GAMMA_RANGE = (1.7, 2.6)  # parameters of `film`
CONTRAST_RANGE = (0.0, 0.5)
LIFT_RANGE = (0.0, 0.2)
CHANNEL_GAMMA_SPREAD = 0.03  # standard deviation of the log of a channel's gamma
CHANNEL_RANGE = (0.8, 1.2)  # factors on a channel's contrast and lift
ZOOM_RANGE = (0.8, 1.25)  # factors on the size at which a pair is matched
MIN_KNOWN_SHARE = 0.999  # of a resampled pixel whose flow counts as known


@dataclass(frozen=True)
class Example:
    """What a network is trained on: a pair batch, and the flow to predict."""

    images: Tensor  # (2, 3, h, w) in [0, 1]
    flow: Tensor  # (2, 2, h, w) px of that size
    known: Tensor  # (2, h, w) bool


@dataclass(frozen=True)
class PairCamera:
    """How a pair is recorded."""

    evs: np.ndarray  # (2,)
    white: np.ndarray  # (3,) gains
    curve: Curve
    noise: float  # relative to `Noise`


def record_middle_pair(radiance: np.ndarray, stops: float, equal: bool) -> np.ndarray:
    """A pair (2, H, W, 3) recorded `stops` EV apart by one fixed camera, to measure on.

    `radiance` (2, H, W, 3) is exposed around its own middle; `equal` brings both
    pictures to a common brightness.
    """
    evs = middle_ev(radiance) + np.array([-0.5, 0.5]) * stops
    camera = PairCamera(evs, np.ones(3), response_curve("film"), 1.0)
    return record_pair(radiance, camera, np.random.default_rng(0), equal)


def training_example(
    sample: Sample, stops: float, size: tuple[int, int], rng: np.random.Generator
) -> Example:
    """A random crop of a pair, recorded up to `stops` EV apart by a random camera.

    The crop is of `size` (h, w), at about the scale at which `prepare` matches frames.
    """
    apart = rng.uniform(-stops, stops)
    around = middle_ev(sample.radiance) + rng.uniform(-MIDDLE_RANGE_EV, MIDDLE_RANGE_EV)
    white = np.exp(rng.normal(0, WHITE_BALANCE_SPREAD, 3))
    noise = 2.0 ** rng.uniform(*NOISE_RANGE_LOG2)
    evs = around + np.array([-0.5, 0.5]) * apart
    camera = PairCamera(evs, white, random_curve(rng), noise)
    equal = rng.random() < EQUALIZED_SHARE
    images = record_pair(sample.radiance, camera, rng, equal)
    return random_crop(images, sample, size, rng)


def middle_ev(radiance: np.ndarray) -> float:
    """The EV at which the median of `radiance` (..., 3) becomes `MIDDLE_GRAY`."""
    median = max(float(np.median(radiance @ LUMA)), MIN_RADIANCE)
    return float(np.log2(MIDDLE_GRAY / median))


def record_pair(
    radiance: np.ndarray, camera: PairCamera, rng: np.random.Generator, equal: bool
) -> np.ndarray:
    """`radiance` (2, H, W, 3) as a camera records it, in [0, 1].

    `equal` brings both pictures to a common brightness.
    """
    sensor = Noise(Noise.read * camera.noise, Noise.shot * camera.noise)
    white = tuple(camera.white)
    pictures = [
        record(r, ev, white, camera.curve, sensor, rng)
        for r, ev in zip(radiance, camera.evs, strict=True)
    ]
    video = np.stack(pictures)
    if not equal:
        return video
    frames, clipped = equalize(video, [0, 1])
    ranges = [recorded_range(f, c) for f, c in zip(frames, clipped, strict=True)]
    return np.stack(common_rgb(frames, ranges, 0, 1))


def random_curve(rng: np.random.Generator) -> Curve:
    """A response curve from the family of `film`, slightly different per channel."""
    gamma = rng.uniform(*GAMMA_RANGE)
    contrast = rng.uniform(*CONTRAST_RANGE)
    lift = rng.uniform(*LIFT_RANGE)
    gammas = gamma * np.exp(rng.normal(0, CHANNEL_GAMMA_SPREAD, 3))
    contrasts = contrast * rng.uniform(*CHANNEL_RANGE, 3)
    lifts = lift * rng.uniform(*CHANNEL_RANGE, 3)
    x = np.linspace(0, 1, POINTS) ** 2.2
    channels = [film(x, g, c, s) for g, c, s in zip(gammas, contrasts, lifts, strict=True)]
    return Curve(x, np.stack(channels))


def random_crop(
    images: np.ndarray, sample: Sample, size: tuple[int, int], rng: np.random.Generator
) -> Example:
    """A random part of a pair (2, H, W, 3), mirrored at random and of `size` (h, w)."""
    height, width = images.shape[1:3]
    prepare_zoom = working_size(height, width)[1] / width
    smallest_zoom = max(size[0] / height, size[1] / width)
    zoom = max(prepare_zoom * rng.uniform(*ZOOM_RANGE), smallest_zoom)
    h = min(height, round(size[0] / zoom))
    w = min(width, round(size[1] / zoom))
    y = rng.integers(height - h + 1)
    x = rng.integers(width - w + 1)

    def crop(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array[:, y : y + h, x : x + w].copy())

    rgb = resize_images(crop(images).permute(0, 3, 1, 2).float(), size)
    flow = resize_flow(crop(sample.flow).permute(0, 3, 1, 2), size)
    share = functional.interpolate(crop(sample.known)[:, None].float(), size=size, mode="area")
    known = share[:, 0] > MIN_KNOWN_SHARE
    for axis, channel in ((-1, 0), (-2, 1)):
        if rng.random() < 0.5:
            rgb = rgb.flip(axis)
            flow = flow.flip(axis)
            known = known.flip(axis)
            flow[:, channel] *= -1
    return Example(rgb, flow, known)
