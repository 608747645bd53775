"""Camera poses from frames alone: structure from motion on exposure-equalized frames
with moving objects left out.

Footage without parallax is recognized first: a tripod, or a camera that shakes behind
movers (`still_camera.py`), or one that turns in place; the latter two get rotations
(`rotation.py`). All other footage goes to structure from motion (`reconstruct.py`).
Poses are camera to world, OpenCV axes; the world's +z is the mean viewing direction,
near is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.core.stack import ArrayStack, spread_frames
from hdr_nsff.core.tensors import CPU
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.pinhole import intrinsics
from hdr_nsff.geometry.poses import Poses, interpolate
from hdr_nsff.priors.poses.lens import LensChoice
from hdr_nsff.priors.poses.lightglue import Matcher
from hdr_nsff.priors.poses.mapper import Mapper, Readout
from hdr_nsff.priors.poses.matching import (
    camera_groups,
    detect_keypoints,
    match_pairs,
    view_pairs,
)
from hdr_nsff.priors.poses.reconstruct import ReconstructionTuning, SfmViews, sfm_views
from hdr_nsff.priors.poses.rotation import (
    Panorama,
    RotationTuning,
    default_focal,
    fit_panorama,
    fit_video,
    rotation_share,
)
from hdr_nsff.priors.poses.still_camera import (
    StillCameraTuning,
    nearly_still_shifts,
    shaken_background,
    still_camera_shifts,
)
from hdr_nsff.priors.poses.view_matches import EarlierRounds
from hdr_nsff.priors.poses.visit_matches import VisitImages

MIN_FRAMES = 3


@dataclass(frozen=True)
class PosesTuning:
    """How footage without parallax is recognized."""

    # share of static matches that rotations must explain before footage counts as
    # without parallax (measured on rendered and real clips: above 0.84 without, below
    # 0.42 with parallax; 0.70 and 0.73 on two that have it before a background far
    # away, of which structure from motion succeeds on the first alone)
    min_rotation_share: float = 0.8
    # the same where structure from motion fails, or its masks keep changing
    # (hand-chosen)
    min_rotation_share_fallback: float = 0.5
    # points below which structure from motion counts as failed where rotations explain
    # that much, or the camera stands nearly still (a shaken camera behind two people:
    # share 0.78, 19 points; 424 at least on rendered clips and two shots of a film)
    few_points: int = 100
    # the same behind a long lens, where a camera that slides past something flat sees a
    # turn, too (a painted wall behind boards: 0.80, a pan of 20 degrees: 0.97); with
    # less, structure from motion is tried first
    min_long_lens_share: float = 0.9
    # share from which too little parallax is left to look for a lens (a painted clip
    # with a share of 0.68 shows its lens)
    no_lens_share: float = 0.7
    reconstruction: ReconstructionTuning = field(default_factory=ReconstructionTuning)
    still: StillCameraTuning = field(default_factory=StillCameraTuning)


def estimate_poses(
    video: ArrayStack,
    masks: np.ndarray | None,
    workdir: Path | str,
    clipped: ArrayStack | None = None,
    camera_ids: list[int] | None = None,
    threads: int = 0,
    matcher: Matcher = "sift",
    tuning: PosesTuning = PosesTuning(),
    device: torch.device = CPU,
    earlier: EarlierRounds | None = None,
    lens: LensChoice = "none",
    views: SfmViews | None = None,
    readout: Readout = 0.0,
) -> Poses:
    """Poses of every frame of `video` (T, H, W, 3), exposure-equalized rgb in [0, 1].

    `masks` (T, H, W) bool moving; `clipped` (T, H, W) bool without information;
    `camera_ids` (T,) the physical camera of each frame (each has its own focal length),
    by default one. `matcher` finds and matches keypoints for structure from motion, a
    learned one on `device`; `threads` 0 uses all cores. Temporary files go into
    `workdir`. What `earlier` rounds on the same frames found is used again. A `lens`
    that was found or given is in `Poses.lenses`; undistort the frames, and estimate
    again. `views`: the images of a rig in turn, see `rig_views`, mapped instead of the
    frames. `readout` of a rolling shutter, in frames: cameras are then those of the
    middle rows; "auto" measures it. InputError where poses cannot be estimated.
    """
    check_length(len(video))
    ignore = union(video.shape[:3], masks, clipped)
    cameras = camera_ids or [0] * len(video)
    groups = camera_groups(cameras)
    poses, share, is_one_camera = None, 0.0, views is None and len(groups) == 1
    if is_one_camera:
        poses = still_poses(video, clipped, tuning, lens)
        if poses is None:
            share = parallax_free_share(video, ignore, tuning) or 0.0
    if share >= tuning.min_rotation_share:
        poses = rotation_poses(video, ignore, tuning, lens)
    if poses is None and is_one_camera:
        poses = shaken_poses(video, ignore, clipped, tuning, lens)
    if poses is None:
        if share >= tuning.no_lens_share and lens == "auto":
            lens = "none"
        earlier = earlier or EarlierRounds()
        if views is None:
            known = (earlier.readout or 0.0) if readout == "auto" else readout
            views = sfm_views(video, ignore, groups, tuning.reconstruction, known)
        mapper = Mapper(
            views, Path(workdir), threads, matcher, tuning.reconstruction, device, earlier
        )  # fmt: skip
        try:
            poses = mapper.poses(lens)
            if readout == "auto" and earlier.readout is None and not poses.lenses:
                poses = mapper.with_measured_readout(poses)
            if is_one_camera and len(poses.points) < tuning.few_points and not poses.lenses:
                few = f"structure from motion finds {len(poses.points)} points only"
                poses = unmapped_poses(few, share, video, ignore, clipped, tuning, lens) or poses
        except InputError as error:
            if is_one_camera:
                poses = unmapped_poses(str(error), share, video, ignore, clipped, tuning, lens)
            if poses is None:
                raise
    if poses.lenses:
        return replace(poses, lenses={cameras[groups[k][0]]: v for k, v in poses.lenses.items()})
    for note in poses.notes:
        say(f"poses: {note}")
    return poses


def check_length(count: int) -> None:
    """InputError where a clip of `count` frames is too short."""
    if count < MIN_FRAMES:
        raise InputError(
            f"{count} frames are too few to estimate poses from; "
            f"give at least {MIN_FRAMES}, or import poses (--poses)"
        )


def union(shape: tuple[int, ...], *masks: ArrayStack | None) -> np.ndarray:
    """Where any of the `masks` is true, (T, H, W) bool; None is nowhere."""
    anywhere = np.zeros(shape, bool)
    for mask in masks:
        if mask is not None:
            for t in range(len(anywhere)):
                anywhere[t] |= mask[t]
    return anywhere


def unmapped_poses(
    reason: str,
    share: float,
    video: ArrayStack,
    ignore: np.ndarray,
    clipped: ArrayStack | None,
    tuning: PosesTuning,
    lens: LensChoice,
) -> Poses | None:
    """Poses of one camera that structure from motion does not place, for a `reason`
    that the note names: of a turn in place that explains a `share` of the matches, or
    at rest.

    `video` (T, H, W, 3); `ignore` and `clipped` (T, H, W) bool. None where neither
    explains it.
    """
    poses, motion = None, "turns in place"
    if share >= tuning.min_rotation_share_fallback:
        poses = rotation_poses(video, ignore, tuning, lens)
    if poses is None:
        poses, motion = nearly_still_poses(video, clipped, tuning, lens), "stands still"
    if poses is None:
        return None
    note = f"treated as a camera that {motion}, since {reason}"
    return replace(poses, notes=(note, *poses.notes))


def rig_views(pictures: np.ndarray, visits: VisitImages, places: Sequence[int]) -> SfmViews:
    """One view per camera of a rig in turn, all with one focal length: its static
    picture (N, H, W, 3), matched by `visits`; `places` (T,): the camera of each frame.
    """
    ignore = np.zeros(pictures.shape[:3], bool)
    return SfmViews(pictures, ignore, [list(range(len(pictures)))], np.asarray(places), visits)


def parallax_free_share(
    video: ArrayStack, ignore: np.ndarray, tuning: PosesTuning = PosesTuning()
) -> float | None:
    """The share of static matches that pure rotations explain, in [0, 1], from frames
    spread over the clip (T, H, W, 3); `ignore` (T, H, W) bool.

    None where too little matches.
    """
    matching, rotation = tuning.reconstruction.matching, tuning.reconstruction.rotation
    sampled = spread_frames(len(video), tuning.reconstruction.max_sampled_frames)
    keypoints = detect_keypoints(video[sampled], ignore[sampled], matching)
    pairs = view_pairs([list(range(len(sampled)))], matching)
    matches = match_pairs(keypoints, pairs, matching)
    height, width = video.shape[1:3]
    panorama = fit_panorama(matches, len(sampled), width, height, rotation)
    if panorama is None:
        return None
    share = rotation_share(matches, panorama, width, height, rotation)
    return believed_share(panorama, share, tuning)


def believed_share(
    panorama: Panorama, share: float | None, tuning: PosesTuning = PosesTuning()
) -> float | None:
    """A `share` of matches that the rotations of a `panorama` explain, at most
    `min_rotation_share_fallback` where these may be of a camera that slides.
    """
    if share is None or not panorama.long_lens or share >= tuning.min_long_lens_share:
        return share
    return min(share, tuning.min_rotation_share_fallback)


def still_poses(
    video: ArrayStack,
    clipped: ArrayStack | None,
    tuning: PosesTuning = PosesTuning(),
    lens: LensChoice = "none",
) -> Poses | None:
    """Poses of a camera that stands still, from all frames (T, H, W, 3) and where they
    are `clipped` (T, H, W) bool; None where it moves.
    """
    shifts = still_camera_shifts(video, clipped, tuning.still)
    return None if shifts is None else poses_at_rest(video, shifts, tuning, lens)


def nearly_still_poses(
    video: ArrayStack,
    clipped: ArrayStack | None,
    tuning: PosesTuning = PosesTuning(),
    lens: LensChoice = "none",
) -> Poses | None:
    """The same where no other poses are found, of a camera that may shake a little."""
    shifts = nearly_still_shifts(video, clipped, tuning.still)
    return None if shifts is None else poses_at_rest(video, shifts, tuning, lens)


def shaken_poses(
    video: ArrayStack,
    ignore: np.ndarray,
    clipped: ArrayStack | None,
    tuning: PosesTuning = PosesTuning(),
    lens: LensChoice = "none",
) -> Poses | None:
    """Poses of a camera that shakes, or turns by as little, behind movers that hide it
    from `parallax_free_share`: rotations of what keeps its place.

    `video` (T, H, W, 3); `ignore` and `clipped` (T, H, W) bool. None where the camera
    moves farther, or rotations do not explain what keeps its place.
    """
    background = shaken_background(video, clipped, tuning.still)
    if background is None:
        return None
    poses = rotation_poses(video, ignore | ~background, tuning, lens)
    if poses is None:
        return None
    note = f"what keeps its place, {background.mean():.0%} of the picture, shakes at most"
    return replace(poses, notes=(*poses.notes, note))


def poses_at_rest(
    video: ArrayStack, shifts: np.ndarray, tuning: PosesTuning, lens: LensChoice
) -> Poses:
    """Poses of a camera at rest, for frames that shift by `shifts` (F,) pixels."""
    count, height, width = video.shape[:3]
    panorama = still_panorama(count, max(height, width), float(np.median(shifts)), tuning)
    return panorama_poses(panorama, height, width, tuning, lens)


def still_panorama(
    count: int, longer_side: int, error_px: float = 0.0, tuning: PosesTuning = PosesTuning()
) -> Panorama:
    """`count` frames of a still camera whose `longer_side` has as many pixels."""
    return Panorama(
        rotations=np.tile(np.eye(3), (count, 1, 1)),
        linked=np.ones(count, bool),
        focal=default_focal(longer_side, tuning.reconstruction.rotation),
        focal_known=False,
        long_lens=False,
        explained=1.0,
        frame_errors=np.full(count, error_px),
        max_displacement=0.0,
    )


def rotation_poses(
    video: ArrayStack,
    ignore: np.ndarray,
    tuning: PosesTuning = PosesTuning(),
    lens: LensChoice = "none",
) -> Poses | None:
    """Poses of a camera on a tripod or turning in place, from all frames (T, H, W, 3);
    `ignore` (T, H, W) bool. None where rotations do not explain the footage after all.
    """
    rotation = tuning.reconstruction.rotation
    panorama = fit_video(video, ignore, tuning.reconstruction.matching, rotation)
    if panorama is None or panorama.explained < rotation.min_explained:
        return None
    if panorama.linked.mean() < tuning.reconstruction.min_registered:
        return None
    height, width = video.shape[1:3]
    return panorama_poses(panorama, height, width, tuning, lens)


def panorama_poses(
    panorama: Panorama,
    height: int,
    width: int,
    tuning: PosesTuning = PosesTuning(),
    lens: LensChoice = "none",
) -> Poses:
    """Poses of a camera without parallax. A given `lens` gets the focal length; none is
    estimated.
    """
    rotation = tuning.reconstruction.rotation
    count = len(panorama.rotations)
    still = panorama.max_displacement < rotation.max_tripod_motion_px
    c2w = np.zeros((count, 3, 4))
    c2w[:, :, :3] = np.eye(3) if still else panorama.rotations
    poses = Poses(
        K=np.tile(intrinsics(panorama.focal, width, height), (count, 1, 1)),
        c2w=c2w,
        registered=panorama.linked | still,
        parallax="none" if still else "rotation",
        frame_errors=panorama.frame_errors,
        notes=rotation_notes(panorama, still, rotation),
    )
    if lens == "auto":
        note = "lens distortion is not estimated without parallax; --lens-distortion gives it"
        poses = replace(poses, notes=(*poses.notes, note))
    elif not isinstance(lens, str):
        poses = replace(poses, lenses={0: Lens(poses.K[0], (*lens, 0.0, 0.0), width, height)})
    return interpolate(poses, [list(range(count))])


def rotation_notes(panorama: Panorama, still: bool, tuning: RotationTuning) -> tuple[str, str]:
    """What was found of a camera without parallax, in sentences."""
    motion = "no parallax: the camera stands still"
    if not still:  # a camera that slides slowly past what is far away looks the same
        by = f"by up to {panorama.max_displacement:.0f} px"
        motion = f"hardly any parallax: the camera counts as one that turns in place ({by})"
    origin = "from the turn"
    if not panorama.focal_known:
        lens, fov = "", tuning.default_fov_degrees
        if panorama.long_lens:
            lens, fov = "a long lens, ", tuning.long_fov_degrees
        origin = f"assumed: {lens}{fov:.0f} degrees across the longer side"
    return (
        f"{motion}; HDR video and in-between times work, novel viewpoints do not",
        f"focal length {panorama.focal:.0f} px, {origin}",
    )
