"""The step `refined_flow`: flow of movers again, with masks and response known.

Where pixels move, flow is refined from moving pixels alone, on frames brought to one
exposure through the response; where it fails the round trip or is clipped, it is filled
in from its neighborhood. Given flow stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hdr_nsff.core.io import read_npy
from hdr_nsff.core.parallel import map_in_threads
from hdr_nsff.core.stack import ArrayStack, RecentArrays, Stack
from hdr_nsff.geometry.round_trip import RoundTripTuning, valid_flow
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.flow import Pair, flow_files, flow_is_given, stored, write_flow
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.flow.dense import average_with_reverse
from hdr_nsff.priors.flow.local_motion import LocalMotionTuning, fill_uncertain_flow
from hdr_nsff.priors.flow.masked_least_squares import (
    MaskedLeastSquaresTuning,
    refine_mover_flow,
)
from hdr_nsff.radiometry.common_range import common_gray, common_rgb, recorded_range
from hdr_nsff.radiometry.one_exposure import at_one_exposure
from hdr_nsff.scene.response import read_response

VIDEO_MEMORY = 256 << 20  # bytes of frames at one exposure that are kept


@dataclass(frozen=True)
class RefinedFlowTuning:
    """Tuning constants of the parts of this step."""

    least_squares: MaskedLeastSquaresTuning = field(default_factory=MaskedLeastSquaresTuning)
    local_motion: LocalMotionTuning = field(default_factory=LocalMotionTuning)
    round_trip: RoundTripTuning = field(default_factory=RoundTripTuning)


REFINED_FLOW_TUNING = RefinedFlowTuning()


def refine_flow(work: Work) -> StepResult:
    """Refined flow of every pair that was matched, in both directions.

    Each pair is stored at once, so that a killed run keeps it.
    """
    m = work.manifest
    own = [
        (f.index, j) for f in m.frames for j in f.raw_flow if not flow_is_given(work, f.index, j)
    ]
    names = {pair: flow_files("refined_flow", pair) for pair in own}
    flow = {
        f.index: {j: names.get((f.index, j), r) for j, r in f.raw_flow.items()} for f in m.frames
    }
    if not own:
        note = "given flow stays as it is"
        return StepResult(note=note, provenance="given", frames={"flow": flow})
    video, how = equalized(work)
    refiner = Refiner(work, video)

    def refine(pair: Pair) -> None:
        i, j = pair
        if stored(work, names[i, j]) and stored(work, names[j, i]):
            return  # by a run that was killed
        for one, found, valid in refiner.predict_both_directions(i, j):
            write_flow(work, names[one], found, valid)

    map_in_threads(refine, [(i, j) for i, j in own if i < j], "flow of movers")
    note = f"{len(own)} pairs refined inside the moving masks, {how}"
    return StepResult(note=note, frames={"flow": flow})


def equalized(work: Work) -> tuple[ArrayStack, str]:
    """All frames at one brightness (T, H, W, 3): through the response of their camera
    where static points determined it, else by the brackets' brightness; and which.
    """
    m = work.manifest
    assert m.response is not None
    response = read_response(work.folder / m.response, m.num_cameras, m.num_brackets)
    if response.source != "static points":
        return work.equalized[0], "on frames equalized by brightness"
    brackets = np.array([f.bracket for f in m.frames])
    cameras = np.array([f.camera_id for f in m.frames])
    drift = np.array([f.drift or 0.0 for f in m.frames])
    video = at_one_exposure(work.video, brackets, cameras, response, drift)
    recent = RecentArrays(VIDEO_MEMORY)
    kept = Stack(lambda t: recent.get(t, lambda: video[t]), video.shape)
    return kept, "on frames at one exposure through the response"


class Refiner:
    """Refines the flow of one pair of frames at a time."""

    def __init__(
        self, work: Work, video: ArrayStack, tuning: RefinedFlowTuning = REFINED_FLOW_TUNING
    ) -> None:
        """`video` (T, H, W, 3): all frames at one brightness, in [0, 1]."""
        self.work, self.video = work, video
        self.tuning = tuning
        self.clipped = work.equalized[1]
        self.moving = work.masks
        frames = zip(video, self.clipped, strict=True)
        self.ranges = [recorded_range(frame, clipped) for frame, clipped in frames]

    def predict_both_directions(self, i: int, j: int) -> list[tuple[Pair, np.ndarray, np.ndarray]]:
        """((from, to), flow (H, W, 2) px, valid (H, W)) of the pair, there and back."""
        here_rgb, there_rgb = common_rgb(self.video, self.ranges, i, j)
        there = self.least_squares(i, j, here_rgb, there_rgb)
        back = self.least_squares(j, i, there_rgb, here_rgb)
        tolerance = self.tuning.round_trip
        valid_there = valid_flow(there, back, self.clipped[i], self.clipped[j], tolerance)
        valid_back = valid_flow(back, there, self.clipped[j], self.clipped[i], tolerance)
        here_gray, there_gray = common_gray(self.video, self.ranges, i, j)
        filled = (
            fill_uncertain_flow(
                there, back, here_gray, there_gray,
                self.clipped[i], self.clipped[j], self.moving[i],
                self.moving[i] | valid_there, self.tuning.local_motion,
            ),
            fill_uncertain_flow(
                back, there, there_gray, here_gray,
                self.clipped[j], self.clipped[i], self.moving[j],
                self.moving[j] | valid_back, self.tuning.local_motion,
            ),
        )  # fmt: skip
        there, back = filled
        return [
            ((i, j), average_with_reverse(there, back), valid_there),
            ((j, i), average_with_reverse(back, there), valid_back),
        ]

    def least_squares(self, i: int, j: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Flow (H, W, 2) px from frame `i` to `j`, refined inside the moving mask.

        `source` and `target` (H, W, 3) are those frames, cut to their common range.
        """
        files = self.work.manifest.frames[i].raw_flow[j]
        matched = read_npy(self.work.folder / files.flow).astype(np.float32)
        unclipped = self.moving[i] & ~self.clipped[i]
        return refine_mover_flow(source, target, matched, unclipped, self.tuning.least_squares)
