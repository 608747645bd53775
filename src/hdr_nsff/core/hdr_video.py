"""HDR video: planes of 10-bit codes to HEVC Main 10, AV1 or ProRes, through PyAV.

The codes are Y, Cb and Cr of BT.2100, limited range: 4:2:0 in MP4, and for ProRes 4444,
which editing programs take, 4:4:4 in MOV. Stream and frames are tagged. PQ in MP4
carries the metadata of HDR10: the mastering display (SMPTE ST 2086) and the content's
light levels (CTA-861.3).
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic

Codec = Literal["hevc", "av1", "prores"]
Planes = tuple[np.ndarray, np.ndarray, np.ndarray]

ENCODERS = {"hevc": "libx265", "av1": "libsvtav1", "prores": "prores_ks"}
# Codes of H.273, the same in both codecs
REC2020_PRIMARIES = 9
REC2020_MATRIX = 9  # non-constant luminance
LIMITED_RANGE = 1
TRANSFERS = {"pq": 16, "hlg": 18}
PIXELS = "yuv420p10le"
FULL_CHROMA_PIXELS = "yuv444p10le"  # of ProRes 4444
PRORES_OPTIONS = {"profile": "4444", "vendor": "apl0"}  # the vendor that editors expect
# Constant quality (hand-chosen: a gray patch and a ramp keep their codes within 2)
HEVC_CRF = 14
AV1_CRF = 18
AV1_PRESET = 6  # of 0 (slow) to 13
MIN_SIDE_PX = 64  # x265 4.2 overruns its buffers at widths of 48 and less
MAX_AV1_FPS = 240  # of SVT-AV1
MAX_DELAY = 1000  # frames: far more than an encoder ever waits for


@dataclass(frozen=True)
class LightLevels:
    """Light levels of a video (CTA-861.3), in nits."""

    max_cll: float  # the largest channel of any pixel
    max_fall: float  # the largest mean over a frame of the pixels' largest channels


def check_encoder(codec: Codec) -> None:
    """InputError where the user's PyAV has no encoder for `codec`."""
    import av

    encoder = ENCODERS[codec]
    try:
        av.Codec(encoder, "w")
    except (av.FFmpegError, ValueError) as error:
        advice = "`pip install --force-reinstall av` installs one that has it"
        raise InputError(f"HDR video: this PyAV has no encoder {encoder}; {advice}") from error


def can_encode(codec: Codec, width: int, height: int, fps: float) -> bool:
    """Whether this PyAV writes HDR video of this size and rate."""
    try:
        check_encoder(codec)
        check_side("", width, height)
        check_rate("", codec, fps)
    except InputError:
        return False
    return True


