"""Video whose tags name another transfer than a camera's curve: HDR, log and linear."""

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from hdr_nsff.core.exr import REC709
from hdr_nsff.core.hdr_video import write_hdr_video
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.maths.hdr_signal import REC2020, hlg_oetf, pq_encode, rgb_to_xyz, ycbcr_planes


@pytest.mark.parametrize("transfer", ["hlg", "pq"])
def test_hdr_video_is_brought_to_linear_light_by_its_tags(tmp_path: Path, transfer: Any) -> None:
    light = np.zeros((64, 96, 3))
    light[...] = [0.3, 0.1, 0.05]  # Rec. 709, of the peak
    light[:, 48:] *= 0.25
    to_2020 = np.linalg.solve(rgb_to_xyz(REC2020), rgb_to_xyz(REC709))
    wide = light @ to_2020.T
    signal = pq_encode(1000 * wide) if transfer == "pq" else hlg_oetf(wide)
    write_hdr_video(tmp_path / "a.mp4", [ycbcr_planes(signal)] * 3, 24, transfer)
    footage = open_footage(tmp_path / "a.mp4")
    assert footage.transfer == transfer
    frame = next(read_frames(footage, 0, None, 1, 4096))
    for column, factor in ((20, 1.0), (76, 0.25)):
        found = frame.rgb[32, column] ** 2.2
        assert found == pytest.approx(factor * np.array([0.3, 0.1, 0.05]), rel=0.04, abs=2e-3)


def write_tagged(path: Path, signal: np.ndarray, code: int) -> None:
    """A lossless video of a gray signal (H, W) in [0, 1] in full range, whose transfer
    characteristics have this code.
    """
    luma = np.rint(255 * signal).astype(np.uint8)
    planes = np.stack([luma, 0 * luma + 128, 0 * luma + 128])
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"qp": "0", "preset": "fast"})
        stream.height, stream.width = signal.shape
        stream.pix_fmt = "yuvj444p"
        tags = stream.codec_context
        tags.color_trc, tags.color_primaries, tags.colorspace, tags.color_range = code, 1, 1, 2
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(planes, format="yuvj444p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize(
    ("code", "transfer", "light"),
    [
        (8, "linear", [0.0, 0.2, 0.6, 1.0]),
        (9, "log100", [0.0, 10**-1.6, 10**-0.8, 1.0]),
        (10, "log316", [0.0, 10**-2.0, 10**-1.0, 1.0]),
    ],
)
def test_linear_and_log_video_is_brought_to_light_by_its_tags(
    tmp_path: Path, code: int, transfer: str, light: list[float]
) -> None:
    signal = np.repeat([0.0, 0.2, 0.6, 1.0], 16)  # of which a log is 1 + log10(light) / 2
    write_tagged(tmp_path / "a.mp4", np.tile(signal, (32, 1)), code)
    footage = open_footage(tmp_path / "a.mp4")
    assert footage.transfer == transfer
    frame = next(read_frames(footage, 0, None, 1, 4096))
    found = frame.rgb[16, 8::16] ** 2.2  # (4, 3)
    np.testing.assert_allclose(found, np.tile(light, (3, 1)).T, rtol=0.04, atol=2e-3)


def test_video_without_hdr_tags_is_taken_as_recorded(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", [np.full((16, 16, 3), 0.5)] * 3)
    assert open_footage(tmp_path / "a.mp4").transfer is None
