"""PQ stills are read again by other programs: FFmpeg, OpenCV, Pillow."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from test_hdr_video import luma, ramp

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_still import write_avif, write_pq_png
from hdr_nsff.core.hdr_video import LightLevels
from hdr_nsff.maths.hdr_signal import encode, pq_decode


def test_avif_is_decoded_with_its_tags_and_codes(tmp_path: Path) -> None:
    path = tmp_path / "a.avif"
    planes = ramp("pq")
    write_avif(path, planes)
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    assert frame.format.name == "yuv420p10le"
    assert (frame.color_primaries, frame.color_trc, frame.colorspace) == (9, 16, 9)
    assert np.abs(luma(frame) - planes[0].astype(int)).mean() < 1
    assert np.abs(luma(frame)[:, 8:56] - 573).max() <= 2  # diffuse white, 203 nits
    with Image.open(path) as image:
        assert image.size == (704, 64)


def test_png_has_16_bits_of_pq_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    light = np.random.default_rng(0).uniform(0.1, 1000, (5, 7, 3))
    write_pq_png(path, encode(light, "pq"), LightLevels(812.5, 97.25))
    seen = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert seen.dtype == np.uint16
    assert np.allclose(pq_decode(seen[..., ::-1] / 65535), light, rtol=1e-3)
    with av.open(str(path)) as container:
        frame = next(container.decode(video=0))
    assert (frame.color_primaries, frame.color_trc, frame.color_range) == (9, 16, 2)
    data = path.read_bytes()
    assert data.index(b"cICP") < data.index(b"IDAT")
    place = data.index(b"cLLI") + 4
    assert struct.unpack(">II", data[place : place + 8]) == (8125000, 972500)


def test_a_picture_too_small_for_avif_is_refused(tmp_path: Path) -> None:
    planes = ramp("pq")
    small = (planes[0][:8, :8], planes[1][:4, :4], planes[2][:4, :4])
    with pytest.raises(InputError, match="8 x 8 pixels; an HDR encoder takes at least 64"):
        write_avif(tmp_path / "a.avif", small)
    assert not list(tmp_path.iterdir())
