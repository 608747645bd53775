"""Depth and motion against the exact ones.

The scale of an estimated scene is arbitrary. Depth therefore takes one scale for all
views, the median ratio; scene flow takes that of the similarity between estimated and
true camera centers. Motion is per frame, to later and to earlier times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr
from hdr_nsff.evaluation.predictions import Geometry, geometry_of
from hdr_nsff.evaluation.targets import GeometryFile, Target, moving_of
from hdr_nsff.maths import metrics
from hdr_nsff.scene.truth import GEOMETRY

GEOMETRY_SCORES = {  # label, and digits after the point
    "depth_abs_rel": ["depth, AbsRel", 4],
    "depth_abs_rel_moving": ["depth, AbsRel moving", 4],
    "depth_rmse": ["depth, RMSE, true units", 4],
    "depth_rmse_moving": ["depth, RMSE moving, true units", 4],
    "scene_flow_epe": ["scene flow, end-point error, true units per frame", 4],
    "scene_flow_epe_moving": ["scene flow, end-point error moving", 4],
    "flow_epe": ["motion in the picture, end-point error, pixels per frame", 3],
    "flow_epe_moving": ["motion in the picture, end-point error moving", 3],
    "flow_epe_of_rest": ["the same of a run in which nothing moves", 3],
    "flow_epe_of_rest_moving": ["the same moving", 3],
}


@dataclass(frozen=True)
class Units:
    """True units per scene unit."""

    depth: float  # factor of predicted depth, for all views: the median of truth / prediction
    # of the similarity between the camera paths; None where the cameras do not spread
    world: float | None


def true_geometry(file: GeometryFile) -> Geometry:
    """Depth and motion of a truth file, in true units along the axes of the scene."""
    channels = read_exr(file.path)
    missing = [name for name in GEOMETRY if name not in channels]
    if missing:
        problem = f"no channel {missing[0]} in this truth file"
        raise InputError(f"{file.path}: {problem}; make the truth again")
    if channels["Z"].shape != file.size:
        problem = f"but the pictures of that view are {file.size}"
        raise InputError(f"{file.path}: depth of {channels['Z'].shape}, {problem}")

    def stacked(name: str, axes: str) -> Tensor:
        return torch.from_numpy(np.stack([channels[f"{name}.{a}"] for a in axes], -1))

    rotation = torch.from_numpy(file.rotation).float()
    flow = {side: stacked(name, "uv") for side, name in MOTION_DIRECTIONS.items()}
    scene_flow = {
        side: stacked(name, "xyz") @ rotation.T for side, name in MOTION_DIRECTIONS.items()
    }
    return Geometry(torch.from_numpy(channels["Z"]), flow, scene_flow)


def find_units(
    targets: Sequence[Target], predictions: Sequence[Path], world_scale: float | None
) -> Units | None:
    """One set of units for all views; None where no view has a true depth.
    `world_scale`: scene units per true unit.
    """
    predicted, true = [], []
    for target, path in zip(targets, predictions, strict=True):
        if target.geometry is not None:
            predicted.append(geometry_of(path, target.view).depth.flatten())
            true.append(true_geometry(target.geometry).depth.flatten())
    if not true:
        return None
    depth = metrics.median_ratio(torch.cat(predicted), torch.cat(true))
    return Units(depth, 1 / world_scale if world_scale else None)


def score_geometry(target: Target, prediction: Path, units: Units) -> dict[str, float]:
    """Depth and motion of a view; names as in `GEOMETRY_SCORES`.

    Over pixels whose true ray hits a surface, moving-only where that moves.
    """
    if target.geometry is None:
        return {}
    predicted = geometry_of(prediction, target.view)
    true = true_geometry(target.geometry)
    moving = moving_of(target)
    regions = {"": true.depth > 0}  # (H, W)
    if moving is not None:
        regions["_moving"] = (true.depth > 0) & moving
    scores: dict[str, float] = {}
    for suffix, region in regions.items():
        if region.any():
            depth = predicted.depth * units.depth
            abs_rel, rmse = metrics.depth_errors(depth, true.depth, region)
            scores[f"depth_abs_rel{suffix}"] = abs_rel
            scores[f"depth_rmse{suffix}"] = rmse
            for name, error in motion_errors(predicted, true, region, units).items():
                scores[f"{name}{suffix}"] = error
    return scores


def motion_errors(
    predicted: Geometry, true: Geometry, region: Tensor, units: Units
) -> dict[str, float]:
    """End-point errors over a region (H, W); empty where the run has no motion.

    The mean of both directions, or the one that the run has.
    """
    sides = list(predicted.flow)
    if not sides:
        return {}
    errors: dict[str, list[float]] = {"flow_epe": [], "flow_epe_of_rest": []}
    if units.world is not None:
        errors["scene_flow_epe"] = []
    for side in sides:
        flow, at_rest = true.flow[side], torch.zeros_like(true.flow[side])
        errors["flow_epe"].append(metrics.end_point_error(predicted.flow[side], flow, region))
        errors["flow_epe_of_rest"].append(metrics.end_point_error(at_rest, flow, region))
        if units.world is not None:
            scene_flow = predicted.scene_flow[side] * units.world
            error = metrics.end_point_error(scene_flow, true.scene_flow[side], region)
            errors["scene_flow_epe"].append(error)
    return {name: float(np.mean(values)) for name, values in errors.items()}
