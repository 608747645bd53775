"""Bundle adjustment of one mover: its shape and rigid motion from tracks in cameras
with known poses.

A body that turns, or that a moving camera passes, shows its depth relief as a static
scene does. Only its distance as a whole remains a matter of priors
(`bundle_problem.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hdr_nsff.priors.movers.bundle_problem import BundleProblem, BundleState, Cameras
from hdr_nsff.priors.movers.depth_reversal import undo_depth_reversals
from hdr_nsff.priors.movers.rigid_motion import RigidGroup
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import BUNDLE_TUNING, BundleTuning


@dataclass(frozen=True)
class MoverShape:
    """A group with the canonical point of each of its tracks."""

    group: RigidGroup
    points: np.ndarray  # (N, 3) canonical, scene units; NaN where unknown
    # median reprojection error in its standard deviations; inf where there is no point
    error: float


def adjust_bundle(
    tracks: Tracks,
    group: RigidGroup,
    cameras: Cameras,
    tuning: BundleTuning = BUNDLE_TUNING,
    near: MoverShape | None = None,
) -> MoverShape:
    """The shape and motion that best explain the pixels of a group's tracks.

    Times before the first and after the last visible one, and in long gaps, are left
    out of the solution, which they would only slow down, and interpolated. `near` is
    the shape of about the same tracks.
    """
    visible = (tracks.trust[group.members] > 0).any(0)
    times = times_of_solution(visible, tuning.max_gap_times)
    view, seen = tracks.at(times), cameras.at(times)
    if near is not None:
        known = replace(near, group=near.group.at(times))
        shape = continue_adjustment(view, group.at(times), seen, times, known, tuning)
    else:
        shape = adjust_visible_times(view, group.at(times), seen, times, tuning)
    return replace(shape, group=shape.group.over_all_times(times, group.known))


def times_of_solution(visible: np.ndarray, max_gap: int) -> np.ndarray:
    """The times (S,) from the first `visible` (T,) one to the last, without gaps of
    more than `max_gap`; all where none is visible.
    """
    seen = np.nonzero(visible)[0]
    if not len(seen):
        return np.arange(len(visible))
    parts = np.split(seen, np.nonzero(np.diff(seen) > max_gap + 1)[0] + 1)
    return np.concatenate([np.arange(part[0], part[-1] + 1) for part in parts])


def continue_adjustment(
    tracks: Tracks,
    group: RigidGroup,
    cameras: Cameras,
    times: np.ndarray,
    near: MoverShape,
    tuning: BundleTuning = BUNDLE_TUNING,
) -> MoverShape:
    """The shape of a group, found from the one of nearly the same tracks.

    Depth is not reversed again. The other arguments are those of
    `adjust_visible_times`.
    """
    start = replace(near.group, members=group.members, known=group.known)
    problem = problem_of(tracks, start, cameras, times, tuning)
    if problem.usable.sum() < tuning.min_tracks:
        return MoverShape(start, np.full((len(start.members), 3), np.nan), np.inf)
    state = BundleState(problem.start, start.rotations, start.translations)
    points = problem.points_on_rays(state)
    known = np.full((len(tracks.trust), 3), np.nan)
    known[near.group.members] = near.points - start.center
    known = known[problem.members]
    state = replace(state, points=np.where(np.isfinite(known), known, points))
    state, _ = problem.minimize(state, tuning.iterations)
    return finish_adjustment(tracks, start, cameras, times, problem, state)


def adjust_visible_times(
    tracks: Tracks,
    group: RigidGroup,
    cameras: Cameras,
    times: np.ndarray,
    tuning: BundleTuning = BUNDLE_TUNING,
) -> MoverShape:
    """The shape of a group that is visible at the first and the last of its `times`
    (S,) in the clip.

    The solution starts from the group's motion and from its path without rotation; the
    better result counts.
    """
    solutions = []
    for start in (group, path_without_rotation(tracks, group, tuning)):
        problem = problem_of(tracks, start, cameras, times, tuning)
        if problem.usable.sum() < tuning.min_tracks:
            continue
        first = BundleState(problem.start, start.rotations, start.translations)
        state, cost = problem.minimize(first, tuning.iterations)
        solutions.append((cost, state, problem, start))
    if not solutions:
        return MoverShape(group, np.full((len(group.members), 3), np.nan), np.inf)
    cost, state, problem, start = min(solutions, key=lambda solution: solution[0])
    state = undo_depth_reversals(problem, state, cost)
    return finish_adjustment(tracks, start, cameras, times, problem, state)


def problem_of(
    tracks: Tracks, group: RigidGroup, cameras: Cameras, times: np.ndarray, tuning: BundleTuning
) -> BundleProblem:
    """The problem of the tracks that poses are estimated from."""
    visible = tracks.trust[group.members] > 0
    chosen = group.members[longest_tracks(visible, tuning.max_tracks)]
    return BundleProblem(tracks, replace(group, members=chosen), cameras, tuning, times)


def finish_adjustment(
    tracks: Tracks,
    start: RigidGroup,
    cameras: Cameras,
    times: np.ndarray,
    problem: BundleProblem,
    state: BundleState,
) -> MoverShape:
    """The shape of all tracks of the group `start`, from the `state` of a `problem` of
    some: on a path as smooth as itself.
    """
    tuning = problem.tuning
    for _ in range(tuning.smoothness_rounds):
        problem.fit_path_whitening(state)
        state, _ = problem.minimize(state, tuning.iterations)

    points = np.full((len(start.members), 3), np.nan)
    complete = BundleProblem(tracks, start, cameras, tuning, times)
    state = complete.solve_points(state)
    points[complete.usable] = state.points + start.center
    errors = np.linalg.norm(complete.reproject(state).error, axis=-1) / complete.noise
    return MoverShape(
        group=replace(start, rotations=state.rotations, translations=state.translations),
        points=points,
        error=float(np.median(errors[complete.visible])),
    )


def longest_tracks(visible: np.ndarray, max_tracks: int) -> np.ndarray:
    """Sorted indices of at most `max_tracks` of the tracks `visible` (N, T).

    Every time contributes its longest tracks in turn.
    """
    count = len(visible)
    length = visible.sum(1)
    order = np.argsort(-length, kind="stable")
    rank_per_time = np.cumsum(visible[order], 0)
    rank_per_time = np.where(visible[order], rank_per_time, count + 1)
    rank = rank_per_time.min(1, initial=count + 1)
    return np.sort(order[np.argsort(rank, kind="stable")[:max_tracks]])


def path_without_rotation(
    tracks: Tracks, group: RigidGroup, tuning: BundleTuning = BUNDLE_TUNING
) -> RigidGroup:
    """The group on the path of its tracks' median steps, without rotation.

    Rotations that were fitted to flat depth would mislead.
    """
    points = tracks.points[group.members]
    visible = tracks.trust[group.members] > 0
    num = visible.shape[1]
    known = visible.sum(0) >= tuning.min_tracks
    start = int(np.argmax(visible.sum(0)))
    translations = np.zeros((num, 3))
    for step, times in ((1, range(start + 1, num)), (-1, range(start - 1, -1, -1))):
        last = start
        for t in times:
            both = visible[:, t] & visible[:, last]
            if both.sum() >= tuning.min_tracks:
                median_step = np.median(points[both, t] - points[both, last], 0)
                translations[t] = translations[last] + median_step
                last = t
            elif known[t]:
                median = np.nanmedian(points[:, t], 0)
                last_median = np.nanmedian(points[:, last], 0)
                translations[t] = translations[last] + median - last_median
                last = t
            else:
                translations[t] = translations[t - step]
    rotations = np.tile(np.eye(3), (num, 1, 1))
    return replace(group, rotations=rotations, translations=translations, known=known)
