"""Which views are mapped, which reconstruction wins, and why there may be none."""

from dataclasses import replace

import numpy as np
import pytest
from posed_clips import panning

from hdr_nsff.core.errors import InputError, NoSceneError
from hdr_nsff.footage.colmap import ColmapCamera, ColmapImage, ColmapModel
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.priors.poses import reconstruct, sfm
from hdr_nsff.priors.poses.reconstruct import (
    ReconstructionTuning,
    SfmViews,
    best_model,
    failure_message,
    has_plausible_lens,
    model_rank,
    sfm_views,
    tuning_for_lenses,
)
from hdr_nsff.priors.poses.view_matches import EarlierRounds


def test_cameras_of_a_rig_at_rest_share_one_view():
    rng = np.random.default_rng(0)
    left, right = panning(np.zeros(1))[0], panning(np.array([20.0]))[0]
    video = np.stack([f + 0.005 * rng.normal(size=f.shape) for f in [left, right] * 6]).astype(
        np.float32
    )
    video[4, 20:50, 20:50] = 0  # something passes the left camera once
    views = sfm_views(
        video, np.zeros(video.shape[:3], bool), [list(range(0, 12, 2)), list(range(1, 12, 2))]
    )
    assert len(views.images) == 2 and views.of_frame.tolist() == [0, 1] * 6
    assert np.abs(views.images[0] - left).max() < 0.03  # the median is free of the passer-by


def model(focal: float, images: int) -> ColmapModel:
    """A reconstruction of `images` images, 240 pixels wide."""
    camera = ColmapCamera("SIMPLE_PINHOLE", 240, 136, np.diag([focal, focal, 1.0]), np.zeros(0))
    return ColmapModel(
        {1: camera},
        dict.fromkeys(range(images)),
        np.zeros(0),
        np.zeros((0, 3)),
        np.zeros(0),
        np.zeros(0),
    )


def test_a_plausible_lens_counts_more_than_images():
    # 107 degrees: the estimate of a 50 degree lens with movers left unmasked
    assert not has_plausible_lens(model(89, 36))
    assert model_rank(model(250, 20), 36) > model_rank(model(89, 36), 36)
    assert model_rank(model(250, 34), 36) > model_rank(model(250, 20), 36)


def test_a_phone_held_upright_has_a_plausible_lens():
    upright = ColmapCamera("SIMPLE_PINHOLE", 136, 240, np.diag([330.0, 330, 1]), np.zeros(0))
    assert has_plausible_lens(replace(model(330, 36), cameras={1: upright}))  # 40 degrees


def test_a_lens_that_bends_strongly_may_be_wider():
    def bent(k1: float) -> Lens:
        return Lens(np.array([[120, 0, 120], [0, 120, 68], [0, 0, 1.0]]), (k1, 0, 0, 0), 240, 136)

    wide = model(94, 36)  # 104 degrees
    assert not has_plausible_lens(wide, tuning_for_lenses([]))
    assert not has_plausible_lens(wide, tuning_for_lenses([bent(-0.005)]))
    assert has_plausible_lens(wide, tuning_for_lenses([bent(-0.1)]))
    assert not has_plausible_lens(model(60, 36), tuning_for_lenses([bent(-0.1)]))  # 127 degrees
    # the lens that was found with the poses counts as well
    K = np.array([[94, 0, 120], [0, 94, 68], [0, 0, 1.0]])
    with_lens = ColmapCamera("RADIAL", 240, 136, K, np.array([-0.07, 0.0]))
    assert has_plausible_lens(replace(wide, cameras={1: with_lens}))
    folds_over = replace(with_lens, distortion=np.array([-0.4, 0.0]))
    assert not has_plausible_lens(replace(wide, cameras={1: folds_over}))
    # two cameras, one of which is no wide one
    assert not has_plausible_lens(wide, tuning_for_lenses([bent(-0.1), bent(-0.005)]))


def views_of(count: int) -> SfmViews:
    """`count` black frames of one camera, 240x136."""
    return SfmViews(
        np.zeros((count, 136, 240, 3)),
        np.zeros((count, 136, 240), bool),
        [list(range(count))],
        np.arange(count),
    )


