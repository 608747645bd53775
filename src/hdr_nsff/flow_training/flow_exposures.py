"""Pairs of known flow as an alternating-exposure camera would have recorded them: other
exposures, responses, noise, white balance, and crops. All randomness comes from the
generator that is handed in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hdr_nsff.flow_training.flow_sets import Sample
from hdr_nsff.priors.flow.networks import resized, resized_flow, working_size
from hdr_nsff.radiometry.common_range import LUMA, common_rgb, recorded_range
from hdr_nsff.radiometry.exposure_cycle import equalize
from hdr_nsff.radiometry.recording import POINTS, Curve, Noise, film, record, response_curve

MIDDLE = 0.18  # sensor exposure that the median of a pair gets, give or take
EQUALIZED = 0.75  # the share of pairs seen as `prepare` shows them; the others as recorded


@dataclass(frozen=True)
class Example:
    """What a network is trained on: a pair batch, and what it should say of it."""

    images: Tensor  # (2, 3, h, w) in [0, 1]
    flow: Tensor  # (2, 2, h, w) px of that size
    known: Tensor  # (2, h, w) bool


def recorded_pair(radiance: np.ndarray, stops: float, equal: bool) -> np.ndarray:
    """A pair (2, H, W, 3) recorded `stops` EV apart around its own middle by one fixed
    camera, to measure on.
    """
    return seen(
        radiance,
        middle(radiance) + np.array([-0.5, 0.5]) * stops,
        np.ones(3),
        response_curve("film"),
        1.0,
        np.random.default_rng(0),
        equal,
    )


def example(
    sample: Sample, stops: float, size: tuple[int, int], rng: np.random.Generator
) -> Example:
    """A random crop of `size` (h, w) of a pair recorded up to `stops` EV apart by a
    random camera, at about the size it is matched at.
    """
    apart = rng.uniform(-stops, stops)
    around = middle(sample.radiance) + rng.uniform(-1, 1)
    white = np.exp(rng.normal(0, 0.1, 3))
    noise = 2.0 ** rng.uniform(-1, 2)
    images = seen(
        sample.radiance,
        around + np.array([-0.5, 0.5]) * apart,
        white,
        random_curve(rng),
        noise,
        rng,
        rng.random() < EQUALIZED,
    )
    return cropped(images, sample, size, rng)


def middle(radiance: np.ndarray) -> float:
    """The EV at which the median of `radiance` (..., 3) becomes `MIDDLE`."""
    return float(np.log2(MIDDLE / max(float(np.median(radiance @ LUMA)), 1e-6)))


def seen(
    radiance: np.ndarray,
    evs: np.ndarray,
    white: np.ndarray,
    curve: Curve,
    noise: float,
    rng: np.random.Generator,
    equal: bool,
) -> np.ndarray:
    """`radiance` (2, H, W, 3) recorded at `evs` (2,), and then brought to a common
    brightness where `equal`; (2, H, W, 3) in [0, 1].
    """
    sensor = Noise(Noise.read * noise, Noise.shot * noise)
    video = np.stack(
        [
            record(r, ev, tuple(white), curve, sensor, rng)
            for r, ev in zip(radiance, evs, strict=True)
        ]
    )
    if not equal:
        return video
    frames, clipped = equalize(video, [0, 1])
    ranges = [recorded_range(f, c) for f, c in zip(frames, clipped, strict=True)]
    return np.stack(common_rgb(frames, ranges, 0, 1))


def random_curve(rng: np.random.Generator) -> Curve:
    """A response curve from the family that `film` spans, every channel a little
    different.
    """
    gamma, contrast, lift = rng.uniform(1.7, 2.6), rng.uniform(0, 0.5), rng.uniform(0, 0.2)
    x = np.linspace(0, 1, POINTS) ** 2.2
    each = zip(
        gamma * np.exp(rng.normal(0, 0.03, 3)),
        contrast * rng.uniform(0.8, 1.2, 3),
        lift * rng.uniform(0.8, 1.2, 3),
        strict=True,
    )
    return Curve(x, np.stack([film(x, *channel) for channel in each]))


def cropped(
    images: np.ndarray, sample: Sample, size: tuple[int, int], rng: np.random.Generator
) -> Example:
    """A random place of a pair (2, H, W, 3), enlarged or shrunk to `size` and mirrored
    at random.
    """
    height, width = images.shape[1:3]
    usual = working_size(height, width)[1] / width * rng.uniform(0.8, 1.25)
    zoom = max(usual, size[0] / height, size[1] / width)
    h, w = min(height, round(size[0] / zoom)), min(width, round(size[1] / zoom))
    y, x = rng.integers(height - h + 1), rng.integers(width - w + 1)
    rgb, flow, known = (
        torch.from_numpy(v[:, y : y + h, x : x + w].copy())
        for v in (images, sample.flow, sample.known)
    )
    rgb, flow = (
        resized(rgb.permute(0, 3, 1, 2).float(), size),
        resized_flow(flow.permute(0, 3, 1, 2), size),
    )
    known = functional.interpolate(known[:, None].float(), size=size, mode="area")[:, 0] > 0.999
    for axis, channel in ((-1, 0), (-2, 1)):
        if rng.random() < 0.5:
            rgb, flow, known = rgb.flip(axis), flow.flip(axis), known.flip(axis)
            flow[:, channel] *= -1
    return Example(rgb, flow, known)
