"""The step `static_depth`: depth before movers are known.

It is that of the static scene, also behind moving pixels. Where a network, the user or
a data set gives depth, it is that of everything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.distance import pdist

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.core.stack import ArrayStack, Stack, by_key, spread_frames
from hdr_nsff.footage.datasets import maps
from hdr_nsff.footage.depth_files import read_depth_files
from hdr_nsff.prepare.given_maps import depth_files
from hdr_nsff.prepare.lens import undistorted_maps
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.neural import network_depth
from hdr_nsff.prepare.still_cameras import still_cameras
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.depth.geometric import DepthTuning, depth_range, static_geometric_depth
from hdr_nsff.priors.depth.parallax import disparity_range, triangulate
from hdr_nsff.priors.masks.visits import without_movers
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.posed_video import PosedVideo

MAX_STILL_FRAMES = 60  # of a camera that stands still, that its static picture is made of
KNOWN = 0.5  # confidence of depth from which on a pixel counts as well known
# of synchronized still cameras, below which depth is mere chance (hand-chosen: 3 % of
# cameras a quarter of a circle apart, where a picture before each was 4 dB better)
MIN_KNOWN_SHARE = 0.1


@dataclass(frozen=True)
class Depth:
    """Depth of the training frames, in order."""

    disparity: ArrayStack  # (T, H, W) 1 / scene units, or relative
    confidence: ArrayStack  # (T, H, W) in [0, 1]
    note: str
    source: str  # "geometric", "given", ...
    given: bool = False
    still: ArrayStack | None = None  # (T, H, W) pixels of the masks that stand still
    details: dict[str, Any] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)


def find_static_depth(work: Work) -> StepResult:
    """Disparity of the training frames and how far it can be believed."""
    m, c = work.manifest, work.config
    if work.capture_with("depth") is not None:
        depth = data_set_depth(work)
    elif isinstance(c.depth, Path):
        depth = user_depth(work, c.depth)
    elif m.parallax != "full":
        ones = np.ones((len(work.train), m.height, m.width), np.float32)
        note = "everything at distance 1: without parallax there is no depth to find"
        depth = Depth(ones, ones, note, "geometric")  # no network had a part in it
    elif c.depth == "depth-anything":
        depth = depth_anything(work)
    else:
        depth = geometric_depth(work)
    result_maps = {"static_disparity": depth.disparity, "static_confidence": depth.confidence}
    if depth.still is not None:
        result_maps["still"] = depth.still
    indices = [f.index for f in work.train]
    cleared: dict[str, dict[int, Any]] = {"still": {}, "disparity": {}, "disparity_confidence": {}}
    return StepResult(
        provenance="given" if depth.given else "estimated",
        note=depth.note,
        details={"source": depth.source, **depth.details},
        manifest={"depth_kind": "scene", **range_of_poses(m), **depth.manifest},
        frames=cleared,
        maps={name: by_key(indices, values) for name, values in result_maps.items()},
    )


def range_of_poses(m: Manifest) -> dict[str, float | None]:
    """Near and far as the step `poses` left them, whatever depth has made of them."""
    near, far = m.steps["poses"].details.get("range", (m.near, m.far))
    return {"near": near, "far": far}


def geometric_depth(work: Work) -> Depth:
    """Depth from the parallax of the static scene."""
    m = work.manifest
    points = work.static_points()
    cameras = still_cameras(work)
    if cameras is not None:
        of_train = cameras[[f.index for f in work.train]]
        disparity, confidence, still = depth_of_cameras(work, of_train, points)
    else:
        flow = work.training_flows(work.raw_flows)
        disparity, confidence, still = static_geometric_depth(work.training_clip(), *flow, points)
        if m.synchronized:  # views of one instant fit moving pixels too
            still = np.zeros(still.shape, bool)
    known = np.mean([(map > KNOWN).mean() for map in confidence])
    note = f"{known:.0%} of the pixels well known"
    return Depth(disparity, confidence, note, "geometric", still=still)


def depth_of_cameras(
    work: Work, camera_of: np.ndarray, points: np.ndarray
) -> tuple[ArrayStack, ArrayStack, ArrayStack]:
    """Depth from the static pictures of still cameras, the same for all frames of a
    camera: disparity, confidence, and that no pixel of the masks is static, (T, H, W).
    `camera_of` (T,): the camera of every training frame.
    """
    cameras, first, of_frame = np.unique(camera_of, return_index=True, return_inverse=True)
    frames = work.training_clip()
    of_camera = [np.flatnonzero(of_frame == k) for k in range(len(cameras))]
    some = np.concatenate([own[spread_frames(len(own), MAX_STILL_FRAMES)] for own in of_camera])
    kept = frames.video[some], frames.clipped[some], frames.moving[some]
    pictures = without_movers(*kept, of_frame[some].tolist(), len(cameras))
    # each at a time of its own: what is unknown in one may move in another
    times = np.arange(len(cameras), dtype=np.float64)
    clip = PosedVideo(frames.K[first], frames.c2w[first], times, *pictures)
    no_flow = np.zeros((0, *clip.size, 2)), np.zeros((0, *clip.size), bool), np.zeros((0, 2), int)
    disparity, confidence, _ = static_geometric_depth(clip, *no_flow, points)
    known = np.mean([(map > KNOWN).mean() for map in confidence])
    if work.manifest.rig == 1 and np.any(confidence) and known < MIN_KNOWN_SHARE:
        distance = np.float32(least_spacing(clip.c2w) / 2)
        say(
            f"depth: the cameras agree about {known:.0%} of the pixels only; what each sees is put "
            f"at distance {distance:.3g}, so views between the cameras will not work"
        )
        disparity = np.full(confidence.shape, 1 / distance)
        confidence = np.zeros(confidence.shape, np.float32)
    shape = (len(camera_of), *clip.size)

    def of_frames(maps: ArrayStack) -> Stack:
        return Stack(lambda t: maps[of_frame[t]], shape)

    return of_frames(disparity), of_frames(confidence), np.zeros(shape, bool)


def least_spacing(c2w: np.ndarray) -> float:
    """The smallest distance between two of the cameras `c2w` (N, 3, 4) at different
    places.
    """
    spacings = pdist(c2w[:, :, 3])
    return float(spacings[spacings > 0].min())


def data_set_depth(work: Work) -> Depth:
    """The depth of a data set."""
    m, capture = work.manifest, work.capture_with("depth")
    assert capture is not None
    pictures = [work.picture(f) for f in work.train]
    disparity, confidence, how = maps.disparities(capture, pictures, (m.height, m.width))
    disparity, confidence = (
        undistorted_maps(work, work.train, values) for values in (disparity, confidence)
    )
    changes = changes_of(work, capture.depth_kind == "relative", disparity, confidence)
    note = "; ".join(part for part in (f"given ({capture.depth_kind})", how) if part)
    return Depth(disparity, confidence, note, "given", given=True, manifest=changes)


def user_depth(work: Work, folder: Path) -> Depth:
    """The depth maps in the user's folder."""
    m, kind = work.manifest, work.config.depth_kind
    files = depth_files(work, folder)
    disparity, confidence = read_depth_files(files, kind, (m.height, m.width))
    index = [f.index for f in work.train]
    disparity, confidence = (
        undistorted_maps(work, work.train, values[index]) for values in (disparity, confidence)
    )
    changes = changes_of(work, kind == "relative", disparity, confidence)
    return Depth(
        disparity,
        confidence,
        f"given ({kind})",
        "given",
        given=True,
        manifest=changes,
    )


