"""Textures of the synthetic scenes are physical."""

import numpy as np

from hdr_nsff.synth import textures


def test_textures_are_physical_albedos_and_the_seed_repeats_them() -> None:
    for paint in (
        textures.bricks,
        textures.planks,
        textures.tiles,
        textures.poster,
        textures.books,
    ):
        a, b = (paint(60, 80, np.random.default_rng(3)) for _ in range(2))
        assert a.shape == (60, 80, 3) and a.dtype == np.float32
        assert a.min() > 0 and a.max() <= 0.82 and a.std() > 0.05
        np.testing.assert_array_equal(a, b)
