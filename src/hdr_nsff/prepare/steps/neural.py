"""Masks and depth by networks: `prepare --mask sam2` and `--depth depth-anything`.

A clip has one or more cameras. This file also lists the weights that steps read.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_npy, write_json
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import pick_device
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
from hdr_nsff.priors.pretrained import find_model, pretrained
from hdr_nsff.priors.weights import content_hash, find

SAM2, DEPTH_ANYTHING = "Sam2VideoModel", "DepthAnythingForDepthEstimation"
PROMPTS = "masks/prompts.json"


def check_networks(config: PrepareConfig) -> None:
    """InputError where a chosen network cannot run, before anything else is done.

    Its weights are downloaded where that is allowed.
    """
    check_matcher(config.matcher)
    needs = {
        "mask_weights": ("--mask sam2", config.masks == "sam2"),
        "depth_weights": ("--depth depth-anything", config.depth == "depth-anything"),
    }
    for setting, (option, chosen) in needs.items():
        name = getattr(config, setting)
        if not chosen and name != getattr(PrepareConfig, setting):
            raise InputError(
                f"--{setting.replace('_', '-')} {name}: read by `{option}` alone; "
                "add that option, or leave this one out"
            )
    if config.masks == "sam2":
        find_model(SAM2, config.mask_weights)
    elif config.mask_points is not None:
        raise InputError(
            "--mask-points: only `--mask sam2` can be corrected by points; "
            "choose it, or paint over the files in masks/ and give them"
        )
    if config.depth == "depth-anything":
        find_model(DEPTH_ANYTHING, config.depth_weights)


def weights_of(config: PrepareConfig, step: StepName) -> list[str]:
    """Hashes of the weights that a step reads; InputError where they are missing."""
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


def load_network(config: PrepareConfig, network: str, weights: str) -> Any:
    """The network, on the device of the settings."""
    return pretrained(network, weights).to(pick_device(config.device))


def sam2_masks(work: Work, moving: np.ndarray) -> np.ndarray:
    """`moving` (T, H, W) bool outlined by SAM 2, camera by camera.

    Masks of training frames come from training frames alone; held-out ones get theirs
    from a second run over all frames. Prompts are written to `masks/prompts.json`.
    """
    frames = work.manifest.frames
    given = given_points(work)
    network = load_network(work.config, SAM2, work.config.mask_weights)
    video = work.equalized[0]
    outlined = np.zeros_like(moving)
    written: dict[str, list[Any]] = {"points": [], "boxes": []}
    num_found = 0  # in the clips of the cameras before
    for of_camera in work.camera_frames():
        train = [i for i in of_camera if frames[i].split == "train"]
        found = find_objects(moving[train], num_found + 1)
        num_found += len(found)  # not the user's: they must not number later ones anew
        prompts = merge_prompts(found, given, train)
        for key, entries in to_points_file(prompts, train).items():
            written[key] += entries
        outlined[train] = sam2_mask(network, video[train], prompts, "masks: sam2")
        held_out = [i for i in of_camera if i not in train]
        if held_out:
            remapped = [p.remap_frames(train, of_camera) for p in prompts]
            note = "masks: sam2, held-out frames"
            of_all = sam2_mask(network, video[of_camera], remapped, note)
            outlined[held_out] = of_all[np.searchsorted(of_camera, held_out)]
    if not written["points"] and not written["boxes"]:
        say("masks: nothing moves that sam2 could outline")
    write_json(work.folder / PROMPTS, written)
    return outlined


def given_points(work: Work) -> PointsFile:
    """The user's points; InputError where one is in a held-out frame."""
    m = work.manifest
    path = work.config.mask_points
    if path is None:
        return PointsFile()
    given = read_points(path, len(m.frames), (m.height, m.width))
    named = sorted({entry.frame for entry in (*given.points, *given.boxes)})
    held_out = [i for i in named if m.frames[i].split != "train"]
    if held_out:
        raise InputError(
            f"{path}: frame {held_out[0]} is held out of training; point at frames beside it"
        )
    return given


def network_depth(work: Work) -> tuple[np.ndarray, np.ndarray, float, float, Kind]:
    """Disparity and confidence (T, H, W) of the training frames by Depth Anything.

    With near and far, and the kind of the network's depth.
    """
    m = work.manifest
    clip = work.training_clip()
    network = load_network(work.config, DEPTH_ANYTHING, work.config.depth_weights)
    predicted, kind = network_disparity(network, clip.video)
    points = np.array(read_npy(work.folder / m.points)) if m.points else np.zeros((0, 3))
    flow = work.training_flows(work.raw_flows)
    return *anchored_depth(predicted, kind, clip, points, *flow), kind
