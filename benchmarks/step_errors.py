"""Errors of single steps of `prepare` on one clip, each from the step's stored inputs.

A step runs again with tuning constants of one's choice while everything before it stays
as `prepare` left it in the scene folder. On rendered clips the error is the distance
from the truth. Recorded clips have no truth but their exposures, so their error is a
disagreement, with other frames or with the result of the default constants (`METRICS`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS
from hdr_nsff.core.io import read_npy
from hdr_nsff.geometry import alignment, pinhole
from hdr_nsff.geometry.poses import Poses, project
from hdr_nsff.geometry.round_trip import follow, valid_flow
from hdr_nsff.prepare.steps.flow import Pair, learning_pairs
from hdr_nsff.prepare.steps.movers import find_movers
from hdr_nsff.prepare.steps.refined_flow import RefinedFlowTuning, Refiner, equalized
from hdr_nsff.prepare.steps.response import response_view
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.depth.geometric import DepthTuning, static_geometric_depth
from hdr_nsff.priors.flow.sources import FlowTuning, flow_source
from hdr_nsff.priors.masks.geometric import geometric_mask
from hdr_nsff.priors.masks.geometric_tuning import GeometricMaskTuning
from hdr_nsff.priors.movers.tuning import MoversTuning
from hdr_nsff.priors.poses.estimate import PosesTuning, estimate_poses
from hdr_nsff.radiometry.estimate_response import ResponseTuning, estimate_response
from hdr_nsff.radiometry.exposure_cycle import ExposureCycleTuning, detect_cycle
from hdr_nsff.radiometry.recording import response_curve
from hdr_nsff.scene.movers import fill_mover_depth, read_movers

CODES = 255  # of 8 bits
RIGHT_FLOW_PX = 1.0  # end-point error up to which flow counts as right
MAX_LOG_ERROR = 1.0  # of depth: a factor of e, so that a few outliers do not decide
SEGMENT_NEAR = 0.5  # of near: where the epipolar segment of a pixel ends
RESPONSE = "film"  # of the camera that records rendered clips

Errors = dict[str, float]  # by the names of `METRICS`


@dataclass(frozen=True)
class Metric:
    """One number that a step is measured by; lower is better."""

    unit: str
    rendered: str
    recorded: str = ""
    recorded_unit: str = ""  # where it differs


METRICS = {
    "exposure": Metric(
        "EV",
        "mean error of the exposure steps between neighboring frames",
        "the same, from the exposures that the camera was set to",
    ),
    "curve": Metric("codes", "root mean square error of the response curve, of 255"),
    "mask": Metric(
        "%",
        "1 - IoU of the moving masks",
        "1 - IoU with the masks of the default",
    ),
    "flow": Metric(
        "px",
        "mean end-point error of moving pixels that both frames show",
        "mean difference of recorded values, in codes of 255, of frames of equal "
        "exposure, one cycle apart, along the chain of flow between them",
        "codes",
    ),
    "static flow": Metric("px", "mean end-point error of static pixels that both frames show"),
    "validity": Metric(
        "%",
        "unclipped pixels whose flow is valid with an error above 1 px, or invalid with "
        "an error below",
        "pixels whose validity differs from the default's",
    ),
    "pose": Metric(
        "%",
        "root mean square error of the camera centers (ATE), of the path's extent",
        "median distance (px) of the flow of static pixels from their epipolar segments",
        "px",
    ),
    "rotation": Metric("degrees", "mean rotation left after the best common rotation"),
    "focal": Metric("%", "error of the focal length"),
    "points": Metric(
        "%",
        "mean |ln(estimated / true)| of the depth of the points, wherever they are seen, at most 1",
    ),
    "depth": Metric(
        "%",
        "mean |ln(estimated / true)| of the depth of static pixels, at most 1",
        "mean |ln| of the ratio between the disparities of neighboring frames in static "
        "pixels, at most 1",
    ),
    "still": Metric(
        "%",
        "pixels of the moving masks wrongly judged to stand still, or to move",
        "pixels of the moving masks judged otherwise than by the default",
    ),
    "mover depth": Metric(
        "%",
        "mean |ln(estimated / true)| of the depth of moving pixels that the masks mark, at most 1",
    ),
}


@dataclass(frozen=True)
class Clip:
    """A prepared clip, and what is known of it."""

    name: str
    work: Work
    ev: tuple[float, ...]  # one cycle, stops relative to any reference
    # per frame, of rendered clips: radiance, depth, bodies and flow, as `synth` writes
    exact: tuple[dict[str, np.ndarray], ...] | None = None
    c2w: np.ndarray | None = None  # (T, 3, 4), of rendered clips
    focal: float | None = None  # pixels, of rendered clips

    @property
    def moving(self) -> np.ndarray:
        """Truly moving pixels (T, H, W) of a rendered clip."""
        assert self.exact is not None
        return np.stack([frame["body"] > 0 for frame in self.exact])

    def true_flow(self, i: int, j: int) -> np.ndarray:
        """The exact flow (H, W, 2) px from frame `i` to its neighbor `j`."""
        assert self.exact is not None
        name = MOTION_DIRECTIONS[j - i]
        return np.stack([self.exact[i][f"{name}.u"], self.exact[i][f"{name}.v"]], -1)

    def true_steps(self) -> np.ndarray:
        """EV from each frame to the next (T-1,)."""
        count = len(self.work.manifest.frames)
        return np.diff([self.ev[t % len(self.ev)] for t in range(count)])


@dataclass(frozen=True)
class Step:
    """A step: its tuning constants, and its errors with others."""

    tuning: Any
    errors: Callable[[Clip, Any], Errors]
    repeats: int = 1  # runs of the default, of a step that is not repeatable


# Exposures


def exposure_errors(clip: Clip, tuning: ExposureCycleTuning) -> Errors:
    """Of the step `exposure`, where brightness alone shows the cycle."""
    cycle = detect_cycle(clip.work.video, tuning)
    steps = np.diff([cycle.ev[b] for b in cycle.brackets])
    return {"exposure": float(np.abs(steps - clip.true_steps()).mean())}


def response_errors(clip: Clip, tuning: ResponseTuning) -> Errors:
    """Of the step `response`."""
    m, train = clip.work.manifest, clip.work.train
    views = [response_view(clip.work, f) for f in train]
    cameras = [f.camera_id for f in train]
    response = estimate_response(
        views, cameras, m.known_ev, m.reference_bracket, m.num_cameras, tuning
    )
    steps = np.diff([response.ev[f.bracket] for f in train])
    errors = {"exposure": float(np.abs(steps - clip.true_steps()).mean())}
    if clip.exact is not None:
        curve = response_curve(RESPONSE)
        true = np.stack([np.interp(response.x, curve.x, y) for y in curve.y])
        errors["curve"] = CODES * float(np.sqrt(((response.y[0] - true) ** 2).mean()))
    return errors


# Masks


def mask_errors(clip: Clip, tuning: GeometricMaskTuning) -> Errors:
    """Of the step `masks`."""
    K, c2w = clip.work.cameras()
    found = geometric_mask(*clip.work.raw_flows, clip.work.equalized[0], K, c2w, tuning)
    reference = clip.work.masks if clip.exact is None else clip.moving
    union = (found | reference).sum()
    iou = (found & reference).sum() / max(union, 1)
    return {"mask": 100 * float(1 - iou) if union else 0.0}


# Flow


def flow_errors(clip: Clip, tuning: FlowTuning) -> Errors:
    """Of the step `flow`."""
    pairs = clip.work.raw_flows[2]
    neighbors, equal = learning_pairs(clip.work.manifest.frames)
    source = flow_source(None, None, None, neighbors, equal, tuning)
    found, _ = source(*clip.work.equalized, pairs)
    return errors_of_flow(clip, by_pair(found, pairs))


def refined_flow_errors(clip: Clip, tuning: RefinedFlowTuning) -> Errors:
    """Of the step `refined_flow`."""
    refiner = Refiner(clip.work, equalized(clip.work)[0], tuning)
    pairs = [(int(i), int(j)) for i, j in clip.work.raw_flows[2] if i < j]
    found = [one for pair in pairs for one in refiner.predict_both_directions(*pair)]
    flow = {pair: one for pair, one, _ in found}
    valid = {pair: one for pair, _, one in found}
    return errors_of_flow(clip, flow) | {"validity": validity_error(clip, flow, valid)}


def by_pair(maps: np.ndarray, pairs: np.ndarray) -> dict[Pair, np.ndarray]:
    """Maps (P, ...) by their pairs (P, 2) of frames."""
    return {(int(i), int(j)): one for (i, j), one in zip(pairs, maps, strict=True)}


def errors_of_flow(clip: Clip, flow: dict[Pair, np.ndarray]) -> Errors:
    """The errors of the flow (H, W, 2) px of neighbors."""
    if clip.exact is None:
        return {"flow": cycle_difference(clip, flow)}
    nothing = np.zeros(clip.moving.shape[1:], bool)
    moving, static = [], []
    for (i, j), found in flow.items():
        there, back = clip.true_flow(i, j), clip.true_flow(j, i)
        visible = valid_flow(there, back, nothing, nothing)
        error = np.linalg.norm(found - there, axis=-1)
        moving.append(error[visible & clip.moving[i]])
        static.append(error[visible & ~clip.moving[i]])
    return {
        "flow": float(np.concatenate(moving).mean()),
        "static flow": float(np.concatenate(static).mean()),
    }


def cycle_difference(clip: Clip, flow: dict[Pair, np.ndarray]) -> float:
    """The mean difference of recorded values, in codes, between frames one cycle apart
    along the chain of `flow` between them. Matching has not compared these frames.
    """
    video, clipped = clip.work.video, clip.work.equalized[1]
    length = len(clip.ev)
    differences = []
    for t in range(len(video) - length):
        chain = flow[t, t + 1]
        for k in range(t + 1, t + length):
            chain = chain + follow(flow[k, k + 1], chain)
        target_clipped = follow(clipped[t + length].astype(np.float32), chain, fill=1.0)
        recorded = ~clipped[t] & (target_clipped < 0.01)
        difference = np.abs(follow(video[t + length], chain) - video[t]).mean(-1)
        differences.append(difference[recorded])
    return CODES * float(np.concatenate(differences).mean())


def validity_error(
    clip: Clip, flow: dict[Pair, np.ndarray], valid: dict[Pair, np.ndarray]
) -> float:
    """Percent of pixels whose validity is wrong, or of a recorded clip another one than
    the default's.
    """
    default = by_pair(clip.work.refined_flows[1], clip.work.refined_flows[2])
    clipped = clip.work.equalized[1]
    wrong = []
    for (i, j), found in valid.items():
        if clip.exact is None:
            wrong.append((found != default[i, j]).ravel())
            continue
        error = np.linalg.norm(flow[i, j] - clip.true_flow(i, j), axis=-1)
        unclipped = ~clipped[i] & (follow(clipped[j].astype(np.float32), flow[i, j], 1.0) < 0.01)
        wrong.append((found != (error < RIGHT_FLOW_PX))[unclipped])
    return 100 * float(np.concatenate(wrong).mean())


# Poses


def pose_errors(clip: Clip, tuning: PosesTuning) -> Errors:
    """Of the step `poses`, in one round with the final masks. On one thread incremental
    mapping is repeatable; global mapping is not.
    """
    video, clipped = clip.work.equalized
    with TemporaryDirectory() as folder:
        try:
            poses = estimate_poses(
                video, clip.work.masks, Path(folder), clipped, threads=1, tuning=tuning
            )
        except InputError:
            return {"pose": np.inf, "points": np.inf}
    if clip.exact is None:
        return {"pose": epipolar_distance(clip, poses)}
    assert clip.c2w is not None and clip.focal is not None
    errors = alignment.pose_errors(clip.c2w, poses.c2w)
    return {
        "pose": 100 * errors.get("ate_share", np.inf),
        "rotation": errors["rotation_degrees"],
        "focal": 100 * abs(float(poses.K[0, 0, 0]) / clip.focal - 1),
        "points": point_error(clip, poses),
    }


def point_error(clip: Clip, poses: Poses) -> float:
    """Percent: the mean error of the logarithm of the depth of the points of `poses` in
    the frames that see them; infinite where there is none.
    """
    assert clip.exact is not None and clip.c2w is not None
    fit = alignment.umeyama(clip.c2w[:, :, 3], poses.c2w[:, :, 3])
    if fit is None or not len(poses.tracks):
        return np.inf
    frames, rows = poses.tracks[:, 0].astype(int), poses.tracks[:, 1].astype(int)
    _, estimated = project(poses, frames, poses.points[rows])
    depth = np.stack([frame["Z"] for frame in clip.exact])
    height, width = depth.shape[1:]
    x = poses.tracks[:, 2].astype(int).clip(0, width - 1)
    y = poses.tracks[:, 3].astype(int).clip(0, height - 1)
    error = np.abs(np.log(np.maximum(estimated, 1e-9) / (fit.scale * depth[frames, y, x])))
    return 100 * float(np.minimum(error, MAX_LOG_ERROR).mean())


def epipolar_distance(clip: Clip, poses: Poses) -> float:
    """The median distance (px) of valid flow of static pixels from where their epipolar
    segments are. A segment shrinks to a point for cameras that only turn.
    """
    flow, valid, pairs = clip.work.raw_flows
    static = np.asarray(valid) & ~clip.work.masks[pairs[:, 0]]
    pixels = pinhole.pixel_centers(*flow.shape[1:3])
    max_disparity = 1 / (SEGMENT_NEAR * (poses.near or 1.0))
    distances = []
    for one, use, (i, j) in zip(flow, static, pairs, strict=True):
        rotation, shift = pinhole.transfer(poses.K[i], poses.c2w[i], poses.K[j], poses.c2w[j])
        far = pinhole.homogeneous(pixels[use]) @ rotation.T
        near = far + max_disparity * shift
        start, end = far[:, :2] / far[:, 2:], near[:, :2] / near[:, 2:]
        target = pixels[use] + one[use]
        along = end - start
        share = ((target - start) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
        nearest = start + share.clip(0, 1)[:, None] * along
        distances.append(np.linalg.norm(target - nearest, axis=-1))
    return float(np.median(np.concatenate(distances)))


# Depth


def depth_errors(clip: Clip, tuning: DepthTuning) -> Errors:
    """Of the step `static_depth`; none for a clip without parallax."""
    work = clip.work
    if work.manifest.parallax != "full":
        return {}
    points = np.zeros((0, 3))
    if work.manifest.points is not None:
        points = np.array(read_npy(work.folder / work.manifest.points))
    flow = work.training_flows(work.raw_flows)
    disparity, _, still = static_geometric_depth(work.training_clip(), *flow, points, tuning)
    moving = work.masks
    default = work.still()
    if clip.exact is None:
        assert default is not None
        depth = disparity_mismatch(clip, np.asarray(disparity))
        wrong = np.asarray(still) != default
    else:
        depth = depth_error(clip, np.asarray(disparity), ~clip.moving)
        wrong = np.asarray(still) == clip.moving
    return {"depth": depth, "still": 100 * float(wrong[moving].mean())}


def depth_error(clip: Clip, disparity: np.ndarray, where: np.ndarray) -> float:
    """Percent: the mean error of the logarithm of depth in pixels `where` (T, H, W), at
    the scale of the camera path.
    """
    assert clip.exact is not None and clip.c2w is not None
    scale = alignment.scale_between(clip.c2w, clip.work.cameras()[1])
    depth = np.stack([frame["Z"] for frame in clip.exact])
    seen = where & np.isfinite(depth) & (depth > 0) & (disparity > 0)
    error = np.abs(np.log(disparity[seen] * depth[seen] * (scale or np.nan)))
    return 100 * float(np.minimum(error, MAX_LOG_ERROR).mean())


def disparity_mismatch(clip: Clip, disparity: np.ndarray) -> float:
    """Percent: the mean difference of the logarithms of each frame's disparity and the
    next frame's where that pixel falls, static pixels only.
    """
    K, c2w = clip.work.cameras()
    moving = clip.work.masks
    pixels = pinhole.pixel_centers(*disparity.shape[1:])
    errors = []
    for i in range(len(disparity) - 1):
        rotation, shift = pinhole.transfer(K[i], c2w[i], K[i + 1], c2w[i + 1])
        d = disparity[i][..., None]
        target = pinhole.homogeneous(pixels) @ rotation.T + d * shift
        way = (target[..., :2] / target[..., 2:] - pixels).astype(np.float32)
        expected = disparity[i] / target[..., 2]
        found = follow(disparity[i + 1].astype(np.float32), way, fill=0.0)
        blocked = follow(moving[i + 1].astype(np.float32), way, fill=1.0) > 0
        compared = ~blocked & ~moving[i] & (found > 0)
        error = np.abs(np.log(found[compared] / expected[compared]))
        errors.append(np.minimum(error, MAX_LOG_ERROR))
    return 100 * float(np.concatenate(errors).mean())


def mover_errors(clip: Clip, tuning: MoversTuning) -> Errors:
    """Of the steps `movers` and `depth`; recorded clips have no truth for them."""
    work = clip.work
    still = work.still()
    if clip.exact is None or still is None:
        return {}
    result = find_movers(work, tuning)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "movers.npz"
        result.files["movers.npz"](path)
        movers = read_movers(path)
    time_of = {int(index): t for t, index in enumerate(movers[0].frames)} if movers else {}
    moving = work.masks & ~still
    disparity, confidence = work.static_depth()
    first = np.stack([result.maps["mover_disparity"][k] for k in range(len(disparity))])
    disparity = np.where(moving, first, np.asarray(disparity))
    for k, t in time_of.items():
        c2w = work.camera(work.train[k])[1]
        disparity[k], _ = fill_mover_depth(movers, t, moving[k], c2w, disparity[k], confidence[k])
    return {"mover depth": depth_error(clip, disparity, clip.moving & work.masks)}


STEPS = {
    "exposure": Step(ExposureCycleTuning(), exposure_errors),
    "flow": Step(FlowTuning(), flow_errors),
    "poses": Step(PosesTuning(), pose_errors, repeats=3),
    "masks": Step(GeometricMaskTuning(), mask_errors),
    "static_depth": Step(DepthTuning(), depth_errors),
    "response": Step(ResponseTuning(), response_errors),
    "refined_flow": Step(RefinedFlowTuning(), refined_flow_errors),
    "movers": Step(MoversTuning(), mover_errors),
}
