"""Tracks of one camera that record at the same times, each with an exposure of its own:
HDRx, dual gain.

The tracks share lens, response and movement. A frame of one track has the pose of the
frames of the others at its time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.footage import Footage, open_footage


def open_tracks(clip: Path, names: Sequence[str]) -> Footage:
    """The footage of the tracks `names`, video files or folders of frames inside the
    folder `clip`; InputError where they cannot be tracks of one camera.
    """
    option = f"--same-camera {' '.join(names)}"
    if not clip.is_dir():
        raise InputError(f"{option}: {clip} is no folder; give the folder that holds the tracks")
    if len(set(names)) < len(names):
        raise InputError(f"{option}: the same track twice; name two")
    tracks = [open_track(clip, name, option) for name in names]
    first, *others = tracks
    for name, other in zip(names[1:], others, strict=True):
        if other.video != first.video or other.linear != first.linear:
            raise InputError(
                f"{option}: {names[0]} and {name} are of different kinds; "
                "export both tracks in one format"
            )
        if other.count != first.count:
            raise InputError(
                f"{option}: {names[0]} has {first.count} frames and {name} has {other.count}; "
                "tracks that record at the same times have equally many"
            )
        if other.transfer != first.transfer:
            raise InputError(
                f"{option}: the transfer functions of {names[0]} and {name} differ by their "
                "tags; export both tracks in one format"
            )
    cameras = [files for track in tracks for files in track.cameras]
    return replace(first, path=clip, cameras=cameras, same_camera=True)


def open_track(clip: Path, name: str, option: str) -> Footage:
    """The footage of one track; InputError where it is not in the folder `clip`."""
    path = clip / name
    if not path.resolve().is_relative_to(clip.resolve()) or not path.exists():
        raise InputError(
            f"{option}: no {name} in {clip}; name video files or folders of frames inside it"
        )
    track = open_footage(path)
    if len(track.cameras) > 1:
        raise InputError(f"{path}: folders of several cameras; a track is one folder of frames")
    return track
