"""The step `poses`: cameras of all frames and static points, given or estimated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic, write_npy
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.footage.pose_files import check_offset, fit_poses, import_poses, with_depth_range
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.prepare.lens import DistortedFramesError, lens_to_find
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.masks import given_masks
from hdr_nsff.prepare.tracks import best_track, share_masks, share_poses, track_frames
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.depth.guided_points import points_between_cameras
from hdr_nsff.priors.masks.geometric import geometric_mask, rough_mask
from hdr_nsff.priors.poses.estimate import (
    PosesTuning,
    estimate_poses,
    nearly_still_poses,
    panorama_poses,
    parallax_free_share,
    rig_views,
    rotation_poses,
    still_panorama,
)
from hdr_nsff.priors.poses.reconstruct import tuning_for_lenses
from hdr_nsff.priors.poses.view_matches import EarlierRounds
from hdr_nsff.priors.poses.visit_matches import choose_visits
from hdr_nsff.scene.posed_video import PosedVideo

MAX_ROUNDS = 2  # of structure from motion after the first
MIN_MASK_IOU = 0.85  # intersection over union from which masks count as the same
# share of all pixels whose masks change in the last round, from which poses have not
# settled (hand-chosen; 0.02 or more on two clips that do not)
MIN_RESTLESS_SHARE = 0.01
# intersection over union of the last two masks below which poses are in doubt
# (hand-chosen; a man who fills a still picture, mapped as a camera that moves: 0.25)
MIN_TRUSTED_IOU = 0.5
# where a round fails, a camera counts as one at rest that leaves less than this share
# of the pixels moving, and at most so many times what the poses before leave (chosen on
# one clip, a bottle in a hand before a plain wall: 0.22, 1.2 times. Of 15 cameras that
# move, 11 leave 0.32 or more, or 2.8 times; four that shake or hardly turn leave as
# much as by their own poses, which no failed round decided)
MAX_MOVING_AT_REST = 0.3
MAX_MORE_AT_REST = 1.3
# z-depth around distance 1, where everything lies when there is no parallax:
SPHERE_NEAR = 0.5
SPHERE_FAR = 2.0
SIGHTINGS = "poses/sightings.npy"  # (O, 2) int32: a frame, and a point that it sees
FIRST_ROUND = "poses/first_round.npz"  # lets a killed run go on with the second round


def find_poses(work: Work) -> StepResult:
    """Cameras of all frames: a data set's, the user's, or by structure from motion."""
    m, c = work.manifest, work.config
    given = True
    capture = work.capture_with("poses")
    if capture is not None and capture.poses is not None:
        poses = with_common_points(work, data_set_poses(work))
    elif c.poses is not None:
        size, sources = (m.height, m.width), [f.source for f in m.frames if not f.track]
        poses = import_poses(c.poses, sources, size, lenses_of_frames(work))
        poses = with_common_points(work, share_poses(work, poses, track=0))
    elif c.tripod:
        poses = tripod_poses(work)
    elif isinstance(c.masks, Path) or work.capture_with("masks") is not None:
        poses, given = estimate(work, given_masks(work)), False
    else:
        poses, given = poses_and_masks(work), False
    if c.readout == "auto" and (given or poses.parallax != "full"):
        say("poses: --readout auto: not measured without structure from motion; taken for 0")
    known_range = bool(poses.near and poses.far)
    near, far = (poses.near, poses.far) if known_range else (SPHERE_NEAR, SPHERE_FAR)
    files = {}
    if len(poses.points):
        points = poses.points.astype(np.float32)
        files["points.npy"] = lambda path: write_npy(path, points)
        sightings = poses.tracks[:, :2].astype(np.int32)
        files[SIGHTINGS] = lambda path: write_npy(path, sightings)
    registered = poses.registered.tolist()
    return StepResult(
        provenance="given" if given else "estimated",
        note=f"{sum(registered)} of {len(m.frames)} frames placed, parallax: {poses.parallax}",
        details={
            "registered": registered,
            "notes": list(poses.notes),
            "known_range": known_range,
            "range": [near, far],  # from which `static_depth` starts, also a second time
        },
        manifest={
            "parallax": poses.parallax,
            "near": near,
            "far": far,
            "points": "points.npy" if len(poses.points) else None,
            "readout": readout_of(work, poses),
        },
        frames={
            "K": {f.index: K.tolist() for f, K in zip(m.frames, poses.K, strict=True)},
            "c2w": {f.index: c2w.tolist() for f, c2w in zip(m.frames, poses.c2w, strict=True)},
        },
        files=files,
    )


def readout_of(work: Work, poses: Poses) -> float:
    """The readout in milliseconds: as given, else as measured with the poses."""
    given = work.config.readout
    return 1e3 * work.manifest.frame_interval * poses.readout if given == "auto" else given


def data_set_poses(work: Work) -> Poses:
    """The poses of a data set, with its static points."""
    capture, m = work.capture, work.manifest
    assert capture is not None and capture.poses is not None
    rows: list[int | None] = [capture.row[f.source] for f in m.frames]
    size = (m.height, m.width)
    poses = fit_poses(capture.root, capture.poses, rows, size, lenses_of_frames(work))
    check_offset(capture.root, poses)
    return poses if capture.points is None else replace(poses, points=capture.points)


def with_common_points(work: Work, poses: Poses) -> Poses:
    """Given `poses` with the static points that several cameras see at once, where no
    points come with them: outside of held-out frames, since these points bound depth.
    """
    if len(poses.points) or not work.manifest.synchronized:
        return poses
    index = np.array([f.index for f in work.train])
    times = np.array([f.time for f in work.train])
    video, clipped = (stack[index] for stack in work.equalized)
    K, c2w = poses.K[index], poses.c2w[index]
    moving = geometric_mask(*work.training_flows(work.raw_flows), video, K, c2w)
    clip = PosedVideo(K, c2w, times, video, clipped, moving)
    points, tracks = points_between_cameras(clip)
    tracks[:, 0] = index[tracks[:, 0].astype(int)]
    say(f"poses: {len(points)} static points matched between the cameras")
    found = replace(poses, points=points, tracks=tracks)
    return found if found.near else with_depth_range(found)


def tripod_poses(work: Work) -> Poses:
    """One pose for all frames, with the default focal length."""
    m = work.manifest
    if m.num_cameras > 1 or m.rig > 1:
        raise InputError(
            "--tripod is for one camera; leave it out: the poses of several are estimated"
        )
    panorama = still_panorama(len(m.frames), max(m.width, m.height))
    poses = panorama_poses(panorama, m.height, m.width, lens=lens_to_find(work))
    if poses.lenses:
        raise DistortedFramesError(poses.lenses)
    return poses


def lenses_of_frames(work: Work) -> list[Lens | None]:
    """The given lens of each frame of the first track; None for a pinhole."""
    m = work.manifest
    lenses = {camera_id: entry.lens() for camera_id, entry in m.lens.items()}
    return [lenses.get(f.camera_id) for f in m.frames if not f.track]


def poses_and_masks(work: Work) -> Poses:
    """Structure from motion in up to three rounds.

    Poses need masks, and good masks need poses. The rounds end once the masks hardly
    change any more. Where they keep changing and rotations explain much of the
    footage, the camera counts as one that turns in place; where the little detail that
    is no mover's keeps its place, as one that stands still. Where a later round fails,
    that counts too if a camera at rest explains flow about as well; else a note says
    that they are in doubt. A rig needs one round: its masks need no poses.
    """
    if work.manifest.rig > 1:
        return estimate(work, work.visits.moving)
    earlier = EarlierRounds()
    cache = work.folder / FIRST_ROUND
    if cache.is_file():
        poses, before, earlier.model = read_round(cache)
        earlier.readout = poses.readout
    else:
        before = share_masks(work, rough_mask(*work.raw_flows, work.equalized[0]))
        poses = estimate(work, before, earlier)
        write_round(cache, poses, before, earlier.model)
    if poses.parallax != "full":
        return poses
    failure = ""
    for rounds_left in reversed(range(MAX_ROUNDS + 1)):
        found = geometric_mask(*work.raw_flows, work.equalized[0], poses.K, poses.c2w)
        moving = share_masks(work, found)
        union = (before | moving).sum()
        agreement = (before & moving).sum() / union if union else 1.0
        settled = agreement >= MIN_MASK_IOU
        outcome = ": once more" if rounds_left and not settled else ""
        say(f"poses: masks from these poses agree to {agreement:.0%} with those before{outcome}")
        if settled:
            return poses
        if rounds_left:
            try:
                poses, before = estimate(work, moving, earlier), moving
            except InputError as error:
                failure, *_ = str(error).split(";")
                break
    without_parallax = poses_without_parallax(work, before, moving)
    if without_parallax is not None:
        return without_parallax
    if failure:
        at_rest = explained_at_rest(work, moving)
        if at_rest is not None:
            return at_rest
        return in_doubt(poses, f"the next round failed with masks from these: {failure}")
    if agreement < MIN_TRUSTED_IOU and is_restless(before, moving):
        rounds = MAX_ROUNDS + 1
        return in_doubt(poses, f"after {rounds} rounds masks still agree to {agreement:.0%} only")
    return poses


def in_doubt(poses: Poses, reason: str) -> Poses:
    """The same poses with a note, also printed, that they are in doubt, and why."""
    note = (
        f"in doubt: {reason}; give --tripod if the camera stands still, else poses "
        "(--poses PATH) or masks (--mask FOLDER)"
    )
    say(f"poses: {note}")
    return replace(poses, notes=(*poses.notes, note))


def is_restless(before: np.ndarray, moving: np.ndarray) -> bool:
    """Whether masks (T, H, W) bool change much from one round to the next."""
    return bool((before ^ moving).mean() >= MIN_RESTLESS_SHARE)


def poses_without_parallax(work: Work, before: np.ndarray, moving: np.ndarray) -> Poses | None:
    """Poses of a camera that turns in place or stands still, where masks (T, H, W) bool
    keep changing, from `before` to `moving`.

    None where the masks change little or rotations explain too little of what is not
    moving, and nothing keeps its place; and for several cameras.
    """
    if has_several_cameras(work):
        return None
    track = best_track(work)
    own = track_frames(work.manifest, track)
    video, clipped = (stack[own] for stack in work.equalized)
    ignore = moving[own] | np.array(clipped)
    share = parallax_free_share(video, ignore) if is_restless(before, moving) else None
    reason = "since its masks keep changing"
    poses = None
    if share is not None and share >= PosesTuning().min_rotation_share_fallback:
        poses = rotation_poses(video, ignore)
        note = f"turns in place, {reason} and rotations explain {share:.0%} of the matches"
    if poses is None:
        poses = nearly_still_poses(video, clipped)
        note = f"stands still, {reason} and what is no mover's keeps its place"
    if poses is None:
        return None
    note = f"treated as a camera that {note}"
    say(f"poses: {note}")
    return share_poses(work, replace(poses, notes=(note, *poses.notes)), track)


def has_several_cameras(work: Work) -> bool:
    """Whether more than one camera took the frames."""
    return len({f.camera_id for f in work.manifest.frames if not f.track}) > 1


def explained_at_rest(work: Work, moving: np.ndarray) -> Poses | None:
    """Poses of one camera that stands still, where hardly more pixels then move than
    the `moving` ones (T, H, W) bool of poses in doubt; else None.
    """
    if has_several_cameras(work):
        return None
    poses = tripod_poses(work)
    found = geometric_mask(*work.raw_flows, work.equalized[0], poses.K, poses.c2w).mean()
    if found >= min(MAX_MOVING_AT_REST, MAX_MORE_AT_REST * moving.mean()):
        return None
    note = (
        "treated as a camera that stands still, since the next round failed, and only "
        f"{found:.0%} of the pixels move then; give --poses if the camera moves"
    )
    say(f"poses: {note}")
    return replace(poses, notes=(*poses.notes, note))


def estimate(work: Work, moving: np.ndarray, earlier: EarlierRounds | None = None) -> Poses:
    """Poses by structure from motion on equalized frames, without pixels that are
    `moving` (T, H, W) bool; what `earlier` rounds found is used again.
    DistortedFramesError where the frames turn out to be distorted.
    """
    if work.manifest.num_tracks > 1:
        return estimate_of_track(work, moving, earlier)
    video, clipped = work.equalized
    cameras = [f.camera_id for f in work.manifest.frames]
    folder = work.folder / "poses"
    matcher, device = work.config.matcher, pick_device(work.config.device)
    views, lens = None, lens_to_find(work)
    if work.manifest.rig > 1:
        lens = "none"  # its static pictures are of frames as recorded
        pictures = work.visits
        places = work.manifest.places
        hidden = pictures.unknown | pictures.clipped
        ignore = moving | np.array(clipped)
        visits = choose_visits(video, ignore, pictures.video, hidden, places)
        views = rig_views(pictures.video, visits, places)
    poses = estimate_poses(
        video,
        moving,
        folder,
        clipped,
        cameras,
        matcher=matcher,
        device=device,
        earlier=earlier,
        lens=lens,
        views=views,
        readout=work.readout,
        tuning=tuning_of(work),
    )
    if poses.lenses:
        raise DistortedFramesError(poses.lenses)
    return poses


def tuning_of(work: Work) -> PosesTuning:
    """The tuning for frames that were undistorted by a clip's lenses."""
    lenses = [entry.lens() for entry in work.manifest.lens.values()]
    return PosesTuning(reconstruction=tuning_for_lenses(lenses))


