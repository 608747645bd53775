"""Tracks segmented by the motions that explain them.

Groups of tracks that were found with depth that may be wrong (`rigid_groups.py`) get
shapes by bundle adjustment (`bundle.py`). Then every track is assigned to the motion
that reprojects it best over its whole life, its neighbors' lives included, and changed
groups are adjusted again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.sparse import csr_matrix
from threadpoolctl import threadpool_limits

from hdr_nsff.core.parallel import map_in_threads
from hdr_nsff.priors.movers.bundle import MoverShape, adjust_bundle
from hdr_nsff.priors.movers.bundle_problem import BundleProblem, BundleState, Cameras
from hdr_nsff.priors.movers.rigid_groups import (
    are_in_different_patches,
    find_rigid_groups,
    nearest_times,
    neighbor_graph,
)
from hdr_nsff.priors.movers.rigid_motion import RigidGroup, fit_motion
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING, MoversTuning


@dataclass(frozen=True)
class Segment:
    """Tracks of one mover, with its shape where they determine one."""

    group: RigidGroup
    shape: MoverShape | None

    @property
    def members(self) -> np.ndarray:
        """Indices (n,) of its tracks."""
        return self.group.members


def segment_tracks(
    tracks: Tracks, cameras: Cameras, tuning: MoversTuning = MOVERS_TUNING
) -> list[Segment]:
    """The movers among the tracks, largest first."""
    graph = neighbor_graph(tracks, tuning.groups)
    groups = find_rigid_groups(tracks, graph, min_piece_share(tuning), tuning.groups)
    with threadpool_limits(1, "blas"):  # on such small systems, its threads mostly wait
        return refine_segments(tracks, graph, [group.members for group in groups], cameras, tuning)


def min_piece_share(tuning: MoversTuning) -> float:
    """The share of all tracks that a piece of an object needs."""
    return tuning.segmentation.min_piece_share * tuning.groups.min_group_share


def refine_segments(
    tracks: Tracks,
    graph: csr_matrix,
    groups: list[np.ndarray],
    cameras: Cameras,
    tuning: MoversTuning = MOVERS_TUNING,
) -> list[Segment]:
    """Segments, largest first, from groups of tracks that may be mixed or in pieces.

    `graph` (N, N) has the affinities of neighbors, `groups` the members of each. Groups
    are merged and tracks reassigned until hardly any changes; small segments are
    dropped, except the first.
    """
    segments = fit_segments(tracks, groups, [], cameras, tuning)
    if any(segment.shape is not None for segment in segments):
        weights = rows_of_one(graph)
        for _ in range(tuning.segmentation.rounds):
            segments = merge_segments(tracks, segments, cameras, tuning)
            before = [segment.members for segment in segments]
            shapes = [segment.shape for segment in segments]
            errors = smoothed_errors(tracks, shapes, cameras, weights, tuning)
            owner = assign_tracks(before, errors, tuning)
            after = [np.nonzero(owner == k)[0] for k in range(len(before))]
            if all(same_members(b, a, tuning) for b, a in zip(before, after, strict=True)):
                break
            groups = members_by_owner(owner, tuning)
            segments = fit_segments(tracks, groups, segments, cameras, tuning)
    min_members = tuning.groups.min_group_share * len(tracks.trust)
    return [s for i, s in enumerate(segments) if i == 0 or len(s.members) >= min_members]


def fit_segments(
    tracks: Tracks,
    groups: list[np.ndarray],
    known: list[Segment],
    cameras: Cameras,
    tuning: MoversTuning = MOVERS_TUNING,
) -> list[Segment]:
    """Segments of the members in `groups`; those that hardly changed are `known`."""

    def segment_of(members: np.ndarray) -> Segment:
        same = [s for s in known if same_members(s.members, members, tuning)]
        return same[0] if same else fit_segment(tracks, members, cameras, tuning, known)

    return map_in_threads(segment_of, groups, "movers")


def fit_segment(
    tracks: Tracks,
    members: np.ndarray,
    cameras: Cameras,
    tuning: MoversTuning = MOVERS_TUNING,
    known: Sequence[Segment] = (),
) -> Segment:
    """The segment of `members`, with a shape where one of small error is found.

    Adjustment goes on from the `known` segment that has about the same members.
    """
    group = fit_motion(tracks, members, tuning.groups)
    constants = tuning.segmentation
    few_tracks = len(members) < constants.min_shape_tracks
    if few_tracks or len(cameras.K) < constants.min_shape_times:
        return Segment(group, None)
    near = nearly_same(tracks, group, known, tuning)
    shape = adjust_bundle(tracks, group, cameras, tuning.bundle, near)
    return Segment(group, shape if shape.error < constants.max_error else None)


def nearly_same(
    tracks: Tracks,
    group: RigidGroup,
    known: Sequence[Segment],
    tuning: MoversTuning = MOVERS_TUNING,
) -> MoverShape | None:
    """The shape of the `known` segment that shares most members with a group.

    None where none shares enough, or its motion is known for too little of the group's
    life.
    """
    found: MoverShape | None = None
    constants = tuning.segmentation
    most = constants.min_shared_members
    for segment in known:
        if segment.shape is None:
            continue
        motion = segment.shape.group
        both = len(np.intersect1d(motion.members, group.members, assume_unique=True))
        share = both / (len(motion.members) + len(group.members) - both)
        known_share = motion.known[group.known].mean()
        if share > most and known_share >= constants.min_shared_times:
            found, most = segment.shape, share
    return found


def merge_segments(
    tracks: Tracks,
    segments: list[Segment],
    cameras: Cameras,
    tuning: MoversTuning = MOVERS_TUNING,
) -> list[Segment]:
    """Segments merged in pairs while one motion explains both about equally well."""
    segments = list(segments)
    tried: set[tuple[int, ...]] = set()
    pair = next_pair(segments, tried)
    while pair is not None:
        a, b = segments[pair[0]], segments[pair[1]]
        tried.add(pair_key(a, b))
        merged = merge_pair(tracks, a, b, cameras, tuning)
        if merged is not None:
            others = [s for k, s in enumerate(segments) if k not in pair]
            segments = sorted([merged, *others], key=lambda s: -len(s.members))
        pair = next_pair(segments, tried)
    return segments


def next_pair(segments: list[Segment], tried: set[tuple[int, ...]]) -> tuple[int, int] | None:
    """The first pair of segments that was not `tried`, None where all were."""
    for i, j in combinations(range(len(segments)), 2):
        if pair_key(segments[i], segments[j]) not in tried:
            return i, j
    return None


def pair_key(a: Segment, b: Segment) -> tuple[int, ...]:
    """Identifies a pair of segments: for each its number of tracks, and the first."""
    return len(a.members), int(a.members[0]), len(b.members), int(b.members[0])


def merge_pair(
    tracks: Tracks,
    a: Segment,
    b: Segment,
    cameras: Cameras,
    tuning: MoversTuning = MOVERS_TUNING,
) -> Segment | None:
    """One segment for two, None where their own motions explain them better."""
    if not may_be_one_mover(tracks, a.group, b.group, tuning):
        return None
    merged = fit_segment(tracks, np.union1d(a.members, b.members), cameras, tuning, (a, b))
    if merged.shape is None:
        return None
    constants = tuning.segmentation
    for segment in (a, b):
        own_error = constants.max_error - constants.equal_error
        if segment.shape is not None:
            own_error = median_error(tracks, segment.shape, segment.members, cameras, tuning)
        error = median_error(tracks, merged.shape, segment.members, cameras, tuning)
        if not error < own_error + constants.equal_error:
            return None
    return merged


def may_be_one_mover(
    tracks: Tracks, a: RigidGroup, b: RigidGroup, tuning: MoversTuning = MOVERS_TUNING
) -> bool:
    """Whether two groups may be one object.

    They must lie in one patch where both are visible, or one must begin near where and
    when the other ends.
    """
    visible_a = visible_times(tracks, a, tuning)
    visible_b = visible_times(tracks, b, tuning)
    if not (visible_a.any() and visible_b.any()):
        return False
    if (visible_a & visible_b).sum() >= tuning.groups.min_shared_frames:
        return not are_in_different_patches(tracks, a, b, tuning.groups)
    i, j = nearest_times(visible_a, visible_b)
    pixels_a, pixels_b = tracks.pixels[a.members], tracks.pixels[b.members]
    middle_a = np.nanmedian(pixels_a[:, i], 0)
    middle_b = np.nanmedian(pixels_b[:, j], 0)
    radius = max(image_radius(pixels_a[:, visible_a]), image_radius(pixels_b[:, visible_b]))
    max_distance = tuning.segmentation.max_return_radii * radius
    near = np.linalg.norm(middle_a - middle_b) < max_distance
    return bool(near and abs(i - j) <= tuning.groups.max_gap_frames)


def visible_times(
    tracks: Tracks, group: RigidGroup, tuning: MoversTuning = MOVERS_TUNING
) -> np.ndarray:
    """The times (T,) bool at which more than stray tracks of a group are visible."""
    count = (tracks.trust[group.members] > 0).sum(0)
    stray = tuning.segmentation.min_visible_share * count.max()
    return count >= max(tuning.groups.min_tracks, stray)


def image_radius(pixels: np.ndarray) -> float:
    """Median distance of tracks (N, T, 2) px from the median of their time.

    Some must be visible at every time.
    """
    return float(np.nanmedian(np.linalg.norm(pixels - np.nanmedian(pixels, 0), axis=-1)))


def members_by_owner(owner: np.ndarray, tuning: MoversTuning = MOVERS_TUNING) -> list[np.ndarray]:
    """The members of each group, largest first, of the `owner` (N,) of every track.

    Tracks of owner -1 and small groups are dropped; the first group always stays.
    """
    groups = [np.nonzero(owner == k)[0] for k in range(owner.max(initial=-1) + 1)]
    groups = sorted(groups, key=len, reverse=True)
    min_members = min_piece_share(tuning) * len(owner)
    first = [members for members in groups[:1] if len(members)]
    return first + [members for members in groups[1:] if len(members) >= min_members]


def same_members(
    before: np.ndarray, after: np.ndarray, tuning: MoversTuning = MOVERS_TUNING
) -> bool:
    """Whether two groups have the same members, up to a small share."""
    max_changed = tuning.segmentation.max_changed_share * len(before)
    return len(np.setxor1d(before, after)) <= max_changed


def rows_of_one(graph: csr_matrix) -> csr_matrix:
    """The graph (N, N) with rows that sum to 1, or to 0 without any neighbor."""
    total = np.maximum(np.asarray(graph.sum(1)).ravel(), 1e-9)
    return csr_matrix(graph.multiply(1 / total[:, None]))


def smoothed_errors(
    tracks: Tracks,
    shapes: list[MoverShape | None],
    cameras: Cameras,
    weights: csr_matrix,
    tuning: MoversTuning = MOVERS_TUNING,
) -> np.ndarray:
    """`track_errors` (N, K) by every motion, averaged with those of neighbors.

    Longer tracks count more, as they discriminate more. inf where there is no shape or
    its motion is not known.
    """
    length = (tracks.trust > 0).sum(1).astype(float)
    result = np.full((len(length), len(shapes)), np.inf)
    for k, shape in enumerate(shapes):
        if shape is None:
            continue
        errors = track_errors(tracks, shape, cameras, tuning)
        known = np.isfinite(errors)
        own_weight = length * known
        weighted = np.where(known, errors, 0) * own_weight
        total = weighted + weights @ weighted
        total_weight = own_weight + weights @ own_weight
        result[known, k] = (total / np.maximum(total_weight, 1e-9))[known]
    return result


def track_errors(
    tracks: Tracks, shape: MoverShape, cameras: Cameras, tuning: MoversTuning = MOVERS_TUNING
) -> np.ndarray:
    """Mean reprojection error (N,) of every track by a shape's motion, in sigmas.

    The track's point is fitted to the motion. inf where the motion is known for too
    little of the track's life.
    """
    count = len(tracks.trust)
    group = replace(shape.group, members=np.arange(count))
    problem = BundleProblem(tracks, group, cameras, tuning.bundle)
    state = BundleState(problem.start, group.rotations, group.translations)
    state = problem.solve_points(state, tuning.segmentation.point_iterations)
    errors = np.linalg.norm(problem.reproject(state).error, axis=-1) / problem.noise
    num_known = problem.visible.sum(1)
    num_visible = (tracks.trust[problem.usable] > 0).sum(1)
    mean = np.where(problem.visible, errors, 0).sum(1) / np.maximum(num_known, 1)
    enough = num_known >= tuning.segmentation.min_known_share * num_visible
    result = np.full(count, np.inf)
    result[problem.usable] = np.where(enough & np.isfinite(mean), mean, np.inf)
    return result


def median_error(
    tracks: Tracks,
    shape: MoverShape,
    members: np.ndarray,
    cameras: Cameras,
    tuning: MoversTuning = MOVERS_TUNING,
) -> float:
    """Median of `track_errors` over the tracks `members` (n,)."""
    return float(np.median(track_errors(tracks, shape, cameras, tuning)[members]))


def assign_tracks(
    before: list[np.ndarray], errors: np.ndarray, tuning: MoversTuning = MOVERS_TUNING
) -> np.ndarray:
    """The group (N,) of every track by its `errors` (N, K).

    Of the groups that explain it well, and about as well as the best, it is the first
    and so the largest. A track that none explains stays in its group of `before`, the
    members of each; -1 is none.
    """
    owner = np.full(len(errors), -1)
    for k, members in enumerate(before):
        owner[members] = k
    constants = tuning.segmentation
    near_best = errors <= errors.min(1, keepdims=True) + constants.equal_error
    explained = near_best & (errors < constants.max_error)
    return np.where(explained.any(1), explained.argmax(1), owner)
