"""HDR stills of a shot show the light of its EXR files."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from fakes import fake_run
from test_hdr_shots import large_shot
from test_hdr_video import luma
from test_ultra_hdr import decode

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.maths.hdr_signal import KNEE_NITS, display_light, encode, pq_decode, ycbcr_planes
from hdr_nsff.rendering.output import Output
from hdr_nsff.rendering.shots import render_shot

ALL = Output(exr="float", hdr_still=("ultrahdr", "avif", "png16"), ev=-1.0)


def test_stills_show_the_radiance_of_the_exr(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    render_shot(run, large_shot(), tmp_path, ALL)
    neutral = run.tonemapper.neutral(0).detach().numpy()
    radiance = read_exr(tmp_path / "some/00001.exr")["RGB"] * neutral
    light = display_light(radiance, 0.5, "pq")
    png = cv2.imread(str(tmp_path / "some/00001_pq.png"), cv2.IMREAD_UNCHANGED)
    assert np.allclose(pq_decode(png[..., ::-1] / 65535), light, rtol=1e-3, atol=1e-3)
    with av.open(str(tmp_path / "some/00001_pq.avif")) as container:
        codes = luma(next(container.decode(video=0)))
    assert np.abs(codes - ycbcr_planes(encode(light, "pq"))[0].astype(int)).mean() < 2
    found = decode((tmp_path / "some/00001_ultrahdr.jpg").read_bytes())
    below_knee = light.max(-1) < KNEE_NITS
    expected = 0.5 * radiance
    error = (np.abs(found - expected) / np.maximum(expected, 0.05))[below_knee]
    assert np.median(error) < 0.02 and np.percentile(error, 95) < 0.1


def test_stills_are_added_without_rendering_again(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    render_shot(run, large_shot(), tmp_path, Output())
    before = run.field.calls
    render_shot(run, large_shot(), tmp_path, Output(hdr_still=("ultrahdr",)))
    assert run.field.calls == before and (tmp_path / "some/00001_ultrahdr.jpg").is_file()


def test_stills_of_other_settings_are_made_again(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    stills = [tmp_path / "some/00000_pq.png", tmp_path / "some/00000_pq.avif"]
    before = []
    for ev in (0.0, -1.0):
        render_shot(run, large_shot(), tmp_path, Output(hdr_still=("png16", "avif"), ev=ev))
        before.append([still.read_bytes() for still in stills])
    assert all(a != b for a, b in zip(*before, strict=True))


def test_pictures_too_small_for_avif_are_refused_before_rendering(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    before = run.field.calls
    with pytest.raises(InputError, match="48 x 32 pixels"):
        render_shot(run, large_shot(1.0), tmp_path / "out", Output(hdr_still=("avif",)))
    assert run.field.calls == before and not (tmp_path / "out").exists()
