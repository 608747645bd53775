"""Exposures of brackets from the brightness of whole images."""

import numpy as np
import pytest
from wall import EV, GAMMA22, record

from hdr_nsff.radiometry.brightness import brightness_ev


def test_brightness_alone_gives_gamma_exposures():
    rng = np.random.default_rng(0)
    radiance = 2 ** rng.uniform(-5, 1, (40, 50, 3))
    images = [record(radiance * 2.0**ev, GAMMA22, rng) for ev in EV]
    assert brightness_ev(images, [0, 1, 2], reference=2, num_brackets=3) == pytest.approx(
        EV, abs=0.15
    )
