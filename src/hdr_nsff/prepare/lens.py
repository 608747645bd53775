"""The lens of a clip in `prepare`: what the settings ask for, what is known already,
and the frames as a pinhole camera would have recorded them.

Frames are undistorted once, as they are decoded. A lens that structure from motion
finds is known only later, see `undistort.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.footage.lens_files import read_lens
from hdr_nsff.footage.pose_files import MAX_ASPECT_ERROR, locate, read_given, rows_of_cameras
from hdr_nsff.footage.pose_formats import common_lens, distorted
from hdr_nsff.geometry.lens import (
    Lens,
    undistorted_flow,
    undistorted_map,
    undistorted_picture,
    undistortion,
)
from hdr_nsff.prepare.work import Part, PrepareConfig, Work
from hdr_nsff.priors.poses.lens import LensChoice
from hdr_nsff.scene.manifest import FrameEntry, LensEntry, Manifest

MAX_K = 10.0  # no lens has more: beyond it, a number is a mistake
LENS_ADVICE = "write auto, none, K1, or K1,K2, such as -0.2,0.03, or the file of a calibration"


# of a camera_id, flow (H, W, 2) px and its validity (H, W): both without distortion
FlowUndistorter = Callable[[int, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class DistortedFramesError(Exception):
    """The frames turned out to be distorted, by these lenses {camera_id: lens}."""

    def __init__(self, lenses: dict[int, Lens]) -> None:
        super().__init__("the frames are distorted")
        self.lenses = lenses


def parse_lens(text: str) -> LensChoice | Path:
    """What `--lens-distortion` asks for, or the file of a calibration; InputError where
    it makes no sense.
    """
    if text == "auto":
        return "auto"
    if text == "none":
        return "none"
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        if text and Path(text).exists():
            return Path(text)
        raise InputError(
            f"--lens-distortion {shorten(text)!r}: no such file; {LENS_ADVICE}"
        ) from None
    if len(numbers) > 2 or not sum(map(abs, numbers)) < MAX_K:
        raise InputError(
            f"--lens-distortion {shorten(text)!r}: one or two numbers, whose sizes add up to less "
            f"than {MAX_K:g}; {LENS_ADVICE}"
        )
    k1, k2, *_ = [*numbers, 0.0]
    return (k1, k2)


def check_lens_in_turn(config: PrepareConfig, cameras: int) -> None:
    """InputError where numbers are given that nothing would use: frames that `cameras`
    take in turn are mapped as recorded, unless poses bring a focal length.
    """
    choice = parse_lens(config.lens_distortion)
    if cameras > 1 and config.poses is None and isinstance(choice, tuple) and any(choice):
        raise InputError(
            f"--lens-distortion {config.lens_distortion}: {cameras} cameras take the frames in "
            "turn, and numbers without a focal length do not undistort these; give the file of a "
            "calibration, or --rig 1 where it is one camera"
        )


def known_lenses(found: Manifest, config: PrepareConfig) -> dict[int, LensEntry]:
    """The lenses of a scene folder that the settings let stand."""
    choice = parse_lens(config.lens_distortion)
    if "frames" in config.redo or choice == "none":
        return {}
    if isinstance(choice, Path):
        return {}  # read again
    if choice == "auto":
        return {c: entry for c, entry in found.lens.items() if not entry.given}
    return {c: e for c, e in found.lens.items() if e.given and tuple(e.distortion[:2]) == choice}


def given_lenses(work: Work) -> dict[int, LensEntry]:
    """The lenses of a calibration, else those that come with given poses: theirs, or
    that of the settings with their focal length. Empty where neither is given, or
    nothing is distorted.
    """
    choice = parse_lens(work.config.lens_distortion)
    if isinstance(choice, Path):
        lens = calibrated_lens(work, choice)
        return entries_of(work, choice, [lens] * len(camera_names(work)))
    capture, path = work.capture_with("poses"), work.config.poses
    if capture is not None and capture.poses is not None:
        path, given = capture.root, capture.poses
    elif path is not None:
        path = locate(path)
        given, _ = read_given(path)
    else:
        return {}
    if choice == "none":
        return {}
    if choice != "auto":
        given = replace(given, distortion=np.tile([*choice, 0.0, 0.0], (len(given.K), 1)))
    cameras = camera_names(work)
    rows_of = rows_of_cameras(given.names, len(given.c2w), cameras) if len(cameras) > 1 else None
    if rows_of is None:
        return entries_of(work, path, [common_lens(path, given)] * len(cameras))
    return entries_of(work, path, [common_lens(path, given.of(rows)) for rows in rows_of])


def camera_names(work: Work) -> list[str]:
    """The names of the cameras that have lenses: those of their folders or videos."""
    footage = work.footage
    if footage.same_camera:
        return [footage.path.name]
    return [f[0].stem if footage.video else f[0].parent.name for f in footage.cameras]


def calibrated_lens(work: Work, path: Path) -> Lens:
    """The lens of a calibration; InputError where its pictures have another shape."""
    lens = read_lens(path)
    width, height = work.manifest.width, work.manifest.height
    if abs(width / height / (lens.width / lens.height) - 1) > MAX_ASPECT_ERROR:
        raise InputError(
            f"{path}: the calibration is for {lens.width}x{lens.height} pictures, the frames are "
            f"{width}x{height}: another shape; give one for these frames"
        )
    return lens


def entries_of(work: Work, path: Path, lenses: Sequence[Lens | None]) -> dict[int, LensEntry]:
    """The lens of every camera, or None, given by the file `path`; InputError where
    maps that are given would have to be undistorted too.
    """
    bent = {camera_id: lens for camera_id, lens in enumerate(lenses) if lens is not None}
    other_parts: tuple[Part, ...] = ("flow", "masks", "depth")
    with_maps = any(work.capture_with(part) for part in other_parts)
    if bent and (with_maps or (work.capture is not None and work.capture.has_held_out)):
        raise distorted(path, max(lens.max_displacement_px() for lens in bent.values()))
    return {camera_id: LensEntry.of(lens, given=True) for camera_id, lens in bent.items()}


def lens_to_find(work: Work) -> LensChoice:
    """What structure from motion is to do about the lens: nothing, once it is known."""
    choice = parse_lens(work.config.lens_distortion)
    if work.manifest.lens or isinstance(choice, Path):
        return "none"
    return choice


def undistorted(work: Work, picture: np.ndarray, camera_id: int) -> np.ndarray:
    """A frame (H, W, 3) of a camera, or its mask (H, W), without the distortion of its
    lens, where that is known.
    """
    entry = work.manifest.lens.get(camera_id)
    return picture if entry is None else undistorted_picture(picture, entry.lens())


def undistorted_maps(work: Work, frames: Sequence[FrameEntry], maps: np.ndarray) -> np.ndarray:
    """Maps (T, H, W) of recorded `frames` without the distortion of their lenses, where
    these are known.
    """
    if not work.manifest.lens:
        return maps
    entries = [work.manifest.lens.get(f.camera_id) for f in frames]
    pairs = zip(maps, entries, strict=True)
    return np.stack([m if e is None else undistorted_map(m, e.lens()) for m, e in pairs])


def flow_undistorter(lenses: Mapping[int, Lens], width: int, height: int) -> FlowUndistorter:
    """Undistorts flow of cameras that have one of the `lenses`, and leaves that of
    others as it is; frames are `width` x `height`.
    """
    resized = {camera_id: lens.resized(width, height) for camera_id, lens in lenses.items()}
    shifts = {camera_id: undistortion(lens) for camera_id, lens in resized.items()}

    def undistort(
        camera_id: int, flow: np.ndarray, valid: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        if camera_id not in resized:
            return flow, valid
        return undistorted_flow(flow, valid, resized[camera_id], shifts[camera_id])

    return undistort


def describe(lenses: dict[int, LensEntry]) -> str:
    """The distortion of lenses in words, such as "k1 -0.096, k2 0.007, 5 px at the
    corners".
    """
    words = []
    for entry in lenses.values():
        k1, k2, *_ = entry.distortion
        moved = entry.lens().max_displacement_px()
        words.append(f"k1 {k1:.4f}, k2 {k2:.4f}, {moved:.0f} px at the corners")
    return "; ".join(dict.fromkeys(words))
