"""Masks and depth by networks: what `prepare --mask sam2` and `--depth depth-anything`
do with a clip of one or more cameras; and which weights the steps read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_npy, write_json
from hdr_nsff.core.progress import say
from hdr_nsff.prepare.work import PrepareConfig, StepName, Work
from hdr_nsff.priors.depth.depth_anything import Kind, anchored_depth, network_disparity
from hdr_nsff.priors.flow.sources import flow_weights
from hdr_nsff.priors.masks.points_file import (
    PointsFile,
    merge_prompts,
    read_points,
    to_points_file,
)
from hdr_nsff.priors.masks.prompts import find_objects
from hdr_nsff.priors.masks.sam2 import sam2_mask
from hdr_nsff.priors.poses.lightglue import check_matcher, matcher_weights
from hdr_nsff.priors.pretrained import architecture, pretrained
from hdr_nsff.priors.weights import content_hash, find

SAM2, DEPTH_ANYTHING = "Sam2VideoModel", "DepthAnythingForDepthEstimation"
PROMPTS = "masks/prompts.json"


def check_networks(config: PrepareConfig) -> None:
    """InputError where a network that was chosen cannot run, before anything else is
    done; its weights are downloaded where they may be.
    """
    check_matcher(config.matcher)
    if config.masks == "sam2":
        architecture(SAM2)
        find(config.mask_weights)
    elif config.mask_points is not None:
        raise InputError(
            "--mask-points: only `--mask sam2` can be corrected by points; "
            "choose it, or paint over the files in masks/ and give them"
        )
    if config.depth == "depth-anything":
        architecture(DEPTH_ANYTHING)
        find(config.depth_weights)


def weights_of(config: PrepareConfig, step: StepName) -> list[str]:
    """The hashes of the weights that a step reads. InputError where they are not to be
    had.
    """
    match step:
        case "flow":
            paths = flow_weights(config.flow, config.flow_weights, config.semantic)
        case "poses" if config.poses is None:
            paths = matcher_weights(config.matcher)
        case "masks" if config.masks == "sam2":
            paths = [find(config.mask_weights)]
        case "static_depth" if config.depth == "depth-anything":
            paths = [find(config.depth_weights)]
        case _:
            paths = []
    return [content_hash(path) for path in paths]


def ready(network: str, weights: str) -> Any:
    """The network, on the GPU where there is one."""
    return pretrained(network, weights).to("cuda" if torch.cuda.is_available() else "cpu")


def sam2_masks(work: Work, moving: np.ndarray) -> np.ndarray:
    """`moving` (T, H, W) bool outlined by SAM 2, camera by camera; what it was asked is
    written to `masks/prompts.json`.

    Masks of training frames come from training frames alone; held-out ones get theirs
    from a second run over all frames.
    """
    m, c = work.manifest, work.config
    given = (
        PointsFile()
        if c.mask_points is None
        else read_points(c.mask_points, len(m.frames), (m.height, m.width))
    )
    if other := sorted(
        {e.frame for e in (*given.points, *given.boxes) if m.frames[e.frame].split != "train"}
    ):
        raise InputError(
            f"{c.mask_points}: frame {other[0]} is held out of training; point at frames beside it"
        )
    network = ready(SAM2, c.mask_weights)
    video = work.equalized[0]
    outlined = np.zeros_like(moving)
    written: dict[str, list[Any]] = {"points": [], "boxes": []}
    number = 0  # of objects of the cameras before
    for frames in work.camera_frames():
        train = [i for i in frames if m.frames[i].split == "train"]
        asked = merge_prompts(find_objects(moving[train], number + 1), given, train)
        number = max([number, *(a.number for a in asked)])
        for key, entries in to_points_file(asked, train).items():
            written[key] += entries
        outlined[train] = sam2_mask(network, video[train], asked, "masks: sam2")
        held_out = [i for i in frames if i not in train]
        if held_out:
            again = [a.remap_frames(train, frames) for a in asked]
            among = sam2_mask(network, video[frames], again, "masks: sam2, held-out frames")
            outlined[held_out] = among[np.searchsorted(frames, held_out)]
    if not written["points"] and not written["boxes"]:
        say("masks: nothing moves that sam2 could be asked about")
    write_json(work.folder / PROMPTS, written)
    return outlined


def network_depth(work: Work) -> tuple[np.ndarray, np.ndarray, float, float, Kind]:
    """Disparity and confidence (T, H, W) of the training frames, near and far, by Depth
    Anything; and its kind.
    """
    m = work.manifest
    clip = work.training_clip()
    network = ready(DEPTH_ANYTHING, work.config.depth_weights)
    answered, kind = network_disparity(network, clip.video)
    points = np.array(read_npy(work.folder / m.points)) if m.points else np.zeros((0, 3))
    flow = work.training_flows(work.raw_flows)
    return *anchored_depth(answered, kind, clip, points, *flow), kind
