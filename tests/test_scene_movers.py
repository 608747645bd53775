"""Movers as files, and the depth that their shapes give."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError
from hdr_nsff.scene.movers import (
    NO_MOVER,
    Mover,
    fill_mover_depth,
    movers_in_picture,
    nearest_mover,
    read_movers,
    write_movers,
)

TIMES = 3
C2W = np.eye(3, 4)
K = np.array([[10.0, 0, 4], [0, 10.0, 2], [0, 0, 1]])
CAMERA = (K, C2W)


def mover(pixels: list[list[float]], points: list[list[float]], error: float = 0.1) -> Mover:
    """One that stands still, its tracks at the same `pixels` at every time."""
    count = len(pixels)
    return Mover(
        frames=np.arange(TIMES),
        pixels=np.repeat(np.array(pixels, float).reshape(count, 1, 2), TIMES, 1),
        trust=np.ones((count, TIMES)),
        points=np.array(points, float).reshape(count, 3),
        rotations=np.tile(np.eye(3), (TIMES, 1, 1)),
        translations=np.zeros((TIMES, 3)),
        center=np.zeros(3),
        known=np.ones(TIMES, bool),
        error=error,
    )


def test_canonical_points_are_recovered_from_any_time() -> None:
    turning = Rotation.from_rotvec([[0, 0, 0], [0.1, 0.2, 0], [0, 0.5, 0.3]]).as_matrix()
    m = mover([[1, 1], [2, 2]], [[0.5, 0, 3], [0, 0.5, 4]])
    m = replace(m, rotations=turning, translations=np.eye(3), center=np.array([1.0, 2, 3]))
    for t in range(TIMES):
        np.testing.assert_allclose(m.canonical(m.at(t), t), m.points, atol=1e-12)


def test_a_pixel_takes_the_depth_of_near_tracks_unless_it_differs_much() -> None:
    disparity, confidence = np.full((8, 12), 0.4, np.float32), np.zeros((8, 12), np.float32)
    disparity[2, 4], disparity[2, 5], confidence[2, 3] = 0, 0.2, 0.9
    tracks = mover([[2.5, 2.5]], [[0, 0, 2.2]])  # of disparity 1 / 2.2 = 0.455
    moving = np.ones((8, 12), bool)
    found, trust = fill_mover_depth([tracks], 0, moving, C2W, disparity, confidence)
    expected = [1 / 2.2, 1 / 2.2, 0, 0.2, 0.4]  # the last is out of reach
    assert found[2, [2, 3, 4, 5, 11]] == pytest.approx(expected)
    assert trust[2, [2, 3, 4, 11]] == pytest.approx([0.5, 0.9, 0, 0])
    assert disparity[2, 2] == np.float32(0.4)  # what was given stays as it was


def test_depth_is_that_along_the_axis_of_a_turned_camera() -> None:
    turn = Rotation.from_rotvec([0.2, 0.6, -0.3]).as_matrix()
    c2w = np.c_[turn, [1.0, 2.0, 3.0]]
    tracks = mover([[2.5, 2.5]], [c2w[:, 3] + turn @ [0.4, -0.3, 2.2]])
    flat, moving = np.full((4, 6), 0.4, np.float32), np.ones((4, 6), bool)
    found, _ = fill_mover_depth([tracks], 0, moving, c2w, flat, np.zeros_like(flat))
    assert found[2, 2] == pytest.approx(1 / 2.2)


def test_two_movers_do_not_mix_their_depths() -> None:
    disparity, confidence = np.full((4, 8), 0.4, np.float32), np.zeros((4, 8), np.float32)
    movers = [mover([[1.5, 1.5]], [[0, 0, 2.0]]), mover([[6.5, 1.5]], [[0, 0, 3.0]])]
    found, _ = fill_mover_depth(movers, 1, np.ones((4, 8), bool), C2W, disparity, confidence)
    assert found[1, [1, 6]] == pytest.approx([1 / 2, 1 / 3])
    pixels = np.array([[0.5, 0.5], [7.5, 2.5]])
    assert nearest_mover(movers, 1, pixels, CAMERA).tolist() == [0, 1]


def test_what_is_not_rigid_keeps_a_depth_that_is_known_better() -> None:
    disparity, confidence = np.full((4, 8), 0.4, np.float32), np.zeros((4, 8), np.float32)
    confidence[1, 2] = 0.6
    bent = replace(mover([[1.5, 1.5]], [[0, 0, 2.0]]), rigid=False)
    movers = [bent, mover([[6.5, 1.5]], [[0, 0, 3.0]])]
    given = movers, 1, np.ones((4, 8), bool), C2W, disparity, confidence
    found, _ = fill_mover_depth(*given)
    assert found[1, [1, 2, 6]] == pytest.approx([1 / 2, 0.4, 1 / 3])
    found, _ = fill_mover_depth(*given, rigid_only=True)
    assert found[1, [1, 2, 6]] == pytest.approx([0.4, 0.4, 1 / 3])


def test_another_camera_sees_the_points_of_a_mover_elsewhere() -> None:
    movers = [mover([[0.5, 0.5]], [[0, 0, 2]]), mover([[7.5, 2.5]], [[1, 0, 2]])]
    mirrored = np.array([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4]])  # from behind
    pixels = np.array([[4.0, 2.0], [-1.0, 2.0]])
    assert nearest_mover(movers, 1, pixels, (K, mirrored), tracked=False).tolist() == [0, 1]


def test_what_moves_out_of_reach_of_a_rigid_mover_is_none_of_it() -> None:
    nowhere = [np.nan, np.nan]  # its second point is hidden; it would be at pixel (24, 2)
    rigid = mover([[4.0, 2.0], nowhere], [[0, 0, 1], [2, 0, 1]])
    pixels = np.array([[4.0, 2.0], [11.0, 2.0], [14.0, 2.0], [20.0, 2.0], [33.0, 2.0]])
    assert nearest_mover([rigid], 1, pixels, CAMERA).tolist() == [0, 0, NO_MOVER, 0, NO_MOVER]
    soft = replace(rigid, rigid=False)
    assert nearest_mover([soft], 1, pixels, CAMERA).tolist() == [0] * 5
    shapeless = replace(rigid, points=np.full((2, 3), np.nan), error=np.inf)
    assert nearest_mover([shapeless], 1, pixels, CAMERA).tolist() == [0] * 5


def test_a_mover_of_sparse_tracks_reaches_farther() -> None:
    """1.33 spacings, as 8 pixels are where tracks start 6 pixels apart."""
    dense = replace(mover([[4.0, 2.0]], [[0, 0, 1]]), spacing=6)
    sparse = replace(dense, spacing=18.0)
    pixels = np.array([[11.5, 2.0], [12.5, 2.0], [27.5, 2.0], [28.5, 2.0]])
    moving, far = np.ones((4, 30), bool), np.full((4, 30), 0.8, np.float32)
    for one, owners, reach in ((dense, [0] + [NO_MOVER] * 3, 12), (sparse, [0] * 3 + [-1], 28)):
        assert nearest_mover([one], 1, pixels, CAMERA).tolist() == owners
        found, _ = fill_mover_depth([one], 1, moving, C2W, far, np.zeros_like(far))
        assert (found[2, :reach] == 1).all() and (found[2, reach:] == far[2, reach:]).all()


def test_movers_of_a_file_without_spacing_count_as_dense(tmp_path: Path) -> None:
    path = tmp_path / "movers.npz"
    write_movers(path, [replace(mover([[1, 1]], [[0, 0, 1]]), spacing=17)])
    assert read_movers(path)[0].spacing == 17
    with np.load(path) as arrays:
        older = {name: arrays[name] for name in arrays.files if name != "0/spacing"}
    np.savez(path, **older)  # type: ignore[arg-type]
    assert read_movers(path)[0].reach_px == 8


def test_what_moves_while_no_track_is_seen_is_a_mover_where_its_shape_is() -> None:
    seen = mover([[4.0, 2.0]], [[0, 0, 1]])
    hidden = replace(seen, pixels=np.full_like(seen.pixels, np.nan))
    pixels = np.array([[4.0, 2.0], [33.0, 2.0]])
    assert nearest_mover([hidden], 1, pixels, CAMERA).tolist() == [0, NO_MOVER]
    shapeless = replace(hidden, points=np.full((1, 3), np.nan), error=np.inf)
    assert nearest_mover([shapeless], 1, pixels, CAMERA).tolist() == [0, 0]
    gone = replace(shapeless, known=np.zeros_like(seen.known))
    assert nearest_mover([gone], 1, pixels, CAMERA).tolist() == [NO_MOVER] * 2


@pytest.mark.parametrize("in_turn", [True, False])
def test_what_is_connected_to_a_rigid_mover_is_a_part_of_it_before_a_rig(in_turn: bool) -> None:
    ball = mover([[4.0, 2.0]], [[0, 0, 1]])
    other = mover([[50.0, 2.0]], [[4.6, 0, 1]])
    moving = np.zeros((4, 64), bool)
    moving[2, 3:30] = True  # the ball, and a rod of 26 pixels
    moving[0, 34:38] = True  # a shadow between both
    found = movers_in_picture([ball, other], 1, moving, CAMERA, True, in_turn)
    expected = np.full((4, 64), NO_MOVER)
    expected[2, 3 : 30 if in_turn else 12] = 0  # 8 pixels of reach
    assert (found == expected).all()
    soft = replace(ball, rigid=False)
    assert (movers_in_picture([soft], 1, moving, CAMERA, True, in_turn)[moving] == 0).all()


def test_a_mover_without_a_shape_gives_no_depth() -> None:
    disparity, confidence = np.full((4, 4), 0.4, np.float32), np.zeros((4, 4), np.float32)
    shapeless = [mover([[1.5, 1.5]], [[np.nan] * 3], error=np.inf)]
    moving = np.ones((4, 4), bool)
    found, trust = fill_mover_depth(shapeless, 0, moving, C2W, disparity, confidence)
    assert np.array_equal(found, disparity) and np.array_equal(trust, confidence)


def test_movers_are_read_as_they_were_written_and_one_may_be_dropped(tmp_path: Path) -> None:
    first, second = mover([[1, 1]], [[0, 0, 1]]), mover([[2, 2], [3, 3]], [[0, 0, 2]] * 2, np.inf)
    write_movers(tmp_path / "movers.npz", [first, second])
    found = read_movers(tmp_path / "movers.npz")
    assert [m.error for m in found] == [0.1, np.inf]
    np.testing.assert_array_equal(found[1].pixels, second.pixels)
    arrays = dict(np.load(tmp_path / "movers.npz"))
    kept = {name: array for name, array in arrays.items() if not name.startswith("0/")}
    np.savez(tmp_path / "movers.npz", **kept)
    assert len(read_movers(tmp_path / "movers.npz")) == 1


def without(name: str, arrays: dict[str, np.ndarray]) -> None:
    del arrays[name]


DAMAGE = {
    "an array is missing": lambda a: without("0/pixels", a),
    "another version": lambda a: a.update(version=np.array(9)),
    "another shape": lambda a: a.update({"0/trust": np.ones((7, TIMES))}),
    "no rotation": lambda a: a.update({"0/rotations": np.full((TIMES, 3, 3), 0.3)}),
    "NaN in its motion": lambda a: a.update({"0/translations": np.full((TIMES, 3), np.nan)}),
    "words": lambda a: a.update({"0/error": np.array("much")}),
    "no number for its name": lambda a: a.update({"first/error": np.array(1.0)}),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_movers_that_make_no_sense_are_refused_in_a_sentence(what: str, tmp_path: Path) -> None:
    path = tmp_path / "movers.npz"
    write_movers(path, [mover([[1, 1]], [[0, 0, 1]])])
    arrays = dict(np.load(path))
    DAMAGE[what](arrays)
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="--redo movers"):
        read_movers(path)


@pytest.mark.parametrize("cut", [0, 10, 200, -30])
def test_a_file_that_was_cut_short_is_refused_in_a_sentence(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "movers.npz"
    write_movers(path, [mover([[1, 1]], [[0, 0, 1]])])
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match="--redo movers"):
        read_movers(path)


def test_damaged_movers_are_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "movers.npz"
    write_movers(path, (mover([[1, 1], [2, 2]], [[0.5, 0, 3], [0, 0.5, 4]]),))
    check_reader(path, lambda: read_movers(path), 200)
    with zipfile.ZipFile(path, "w") as archive:  # zipfile itself has a RuntimeError for it
        entry = zipfile.ZipInfo("0/frames.npy")
        archive.writestr(entry, b"secret")
        entry.flag_bits |= 1
    with pytest.raises(InputError, match="damaged"):
        read_movers(path)
