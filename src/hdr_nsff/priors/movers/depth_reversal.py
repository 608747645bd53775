"""Reversed depth in bundle adjustment, and how it is undone.

Seen from a distance, a body that turns one way and its mirror image that turns the
other way look the same (Necker 1832). A start without depth relief may converge to
either, and to different ones at different times. Perspective tells them apart: the
true one has the lower cost.
"""

from __future__ import annotations

import numpy as np

from hdr_nsff.priors.movers.bundle_problem import BundleProblem, BundleState


def undo_depth_reversals(problem: BundleProblem, state: BundleState, cost: float) -> BundleState:
    """The state of lowest cost that depth reversals up to some time lead to.

    `cost` is that of `state`.
    """
    tuning = problem.tuning
    num = len(problem.K)
    gap = max(tuning.min_reversal_frames, num // tuning.reversal_splits)
    splits = [*range(gap, num - gap // 2, gap), num]
    for _ in range(tuning.reversal_rounds):
        candidates = [
            problem.minimize(reverse_depth(problem, state, k), tuning.reversal_iterations)
            for k in splits
        ]
        best, best_cost = min(candidates, key=lambda candidate: candidate[1])
        if best_cost > tuning.max_reversal_cost_ratio * cost:
            break
        state, cost = problem.minimize(best, tuning.iterations)
    return state


def reverse_depth(problem: BundleProblem, state: BundleState, split: int) -> BundleState:
    """The state with depth mirrored at the times before `split`.

    The mirror is orthogonal to the line of sight at `split`, so that the motion stays
    continuous there. Points that are mostly visible before it are mirrored with it.
    """
    k = min(split, len(problem.K) - 1)
    sight = state.translations[k] - problem.eyes[k]
    sight = sight / np.linalg.norm(sight)
    mirror = np.eye(3) - 2 * np.outer(sight, sight)
    canonical_mirror = state.rotations[k].T @ mirror @ state.rotations[k]
    rotations = state.rotations.copy()
    rotations[:split] = mirror @ state.rotations[:split] @ canonical_mirror

    points = state.points.copy()
    visible = problem.visible
    before = visible[:, :split].sum(1) > 0.5 * visible.sum(1)
    middle = np.median(points[before], 0) if before.any() else np.zeros(3)
    points[before] = (points[before] - middle) @ canonical_mirror + middle
    return BundleState(points, rotations, state.translations)
