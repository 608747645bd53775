"""Rounds of poses and masks: when they end, and what they end with."""

from types import SimpleNamespace

import numpy as np
import pytest
from posed_clips import H, W, panning

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.prepare.steps import poses as step

T = 8
PLACED = Poses(
    K=np.tile(np.eye(3), (T, 1, 1)),
    c2w=np.tile(np.eye(4)[:3], (T, 1, 1)),
    registered=np.ones(T, bool),
    parallax="full",
    near=1.0,
    far=9.0,
)


PAN = panning(np.linspace(-10, 10, T))


@pytest.fixture
def models() -> list[dict[str, bytes]]:
    """The models that the rounds start from, one after another."""
    return []


@pytest.fixture
def rounds(tmp_path, monkeypatch, models):
    """Runs the rounds on a pan whose structure from motion is said to find parallax,
    and of which rotations explain a `share`; the masks of every round are given, and
    round `fails`, counted from 1, fails.
    """

    def run(
        share: float | None,
        *masks: np.ndarray,
        video: np.ndarray = PAN,
        cameras: int = 1,
        fails: int | None = None,
    ) -> tuple[Poses, int]:
        estimates = []

        def estimate(work, moving, earlier):
            estimates.append(moving)
            models.append(dict(earlier.model))
            if len(estimates) == fails:
                raise InputError("poses failed: 7 of 8 frames; film slower")
            earlier.model = {"images.bin": bytes([len(models), 0, 255])}
            return PLACED

        after = iter(masks[1:])
        monkeypatch.setattr(step, "estimate", estimate)
        monkeypatch.setattr(step, "rough_mask", lambda *_: masks[0])
        monkeypatch.setattr(step, "geometric_mask", lambda *_: next(after))
        monkeypatch.setattr(step, "parallax_free_share", lambda *_: share)
        frames = [SimpleNamespace(index=t, track=0, camera_id=t % cameras) for t in range(T)]
        work = SimpleNamespace(
            folder=tmp_path,
            config=SimpleNamespace(lens_distortion="none"),
            manifest=SimpleNamespace(
                rig=1, num_tracks=1, num_cameras=1, frames=frames, lens={}, width=W, height=H
            ),
            raw_flows=(None, None),
            equalized=(video, np.zeros((T, H, W), bool)),
        )
        (tmp_path / "poses").mkdir(exist_ok=True)
        return step.poses_and_masks(work), len(estimates)

    return run


def mask(column: int, width: int = 20) -> np.ndarray:
    moving = np.zeros((T, H, W), bool)
    moving[:, 40:60, column : column + width] = True
    return moving


@pytest.mark.parametrize("number", [1, 2, 3])
def test_masks_that_settle_keep_the_parallax(rounds, number):
    masks = [mask(30 * k) for k in range(number)]
    poses, estimates = rounds(0.7, *masks, masks[-1])
    assert poses.parallax == "full" and estimates == number


RESTLESS = [mask(0), mask(30), mask(60), mask(90)]


def test_restless_masks_of_a_clip_that_rotations_explain_mean_a_turn(rounds, capsys):
    poses, estimates = rounds(0.7, *RESTLESS)
    assert poses.parallax == "rotation" and estimates == 3
    assert not poses.c2w[:, :, 3].any() and poses.registered.all()
    assert "rotations explain 70% of the matches" in capsys.readouterr().err
    assert "masks keep changing" in poses.notes[0]


def test_small_movers_that_flicker_do_not(rounds):
    dots = [m & (np.arange(H) == 50)[:, None] for m in RESTLESS]
    poses, estimates = rounds(0.7, *dots)
    assert poses.parallax == "full" and estimates == 3 and not poses.notes


def test_where_nothing_moves_one_round_is_enough(rounds):
    poses, estimates = rounds(0.7, *[np.zeros((T, H, W), bool)] * 2)
    assert poses.parallax == "full" and estimates == 1


