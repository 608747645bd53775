"""The lens that structure from motion finds, and where it finds none."""

import numpy as np
import posed_clips
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.tensors import CPU
from hdr_nsff.footage.colmap import ColmapCamera, ColmapImage, ColmapModel
from hdr_nsff.geometry.lens import Lens, distorted_picture
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.estimate import PosesTuning, estimate_poses
from hdr_nsff.priors.poses.lens import LensTuning, bent_cameras
from hdr_nsff.priors.poses.mapper import Mapper
from hdr_nsff.priors.poses.reconstruct import ReconstructionTuning, SfmViews
from hdr_nsff.priors.poses.view_matches import EarlierRounds

LENS = Lens(posed_clips.K, (0.15, 0.0, 0.0, 0.0), posed_clips.W, posed_clips.H)


@pytest.fixture(scope="module")
def clip():
    return posed_clips.sliding(posed_clips.PLACES)


def test_a_clip_of_a_pinhole_camera_has_the_same_poses_with_the_search_as_without(tmp_path, clip):
    searched, plain = (
        estimate_poses(clip, None, tmp_path, threads=1, lens=choice) for choice in ("auto", "none")
    )
    assert not searched.lenses and np.array_equal(searched.c2w, plain.c2w)
    assert np.array_equal(searched.K, plain.K)


def test_the_distortion_of_a_clip_is_found(tmp_path, clip):
    bent = np.stack([distorted_picture(frame, posed_clips.K, LENS) for frame in clip])
    lens = estimate_poses(bent, None, tmp_path, threads=1, lens="auto").lenses[0]
    assert lens.max_displacement_px() == pytest.approx(LENS.max_displacement_px(), rel=0.25)
    assert lens.distortion[0] > 0 and lens.distortion[1:] == (0, 0, 0)


def test_a_lens_is_found_from_the_poses_of_the_pinhole_camera(tmp_path, clip, monkeypatch):
    tasks = []

    def run(jobs, at_once):
        for job, models in zip(jobs, map_images(jobs, at_once), strict=True):
            tasks.append(job.task)
            yield models

    map_images = sfm.run_in_turn
    monkeypatch.setattr(sfm, "run_in_turn", run)
    bent = np.stack([distorted_picture(frame, posed_clips.K, LENS) for frame in clip])
    assert estimate_poses(bent, None, tmp_path, threads=1, lens="auto").lenses
    assert tasks == ["incremental", "adjust"]


def test_given_distortion_is_held_and_gets_a_focal_length(tmp_path, clip):
    bent = np.stack([distorted_picture(frame, posed_clips.K, LENS) for frame in clip])
    lens = estimate_poses(bent, None, tmp_path, threads=1, lens=(0.15, 0.0)).lenses[0]
    assert lens.distortion == (0.15, 0, 0, 0)
    assert lens.K[0, 0] == pytest.approx(posed_clips.FOCAL, rel=0.1)


def test_where_no_mapping_with_the_lens_succeeds_its_fit_counts(tmp_path, clip, monkeypatch):
    def fail(self, mapping, max_error_px):
        raise InputError("too few views")

    bent = np.stack([distorted_picture(frame, posed_clips.K, LENS) for frame in clip])
    monkeypatch.setattr(Mapper, "bent_poses", fail)
    lens = estimate_poses(bent, None, tmp_path, threads=1, lens="auto").lenses[0]
    assert lens.max_displacement_px() == pytest.approx(LENS.max_displacement_px(), rel=0.3)
    assert (lens.width, lens.height) == (posed_clips.W, posed_clips.H)


def test_a_lens_whose_model_fits_worse_than_the_pinholes_is_none(tmp_path, clip):
    bent = np.stack([distorted_picture(frame, posed_clips.K, LENS) for frame in clip])
    strict = ReconstructionTuning(lens=LensTuning(max_model_error_share=0.01))
    searched, plain = (
        estimate_poses(
            bent, None, tmp_path, threads=1, lens=choice, tuning=PosesTuning(reconstruction=strict)
        )
        for choice in ("auto", "none")
    )
    assert not searched.lenses and np.array_equal(searched.c2w, plain.c2w)


@pytest.mark.parametrize("lens", [(0.15, 0.0), "auto"])
def test_a_camera_with_a_lens_that_does_not_register_is_named(tmp_path, clip, monkeypatch, lens):
    camera = ColmapCamera("RADIAL", posed_clips.W, posed_clips.H, posed_clips.K, np.zeros(2))
    nothing = np.zeros(0)
    image = ColmapImage("00000.png", 1, np.eye(4)[:3], np.zeros((0, 2)), nothing)
    model = ColmapModel({1: camera}, {1: image}, nothing, np.zeros((0, 3)), nothing, nothing)
    views = SfmViews(clip[:2], np.zeros(clip.shape[:3], bool)[:2], [[0], [1]], np.arange(2))
    tuning = ReconstructionTuning()
    mapper = Mapper(views, tmp_path, 1, "sift", tuning, CPU, EarlierRounds())
    fit = sfm.LensFit({1: (posed_clips.FOCAL, 0.15, 0.0)}, model_error_px=1.0, error_px=0.5)
    monkeypatch.setattr(Mapper, "model", lambda *_: (model, 1))
    monkeypatch.setattr("hdr_nsff.priors.poses.mapper.lens_fit", lambda *_: fit)
    with pytest.raises(InputError, match="none of the frames of one camera could be registered"):
        mapper.poses(lens)


@pytest.mark.parametrize(
    ("fov", "error_share", "bends"),
    [(60, 0.8, True), (30, 0.8, True), (15, 0.8, False), (60, 0.9945, True), (60, 0.9968, False)],
)
def test_a_lens_bends_where_that_explains_the_clip_better_but_no_long_one(fov, error_share, bends):
    focal = 320 / np.tan(np.radians(fov / 2))
    camera = ColmapCamera("SIMPLE_PINHOLE", 640, 360, np.diag([focal, focal, 1]), np.zeros(0))
    nothing = np.zeros(0)
    model = ColmapModel({1: camera}, {}, nothing, np.zeros((0, 3)), nothing, nothing)
    k1 = 0.03 * (focal / 320) ** 2  # ten pixels at the corners, whatever the focal length
    fit = sfm.LensFit({1: (focal, k1, 0.0)}, model_error_px=0.5, error_px=0.5 * error_share)
    found = bent_cameras(fit, model, scale=1)
    assert [mapping.distortion for mapping in found] == ([(k1, 0.0)] if bends else [])
