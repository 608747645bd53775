"""What `check` measures of a clip: numbers, without judging them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

CameraMotion = Literal["parallax", "rotation", "tripod", "unknown"]


@dataclass(frozen=True)
class FileFacts:
    """The file or the folder of frames."""

    name: str
    frames: int  # of one camera; 0: unknown
    cameras: int  # or tracks of one camera
    width: int  # as players show it, without black bars, pixels
    height: int
    fps: float
    bits: int
    kind: str  # recorded, linear, or the name of a transfer function that is undone
    # milliseconds: the shortest and longest time from frame to frame, by timestamps,
    # where none are missing; None without timestamps
    interval_ms: tuple[float, float] | None
    frame_ms: float | None = None  # the usual one of these; None: by `fps`
    missing: int = 0  # frames by these timestamps
    timestamps_problem: str = ""  # why a list does not show the times, in words
    bars: str = ""  # what `prepare` does with black bars, in words
    interlaced: bool = False  # by the marks of its frames
    same_camera: bool = False  # the `cameras` are tracks of one
    stabilized: bool | None = None  # electronically, as the camera wrote; None: unknown


@dataclass(frozen=True)
class ExposureFacts:
    """Exposures as given, or from brightness under a gamma of 2.2."""

    cycle: int  # frames; 1: no alternation
    ev: tuple[float, ...]  # per bracket, relative to the darkest
    explained: float  # share of the changes of brightness that the cycle explains
    given: str | None  # exposures.csv or EXIF, where frames have them
    change_ev: float  # mean change of brightness from frame to frame
    drift_ev: float  # range of what matched points change beyond the cycle
    white_share: tuple[float, ...]  # per bracket: pixels with a saturated channel
    black_share: tuple[float, ...]  # per bracket: pixels with all channels black
    banding_ev: float  # amplitude of bright and dark bands, 0 where there are none
    color_drift_ev: float = 0.0  # the same of red or blue against green
    missing_before: tuple[int, ...] = ()  # frames before which the cycle skips some
    empty: str = ""  # which frames are black or white all over, a sentence
    given_drift_ev: float = 0.0  # range by which given exposures leave their cycle
    contradictions: tuple[str, ...] = ()  # of given exposures and pixels, sentences


@dataclass(frozen=True)
class CameraExposure:
    """The exposures of one of several cameras, or of a track of one."""

    name: str  # of its folder or file
    cycle: int  # frames; 1: no alternation
    # EV above the first camera, given or under a gamma of 2.2; None: unknown
    level_ev: float | None
    white_share: float  # of its darkest exposure
    black_share: float  # of its brightest
    contradictions: tuple[str, ...] = ()  # of given exposures and pixels, sentences


@dataclass(frozen=True)
class LensFacts:
    """Radial distortion; all 0 where the clip shows none."""

    k1: float  # as OpenCV has them
    k2: float
    corner_px: float  # by which a corner moves, pixels of the clip


@dataclass(frozen=True)
class CameraFacts:
    """What the camera does, and how sharp its pictures are."""

    motion: CameraMotion
    rotation_share: float | None  # of static matches that rotations alone explain
    pixels_per_frame: float  # median motion of matched points, pixels of the clip
    # edges of the brightest bracket relative to those of the darkest: below 1 blurred
    long_sharpness: float | None
    cuts: tuple[int, ...] = ()  # frames that show something else than the one before
    lens: LensFacts | None = None  # None: unknown
    # of a rolling shutter, as a share of the time between frames, and its standard
    # error; None: unknown
    readout: tuple[float, float] | None = None
    # of the picture's center, pixels of the clip: acceleration per frame squared and
    # velocity per frame; None: unknown
    shake: tuple[float, float] | None = None


@dataclass(frozen=True)
class ClipFacts:
    """All of them, of the frames that were looked at."""

    file: FileFacts
    looked_at: int  # frames, from the start on
    measured: tuple[int, int]  # the first of these that are measured, and the end
    exposure: ExposureFacts
    camera: CameraFacts
    each_camera: tuple[CameraExposure, ...] = ()  # where there are several
