"""What a shutter lets a traced frame see, with a tracer whose picture is its time."""

from types import SimpleNamespace

import numpy as np
import pytest

from hdr_nsff.synth.scenes.interior import INTERIOR
from hdr_nsff.synth.shutter import BANDS, Exposure, exposures, trace_exposure
from hdr_nsff.synth.views import TracedView, clip_views

SIZE = (4, 24)
VIEW = TracedView("clip_00003", 3.0, np.eye(3, 4), 64, 5, anchor=3)
SCENE = SimpleNamespace(pose=lambda views, t: np.full((3, 4), t))


def clock(time, K, pose, size, spp, seed, rows):
    """Rows of the squared time, by a camera that is where it should be."""
    assert (pose == time).all()
    return np.full((rows[1] - rows[0], size[0], 3), time**2, np.float32)


def seen(exposure: Exposure) -> np.ndarray:
    tracer = SimpleNamespace(radiance=clock)
    return trace_exposure(tracer, SCENE, VIEW, np.eye(3), SIZE, "mono", exposure)


def test_every_row_is_traced_at_its_time() -> None:
    rows = seen(Exposure(0.6, 0.0))[:, 0, 0]
    exact = (3.0 + 0.6 * ((np.arange(24) + 0.5) / 24 - 0.5)) ** 2
    assert np.abs(rows - exact).max() <= 6.5 * 0.6 / BANDS / 2


def test_an_open_shutter_sees_the_mean_over_its_time() -> None:
    assert seen(Exposure(0.0, 0.9)) == pytest.approx(9 + 0.9**2 / 12, abs=2e-3)


def test_a_camera_of_a_rig_stays_in_its_place_while_its_rows_are_read() -> None:
    """Over more than a frame's time, where other cameras of the rig record."""
    view = clip_views(INTERIOR, 12, 64, 0, "rig")[3]

    def distance(time, K, pose, size, spp, seed, rows):
        away = np.abs(pose - view.c2w).max()
        return np.full((rows[1] - rows[0], size[0], 3), away, np.float32)

    tracer = SimpleNamespace(radiance=distance)
    exposure = Exposure(1.44, 0.5)
    assert not trace_exposure(tracer, INTERIOR, view, np.eye(3), SIZE, "rig", exposure).any()


def test_no_shutter_is_none_and_darker_exposures_are_shorter() -> None:
    assert exposures(0.0, 0.0, [-4.0, -2.0], 24.0) is None
    found = exposures(10.0, 0.5, [-2.0, 0.0], 20.0)
    assert found == [Exposure(0.2, 0.125), Exposure(0.2, 0.5)]