def test_failure_names_the_lens_or_the_frames():
    images = {
        k: ColmapImage(f"{k:05d}.png", 1, np.eye(4)[:3], np.zeros((0, 2)), np.zeros(0))
        for k in (0, 1, 2, 6)
    }
    long_lens, short_lens = (replace(model(f, 0), images=images) for f in (1500, 90))
    message = failure_message(short_lens, views_of(5), [])
    assert "focal length of 45 px is impossible" in message  # doubled frames: 90 / 2
    message = failure_message(long_lens, views_of(10), [])
    assert "6 of 10 frames could not be registered (frames 3-5, 7-9)" in message
    rig = replace(views_of(10), groups=[[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]])
    assert "one each is enough" in failure_message(None, rig, [])
    assert "--tripod" in failure_message(None, views_of(10), [])


@pytest.mark.parametrize(("limit", "tried"), [(1, 1), (3, 3), (8, 8)])
def test_no_more_mappings_than_allowed_are_tried(tmp_path, monkeypatch, limit, tried):
    jobs = []

    def fail(tries, at_once):
        for attempt in tries:
            jobs.append(attempt.task)
            yield sfm.SfmError("nothing matches")

    job = sfm.Job(str(tmp_path), [[]], [], 100.0, "match")
    monkeypatch.setattr(reconstruct, "write_job", lambda *_: job)
    monkeypatch.setattr(sfm, "run_in_turn", fail)
    tuning = ReconstructionTuning(max_attempts=limit)
    with pytest.raises(InputError, match="nothing matches"):
        best_model(views_of(5), tmp_path, 1, "sift", tuning)
    assert len(jobs) == tried


@pytest.mark.parametrize(
    ("reason", "blames_pictures"), [("nothing matches", True), (sfm.KILLED, False)]
)
def test_a_machine_that_fails_does_not_speak_against_the_pictures(
    tmp_path, monkeypatch, reason, blames_pictures
):
    def fail(tries, at_once):
        return (sfm.SfmError(reason) for _ in tries)

    job = sfm.Job(str(tmp_path), [[]], [], 100.0, "match")
    monkeypatch.setattr(reconstruct, "write_job", lambda *_: job)
    monkeypatch.setattr(sfm, "run_in_turn", fail)
    with pytest.raises(InputError) as refusal:
        best_model(views_of(5), tmp_path, 1, "sift")
    assert isinstance(refusal.value, NoSceneError) == blames_pictures


@pytest.mark.parametrize(
    ("ways", "tried", "taken"),
    [
        ([(250, 0.5), (260, 0.3)], 1, 250),  # the first good one
        ([(60, 0.4), (250, 0.5), (60, 0.1), (300, 0.3)], 5, 300),  # the best good one
        ([(250, 0.7), (300, 0.6)], 5, 300),  # the same where the first one fits badly
        ([(None, 0.0), (250, 0.5), (300, 0.3)], 2, 250),  # too few images are no such doubt
    ],
)
def test_where_a_model_is_in_doubt_every_way_is_tried(tmp_path, monkeypatch, ways, tried, taken):
    def of_way(focal, error):
        found = model(focal or 250, 5 if focal else 2)
        return replace(found, errors=np.full(9, error), track_lengths=np.full(9, 3))

    models, jobs = {}, []

    def map_in_turn(tries, at_once):
        for k, attempt in enumerate(tries):
            jobs.append(attempt.task)
            folder = tmp_path / str(k)
            folder.mkdir()
            (folder / "focal").write_text(str(k))
            models[folder] = of_way(*ways[k]) if k < len(ways) else of_way(60, 0.2)
            yield [folder]

    job = sfm.Job(str(tmp_path), [[]], [], 100.0, "match", keyframes=["00000.png"])
    monkeypatch.setattr(reconstruct, "write_job", lambda *_: job)
    monkeypatch.setattr(sfm, "run_in_turn", map_in_turn)
    monkeypatch.setattr(reconstruct, "read_model", models.__getitem__)
    earlier = EarlierRounds()
    found, _ = best_model(views_of(5), tmp_path, 1, "sift", earlier=earlier)
    assert found.cameras[1].K[0, 0] == taken
    assert len(jobs) == tried
    assert ways[int(earlier.model["focal"])][0] == taken
