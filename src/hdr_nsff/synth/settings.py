"""The settings of `synth`, and what they may be."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from tyro.conf import Positional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.paths import MAX_EV
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry.hdr_stills import HdrStill
from hdr_nsff.radiometry.recording import Noise, response_curve
from hdr_nsff.synth.scenes.base import Views
from hdr_nsff.synth.scenes.geometry import intrinsics

MIN_FRAMES = 12  # fewer leave no view far from the frames of its time
MIN_SIDE = 16  # pixels of a picture
MAX_PIXELS = 64_000_000  # of a picture, as `render` has it
MAX_PATHS = 1_000_000  # per pixel: noise a thousandth of that of one path
# pictures that a lens distorts are traced this much wider than the clip, and finer
LENS_MARGIN, LENS_FINENESS = 1.25, 1.5
MAX_SEED = 999  # seeds of pictures are made of it, see `views`
MAX_NOISE = 1000.0  # times the noise of a small sensor


@dataclass(frozen=True)
class SynthConfig:
    """A path-traced scene filmed by a moving camera or a rig. `interior`: a room with a
    bright window, a tumbling box and a swinging ball. `lamp`: objects that rush past a
    lamp. `night`: an alley at night with lights that move. `cloth`: cloth and a dancing
    tube in the wind. `walk`: somebody walks, and the camera follows.
    """

    name: Positional[Literal["interior", "lamp", "night", "cloth", "walk"]]
    """The scene."""
    out: Positional[Path]
    """Folder to write."""
    views: Views = "mono"
    """mono: one moving camera; rig: nine synchronized ones that take the frames in
    turn.
    """
    size: str = "240x136"
    """Width x height in pixels, up to 64 megapixels."""
    frames: int = 36
    ev: str | None = None
    """Exposures that alternate, in stops and in the order they are taken, such as
    -4,-2,0. Default: the scene's.
    """
    response: str = "film"
    """The camera's response curve: film, log, gamma or srgb."""
    white_balance: str = "1.12,1,0.87"
    """Gains of red, green and blue before the response."""
    vignetting: float = 0.0
    """Fall-off of light towards the corners: 1 is the cos^4 law of a simple lens."""
    readout: float = 0.0
    """Milliseconds from the first row to the last of a rolling shutter. The truth has
    none.
    """
    shutter: float = 0.0
    """Share of a frame's time for which the shutter is open at the brightest exposure,
    which blurs motion. The truth is sharp.
    """
    lens: str = "0"
    """Radial distortion of the recordings, k1 or k1,k2 as OpenCV has them, such as
    -0.1; held-out views have none.
    """
    noise: float = 1.0
    """Noise relative to that of a small sensor; 0 is a perfect one."""
    spp: int | None = None
    """Paths per pixel; above 64 rounded to a multiple of it. Default: what suits the
    scene.
    """
    truth_spp: int | None = None
    """Paths per pixel of the held-out views."""
    seed: int = 0
    """Of textures, paths and noise."""
    variant: str = "auto"
    """Mitsuba's variant: auto, llvm_ad_rgb, scalar_rgb, cuda_ad_rgb."""
    hdr_video: tuple[Transfer, ...] = ()
    """Also write the clip's radiance as 10-bit HDR video, reference_hlg.mp4 and
    reference_pq.mp4: hlg, pq or both.
    """
    hdr_codec: Codec = "hevc"
    """Of these videos: hevc, av1 or prores (4444, MOV), as `render` has it."""
    hdr_still: tuple[HdrStill, ...] = ()
    """Also write its frames as HDR stills into reference/: ultrahdr (JPEG with a gain
    map), avif, png16 (both PQ).
    """
    oracle: bool = False
    """Also write a scene folder with exact poses and masks, and with depth and flow
    that have a little noise.
    """
    depth_noise: float = 0.03
    """Of the oracle's depth: relative, smooth over an eighth of the frame."""
    depth_grain: float = 0.0
    """Of the oracle's depth: relative, every pixel for itself."""
    flow_noise: float = 0.3
    """Of the oracle's flow, in pixels."""


