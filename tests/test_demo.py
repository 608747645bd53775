"""The clip in demo/ is whole, and what this version makes."""

from pathlib import Path

import numpy as np

from hdr_nsff.core import io
from hdr_nsff.scene.truth import Truth
from hdr_nsff.synth.scenes.interior import INTERIOR
from hdr_nsff.synth.views import clip_views, held_out_views


def test_the_demo_is_whole_and_small_enough_for_git() -> None:
    demo = Path(__file__).parents[1] / "demo"
    kept = [
        f for f in demo.rglob("*") if f.is_file() and demo / "out" not in f.parents
    ]  # `make demo` writes its results there
    assert sum(f.stat().st_size for f in kept) < 4_000_000
    frames = np.stack([rgb for rgb, _ in io.read_video(demo / "clip.mp4")])
    assert frames.shape == (36, 136, 240, 3)
    means = frames.mean((1, 2, 3)).reshape(12, 3)
    assert (np.diff(means, axis=1) > 0.1).all()  # dark, middle, bright, over and over
    truth = Truth.open(demo / "truth")
    for view in truth.views:
        assert io.read_exr(demo / "truth" / view.radiance)["RGB"].shape == (136, 240, 3)
        assert 0.02 < io.read_mask(demo / "truth" / str(view.mask)).mean() < 0.15
    np.testing.assert_allclose(
        np.array(truth.clip_c2w), [s.c2w for s in clip_views(INTERIOR, 36, 1, 0)]
    )  # the code still makes this clip
    assert [(v.name, v.time, v.anchor) for v in truth.views] == [
        (s.name, s.time, s.anchor) for s in held_out_views(INTERIOR, 36, 1, 0)
    ]
