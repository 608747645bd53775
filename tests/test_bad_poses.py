"""Given poses that make no sense, or do not fit, are refused in a sentence."""

import numpy as np
import pytest
from test_pose_files import (
    NAMES,
    H,
    W,
    colmap_binary,
    colmap_text,
    llff_table,
    transforms,
    write,
)

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.pose_files import import_poses
from hdr_nsff.footage.pose_formats import from_transforms


def bad_npy(folder):
    np.save(folder / "poses_bounds.npy", llff_table()[:, :15])


def bad_count(folder):
    np.save(folder / "poses_bounds.npy", np.tile(llff_table(), (2, 1)))


def bad_distortion(folder):
    write(folder / "transforms.json", transforms(k1=0.3))


def bad_model(folder):
    # distortion too small to matter in a pinhole camera
    small = {"k1": 1e-4, "k2": 1e-5, "k3": 0.0, "k4": 0.0}
    write(folder / "transforms.json", transforms(camera_model="OPENCV_FISHEYE", **small))


def bad_model_of_a_frame(folder):
    document = transforms(camera_model="PINHOLE")
    document["frames"][1]["camera_model"] = "EQUIRECTANGULAR"
    write(folder / "transforms.json", document)


def bad_fisheye(folder):
    write(folder / "transforms.json", transforms(is_fisheye=True))


def bad_terms(folder):
    write(folder / "transforms.json", transforms(camera_model="OPENCV", k4=1e-3))


def bad_colmap_fisheye(folder):
    colmap_text(folder, camera="1 OPENCV_FISHEYE 64 48 50 50 32 24 0 0 0 0")


def bad_shape(folder):
    write(folder / "transforms.json", transforms(w=64, h=64))


def bad_nan(folder):
    table = llff_table()
    table[1, 3] = np.nan
    np.save(folder / "poses_bounds.npy", table)


def bad_json(folder):
    (folder / "transforms.json").write_text("{")


def bad_missing_focal(folder):
    document = transforms()
    del document["fl_x"]
    write(folder / "transforms.json", document)


def bad_truncated(folder):
    colmap_binary(folder / "0")
    whole = (folder / "0" / "images.bin").read_bytes()
    (folder / "0" / "images.bin").write_bytes(whole[:-5])


def bad_empty(folder):
    pass


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (bad_npy, "17"),
        (bad_count, "6 poses for 3 frames"),
        (bad_distortion, "distortion"),
        (bad_model, "the model OPENCV_FISHEYE is not that of a lens with k1"),
        (bad_model_of_a_frame, "the model EQUIRECTANGULAR is not"),
        (bad_fisheye, "the fisheye model .* is not"),
        (bad_terms, "distortion with k4, k5 or k6 is not"),
        (bad_colmap_fisheye, "OPENCV_FISHEYE is not a pinhole"),
        (bad_shape, "another shape"),
        (bad_nan, "NaN"),
        (bad_json, "export them again"),
        (bad_missing_focal, "focal length"),
        (bad_truncated, "cut short"),
        (bad_empty, "no poses here"),
    ],
)
def test_poses_that_do_not_fit_are_refused_in_a_sentence(tmp_path, make, words):
    make(tmp_path)
    with pytest.raises(InputError, match=words):
        import_poses(tmp_path, NAMES, (H, W))


@pytest.mark.parametrize(
    "change",
    [
        {"fl_x": 10**400},
        {"w": 10**400},
        {"k1": 10**400},
        {"k3": 10**400},
        {"k3": 1e308},
        {"k3": float("nan")},
        {"k4": float("nan")},
        {"near": 10**400},
        {"camera_angle_x": 0, "fl_x": None},
        {"near": -1.0},
        {"near": 5.0, "far": 1.0},
        {"far": float("nan")},
        {"cx": 1e300},
    ],
)
def test_numbers_that_no_camera_has_are_one_short_sentence(tmp_path, change):
    write(tmp_path / "transforms.json", transforms(**change))
    with pytest.raises(InputError, match=r"transforms\.json") as error:
        import_poses(tmp_path, NAMES, (H, W))
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("key", ["w", "h"])
def test_a_principal_point_needs_the_size_of_the_pictures(tmp_path, key):
    document = transforms(camera_angle_x=0.9)
    for missing in ("fl_x", key):
        del document[missing]
    with pytest.raises(InputError, match="`cx`, `cy` without `w`, `h`"):
        from_transforms(tmp_path / "transforms.json", document)


@pytest.mark.filterwarnings("error")
def test_poses_with_nan_and_inf_are_one_sentence_without_warnings(tmp_path):
    for value in (np.nan, np.inf):
        table = llff_table()
        table[2, 3] = value
        np.save(tmp_path / "poses_bounds.npy", table)
        with pytest.raises(InputError, match="hold NaN, Inf"):
            import_poses(tmp_path, NAMES, (H, W))
