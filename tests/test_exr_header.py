"""The white balance of rendered EXR files, and what their headers say about it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from fakes import DiscBeforeWall, camera, fake_run
from torch import Tensor

from hdr_nsff.core.exr import REC709, read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.fields.base import Render
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.exr_header import WhiteBalance, rec709_to_xyz, white_of
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shots import render_shot
from hdr_nsff.rendering.standard_set import render_all
from hdr_nsff.training.run_folder import Run

GAMMAS = (2.2, 1.8, 2.8)  # of a camera whose channels differ: mid gray has a tint


class GrayWorld(DiscBeforeWall):
    """One radiance (3,) wherever one looks."""

    def __init__(self, radiance: Tensor) -> None:
        super().__init__()
        self.gray = radiance

    def render(self, *args: Any, **options: Any) -> Render:
        seen = super().render(*args, **options)
        return replace(seen, radiance=self.gray.expand_as(seen.radiance))


def tinted_run(folder: Path) -> Run:
    run = fake_run(folder)
    x = torch.linspace(0, 1, 256)
    curves = torch.stack([x ** (1 / g) for g in GAMMAS])
    run.tonemapper.set_curve(x, curves)  # type: ignore[attr-defined]
    return run


def render_once(folder: Path, choice: WhiteBalance, run: Run | None = None) -> Path:
    output = Output(exr="float", video=False, white_balance=choice)
    shot = Shot("one", [PathView(camera(), 0.0)], 12)
    render_shot(run or tinted_run(folder), shot, folder / choice, output)
    return folder / choice / "one/00000.exr"


def header_of(path: Path) -> dict[str, object]:
    with OpenEXR.File(str(path), header_only=True) as file:
        return dict(file.header())


def gains_in(header: dict[str, object], name: str) -> np.ndarray:
    return np.array([float(word) for word in str(header[name]).split()])


def test_camera_is_the_default_and_leaves_radiance_alone(tmp_path: Path) -> None:
    assert Output().white_balance == "camera"
    run = tinted_run(tmp_path)
    stored = read_exr(render_once(tmp_path, "camera", run))["RGB"]
    exact = run.field.render(camera(), 0.0).radiance.numpy().reshape(stored.shape)
    assert np.array_equal(stored, exact)


def test_neutral_makes_a_gray_patch_gray(tmp_path: Path) -> None:
    run = tinted_run(tmp_path)
    gray = run.tonemapper.inverse(torch.full((1, 3), 0.5), 2)[0]  # recorded as mid gray
    assert float(gray.max() / gray.min()) > 1.5
    run = replace(run, field=GrayWorld(gray))
    before = read_exr(render_once(tmp_path, "camera", run))["RGB"]
    after = read_exr(render_once(tmp_path, "neutral", run))["RGB"]
    assert np.ptp(before[0, 0]) > 0.05
    np.testing.assert_allclose(after, after.mean(-1, keepdims=True).repeat(3, -1), rtol=1e-4)


def test_the_header_has_the_gains_that_lead_from_one_to_the_other(tmp_path: Path) -> None:
    camera_file, neutral_file = (render_once(tmp_path, c) for c in ("camera", "neutral"))
    before, after = header_of(camera_file), header_of(neutral_file)
    gains = gains_in(before, "neutralWhiteBalance")
    assert gains.prod() == pytest.approx(1, rel=1e-4) and np.ptp(gains) > 0.1
    np.testing.assert_array_equal(gains, gains_in(after, "appliedWhiteBalance"))
    for header, name in ((before, "appliedWhiteBalance"), (after, "neutralWhiteBalance")):
        np.testing.assert_array_equal(gains_in(header, name), 1)
    a, b = read_exr(camera_file)["RGB"], read_exr(neutral_file)["RGB"]
    np.testing.assert_allclose(b, a * gains, rtol=1e-5)


def test_chromaticities_say_what_the_numbers_are(tmp_path: Path) -> None:
    neutral = header_of(render_once(tmp_path, "neutral"))
    np.testing.assert_allclose(neutral["chromaticities"], REC709, atol=1e-6)
    header = header_of(render_once(tmp_path, "camera"))
    found = np.array(header["chromaticities"])
    np.testing.assert_allclose(found[:6], REC709[:6], atol=1e-6)
    gains = gains_in(header, "neutralWhiteBalance")
    # a stored gray, read in these chromaticities, is D65
    xyz = to_xyz(found) @ (1 / gains)
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), REC709[6:], atol=1e-4)
    np.testing.assert_allclose(header["adoptedNeutral"], REC709[6:], atol=1e-6)


def to_xyz(chromaticities: np.ndarray) -> np.ndarray:
    """The matrix of an RGB space, channel by channel, its white of luminance 1."""
    xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in chromaticities.reshape(4, 2)])
    return xyz[:3].T @ np.diag(np.linalg.solve(xyz[:3].T, xyz[3]))


def test_the_matrix_of_rec_709_is_the_standard_one() -> None:
    standard = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    np.testing.assert_allclose(rec709_to_xyz(), standard, atol=2e-4)
    assert white_of(np.ones(3)) == pytest.approx(REC709[6:])


def test_pictures_are_the_same_in_either_white_balance(tmp_path: Path) -> None:
    for choice in ("camera", "neutral"):
        output = Output(exr="float", video=False, white_balance=choice)
        render_all(tinted_run(tmp_path), tmp_path / choice, budget=3.0, output=output)
    for name in ("training/00002.png", "ldr/ev-2.0/00002.png"):
        a, b = (read_image(tmp_path / choice / name) for choice in ("camera", "neutral"))
        np.testing.assert_allclose(a, b, atol=1.1 / 255)
