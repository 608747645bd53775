"""The views of a shot: named camera paths and path files, if the footage can show them.

A clip whose camera did not move has no parallax and so no depth: it can be seen from
its own viewpoint only. Nothing was learned about times outside the clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.tensors import to_device
from hdr_nsff.geometry import paths
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.output import Shot
from hdr_nsff.rendering.stills import device_of
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run

SHOTS = ("training", "fixed", "bullet", "slowmo")
MAX_VIEWS = 10_000  # of one shot: seven minutes at 24 frames a second
BULLET_FPS = 12.0  # at most; time stands still, so a slow camera is enough (hand-chosen)
MAX_RADIUS = 0.2  # of the focus depth: how far the spiral leaves its camera (hand-chosen)
# Smallest radii right, down and forward, of the widest: a spiral even where the clip
# moved along a line (hand-chosen).
MIN_RADII = (0.5, 0.25, 0.0)
VIEWPOINT_SHARE = 1e-3  # of the near distance: a view closer to a camera is at its place


def plan_shot(
    run: Run, path: str, frame: int | None = None, factor: int = 2, num_views: int = 24
) -> Shot:
    """The views of a named path or of a JSON file.

    InputError where the footage cannot show them.
    """
    frames = filmed_frames(run)
    cameras = [f.camera for f in frames]
    times = sorted({f.time for f in frames})
    start = find_frame(run, frame)
    fps = run.scene.manifest.fps
    match path:
        case "training":
            return Shot(path, paths.training_path(cameras, [f.time for f in frames]), fps)
        case "fixed":
            check_length(path, times)
            return Shot(path, paths.fixed_path(start.camera, times), fps)
        case "bullet":
            return Shot(path, bullet_views(run, start, num_views), min(fps, BULLET_FPS))
        case "slowmo":
            check_length(path, times)
            check_slow_motion(times, factor)
            if len({f.camera_id for f in frames}) > 1:
                # Gliding from one camera to the next would be a ride around the scene.
                cameras = [start.camera] * len(times)
            return Shot(path, paths.slow_motion(cameras, times, factor), fps)
    if not path.endswith(".json"):
        known = "training, fixed, bullet, slowmo, all or a .json file"
        raise InputError(f"--path {shorten(path)!r}: not known; use {known}")
    name = Path(path).stem
    if name in SHOTS:
        problem = f"its pictures would replace those of `--path {name}`"
        raise InputError(f"--path {path}: {problem}; rename the file")
    views = paths.read_path(path, start.camera)
    if len(views) > MAX_VIEWS:
        limit = f"a shot has at most {MAX_VIEWS:,}; write fewer"
        raise InputError(f"{path}: {len(views):,} views; {limit}")
    check_views(run, path, views)
    return Shot(name, views, fps)


def filmed_frames(run: Run) -> list[Frame]:
    """The frames of the training cameras in order of time, one per camera and time:
    those of training, and those between them that were held out.
    """
    train = run.scene.train
    cameras, times = {f.camera_id for f in train}, [f.time for f in train]
    first, last = min(times), max(times)
    between = [f for f in run.scene.test if f.camera_id in cameras and first <= f.time <= last]
    found: dict[tuple[int, float], Frame] = {}
    for f in [*train, *between]:
        found.setdefault((f.camera_id, f.time), f)
    return sorted(found.values(), key=lambda f: (f.time, f.index))


def check_length(path: str, times: Sequence[float]) -> None:
    """InputError where the clip, with the gaps in it, lasts longer than a shot may."""
    count = round((times[-1] - times[0]) / paths.usual_gap(times)) + 1
    if count > MAX_VIEWS:
        problem = f"the clip lasts {count:,} frames, those that are missing included"
        limit = f"a shot has at most {MAX_VIEWS:,} views; use --path training or a .json file"
        raise InputError(f"--path {path}: {problem}; {limit}")


def check_slow_motion(times: Sequence[float], factor: int) -> None:
    """InputError where slow motion would take more views than a shot may have."""
    count = sum(paths.views_per_interval(times, factor)) + 1
    if count > MAX_VIEWS:
        largest = max(1, factor * (MAX_VIEWS - 1) // count)
        problem = f"slow motion of {len(times)} frames would take {short_count(count)} views"
        limit = f"a shot has at most {MAX_VIEWS:,}"
        raise InputError(f"--factor {short_count(factor)}: {problem}; {limit}, use {largest}")


def short_count(count: int) -> str:
    """A count with its thousands marked; one of many digits as a power of ten."""
    digits = f"{count:,}"
    return digits if len(digits) < 30 else f"10^{len(str(count)) - 1}"


def find_frame(run: Run, index: int | None) -> Frame:
    """The frame of that index; None: the training frame in the middle of the clip."""
    if index is None:
        frames = sorted(run.scene.train, key=lambda f: f.time)
        return frames[len(frames) // 2]
    known = {f.index: f for f in run.scene.train + run.scene.test}
    if index not in known:
        problem = f"the scene has no such frame; it has {min(known)} to {max(known)}"
        raise InputError(f"--frame {index}: {problem}; choose one of these")
    return known[index]


def bullet_views(run: Run, start: Frame, num_views: int) -> list[PathView]:
    """The spiral around a frame, as wide as the cameras of the clip reach.

    InputError where the footage has no parallax.
    """
    parallax = run.scene.manifest.parallax
    if parallax != "full":
        camera = "only turned" if parallax == "rotation" else "stood still"
        problem = f"no bullet time from this clip, its camera {camera}"
        reason = "so there is no parallax and no depth"
        raise InputError(f"{run.folder}: {problem}, {reason}; use --path fixed or --path slowmo")
    depth = focus_depth(run, start)
    reach = paths.center_spread([f.camera for f in run.scene.train], start.camera)
    radius = reach.clamp(max=MAX_RADIUS * depth)  # (3,) right, down, forward
    least = radius.max() * torch.tensor(MIN_RADII).to(radius)
    return paths.bullet_time(start.camera, start.time, depth, radius.maximum(least), num_views)


def focus_depth(run: Run, frame: Frame) -> float:
    """Median z-depth of a small picture from the frame's camera, in scene units.

    Where the picture is empty, the middle of the scene in disparity.
    """
    small = PathView(frame.camera, frame.time).resized(0.25)
    seen = run.field.render(to_device(small.camera, device_of(run)), small.time)
    solid = seen.opacity > 0.5
    if solid.any():
        return float(seen.depth[solid].median())
    return 2 / (1 / run.scene.near + 1 / run.scene.far)


def check_views(run: Run, path: str, views: Sequence[PathView]) -> None:
    """InputError where a path file leaves the clip's time or its viewpoint.

    Its viewpoint only where the clip has no parallax.
    """
    first, last = float(run.scene.times[0]), float(run.scene.times[-1])
    centers = torch.stack([f.camera.c2w[:, 3] for f in run.scene.train])
    for i, view in enumerate(views):
        if not first <= view.time <= last:
            problem = f"outside the clip ({first:g} to {last:g} frames)"
            advice = "choose a time within"
            raise InputError(f"{path}: view {i} is at time {view.time:g}, {problem}; {advice}")
        distance = (centers - view.camera.c2w[:, 3]).norm(dim=-1).min()
        moved = distance > VIEWPOINT_SHARE * run.scene.near
        if moved and run.scene.manifest.parallax != "full":
            problem = "leaves the clip's viewpoint, but the clip has no parallax and so no depth"
            advice = "only turn the camera where it stands"
            raise InputError(f"{path}: view {i} {problem}; {advice}")
