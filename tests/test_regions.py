"""Moving regions that touch, and where flow leads them."""

import numpy as np
from posed_planes import H, W, neighbors

from hdr_nsff.priors.movers.regions import (
    FlowStep,
    flow_steps,
    label_regions,
    link_regions,
    split_regions,
)

TIMES = np.arange(6.0)


def crossing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A large square drifts right in front of a small static one; they touch from frame
    3. Masks (6, H, W), flow, pairs.
    """
    moving, owner = np.zeros((6, H, W), bool), np.zeros((6, H, W), int)
    for t in range(6):
        owner[t, 20:28, 34:44] = 2
        owner[t, 16:32, 10 + 3 * t : 26 + 3 * t] = 1
        moving[t] = owner[t] > 0
    pairs = neighbors(6)
    speed = np.array([0, 3, 0])
    flow = np.zeros((len(pairs), H, W, 2), np.float32)
    for k, (i, j) in enumerate(pairs):
        flow[k, ..., 0] = speed[owner[i]] * (j - i)
    return moving, flow, pairs


def steps_of(flow: np.ndarray, pairs: np.ndarray) -> list[FlowStep]:
    """The steps of flow that is valid everywhere."""
    return flow_steps(TIMES, flow, np.ones(flow.shape[:3], bool), pairs)


def test_regions_are_followed_and_touching_ones_stay_two() -> None:
    moving, flow, pairs = crossing()
    labels, steps = label_regions(moving), steps_of(flow, pairs)
    assert labels[2].max() == 2 and labels[3].max() == 1
    split_regions(labels, steps)
    assert labels[3].max() == 2
    longest = max(link_regions(labels, TIMES, steps), key=lambda track: len(track.frames))
    assert longest.frames == [0, 1, 2, 3, 4, 5] and np.allclose(longest.motions[0], [3, 0])


def test_a_region_that_does_not_flow_back_is_another_object() -> None:
    moving, flow, pairs = crossing()
    flow[1::2] = 40.0  # all backward flow leads elsewhere
    tracks = link_regions(label_regions(moving), TIMES, steps_of(flow, pairs))
    assert all(len(track.frames) == 1 for track in tracks)


def test_a_step_leads_to_the_nearest_later_frame_with_flow_back() -> None:
    pairs = np.array([(0, 2), (2, 0), (0, 1), (1, 0), (1, 2), (2, 3), (3, 2)])
    flow = np.arange(len(pairs), dtype=np.float32)[:, None, None, None] * np.ones((H, W, 2))
    steps = steps_of(flow, pairs)
    assert [(step.start, step.end) for step in steps] == [(0, 1), (2, 3)]
    assert steps[0].flow[0, 0, 0] == 2 and steps[0].back[0, 0, 0] == 3
