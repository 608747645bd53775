"""The rigid motion of a group of tracks over a clip.

Consecutive times are linked by robust rigid fits (Kabsch 1976, with iteratively
reweighted residuals). Then poses are fitted to canonical points and canonical points to
poses, and the poses are smoothed over time.

Convention: a canonical point X of a group is at `R(t) (X - center) + center +
translation(t)` at time t, in scene units. Functions that take `rotations` and
`translations` expect points relative to the center.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry.alignment import nearest_rotation
from hdr_nsff.maths.differences import averaged_with_neighbors
from hdr_nsff.priors.movers import rigid_kernels as kernels
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import RIGID_GROUPS_TUNING, RigidGroupsTuning


@dataclass(frozen=True)
class RigidGroup:
    """Tracks that move as one rigid body, and its motion over T times."""

    rotations: np.ndarray  # (T, 3, 3) from canonical
    translations: np.ndarray  # (T, 3) scene units
    center: np.ndarray  # (3,) canonical
    members: np.ndarray  # indices of its tracks
    # (T,) bool: enough was visible; poses between are interpolated, outer ones held
    known: np.ndarray

    def at(self, times: np.ndarray) -> RigidGroup:
        """The motion at the `times` (S,)."""
        return RigidGroup(
            self.rotations[times],
            self.translations[times],
            self.center,
            self.members,
            self.known[times],
        )

    def over_all_times(self, times: np.ndarray, known: np.ndarray) -> RigidGroup:
        """A motion at the `times` (S,), which rise, over all times of `known` (T,).

        Between them the path is straight and the rotation even; before and after, the
        path goes straight on and the rotation is held.
        """
        num, every = len(times), np.arange(len(known))
        place = np.interp(every, times, np.arange(num))
        low = place.astype(int)
        high, share = np.minimum(low + 1, num - 1), (place - low)[:, None]
        first_speed = self.translations[min(1, num - 1)] - self.translations[0]
        last_speed = self.translations[-1] - self.translations[max(num - 2, 0)]
        speed = np.stack([first_speed, last_speed])[(every > times[0]).astype(int)]
        beyond = (every - every.clip(times[0], times[-1]))[:, None] * speed
        straight = (1 - share) * self.translations[low] + share * self.translations[high]
        turn = np.swapaxes(self.rotations[low], 1, 2) @ self.rotations[high]
        part = Rotation.from_rotvec(share * Rotation.from_matrix(turn).as_rotvec()).as_matrix()
        rotations = np.where(share[..., None] > 0, self.rotations[low] @ part, self.rotations[low])
        return RigidGroup(rotations, straight + beyond, self.center, self.members, known)


def fit_motion(
    tracks: Tracks, members: np.ndarray, tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING
) -> RigidGroup:
    """The rigid motion of the tracks `members` over all times, smoothed.

    Times at which the group is not visible are interpolated. The motion starts at the
    time that shows the most tracks, whose median is the center.
    """
    points = tracks.points[members]
    trust = tracks.trust[members]
    start = int(np.argmax((trust > 0).sum(0)))
    center = np.nanmedian(points[:, start], 0)
    points = points - center
    rotations, translations, known = link_poses(points, trust, start, tuning)
    for _ in range(tuning.refit_rounds):
        rotations, translations = refit_poses(points, trust, rotations, translations, known, tuning)
        rotations, translations = smooth_poses(rotations, translations, known, tracks.times)
    return RigidGroup(rotations, translations, center, members, known)


def link_poses(
    points: np.ndarray,
    trust: np.ndarray,
    start: int,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3), translations (T, 3) and which are known (T,), step by step.

    `points` (N, T, 3) and `trust` (N, T) of a group whose pose at `start` is the
    identity. Each time is fitted to the last known one.
    """
    num = points.shape[1]
    rotations = np.tile(np.eye(3), (num, 1, 1))
    translations = np.zeros((num, 3))
    known = np.zeros(num, bool)
    known[start] = True
    visible = trust > 0
    for times in (range(start + 1, num), range(start - 1, -1, -1)):
        last = start
        for t in times:
            both = visible[:, last] & visible[:, t]
            if both.sum() >= tuning.min_tracks:
                weight = np.minimum(trust[both, last], trust[both, t])
                rotation, translation = fit_rigid(
                    points[both, last], points[both, t], weight, tuning
                )
                rotations[t] = rotation @ rotations[last]
                translations[t] = rotation @ translations[last] + translation
            elif visible[:, t].sum() >= tuning.min_unlinked_points:
                # no track links the two times: keep the rotation, follow the median
                median = np.nanmedian(points[:, t], 0)
                last_median = np.nanmedian(points[:, last], 0)
                rotations[t] = rotations[last]
                translations[t] = translations[last] + median - last_median
            else:
                continue
            known[t] = True
            last = t
    return rotations, translations, known


