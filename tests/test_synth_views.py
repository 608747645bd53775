"""Which pictures `synth` renders."""

import numpy as np
import pytest

from hdr_nsff.synth.scenes.interior import INTERIOR
from hdr_nsff.synth.views import clip_views, held_out_views


def test_held_out_views_are_never_frames_of_the_clip() -> None:
    clip = clip_views(INTERIOR, 36, 1, 0)
    views = held_out_views(INTERIOR, 36, 1, 0)
    assert [v.name.split("_")[0] for v in views] == ["view"] * 8 + ["time"] * 6 + ["off"] * 2
    for view in views:
        same_time = [c for c in clip if c.time == view.time]
        assert all(np.abs(c.c2w - view.c2w).max() > 0.01 for c in same_time)
        at_anchor = np.linalg.norm(view.c2w[:, 3] - clip[view.anchor].c2w[:, 3])
        assert (0.02 < at_anchor < 0.1) if view.off_path else at_anchor == 0
    assert len({v.seed for v in clip + views}) == len(clip + views) == 52


def test_frame_i_of_a_rig_is_what_camera_i_modulo_nine_records() -> None:
    for t, view in enumerate(clip_views(INTERIOR, 20, 1, 0, "rig")):
        assert view.time == t and view.anchor == t
        np.testing.assert_allclose(view.c2w[:, 3], INTERIOR.rig[t % 9])


@pytest.mark.parametrize("frames", [12, 36])
def test_a_rig_holds_out_other_cameras_than_the_one_that_records_then(frames: int) -> None:
    clip = clip_views(INTERIOR, frames, 1, 0, "rig")
    views = held_out_views(INTERIOR, frames, 1, 0, "rig")
    assert len({v.name for v in views}) == 16
    assert sum(v.time % 1 == 0.5 for v in views) == 6
    for view in views:
        recording = clip[int(view.time)]
        apart = np.linalg.norm(view.c2w[:, 3] - recording.c2w[:, 3])
        assert (0.02 < apart < 0.1) if view.off_path else apart > 0.3
        assert view.off_path or np.array_equal(view.c2w, clip[view.anchor].c2w)
    if frames == 36:  # enough for a view from every camera
        assert len({v.anchor % 9 for v in views}) == 9