@pytest.mark.parametrize("share", [0.3, None])
def test_restless_masks_alone_do_not(rounds, share):
    poses, estimates = rounds(share, *RESTLESS)
    assert poses.parallax == "full" and estimates == 3
    assert "in doubt" in poses.notes[-1] and "--tripod" in poses.notes[-1]


@pytest.mark.parametrize("fails", [2, 3])
@pytest.mark.parametrize("more", [28, 160])
def test_a_later_round_that_fails_leaves_the_poses_of_the_one_before(rounds, capsys, fails, more):
    masks = [*RESTLESS[:fails], mask(0, width=more)]
    poses, estimates = rounds(0.3, *masks, fails=fails)
    assert poses.parallax == "full" and poses.registered.all() and estimates == fails
    (note,) = poses.notes
    assert note.startswith("in doubt: the next round failed with masks from these: poses failed")
    assert "7 of 8 frames; give --tripod" in note and note in " ".join(
        capsys.readouterr().err.split()
    )


@pytest.mark.parametrize("fails", [2, 3])
def test_where_a_camera_at_rest_explains_the_flow_as_well_it_stands_still(rounds, capsys, fails):
    masks = [*RESTLESS[:fails], mask(0, width=25)]
    poses, estimates = rounds(0.3, *masks, fails=fails)
    assert poses.parallax == "none" and estimates == fails
    assert np.array_equal(poses.c2w, PLACED.c2w)
    note = poses.notes[-1]
    assert "stands still, since the next round failed, and only 3% of the pixels move then" in note
    assert note in " ".join(capsys.readouterr().err.split())


def test_a_camera_at_rest_that_leaves_much_moving_does_not(rounds):
    wide = [np.ones((T, H, W), bool) & (np.arange(W) % 2 == k) for k in (0, 1, 0)]
    poses, _ = rounds(0.3, *wide, fails=2)
    assert poses.parallax == "full" and "in doubt" in poses.notes[-1]


def test_of_several_cameras_none_is_at_rest(rounds):
    poses, _ = rounds(0.3, *RESTLESS[:2], fails=2, cameras=2)
    assert poses.parallax == "full" and "in doubt" in poses.notes[-1]


def test_a_later_round_that_fails_where_rotations_explain_the_footage_means_a_turn(rounds):
    poses, estimates = rounds(0.7, *RESTLESS, fails=2)
    assert poses.parallax == "rotation" and estimates == 2


def test_a_first_round_that_fails_is_an_error(rounds):
    with pytest.raises(InputError, match="7 of 8 frames"):
        rounds(0.7, *RESTLESS, fails=1)


def test_masks_that_nearly_settle_are_in_no_doubt(rounds):
    poses, estimates = rounds(0.3, mask(0), mask(30), mask(60), mask(66))  # IoU 0.54
    assert poses.parallax == "full" and estimates == 3 and not poses.notes


@pytest.mark.parametrize("shake", [0.0, 0.3])
def test_restless_masks_before_what_keeps_its_place_mean_a_tripod(rounds, capsys, shake):
    shaken = panning(shake * (np.arange(T) % 2))
    poses, estimates = rounds(None, *RESTLESS, video=shaken)
    assert poses.parallax == "none" and estimates == 3
    assert np.array_equal(poses.c2w, PLACED.c2w)
    assert "stands still, since its masks keep changing" in capsys.readouterr().err


def test_a_killed_run_goes_on_with_its_first_round(rounds):
    rounds(0.7, mask(0), mask(0))
    poses, estimates = rounds(0.7, mask(9), *RESTLESS[1:])
    assert poses.parallax == "rotation" and estimates == 2


def test_a_killed_run_starts_its_second_round_from_the_model_of_the_first(rounds, models):
    rounds(0.7, mask(0), mask(0))
    rounds(0.7, mask(9), mask(30), mask(30))
    assert models == [{}, {"images.bin": bytes([1, 0, 255])}]


def test_several_cameras_are_no_tripod(rounds):
    poses, _ = rounds(0.7, *RESTLESS, cameras=2)
    assert poses.parallax == "full"