def changes_of(
    work: Work, relative: bool, disparity: np.ndarray, confidence: np.ndarray
) -> dict[str, Any]:
    """What given depth changes in the manifest: its kind, and near and far where the
    poses come without.
    """
    m = work.manifest
    changes: dict[str, Any] = {"depth_kind": "relative"} if relative else {}
    if m.steps["poses"].details.get("known_range", True):
        return changes
    if not relative:
        changes["near"], changes["far"] = depth_range(disparity, confidence)
    elif m.parallax == "full":
        changes["near"], changes["far"] = range_of_flow(work)
    return changes


def range_of_flow(work: Work) -> tuple[float, float]:
    """Near and far of static points triangulated from flow, with room; InputError where
    there are too few.
    """
    clip, tuning = work.training_clip(), DepthTuning()
    points = triangulate(clip, *work.training_flows(work.raw_flows))
    if len(points) < tuning.min_points:
        raise InputError(
            "depth: relative depth, poses without near and far, and too little parallax to find "
            "these; add `near` and `far` to the poses, or give --depth-kind metric or disparity"
        )
    low, high = disparity_range(clip, points)
    return 1 / high, 1 / low


def depth_anything(work: Work) -> Depth:
    """Depth by the network Depth Anything, laid onto static points."""
    name = work.config.depth_weights
    disparity, confidence, near, far, kind = network_depth(work)
    return Depth(
        disparity,
        confidence,
        f"{name} ({kind}), near {near:.3g}, far {far:.3g} scene units",
        "depth-anything",
        details={"kind": kind, "weights": name},
        manifest={"near": near, "far": far},
    )
