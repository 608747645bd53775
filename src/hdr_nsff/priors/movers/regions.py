"""Connected moving regions, followed through time by flow.

Regions of a moving mask become objects: two that pass in front of each other are split
by their motions, and a region is linked to the one that its flow leads to and comes
back from.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.priors.movers.tuning import MOVER_DISTANCE_TUNING, MoverDistanceTuning


@dataclass
class RegionTrack:
    """One moving region through time."""

    frames: list[int] = field(default_factory=list)
    labels: list[int] = field(default_factory=list)  # of the region in each frame
    # (2,) px to the next frame of the track, None where unknown
    motions: list[np.ndarray | None] = field(default_factory=list)
    # log of the growth in the picture from frame to frame, None where unknown
    growths: list[float | None] = field(default_factory=list)


@dataclass(frozen=True)
class FlowStep:
    """Flow from frame `start` to frame `end` and back."""

    start: int
    end: int
    flows: ArrayStack  # (P, H, W, 2) px, of all pairs
    valids: ArrayStack  # (P, H, W) bool
    forward: int  # the pair from `start` to `end`
    backward: int  # the pair from `end` to `start`

    @property
    def flow(self) -> np.ndarray:
        """(H, W, 2) px from `start` to `end`."""
        return self.flows[self.forward]

    @property
    def valid(self) -> np.ndarray:
        """(H, W) bool."""
        return self.valids[self.forward]

    @property
    def back(self) -> np.ndarray:
        """(H, W, 2) px from `end` to `start`."""
        return self.flows[self.backward]

    @property
    def back_valid(self) -> np.ndarray:
        """(H, W) bool."""
        return self.valids[self.backward]

    def reversed(self) -> FlowStep:
        """The same step in the other direction."""
        return replace(
            self,
            start=self.end,
            end=self.start,
            forward=self.backward,
            backward=self.forward,
        )


@dataclass(frozen=True)
class Arrival:
    """A region of one frame that lands on a region of another."""

    label: int
    motion: np.ndarray  # (2,) px
    pixels: np.ndarray  # (H, W) bool in the other frame


def label_regions(
    moving: np.ndarray, tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING
) -> np.ndarray:
    """Labels (T, H, W) of the connected regions of `moving` (T, H, W), per frame.

    0 is static or in a region too small.
    """
    labels = np.zeros(moving.shape, np.uint16)
    for frame, result in zip(moving, labels, strict=True):
        _, components, stats, _ = cv2.connectedComponentsWithStats(
            frame.astype(np.uint8), connectivity=8
        )
        large = stats[:, cv2.CC_STAT_AREA] >= tuning.min_region_share * frame.size
        large[0] = False
        new_labels = np.cumsum(large) * large
        result[:] = new_labels[components]
    return labels


def flow_steps(
    times: np.ndarray, flow: ArrayStack, valid: ArrayStack, pairs: np.ndarray
) -> list[FlowStep]:
    """From each frame the step to the nearest later one, in order of time.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) are of `pairs` (P, 2) of frames, whose
    `times` are (T,). Only pairs with flow in both directions count.
    """
    index = {(int(i), int(j)): k for k, (i, j) in enumerate(pairs)}
    next_frame: dict[int, int] = {}
    for i, j in index:
        if times[j] <= times[i] or (j, i) not in index:
            continue
        if i not in next_frame or times[j] < times[next_frame[i]]:
            next_frame[i] = j
    steps = []
    for i, j in sorted(next_frame.items(), key=lambda pair: times[pair[0]]):
        steps.append(FlowStep(i, j, flow, valid, index[i, j], index[j, i]))
    return steps


def landing_mask(region: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """The pixels (H, W) of the other frame on which those of `region` (H, W) land."""
    y, x = np.nonzero(region)
    other_x = np.rint(x + flow[y, x, 0]).astype(int)
    other_y = np.rint(y + flow[y, x, 1]).astype(int)
    height, width = region.shape
    inside = (other_x >= 0) & (other_y >= 0) & (other_x < width) & (other_y < height)
    result = np.zeros_like(region)
    result[other_y[inside], other_x[inside]] = True
    return result


def landing_region(
    region: np.ndarray,
    flow: np.ndarray,
    other_labels: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> int:
    """The region of the other frame on which most of `region` (H, W) lands.

    0 where less than a third of it does.
    """
    votes = np.bincount(other_labels[landing_mask(region, flow)], minlength=1)
    votes[0] = 0
    best = int(votes.argmax())
    return best if votes[best] > tuning.min_landing_share * region.sum() else 0


def split_regions(
    labels: np.ndarray,
    steps: list[FlowStep],
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> None:
    """Split, in place, regions of `labels` (T, H, W) that different motions flow into.

    So objects that pass in front of each other remain two. `steps` are in the order of
    propagation. A part counts where it also flows back to where it came from.
    """
    min_pixels = tuning.min_region_share * labels[0].size
    for step in steps:
        here, there = labels[step.start], labels[step.end]
        for target, arrivals in arrivals_by_region(here, there, step, tuning).items():
            parts = different_motions(arrivals, tuning)
            owner = nearest_part(parts)
            for k, part in enumerate(parts[1:], start=1):
                own = (there == target) & (owner == k)
                large = own.sum() >= min_pixels
                if large and landing_region(own, step.back, here, tuning) == part.label:
                    there[own] = there.max() + 1


def arrivals_by_region(
    here: np.ndarray,
    there: np.ndarray,
    step: FlowStep,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> dict[int, list[Arrival]]:
    """The regions of `here` (H, W) that land on each region of `there` (H, W)."""
    min_pixels = tuning.min_region_share * here.size
    arrivals: dict[int, list[Arrival]] = {}
    for label in range(1, here.max() + 1):
        region = here == label
        valid = region & step.valid
        if valid.sum() < min_pixels:
            continue
        target = landing_region(region, step.flow, there, tuning)
        if target:
            motion = np.median(step.flow[valid], axis=0)
            arrival = Arrival(label, motion, landing_mask(valid, step.flow))
            arrivals.setdefault(target, []).append(arrival)
    return arrivals


def different_motions(
    arrivals: list[Arrival], tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING
) -> list[Arrival]:
    """The largest arrival, and those that move differently from it, by size."""
    largest, *others = sorted(arrivals, key=lambda arrival: -int(arrival.pixels.sum()))
    return [largest] + [
        other
        for other in others
        if np.linalg.norm(other.motion - largest.motion) > tuning.min_motion_difference_px
    ]


def nearest_part(parts: list[Arrival]) -> np.ndarray:
    """The index (H, W) of the part whose pixels are nearest."""
    distances = [
        cv2.distanceTransform((~part.pixels).astype(np.uint8), cv2.DIST_L2, 3) for part in parts
    ]
    return np.argmin(distances, axis=0)


def region_core(
    region: np.ndarray, tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING
) -> np.ndarray:
    """The inner half of a region (H, W).

    Masks are generous, so that their outer pixels show the background.
    """
    padded = np.pad(region, 1).astype(np.uint8)
    inset = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
    return region & (inset >= tuning.core_share * inset.max())


def region_motion(
    step: FlowStep,
    here: np.ndarray,
    there: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> np.ndarray | None:
    """Motion (2,) px of a region with masks `here` and `there`, both (H, W).

    It is the median of its flow and its negated backward flow; None where too little
    of them is valid.
    """
    here, there = region_core(here, tuning), region_core(there, tuning)
    forward = step.flow[here & step.valid]
    backward = step.back[there & step.back_valid]
    samples = np.concatenate([forward, -backward])
    if len(samples) < tuning.min_valid_share * (here.sum() + there.sum()):
        return None
    return np.median(samples, axis=0)


def region_growth(
    step: FlowStep,
    here: np.ndarray,
    there: np.ndarray,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> float | None:
    """Log of the scale between a region with masks `here` and `there`, both (H, W).

    The mean of the scales of its flow and of its inverse backward flow, each by the
    similarity with the least median of squares; None where too little is valid.
    """
    forward = flow_scale(step.flow, region_core(here, tuning) & step.valid, tuning)
    backward = flow_scale(step.back, region_core(there, tuning) & step.back_valid, tuning)
    if forward is None or backward is None:
        return None
    return float(np.log(forward) - np.log(backward)) / 2


def flow_scale(
    flow: np.ndarray, pixels: np.ndarray, tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING
) -> float | None:
    """Scale of the similarity that fits `flow` (H, W, 2) at `pixels` (H, W) best."""
    y, x = np.nonzero(pixels)
    stride = max(1, len(y) // tuning.max_scale_points)
    y, x = y[::stride], x[::stride]
    if len(y) < tuning.min_scale_points:
        return None
    start = np.stack([x, y], -1).astype(np.float32)
    similarity, _ = cv2.estimateAffinePartial2D(start, start + flow[y, x], method=cv2.LMEDS)
    if similarity is None:
        return None
    return float(np.hypot(*similarity[:, 0])) or None


def link_regions(
    labels: np.ndarray,
    times: np.ndarray,
    steps: list[FlowStep],
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> list[RegionTrack]:
    """Tracks of the regions of `labels` (T, H, W) at `times` (T,).

    Flow must lead to the next region and back. Where two regions flow into one, the
    larger one continues and the other one ends.
    """
    step_from = {step.start: step for step in steps}
    tracks: list[RegionTrack] = []
    current: dict[tuple[int, int], RegionTrack] = {}
    for frame in np.argsort(times, kind="stable").tolist():
        areas = np.bincount(labels[frame].reshape(-1))
        present = np.nonzero(areas[1:])[0] + 1
        for label in sorted(present.tolist(), key=lambda n: -int(areas[n])):
            region_track = current.get((frame, label))
            if region_track is None:
                region_track = RegionTrack()
                tracks.append(region_track)
            region_track.frames.append(frame)
            region_track.labels.append(label)
            motion = growth = None
            if frame in step_from:
                step = step_from[frame]
                target, motion = next_region(labels, step, label, tuning)
                if target:
                    here, there = labels[frame] == label, labels[step.end] == target
                    growth = region_growth(step, here, there, tuning)
                    if (step.end, target) not in current:
                        current[step.end, target] = region_track
            region_track.motions.append(motion)
            region_track.growths.append(growth)
    return tracks


def next_region(
    labels: np.ndarray,
    step: FlowStep,
    label: int,
    tuning: MoverDistanceTuning = MOVER_DISTANCE_TUNING,
) -> tuple[int, np.ndarray | None]:
    """The label at the step's end of the region `label`, and its motion (2,) px there.

    The label is 0 where flow does not lead there and back. A region of unknown motion
    must also keep its area; otherwise it may be another object.
    """
    here = labels[step.start] == label
    target = landing_region(here, step.flow, labels[step.end], tuning)
    if not target:
        return 0, None
    there = labels[step.end] == target
    if landing_region(there, step.back, labels[step.start], tuning) != label:
        return 0, None
    motion = region_motion(step, here, there, tuning)
    growth = there.sum() / here.sum()
    if motion is None and not 1 / tuning.max_growth < growth < tuning.max_growth:
        return 0, None
    return target, motion
