"""Tracks of one camera in `prepare`: what is known of one track's frame holds for the
frames of all tracks at its time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hdr_nsff.geometry.poses import Poses
from hdr_nsff.prepare.work import Work
from hdr_nsff.scene.manifest import Manifest


def track_frames(manifest: Manifest, track: int) -> np.ndarray:
    """The indices (N,) of the frames of a track, in time."""
    return np.array([f.index for f in manifest.frames if f.track == track])


def rows_in_track(manifest: Manifest) -> np.ndarray:
    """The place (T,) of every frame among those of its track; equal ones share a
    time.
    """
    rows = np.zeros(len(manifest.frames), int)
    for track in range(manifest.num_tracks):
        own = track_frames(manifest, track)
        rows[own] = np.arange(len(own))
    return rows


def best_track(work: Work) -> int:
    """The track with the fewest clipped pixels."""
    clipped = work.equalized[1]
    shares = []
    for track in range(work.manifest.num_tracks):
        own = track_frames(work.manifest, track)
        shares.append(float(np.mean([clipped[t].mean() for t in own])))
    return int(np.argmin(shares))


def share_poses(work: Work, poses: Poses, track: int) -> Poses:
    """The poses of all frames, from those of one track's."""
    manifest = work.manifest
    if manifest.num_tracks == 1:
        return poses
    rows = rows_in_track(manifest)
    seen = poses.tracks.copy()
    seen[:, 0] = track_frames(manifest, track)[seen[:, 0].astype(int)]
    errors = poses.frame_errors
    return replace(
        poses,
        K=poses.K[rows],
        c2w=poses.c2w[rows],
        registered=poses.registered[rows],
        frame_errors=errors[rows] if len(errors) else errors,
        tracks=seen,
    )


def share_masks(work: Work, moving: np.ndarray) -> np.ndarray:
    """Moving masks (T, H, W), each the union of those of all tracks at its time."""
    manifest = work.manifest
    if manifest.num_tracks == 1:
        return moving
    tracks = range(manifest.num_tracks)
    anywhere = np.any([moving[track_frames(manifest, track)] for track in tracks], axis=0)
    return anywhere[rows_in_track(manifest)]
