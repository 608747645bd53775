"""Tracks of two rigid bodies segmented by their motions, in closed form: bodies that
cross, and one that comes back.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.movers.bundle import MoverShape, adjust_bundle
from hdr_nsff.priors.movers.bundle_problem import Cameras
from hdr_nsff.priors.movers.motion_segmentation import (
    Segment,
    assign_tracks,
    may_be_one_mover,
    members_by_owner,
    nearly_same,
    refine_segments,
    same_members,
    segment_tracks,
)
from hdr_nsff.priors.movers.rigid_groups import neighbor_graph
from hdr_nsff.priors.movers.rigid_motion import fit_motion
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import MOVERS_TUNING

TIMES, COUNT, FOCAL = 20, 140, 200.0
T = np.arange(TIMES)
K = np.tile([[FOCAL, 0, 120], [0, FOCAL, 70], [0, 0, 1.0]], (TIMES, 1, 1))
# a camera in a shaking hand
EYES = np.stack([0.05 * np.sin(2.1 * T), 0.04 * np.sin(2.9 * T + 1), 0.02 * np.sin(1.7 * T)], -1)
C2W = np.concatenate([np.tile(np.eye(3), (TIMES, 1, 1)), EYES[..., None]], 2)
CAMERAS = Cameras(K, C2W, T.astype(float))


def body(
    seed: int, size: float, start: list[float], velocity: list[float], spin: float
) -> np.ndarray:
    """Points (COUNT, TIMES, 3) of a turning body on a straight path."""
    local = np.random.default_rng(seed).uniform(-size, size, (COUNT, 3))
    rotations = Rotation.from_rotvec(np.outer(T * spin, [0.3, 1.0, 0.2])).as_matrix()
    return np.einsum("tij,nj->nti", rotations, local) + np.array(start) + np.outer(T, velocity)


ONE = body(0, 0.3, [-0.6, 0.0, 2.0], [0.05, 0, 0], 0.08)
TWO = body(1, 0.15, [0.5, 0.05, 2.6], [-0.05, 0.01, 0.01], -0.1)


def tracked(points: np.ndarray, visible: np.ndarray, far: np.ndarray) -> Tracks:
    """Tracks of points (N, TIMES, 3) at the times `visible` (N, TIMES), all in one
    patch, put at `far` (N, TIMES) times their depth.
    """
    local = points - EYES
    noise = np.random.default_rng(9).normal(0, 0.05, (*visible.shape, 2))
    pixels = local[..., :2] / local[..., 2:] * FOCAL + [120, 70] + noise
    hide = np.where(visible, 1.0, np.nan)[..., None]
    return Tracks(
        pixels * hide,
        (EYES + local * far[..., None]) * hide,
        visible * 0.3,
        visible.astype(int),
        np.zeros(visible.shape, int),
        T.astype(float),
    )


def spans(first: np.ndarray, lasting: int) -> np.ndarray:
    """The times (N, TIMES) bool within `lasting` of the `first` (N,)."""
    return (first[:, None] <= T) & (first[:, None] + lasting > T)


def crossing() -> Tracks:
    """Both bodies in one patch at all times, at one wrong distance."""
    first = np.random.default_rng(3).integers(0, TIMES - 9, 2 * COUNT)
    points = np.concatenate([ONE, TWO])
    return tracked(points, spans(first, 10), 2.3 / points[..., 2])


def hidden() -> tuple[Tracks, np.ndarray]:
    """The second body, out of sight for three times, comes back with depth a third too
    near; which of its tracks are late.
    """
    late = np.arange(COUNT) >= COUNT // 2
    first = np.where(late, 14, np.random.default_rng(4).integers(0, 4, COUNT))
    visible = spans(first, 8) & ((T < 11) | late[:, None])
    far = np.where(late[:, None], 0.7, 1.0) * np.ones(TIMES)
    return tracked(TWO, visible, far), late


def test_two_bodies_that_cross_in_one_patch_are_two_unmixed_movers() -> None:
    found = segment_tracks(crossing(), CAMERAS)
    assert len(found) == 2 and all(segment.shape is not None for segment in found)
    shares = sorted((segment.members < COUNT).mean() for segment in found)
    assert shares[0] < 0.02 and shares[1] > 0.98


def test_tracks_in_the_wrong_group_are_reassigned() -> None:
    tracks = crossing()
    # the first has 20 tracks of the second
    one, two = np.arange(COUNT + 20), np.arange(COUNT + 20, 2 * COUNT)
    found = refine_segments(tracks, neighbor_graph(tracks), [one, two], CAMERAS)
    assert len(found) == 2
    owners = {frozenset((segment.members >= COUNT).tolist()) for segment in found}
    assert owners == {frozenset({False}), frozenset({True})}


def test_a_mover_that_was_hidden_is_one_mover_at_its_distance() -> None:
    tracks, late = hidden()
    groups = [np.nonzero(~late)[0], np.nonzero(late)[0]]
    found = refine_segments(tracks, neighbor_graph(tracks), groups, CAMERAS)
    assert len(found) == 1 and len(found[0].members) == COUNT
    shape = found[0].shape
    assert shape is not None
    group = shape.group
    for t in (2, 8, 15, 19):
        rotated = (shape.points - group.center) @ group.rotations[t].T
        points = rotated + group.center + group.translations[t]
        visible = tracks.trust[:, t] > 0
        ratio = (points - EYES[t])[visible, 2] / (TWO[:, t] - EYES[t])[visible, 2]
        assert abs(np.median(ratio) - 1) < 0.05


def test_groups_that_reappear_elsewhere_are_not_one_mover() -> None:
    tracks, late = hidden()
    a = fit_motion(tracks, np.nonzero(~late)[0])
    b = fit_motion(tracks, np.nonzero(late)[0])
    assert may_be_one_mover(tracks, a, b)
    offset = np.where(late, 200.0, 0.0)[:, None, None]
    assert not may_be_one_mover(replace(tracks, pixels=tracks.pixels + offset), a, b)


def test_groups_that_reappear_after_too_long_a_gap_are_not_one_mover() -> None:
    tracks, late = hidden()  # out of sight for three times
    a = fit_motion(tracks, np.nonzero(~late)[0])
    b = fit_motion(tracks, np.nonzero(late)[0])
    groups = replace(MOVERS_TUNING.groups, max_gap_frames=2)
    assert not may_be_one_mover(tracks, a, b, replace(MOVERS_TUNING, groups=groups))


def test_the_larger_group_gets_what_both_explain_and_others_stay_where_they_were() -> None:
    before = [np.array([0, 1, 2]), np.array([3, 4])]
    errors = np.array(
        [
            [0.1, 0.2],  # both explain it
            [3.0, 0.1],
            [9.0, 8.0],  # none explains it: it stays
            [0.3, 0.2],
            [np.inf, np.inf],
            [np.inf, 1.0],
            [5.0, 5.0],
        ]
    )
    assert assign_tracks(before, errors).tolist() == [0, 1, 0, 0, 1, 1, -1]


def test_groups_of_few_tracks_are_dropped_but_for_the_largest() -> None:
    owner = np.repeat([0, 1, -1], [90, 1, 9])
    assert [len(m) for m in members_by_owner(owner)] == [90]
    assert [len(m) for m in members_by_owner(np.array([0] + [-1] * 99))] == [1]
    assert members_by_owner(np.full(5, -1)) == []


def test_a_hundredth_of_the_tracks_makes_no_other_group() -> None:
    before = np.arange(200)
    assert same_members(before, np.arange(2, 200))
    assert not same_members(before, np.arange(3, 200))


def test_a_group_goes_on_from_the_motion_that_most_of_its_tracks_have() -> None:
    tracks = crossing()
    group = fit_motion(tracks, np.arange(COUNT))

    def segment(first: int, last: int, known: np.ndarray = group.known) -> Segment:
        own = replace(group, members=np.arange(first, last), known=known)
        return Segment(own, MoverShape(own, np.zeros((last - first, 3)), 0.1))

    nearest, near, other = segment(0, COUNT - 5), segment(20, COUNT), segment(0, COUNT // 2)
    known = [near, nearest, other]
    assert nearly_same(tracks, group, known) is nearest.shape
    assert nearly_same(tracks, group, [other]) is None
    assert nearly_same(tracks, group, [Segment(group, None)]) is None
    assert nearly_same(tracks, group, [segment(0, COUNT, group.known & (T > 3))]) is None


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_hardly_any_tracks_are_no_error() -> None:
    tracks = crossing()
    names = ("pixels", "points", "trust", "patch", "age")
    few = replace(tracks, **{name: getattr(tracks, name)[:5] for name in names})
    found = segment_tracks(few, CAMERAS)
    assert len(found) == 1 and found[0].shape is None
    shape = adjust_bundle(tracks, fit_motion(tracks, np.arange(COUNT)), CAMERAS)
    assert np.isfinite(shape.error)