def fit_rigid(
    source: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """Robust rotation (3, 3) and translation (3,) with target = R source + translation.

    `source` and `target` are (N, 3), `weight` (N,). The rotation is the identity for
    fewer than `min_rotation_points`. Weights are of Geman-McClure type, with the median
    residual as scale.
    """
    return kernels.fit_rigid(
        np.ascontiguousarray(source, np.float64),
        np.ascontiguousarray(target, np.float64),
        np.ascontiguousarray(weight, np.float64),
        tuning.robust_rounds,
        tuning.min_rotation_points,
    )


def canonical_points(
    points: np.ndarray,
    visible: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
) -> np.ndarray:
    """Each track's canonical point (N, 3): the median over its visible times.

    `points` (N, T, 3) and `visible` (N, T) bool at times of known pose. NaN for tracks
    that are never visible.
    """
    back = np.einsum("tji,ntj->nti", rotations, points - translations)
    back[~visible] = np.nan
    canonical = np.full((len(points), 3), np.nan)
    some = np.isfinite(back[..., 0]).any(1)
    canonical[some] = np.nanmedian(back[some], 1)
    return canonical


def refit_poses(
    points: np.ndarray,
    trust: np.ndarray,
    rotations: np.ndarray,
    translations: np.ndarray,
    known: np.ndarray,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> tuple[np.ndarray, np.ndarray]:
    """Every known pose fitted to the canonical points that all times share."""
    canonical = canonical_points(points, (trust > 0) & known, rotations, translations)
    rotations, translations = rotations.copy(), translations.copy()
    for t in np.nonzero(known)[0]:
        visible = (trust[:, t] > 0) & np.isfinite(canonical[:, 0])
        if visible.sum() >= tuning.min_rotation_points:
            rotations[t], translations[t] = fit_rigid(
                canonical[visible], points[visible, t], trust[visible, t], tuning
            )
    return rotations, translations


def smooth_poses(
    rotations: np.ndarray, translations: np.ndarray, known: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses at `times` (T,) averaged with their neighbors.

    Unknown poses are interpolated between known ones before, and held beyond them.
    Averaged matrices become the nearest rotations.
    """
    flat = np.concatenate([rotations.reshape(-1, 9), translations], 1)
    columns = [np.interp(times, times[known], column[known]) for column in flat.T]
    flat = averaged_with_neighbors(np.stack(columns, 1), times)
    return nearest_rotation(flat[:, :9].reshape(-1, 3, 3)), flat[:, 9:]


def motion_residuals(
    tracks: Tracks,
    group: RigidGroup,
    members: np.ndarray,
    tuning: RigidGroupsTuning = RIGID_GROUPS_TUNING,
) -> np.ndarray:
    """Median distance (N,) of the tracks `members` from a group's motion, scene units.

    NaN for tracks that the known times cover too little of.
    """
    points = tracks.points[members]
    visible = tracks.trust[members] > 0
    covered = visible & group.known
    canonical = canonical_points(
        points - group.center, covered, group.rotations, group.translations
    )
    moved = np.einsum("tij,nj->nti", group.rotations, canonical)
    moved = moved + group.translations + group.center
    distance = np.where(covered, np.linalg.norm(moved - points, axis=-1), np.nan)
    residuals = np.full(len(members), np.nan)
    enough = covered.sum(1) >= tuning.min_known_share * visible.sum(1)
    residuals[enough] = np.nanmedian(distance[enough], 1)
    return residuals
