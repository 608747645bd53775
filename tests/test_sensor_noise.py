"""The common power of exposures comes back from the noise of a simulated sensor."""

from dataclasses import replace

import numpy as np
import pytest

from hdr_nsff.radiometry.bracketing import FACTORS
from hdr_nsff.radiometry.recording import Curve, Noise, record, response_curve
from hdr_nsff.radiometry.sensor_noise import (
    SensorNoiseTuning,
    code_step,
    measure_noise,
    noise_log_likelihood,
    noise_variances,
    robust_deviation,
)

EV = np.array([-2.0, 0.0, 2.0])


NOISE = Noise()


def recordings(
    curve: Curve,
    noise: Noise | None = NOISE,
    texture: np.ndarray | float = 0.0,
) -> list[np.ndarray]:
    """A smooth pattern over five stops, and `texture` in stops on it, recorded with
    three exposures.
    """
    y, x = np.mgrid[:160, :240] / 60
    level = 2 ** (2.5 * np.sin(x + 0.5 * y) - 2.5)
    radiance = level[..., None] * [1.0, 0.8, 0.6]
    rng = np.random.default_rng(0)
    radiance = radiance * 2**texture
    return [record(radiance, ev, (1, 1, 1), curve, noise, rng) for ev in EV]


def log_likelihood(images: list[np.ndarray], curve: Curve, power: float) -> np.ndarray | None:
    """Of every factor, relative to the best, where curve and EVs were measured as their
    power.
    """
    x, y, ev = curve.x**power, curve.y, EV * power
    found = noise_log_likelihood(images, [0, 1, 2], x, y, ev, FACTORS)
    return None if found is None else found - found.max()


@pytest.mark.parametrize("name", ["film", "srgb", "gamma"])
@pytest.mark.parametrize("power", [0.85, 1.0, 1.2])
def test_a_wrong_power_of_the_curve_is_undone(name: str, power: float) -> None:
    curve = response_curve(name)
    found = log_likelihood(recordings(curve), curve, power)
    assert np.interp(1 / power, FACTORS, found) > -4.5  # within three deviations
    assert np.interp(0.7 / power, FACTORS, found) < -5
    assert np.interp(1.5 / power, FACTORS, found) < -5


def test_noise_that_no_sensor_makes_says_nothing() -> None:
    curve = response_curve("film")
    images = recordings(curve, None)
    rng = np.random.default_rng(0)
    noisy = [np.clip(i + rng.normal(0, 0.03, i.shape) * (1 - i), 0, 1) for i in images]
    assert log_likelihood(noisy, curve, 1.0) is None


def test_without_flat_places_nothing_is_measured() -> None:
    curve = response_curve("film")
    images = [np.ones((20, 20, 3), np.float32)] * 3
    assert log_likelihood(images, curve, 1.0) is None
    assert not measure_noise(images, [0, 1, 2], curve.x, curve.y, EV).count.size


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_rounding_is_to_the_codes_that_occur(bits: int) -> None:
    top = 2**bits - 1
    exact = np.random.default_rng(0).random((80, 90, 3))
    image = (np.rint(exact * top) / top).astype(np.float32)
    assert code_step(image) == pytest.approx(1 / top, rel=0.01)
    assert code_step(np.zeros((2, 2, 3), np.float32)) == pytest.approx(1 / 255)


def test_rounding_to_16_bits_counts_as_that() -> None:
    curve, rng = response_curve("gamma"), np.random.default_rng(0)
    coarse = recordings(curve)
    fine = [np.clip(i + rng.uniform(-0.5, 0.5, i.shape) / 255, 0, 1) for i in coarse]
    fine = [(np.rint(i * 65535) / 65535).astype(np.float32) for i in fine]
    of_8, of_16 = (measure_noise(i, [0, 1, 2], curve.x, curve.y, EV) for i in (coarse, fine))
    ratio = np.median(of_8.rounding) / np.median(of_16.rounding)
    assert ratio == pytest.approx((65535 / 255) ** 2, rel=0.2)


def test_measured_noise_is_that_of_the_sensor() -> None:
    curve = response_curve("gamma")
    bins = measure_noise(recordings(curve), [0, 1, 2], curve.x, curve.y, EV)
    exposure = np.exp(bins.log_exposure)
    expected = (NOISE.read**2 + NOISE.shot * exposure) / exposure**2 + bins.rounding
    np.testing.assert_allclose(np.median(bins.variance / expected), 1, atol=0.1)


def blocks() -> np.ndarray:
    """The texture (160, 240, 1) that a codec leaves, in stops: in every third block."""
    rng = np.random.default_rng(1)
    kept = rng.random((20, 30)) < 0.35
    texture = 0.15 * rng.laplace(size=(160, 240))
    return (texture * np.kron(kept, np.ones((8, 8))))[..., None]


@pytest.mark.parametrize("name", ["film", "srgb"])
def test_the_texture_of_compressed_footage_is_no_noise(name: str) -> None:
    curve = response_curve(name)
    found = np.exp(log_likelihood(recordings(curve, texture=blocks()), curve, 1.0))
    mean = np.exp(found @ np.log(FACTORS) / found.sum())
    assert mean == pytest.approx(1, abs=0.05)


def test_normal_noise_adds_to_texture_of_any_kind() -> None:
    rng = np.random.default_rng(0)
    texture = rng.laplace(size=(2, 200_000)) * (rng.random((2, 200_000)) < 0.3)
    noises = [texture[0], texture[1] + 2 * rng.normal(size=200_000)]
    still, noisy = noise_variances(noises, np.zeros(2))
    assert noisy - still == pytest.approx(4, rel=0.02)
    medians = np.array([robust_deviation(noise) for noise in noises])
    assert np.diff(medians**2) > 4.2  # a median counts texture as noise


def test_where_pixels_clip_no_noise_is_measured() -> None:
    """Those that are left have less texture than all."""
    curve = response_curve("gamma")
    images = recordings(curve, texture=3 * blocks())
    careful = SensorNoiseTuning(flat_share=1.0)
    bins = measure_noise(images, [0, 1, 2], curve.x, curve.y, EV, careful)
    careless = replace(careful, max_clipped=1.0)
    more = measure_noise(images, [0, 1, 2], curve.x, curve.y, EV, careless)
    assert 0 < len(bins.count) < len(more.count)
    assert bins.log_exposure.max() < more.log_exposure.max() - 0.3


def test_flat_areas_without_any_noise_are_left_out() -> None:
    """Those of rendered frames differ by the rounding of float32 only."""
    rng = np.random.default_rng(0)
    level = np.kron(rng.uniform(0.2, 1, (6, 8)), np.ones((40, 40)))[..., None].repeat(3, 2)
    flat = np.rint(255 * 0.5 * level) / 255
    noisy = np.rint(255 * np.clip(level + rng.normal(0, 0.02, level.shape), 0, 1)) / 255
    images = [image.astype(np.float32) for image in (noisy, flat) * 3]
    x = np.linspace(0, 1, 256)
    bins = measure_noise(images, [0, 1] * 3, x, np.stack([x] * 3), np.array([0.0, -1] * 3))
    assert len(bins.variance) and (bins.variance > 0).all()
