"""Clips in which the picture cuts: the longest part is measured."""

from pathlib import Path

import numpy as np
from test_check import FRAMES, clip_of, measured, still_scene

from hdr_nsff.check.findings import judge, outlook
from hdr_nsff.check.picture import draw
from hdr_nsff.core.images import read_image


def test_a_cut_is_found(tmp_path: Path) -> None:
    def cut(t: int) -> np.ndarray:
        return still_scene(t) if t < 5 else still_scene(t)[:, ::-1]

    facts, _, _ = measured(clip_of(tmp_path, cut, [0.0] * FRAMES))
    assert facts.camera.cuts == (5,)


def test_of_a_clip_with_cuts_the_longest_part_is_measured(tmp_path: Path) -> None:
    def cut(t: int) -> np.ndarray:
        warm = still_scene(t)[:, ::-1] * (1.5, 1.0, 0.6)
        return 0.4 * warm if t < 6 else still_scene(t)

    evs = [-2.0 * (t % 2) for t in range(26) if t != 19]
    facts, video, brackets = measured(clip_of(tmp_path, cut, evs))
    assert facts.camera.cuts == (6,) and facts.measured == (6, 25)
    assert facts.looked_at == 25 and len(video) == len(brackets) == 19
    assert facts.exposure.drift_ev < 0.1 and facts.exposure.color_drift_ev < 0.1
    assert facts.exposure.missing_before == (19,)
    (said,) = [finding for finding in judge(facts) if finding.subject == "cuts"]
    assert said.text == (
        "the first 25 frames are cut at frame 6; exposures and camera are those of frames 6 to 24"
    )
    draw(tmp_path / "seen.png", facts, video, brackets, outlook(facts), judge(facts))
    assert read_image(tmp_path / "seen.png").std() > 0.1