def check(config: SynthConfig, min_paths: int, max_frames: int) -> None:
    """InputError for numbers out of range, before anything is rendered. `min_paths` is
    the smaller number of paths per pixel, of the clip or of the held-out views;
    `max_frames` is that of the scene.
    """
    response_curve(config.response)
    parse_white_balance(config.white_balance)
    c = config
    if not 0 <= c.vignetting <= 1:
        raise InputError(f"--vignetting {c.vignetting}: choose from 0 (none) to 1 (the cos^4 law)")
    if not (0 <= c.readout <= 1000 and 0 <= c.shutter <= 1):
        raise InputError(
            f"--readout {c.readout} --shutter {c.shutter}: choose 0 to 1000 milliseconds, "
            "and 0 (a moment) to 1 (open all the time)"
        )
    size = parse_size(c.size)
    if parse_lens(c.lens, intrinsics(*size), size) is not None and c.oracle:
        raise InputError("--lens, --oracle: exact flow is that of a pinhole; leave one out")
    if parse_lens(c.lens, intrinsics(*size), size) is not None and (c.readout or c.shutter):
        raise InputError("--lens and --readout or --shutter: record one of them")
    if not MIN_FRAMES <= c.frames <= max_frames:
        raise InputError(
            f"--frames {c.frames}: choose from {MIN_FRAMES} to {max_frames} for {c.name}; fewer "
            "leave no views far from the frames of their time, and in more, movers may leave "
            "the scene"
        )
    if not 0 <= c.seed <= MAX_SEED:
        raise InputError(f"--seed {c.seed}: choose from 0 to {MAX_SEED}")
    if min_paths < 1:
        raise InputError(
            f"--spp {c.spp} --truth-spp {c.truth_spp}: at least one path per pixel is needed"
        )
    for option, paths in (("--spp", c.spp), ("--truth-spp", c.truth_spp)):
        if paths is not None and paths > MAX_PATHS:
            raise InputError(f"{option}: choose at most {MAX_PATHS:,} paths per pixel")
    if not 0 <= c.noise < MAX_NOISE:
        raise InputError(f"--noise {c.noise}: choose from 0 (a perfect sensor) to {MAX_NOISE:g}")
    if not (0 <= c.depth_noise < 1 and 0 <= c.depth_grain < 1):
        raise InputError(
            f"--depth-noise {c.depth_noise} --depth-grain {c.depth_grain}: "
            "choose from 0 (exact) to 1"
        )
    if not 0 <= c.flow_noise < 100:
        raise InputError(f"--flow-noise {c.flow_noise}: choose from 0 (exact) to 100 pixels")


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) in pixels of "WxH"."""
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", text.lower())
    if found:
        size = int(found[1]), int(found[2])
        if min(size) >= MIN_SIDE and size[0] * size[1] <= MAX_PIXELS:
            return size
    raise InputError(
        f"--size {text!r:.40}: write it as WIDTHxHEIGHT, such as 240x136, "
        f"at least {MIN_SIDE}x{MIN_SIDE} and at most {MAX_PIXELS / 1e6:.0f} megapixels"
    )


def parse_ev(text: str) -> list[float]:
    """The exposures of a cycle, in stops."""
    try:
        evs = [float(word) for word in text.split(",")]
    except ValueError as error:
        raise InputError(
            f"--ev {text!r:.40}: write stops with commas between them, such as -4,-2,0"
        ) from error
    if not (np.abs(evs).max() <= MAX_EV and np.ptp(evs) <= MAX_EV):
        raise InputError(
            f"--ev {text!r:.40}: the stops must be from {-MAX_EV:g} to {MAX_EV:g}, and no more "
            f"than {MAX_EV:g} apart"
        )
    return evs


def parse_white_balance(text: str) -> tuple[float, float, float]:
    """Gains of red, green and blue, of "R,G,B"."""
    try:
        red, green, blue = (float(word) for word in text.split(","))
    except ValueError as error:
        raise InputError(
            f"--white-balance {text!r:.40}: write three gains with commas between them, "
            "such as 1.12,1,0.87"
        ) from error
    gains = red, green, blue
    if not all(0.01 <= gain <= 100 for gain in gains):
        raise InputError(f"--white-balance {text!r:.40}: the gains must be from 0.01 to 100")
    return gains


def parse_lens(text: str, K: np.ndarray, size: tuple[int, int]) -> Lens | None:
    """The lens "K1[,K2]" of a camera `K` (3, 3) with pictures of `size` (width,
    height); None where it distorts nothing.
    """
    try:
        k1, k2, *more = [float(word) for word in f"{text},0".split(",")]
    except ValueError as error:
        raise InputError(
            f"--lens {text!r:.40}: write k1, or k1 and k2 with a comma between them, such as -0.1"
        ) from error
    lens = Lens(K, (k1, k2, 0.0, 0.0), *size)
    sides = np.array(size)
    outline = lens.undistort(lens.border(), K)
    in_view = (np.abs(outline - sides / 2) < LENS_MARGIN * sides / 2).all()
    recorded = np.allclose(lens.distort(outline, K), lens.border(), atol=1e-3)
    if len(more) > 1 or not (in_view and recorded and lens.is_one_to_one()):
        raise InputError(
            f"--lens {text!r:.40}: too strong for these pictures, or not k1,k2; "
            "choose a k1 from -0.3 to 0.3"
        )
    return lens if any(lens.distortion) else None


def sensor_noise(strength: float) -> Noise | None:
    """The noise of a small sensor, `strength` times as strong: at 1, read noise of
    1e-3 of white and 6000 electrons at white. None for a perfect sensor.
    """
    if strength == 0:
        return None
    return Noise(1e-3 * strength, strength**2 / 6000)
