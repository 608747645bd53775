"""Groups of tracks that move as rigid bodies, found from their points.

The graph of neighboring tracks is cut into more parts than there are objects
(normalized cuts; Shi and Malik 2000, on the motion affinity of Brox and Malik 2010).
Parts are merged again while one rigid motion explains two of them about as well as
their own motions do.
"""

from __future__ import annotations

import itertools
from inspect import signature

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import ArpackNoConvergence, eigsh
from scipy.spatial import cKDTree

from hdr_nsff.priors.movers.rigid_motion import RigidGroup, fit_motion, motion_residuals
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import RIGID_GROUPS_TUNING, RigidGroupsTuning

PAIRS_PER_BATCH = 20_000  # bounds the memory of `affinity`
PENDING_PAIRS = 4_000_000  # the same of `neighbor_pairs`: the rest is free of doubles
# newer SciPy restarts from random vectors unless it is seeded
SEEDED_RESTARTS = {"rng": 0} if "rng" in signature(eigsh).parameters else {}

MergeCosts = dict[tuple[int, int], float]  # ids of two groups -> cost of their merge


def find_rigid_groups(
    tracks: Tracks,
    graph: csr_matrix,
    min_share: float | None = None,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> list[RigidGroup]:
    """Groups that move as one, largest first, by the `graph` of neighbors (N, N).

    Each has at least the share `min_share` of the tracks (`min_group_share` without
    one). If none does, the first of them is returned.
    """
    min_share = tuning.min_group_share if min_share is None else min_share
    least = max(tuning.min_tracks, tuning.min_piece_share * graph.shape[0])
    part = split_unconnected(cut_graph(tracks, graph, tuning), graph, least)
    sampled = np.unique(np.linspace(0, len(part) - 1, tuning.max_sampled_tracks).astype(int))
    members_of_part = [np.nonzero(part == k)[0] for k in range(part.max() + 1)]
    samples = [np.intersect1d(members, sampled) for members in members_of_part]
    samples = [members for members in samples if len(members) >= tuning.min_tracks]
    groups = {k: fit_motion(tracks, members, tuning) for k, members in enumerate(samples)}

    costs: MergeCosts = {}  # most pairs survive a merge
    pair = best_merge(tracks, groups, costs, tuning)
    while pair is not None:
        a, b = groups.pop(pair[0]), groups.pop(pair[1])
        merged = fit_motion(tracks, np.concatenate([a.members, b.members]), tuning)
        groups[max(*groups, *pair) + 1] = merged
        pair = best_merge(tracks, groups, costs, tuning)

    complete = [np.nonzero(np.isin(part, part[group.members]))[0] for group in groups.values()]
    large = [members for members in complete if len(members) >= min_share * len(part)]
    chosen = large or complete[:1]
    return [fit_motion(tracks, m, tuning) for m in sorted(chosen, key=len, reverse=True)]


def best_merge(
    tracks: Tracks,
    groups: dict[int, RigidGroup],
    costs: MergeCosts,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> tuple[int, int] | None:
    """The two groups of lowest merge cost; None where no cost is below 1.

    Fills `costs` with the pairs that are missing in it.
    """
    pairs = list(itertools.combinations(sorted(groups), 2))
    for a, b in pairs:
        if (a, b) in costs:
            continue
        if may_be_one_group(tracks, groups[a], groups[b], tuning):
            costs[a, b] = merge_cost(tracks, groups[a], groups[b], tuning)
        else:
            costs[a, b] = np.inf
    best = min(pairs, key=lambda pair: costs[pair], default=None)
    return best if best is not None and costs[best] < 1 else None


def merge_cost(
    tracks: Tracks,
    a: RigidGroup,
    b: RigidGroup,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> float:
    """The residual of one motion for two groups, relative to what is allowed.

    The larger one of the two groups' ratios; inf where a ratio is not known.
    """
    both = fit_motion(tracks, np.concatenate([a.members, b.members]), tuning)
    size = min(group_size(tracks, a), group_size(tracks, b))
    ratios = []
    for group in (a, b):
        own = motion_residuals(tracks, group, group.members, tuning)
        joint = motion_residuals(tracks, both, group.members, tuning)
        known = np.isfinite(own) & np.isfinite(joint)
        if not known.any():
            return np.inf
        tolerated = tuning.max_residual_ratio * np.median(own[known])
        allowed = tolerated + tuning.depth_error_share * size + 1e-9
        ratios.append(np.median(joint[known]) / allowed)
    return float(max(ratios))


def group_size(tracks: Tracks, group: RigidGroup) -> float:
    """Median distance of a group's points from their median per time, scene units."""
    points = tracks.points[group.members]
    points = points[:, np.isfinite(points[..., 0]).any(0)]
    middle = np.nanmedian(points, 0)
    return float(np.nanmedian(np.linalg.norm(points - middle, axis=-1)))


def cut_graph(
    tracks: Tracks, graph: csr_matrix, tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING
) -> np.ndarray:
    """The part (N,) of every track, by normalized cuts of a graph (N, N) of neighbors.

    There are `parts` of them, more than objects, or one where tracks or times are too
    few.
    """
    count, num_times = tracks.trust.shape
    if num_times < 2 or count < tuning.min_tracks_per_part * tuning.parts:
        return np.zeros(count, int)
    graph = graph + diags(np.full(count, 1e-6))
    degree = np.asarray(graph.sum(1)).ravel()
    scale = diags(1 / np.sqrt(degree))
    start = np.random.default_rng(0).standard_normal(count)
    try:
        _, vectors = eigsh(
            scale @ graph @ scale,
            tuning.parts,
            which="LA",
            v0=start,
            maxiter=tuning.cut_iterations,
            **SEEDED_RESTARTS,
        )
    except ArpackNoConvergence:  # the graph is not connected: its components are parts
        component = connected_components(graph)[1]
        rank = np.argsort(np.argsort(-np.bincount(component), kind="stable"))
        return np.minimum(rank[component], tuning.parts - 1)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True) + 1e-12
    return kmeans2(vectors, tuning.parts, minit="++", rng=np.random.default_rng(0))[1]


def split_unconnected(part: np.ndarray, graph: csr_matrix, least: float) -> np.ndarray:
    """The part (N,) of every track, where pieces of one `part` (N,) that no chain of
    neighbors connects are parts of their own.

    Pieces of fewer than `least` tracks stay with their part's largest. Where there are
    more movers than parts, each part holds several of them.
    """
    pairs = graph.tocoo()
    inside = part[pairs.row] == part[pairs.col]
    kept = pairs.data[inside], (pairs.row[inside], pairs.col[inside])
    piece = connected_components(coo_matrix(kept, graph.shape))[1]
    sizes = np.bincount(piece)
    split = np.empty_like(part)
    count = 0
    for k in np.unique(part):
        members = np.nonzero(part == k)[0]
        pieces = np.unique(piece[members])
        pieces = pieces[np.argsort(-sizes[pieces], kind="stable")]
        large = [p for p in pieces if sizes[p] >= least]
        split[members] = count
        for number, p in enumerate(large[1:], count + 1):
            split[piece == p] = number
        count += max(len(large), 1)
    return split


def neighbor_graph(tracks: Tracks, tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING) -> csr_matrix:
    """The affinity (N, N) of tracks that come near each other in an image."""
    count = len(tracks.trust)
    pairs = neighbor_pairs(tracks, tuning)
    graph = coo_matrix((affinity(tracks, pairs, tuning), pairs.T), (count, count)).tocsr()
    return graph + graph.T


def neighbor_pairs(tracks: Tracks, tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING) -> np.ndarray:
    """Pairs (P, 2) of tracks that come near each other in an image."""
    count, num_times = tracks.trust.shape
    found, pending = [np.zeros(0, int)], 0  # pairs as numbers: these are sorted fast
    for t in range(num_times):
        visible = np.nonzero(tracks.trust[:, t])[0]
        if len(visible):
            tree = cKDTree(tracks.pixels[visible, t])
            reach = tuning.link_spacings * tracks.spacing
            first, second = visible[tree.query_pairs(reach, output_type="ndarray")].T
            found.append(first * count + second)
            pending += len(first)
            if pending > PENDING_PAIRS:
                found, pending = [np.unique(np.concatenate(found))], 0
    return np.stack(np.divmod(np.unique(np.concatenate(found)), max(count, 1)), 1)


def affinity(
    tracks: Tracks, pairs: np.ndarray, tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING
) -> np.ndarray:
    """The affinity (P,) of `pairs` (P, 2) of tracks.

    It is the number of steps that both make, times a factor that falls with the fastest
    change of their distance (Brox and Malik 2010, "Object segmentation by long term
    analysis of point trajectories").
    """
    result = np.zeros(len(pairs))
    num_batches = max(len(pairs) // PAIRS_PER_BATCH, 1)
    for batch in np.array_split(np.arange(len(pairs)), num_batches):
        first, second = pairs[batch].T
        offset = tracks.pixels[first] - tracks.pixels[second]  # (P, T, 2)
        speed = np.linalg.norm(np.diff(offset, axis=1), axis=-1)
        shared = np.isfinite(speed)
        fastest = np.where(shared, speed, 0).max(1, initial=0)
        result[batch] = shared.sum(1) * np.exp(-((fastest / tuning.parting_px) ** 2))
    return result


def are_in_different_patches(
    tracks: Tracks,
    a: RigidGroup,
    b: RigidGroup,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> bool:
    """Whether two groups lie in different patches too often to be one object."""
    num_different = 0
    num_shared = 0
    for t in range(tracks.trust.shape[1]):
        patch_a = visible_patches(tracks, a, t)
        patch_b = visible_patches(tracks, b, t)
        if min(len(patch_a), len(patch_b)) >= tuning.min_tracks:
            num_shared += 1
            num_different += np.bincount(patch_a).argmax() != np.bincount(patch_b).argmax()
    often = num_different > tuning.min_separate_share * num_shared
    return bool(num_different >= tuning.min_separate_frames and often)


def visible_patches(tracks: Tracks, group: RigidGroup, t: int) -> np.ndarray:
    """The patches (n,) in which a group's visible tracks lie at time t."""
    visible = tracks.trust[group.members, t] > 0
    return tracks.patch[group.members, t][visible]


def may_be_one_group(
    tracks: Tracks,
    a: RigidGroup,
    b: RigidGroup,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> bool:
    """Whether two groups may be one object.

    They must be visible together in the same patch, or one must begin near where and
    when the other ends.
    """
    if are_in_different_patches(tracks, a, b, tuning):
        return False
    visible_a = (tracks.trust[a.members] > 0).sum(0) >= tuning.min_tracks
    visible_b = (tracks.trust[b.members] > 0).sum(0) >= tuning.min_tracks
    if (visible_a & visible_b).sum() >= tuning.min_shared_frames:
        return True
    if not (visible_a.any() and visible_b.any()):
        return False
    i, j = nearest_times(visible_a, visible_b)
    points_a, points_b = tracks.points[a.members, i], tracks.points[b.members, j]
    middle_a, middle_b = np.nanmedian(points_a, 0), np.nanmedian(points_b, 0)
    distance = np.linalg.norm(middle_a - middle_b)
    size = np.nanmedian(np.linalg.norm(points_a - middle_a, axis=-1))
    near = distance < tuning.max_gap_sizes * size
    return bool(near and abs(i - j) <= tuning.max_gap_frames)


def nearest_times(visible_a: np.ndarray, visible_b: np.ndarray) -> tuple[int, int]:
    """The first two times, one of each mask (T,), that are nearest to each other."""
    times_a = np.nonzero(visible_a)[0].tolist()
    times_b = np.nonzero(visible_b)[0].tolist()
    return min(itertools.product(times_a, times_b), key=lambda pair: abs(pair[0] - pair[1]))