def write_hdr_video(
    path: Path | str,
    frames: Iterable[Planes],
    fps: float,
    transfer: str,
    codec: Codec = "hevc",
    light: LightLevels | None = None,
    peak_nits: float = 1000.0,
) -> int:
    """Write planes Y (H, W), Cb, Cr uint16 as MP4 or MOV, atomically; their number.

    `transfer` is `pq` or `hlg`. With `light` and the mastering display's `peak_nits`
    an MP4 is HDR10. H and W are even; chroma is (H, W) for ProRes, else (H/2, W/2).
    """
    import av

    check_encoder(codec)
    check_rate(path, codec, fps)
    os.environ.setdefault("SVT_LOG", "1")  # errors only: SVT-AV1 prints banners otherwise
    count = 0
    with (
        atomic(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container,
    ):
        stream: Any = None
        for planes in frames:
            if stream is None:
                height, width = planes[0].shape
                check_side(path, width, height)
                options = encoder_options(codec, transfer, light, peak_nits)
                stream = container.add_stream(ENCODERS[codec], rate=rate_of(fps), options=options)
                stream.width, stream.height = width, height
                stream.pix_fmt = pixel_format(codec)
                if codec == "hevc":  # Apple's players take no other tag
                    stream.codec_context.codec_tag = "hvc1"
                tag_rec2020(stream.codec_context, transfer)
            container.mux(timed(stream.encode(to_frame(planes, transfer, pixel_format(codec)))))
            count += 1
        if stream is None:
            raise InputError(f"{path}: no frames to write")
        container.mux(timed(stream.encode()))
    return count


def check_side(path: Path | str, width: int, height: int) -> None:
    """InputError for pictures that the encoders do not take."""
    if min(width, height) < MIN_SIDE_PX:
        size = f"pictures of {width} x {height} pixels"
        limit = f"an HDR encoder takes at least {MIN_SIDE_PX} pixels a side; use larger ones"
        raise InputError(f"{path}: {size}; {limit}")


def check_rate(path: Path | str, codec: Codec, fps: float) -> None:
    """InputError for more frames a second than the encoder takes."""
    if codec == "av1" and rate_of(fps) > MAX_AV1_FPS:
        limit = f"AV1 has at most {MAX_AV1_FPS}; choose --hdr-codec hevc, or a lower rate"
        raise InputError(f"{path}: {fps:g} frames a second; {limit}")


def rate_of(fps: float) -> Fraction:
    """Frames a second as encoders take them."""
    return Fraction(fps).limit_denominator(1001)


def timed(packets: list[Any]) -> list[Any]:
    """Packets with the times at which they are decoded.

    In videos of one or two frames, x265 leaves these unset: any number may be there.
    """
    for packet in packets:
        if packet.dts < -MAX_DELAY:
            packet.dts = packet.pts
    return packets


def has_full_chroma(codec: Codec) -> bool:
    """Whether chroma has the size of luma (4:4:4) instead of half of it (4:2:0)."""
    return codec == "prores"


def pixel_format(codec: Codec) -> str:
    """FFmpeg's name of the planes of a codec."""
    return FULL_CHROMA_PIXELS if has_full_chroma(codec) else PIXELS


def to_frame(planes: Planes, transfer: str, pixels: str = PIXELS) -> Any:
    """A tagged frame of PyAV with these planes."""
    import av

    height, width = planes[0].shape
    frame = av.VideoFrame(width, height, pixels)
    tag_rec2020(frame, transfer)
    for target, codes in zip(frame.planes, planes, strict=True):
        rows = np.zeros((codes.shape[0], target.line_size // 2), "<u2")
        rows[:, : codes.shape[1]] = codes
        target.update(rows.tobytes())
    return frame


def tag_rec2020(target: Any, transfer: str) -> None:
    """Color tags of BT.2100 on a codec context or a frame."""
    target.colorspace = REC2020_MATRIX
    target.color_range = LIMITED_RANGE
    target.color_primaries = REC2020_PRIMARIES
    target.color_trc = TRANSFERS[transfer]


def encoder_options(
    codec: Codec, transfer: str, light: LightLevels | None, peak_nits: float
) -> dict[str, str]:
    """Options of FFmpeg for the encoder: quality, and the metadata of HDR10."""
    if codec == "prores":
        return PRORES_OPTIONS
    levels = ""
    if light is not None:
        levels = f"{round(light.max_cll)},{round(light.max_fall)}"
    if codec == "hevc":
        parameters = ["log-level=error", "repeat-headers=1"]
        if light is not None:
            display = hevc_display(peak_nits)
            parameters += ["hdr10=1", f"max-cll={levels}", f"master-display={display}"]
        return {"crf": str(HEVC_CRF), "x265-params": ":".join(parameters)}
    parameters = ["color-primaries=9", "matrix-coefficients=9"]
    parameters += [f"transfer-characteristics={TRANSFERS[transfer]}", "color-range=0"]
    if light is not None:
        display = f"{AV1_PRIMARIES}L({peak_nits:g},{BLACK_NITS:g})"
        parameters += [f"content-light={levels}", f"mastering-display={display}"]
    options = {"crf": str(AV1_CRF), "preset": str(AV1_PRESET)}
    return {**options, "svtav1-params": ":".join(parameters)}


# The mastering display has the primaries of BT.2020 and white D65
HEVC_PRIMARIES = "G(8500,39850)B(6550,2300)R(35400,14600)WP(15635,16450)"  # in 1/50000
AV1_PRIMARIES = "G(0.17,0.797)B(0.131,0.046)R(0.708,0.292)WP(0.3127,0.329)"
BLACK_NITS = 0.005


def hevc_display(peak_nits: float) -> str:
    """The mastering display in x265's words; light in 1/10000 nit."""
    return f"{HEVC_PRIMARIES}L({round(peak_nits * 1e4)},{round(BLACK_NITS * 1e4)})"
