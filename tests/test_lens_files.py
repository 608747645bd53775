"""Calibrations of other programs become a lens."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.lens_files import read_lens
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.lens import Lens

K = np.array([[500.0, 0, 322], [0, 505.0, 241], [0, 0, 1]])
COEFFICIENTS = (-0.21, 0.06, 0.0004, -0.0003)
LENS = Lens(K, COEFFICIENTS, 640, 480)

ROS = """image_width: 640
image_height: 480
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [500., 0., 322., 0., 505., 241., 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data:
    [
      -0.21, 0.06,
      0.0004, -3e-4, 0.000000
    ]
projection_matrix:
  rows: 3
  cols: 4
  data: [400., 0., 322., 0., 0., 400., 241., 0., 0., 0., 1., 0.]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.21, 0.06, 0.0004, -0.0003]
  distortion_model: radtan
  intrinsics: [500, 505, 322, 241]
  resolution: [640, 480]
  rostopic: /cam0/image
cam1:
  distortion_coeffs: [0, 0, 0, 0]
"""
TRANSFORMS = {
    **{"fl_x": 500, "fl_y": 505, "cx": 322, "cy": 241, "w": 640, "h": 480},
    **dict(zip(("k1", "k2", "p1", "p2"), COEFFICIENTS, strict=True)),
    "frames": [],
}
PLAIN = {
    "camera_matrix": K.tolist(),
    "dist_coeff": [[*COEFFICIENTS, 0]],
    "image_width": 640,
    "image_height": 480,
}


def opencv_file(path: Path, coefficients: tuple[float, ...] = COEFFICIENTS) -> Path:
    """What OpenCV's own sample for calibration writes."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array(coefficients)[:, None])
    storage.write("avg_reprojection_error", 0.21)
    storage.release()
    return path


def assert_same(lens: Lens) -> None:
    np.testing.assert_allclose(lens.K, K)
    np.testing.assert_allclose(lens.distortion, COEFFICIENTS)
    assert (lens.width, lens.height) == (640, 480)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("left.yaml", ROS),
        ("camchain.yaml", KALIBR),
        ("transforms.json", json.dumps(TRANSFORMS)),
        ("calibration.json", json.dumps(PLAIN)),
        ("cameras.txt", "# one\n1 OPENCV 640 480 500 505 322 241 -0.21 0.06 0.0004 -0.0003\n"),
    ],
)
def test_one_lens_is_read_from_every_format(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert_same(read_lens(tmp_path / name))


@pytest.mark.parametrize("name", ["lens.yml", "lens.json"])
def test_files_of_opencv_are_read(tmp_path: Path, name: str) -> None:
    assert_same(read_lens(opencv_file(tmp_path / name)))


def test_more_radial_terms_become_two_that_bend_alike(tmp_path: Path) -> None:
    coefficients = (-0.25, 0.09, 0.0, 0.0, -0.01)
    lens = read_lens(opencv_file(tmp_path / "lens.yml", coefficients))
    pixels = LENS.border()[::16]
    rays = pinhole.homogeneous(0.8 * pinhole.camera_rays(pixels, K)[..., :2])
    true, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(coefficients))
    assert np.abs(lens.distort(pinhole.to_pixels(rays, K), K) - true[:, 0]).max() < 0.6


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.yaml", ROS.replace("plumb_bob", "equidistant"), "equidistant is not that of"),
        ("a.yaml", ROS.replace("image_width", "nothing"), "the size of the pictures"),
        ("a.yaml", "a: 1\n", "no camera matrix"),
        ("a.json", json.dumps({**TRANSFORMS, "is_fisheye": True}), "the fisheye model"),
        ("a.json", json.dumps({**TRANSFORMS, "k4": 0.01}), "distortion with k4, k5 or k6"),
        ("a.json", json.dumps({**TRANSFORMS, "camera_model": "VR180_L"}), "the model VR180_L"),
        ("a.json", "[1]", "no camera matrix"),
        ("a.json", "{", "not"),
        ("a.txt", ROS, "no known calibration"),
        ("cameras.txt", "1 OPENCV_FISHEYE 640 480 500 505 322 241 0.1 0 0 0\n", "OPENCV_FISHEYE"),
        ("cameras.txt", f"1 RADIAL {10**10} 480 500 320 240 0.1 0\n", "impossible numbers"),
        (
            "cameras.txt",
            "1 RADIAL 640 480 500 320 240 0.1 0\n2 RADIAL 640 480 500 320 240 0.2 0\n",
            "2 cameras with different lenses",
        ),
    ],
)
def test_what_is_no_such_lens_is_refused(
    tmp_path: Path, name: str, text: str, problem: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=problem):
        read_lens(tmp_path / name)
