"""Depth and motion against the exact ones. A scene's scale is its own: depth takes one
scale for all views, the median ratio, and scene flow that of the similarity between
estimated and true camera centers. Motion is per frame, to later and to earlier times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core import io
from hdr_nsff.core.errors import InputError
from hdr_nsff.evaluation.predictions import Geometry, geometry_of
from hdr_nsff.evaluation.targets import GeometryFile, Target, moving_of
from hdr_nsff.maths import metrics
from hdr_nsff.scene.truth import GEOMETRY

GEOMETRY_SCORES = {  # what they are called, and digits after the point
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

    # by which predicted depth is multiplied, for all views: the median of truth /
    # prediction
    depth: float
    world: (
        float | None
    )  # of the similarity between the camera paths; None where the cameras do not spread


def true_geometry(file: GeometryFile) -> Geometry:
    """Depth and motion of a truth file, in true units along the axes of the scene."""
    channels = io.read_exr(file.path)
    if lost := [n for n in GEOMETRY if n not in channels]:
        raise InputError(
            f"{file.path}: no channel {lost[0]} in this truth file; make the truth anew"
        )
    if channels["Z"].shape != file.size:
        raise InputError(
            f"{file.path}: depth of {channels['Z'].shape}, but the pictures of that view are {file.size}"
        )

    def stacked(name: str, axes: str) -> Tensor:
        return torch.from_numpy(np.stack([channels[f"{name}.{a}"] for a in axes], -1))

    turn = torch.from_numpy(file.turn).float()
    return Geometry(
        torch.from_numpy(channels["Z"]),
        {s: stacked(n, "uv") for s, n in io.SIDES.items()},
        {s: stacked(n, "xyz") @ turn.T for s, n in io.SIDES.items()},
    )


def find_units(
    targets: Sequence[Target], predictions: Sequence[Path], world_scale: float | None
) -> Units | None:
    """One set of units for all views; None where no view has a true depth.
    `world_scale`: scene units per true unit.
    """
    pairs = [
        (geometry_of(path, t.view).depth.flatten(), true_geometry(t.geometry).depth.flatten())
        for t, path in zip(targets, predictions, strict=True)
        if t.geometry is not None
    ]
    if not pairs:
        return None
    predicted, true = (torch.cat(maps) for maps in zip(*pairs, strict=True))
    return Units(metrics.median_ratio(predicted, true), 1 / world_scale if world_scale else None)


def score_geometry(target: Target, prediction: Path, units: Units) -> dict[str, float]:
    """Depth and motion of a view; names as in `GEOMETRY_SCORES`. Only where the true
    ray hits something; moving-only where that moves.
    """
    if target.geometry is None:
        return {}
    seen, true = geometry_of(prediction, target.view), true_geometry(target.geometry)
    known, moving = true.depth > 0, moving_of(target)
    regions = {"": known} | ({} if moving is None else {"_moving": known & moving})
    scores: dict[str, float] = {}
    for name, region in regions.items():
        if region.any():
            scores[f"depth_abs_rel{name}"], scores[f"depth_rmse{name}"] = metrics.depth_errors(
                seen.depth * units.depth, true.depth, region
            )
            scores |= {f"{k}{name}": v for k, v in motion_errors(seen, true, region, units).items()}
    return scores


def motion_errors(seen: Geometry, true: Geometry, region: Tensor, units: Units) -> dict[str, float]:
    """End-point errors over a region (H, W), mean of both directions (or of the one
    that the run tells); empty where it tells neither.
    """
    sides = list(seen.flow)
    if not sides:
        return {}
    errors = {
        "flow_epe": [metrics.end_point_error(seen.flow[s], true.flow[s], region) for s in sides],
        "flow_epe_of_rest": [
            metrics.end_point_error(torch.zeros_like(true.flow[s]), true.flow[s], region)
            for s in sides
        ],
    }
    if (world := units.world) is not None:
        errors["scene_flow_epe"] = [
            metrics.end_point_error(seen.scene_flow[s] * world, true.scene_flow[s], region)
            for s in sides
        ]
    return {name: float(np.mean(values)) for name, values in errors.items()}
