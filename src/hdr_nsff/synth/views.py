"""Which pictures of a scene `synth` renders: the frames of the clip, and held-out views
that the clip does not show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.synth.scenes.base import SynthScene, Views

# Of the two held-out views off the camera's path: meters from the frame's pose, in the
# axes of its camera.
OFF_PATH = ((0.06, -0.03, 0.03), (-0.05, 0.05, -0.02))
SEEDS_PER_CLIP = 1000  # seeds of the pictures of one clip; its held-out views take half


@dataclass(frozen=True)
class TracedView:
    """A picture to render."""

    name: str
    time: float  # in frames
    c2w: np.ndarray  # (3, 4)
    spp: int  # paths per pixel
    seed: int
    anchor: int  # the clip's frame whose pose is the nearest
    off_path: bool = False  # the pose is not exactly the anchor's


def clip_views(
    scene: SynthScene, frames: int, spp: int, seed: int, views: Views = "mono"
) -> list[TracedView]:
    """The frames of the clip."""
    first_seed = seed * SEEDS_PER_CLIP
    return [
        TracedView(f"clip_{t:05d}", float(t), scene.pose(views, t), spp, first_seed + t, anchor=t)
        for t in range(frames)
    ]


def held_out_views(
    scene: SynthScene, frames: int, spp: int, seed: int, views: Views = "mono"
) -> list[TracedView]:
    """Views for `evaluate`: eight at times of frames and six half-way between two, each
    from the pose of another frame, and two off the camera's path.

    The other frame is far away in time (mono), or of a camera three to six further
    around than the one that records then (rig).
    """
    found: list[TracedView] = []

    def hold_out(kind: str, time: float, anchor: int, offset: tuple[float, ...] | None) -> None:
        c2w = scene.pose(views, anchor)
        if offset is not None:
            c2w[:, 3] += c2w[:, :3] @ np.asarray(offset)
        place = f"pose{anchor:02d}" if views == "mono" else f"camera{anchor % len(scene.rig)}"
        own_seed = seed * SEEDS_PER_CLIP + SEEDS_PER_CLIP // 2 + len(found)
        name = f"{kind}_t{time:04.1f}_{place}"
        found.append(TracedView(name, time, c2w, spp, own_seed, anchor, offset is not None))

    def other_frame(time: int, rank: float) -> int:
        if views == "mono":
            return far_frame(scene, time, frames, rank)
        return rig_frame(time, frames, len(scene.rig), step=3 + len(found) % 4)

    times = np.linspace(1, frames - 2, 8).round().astype(int)
    for time, rank in zip(times, np.linspace(0.3, 0.9, 8), strict=True):
        hold_out("view", float(time), other_frame(time, rank), offset=None)
    times = np.linspace(2, frames - 4, 6).round().astype(int)
    for time, rank in zip(times, np.linspace(0.8, 0.3, 6), strict=True):
        hold_out("time", time + 0.5, other_frame(time, rank), offset=None)
    for time, offset in zip((frames // 3, 2 * frames // 3), OFF_PATH, strict=True):
        hold_out("off", float(time), time, offset)
    return found


def far_frame(scene: SynthScene, time: int, frames: int, rank: float) -> int:
    """A frame at least a quarter of the clip away from `time`: of all such, ordered by
    the camera's distance, the one at `rank` in [0, 1].
    """
    here = scene.camera_pose(time)[:, 3]

    def distance(frame: int) -> float:
        return float(np.linalg.norm(scene.camera_pose(frame)[:, 3] - here))

    others = [k for k in range(frames) if abs(k - time) >= frames // 4]
    others.sort(key=distance)
    return others[round(rank * (len(others) - 1))]


def rig_frame(time: int, frames: int, cameras: int, step: int) -> int:
    """The frame nearest to `time` of the rig's camera `step` further around than the
    one that records then.
    """
    recorded = range((time + step) % cameras, frames, cameras)
    return min(recorded, key=lambda k: abs(k - time))