def estimate_of_track(work: Work, moving: np.ndarray, earlier: EarlierRounds | None) -> Poses:
    """Poses of tracks that one camera records at the same times: those of the track
    that clips least. Arguments as of `estimate`.
    """
    video, clipped = work.equalized
    track = best_track(work)
    own = track_frames(work.manifest, track)
    poses = estimate_poses(
        video[own],
        moving[own],
        work.folder / "poses",
        clipped[own],
        matcher=work.config.matcher,
        device=pick_device(work.config.device),
        earlier=earlier,
        lens=lens_to_find(work),
        readout=work.readout,
        tuning=tuning_of(work),
    )
    if poses.lenses:
        raise DistortedFramesError(poses.lenses)
    return share_poses(work, poses, track)


ARRAYS = ("K", "c2w", "registered", "points", "point_errors", "tracks", "frame_errors")
MODEL = "model/"  # before the names of its files


def write_round(path: Path, poses: Poses, moving: np.ndarray, model: Mapping[str, bytes]) -> None:
    """Keep poses, the masks (T, H, W) they were estimated with, and the files of the
    `model` that the next round starts from.
    """
    arrays = {name: np.asarray(getattr(poses, name)) for name in ARRAYS}
    arrays["range"] = np.array([poses.near or np.nan, poses.far or np.nan])
    arrays["readout"] = np.array(poses.readout)
    arrays["words"] = np.array([poses.parallax, *poses.notes])
    arrays["moving"] = np.packbits(moving, axis=-1)
    arrays["width"] = np.array(moving.shape[-1])
    arrays |= {MODEL + name: np.frombuffer(content, np.uint8) for name, content in model.items()}
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def read_round(path: Path) -> tuple[Poses, np.ndarray, dict[str, bytes]]:
    """What `write_round` wrote."""
    with np.load(path, allow_pickle=False) as arrays:
        near, far = (None if np.isnan(v) else float(v) for v in arrays["range"])
        parallax, *notes = arrays["words"].tolist()
        packed, width = arrays["moving"], int(arrays["width"])
        moving = np.unpackbits(packed, axis=-1, count=width).astype(bool)
        values = {name: arrays[name] for name in ARRAYS}
        readout = float(arrays["readout"]) if "readout" in arrays else 0.0
        stored = [name for name in arrays.files if name.startswith(MODEL)]
        model = {Path(name).name: arrays[name].tobytes() for name in stored}
    poses = Poses(
        **values, parallax=parallax, near=near, far=far, notes=tuple(notes), readout=readout
    )
    return poses, moving, model
