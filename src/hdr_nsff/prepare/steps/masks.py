"""The step `masks`: which pixels of each frame move by themselves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hdr_nsff.footage.datasets import maps
from hdr_nsff.prepare.given_maps import user_masks
from hdr_nsff.prepare.lens import undistorted
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.neural import sam2_masks
from hdr_nsff.prepare.still_cameras import still_cameras
from hdr_nsff.prepare.tracks import share_masks
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.masks.background import correct_by_background
from hdr_nsff.priors.masks.geometric import GeometricMaskTuning, geometric_mask
from hdr_nsff.priors.masks.unsteady import mark_unsteady


def find_masks(work: Work) -> StepResult:
    """Moving masks, given or estimated.

    Masks of training frames come from flow among training frames alone, those of
    held-out frames from all flow.
    """
    m, c = work.manifest, work.config
    given = isinstance(c.masks, Path) or work.capture_with("masks") is not None
    if given:
        moving = given_masks(work)
    else:
        moving = estimated_masks(work)
        if c.masks == "sam2":
            moving = sam2_masks(work, moving)
    return StepResult(
        provenance="given" if given else "estimated",
        note=moving_share(moving, c.tripod),
        details={"source": "given" if given else c.masks or "motion"},
        maps={"mask": {f.index: mask for f, mask in zip(m.frames, moving, strict=True)}},
    )


def moving_share(moving: np.ndarray, tripod: bool) -> str:
    """How much of the frames is marked in `moving` (T, H, W), and whether that goes
    with a camera that is said to stand on a `tripod`.
    """
    note = f"{moving.mean():.1%} of the pixels move"
    if tripod and moving.mean() > GeometricMaskTuning().doubtful_share:
        note += ", as if the camera did: leave out --tripod if it does not stand still"
    return note


def estimated_masks(work: Work) -> np.ndarray:
    """Moving masks (T, H, W) from flow and poses; also from the visits of a rig's
    cameras, from the background, where a camera shows it at other times, or from what a
    camera without parallax never shows again.
    """
    evidence = work.visits.distance if work.manifest.rig > 1 else None
    found, valid, pairs = work.raw_flows
    video, (K, c2w) = work.equalized[0], work.cameras()
    train = np.array([f.split == "train" for f in work.manifest.frames])
    among = train[pairs].all(1)
    moving = geometric_mask(
        found[among], valid[among], pairs[among], video, K, c2w, evidence=evidence
    )
    if not train.all():
        by_all = geometric_mask(found, valid, pairs, video, K, c2w, evidence=evidence)
        moving[~train] = by_all[~train]
    in_turn = work.manifest.rig > 1  # what their visits show is in the masks already
    shows_background = not in_turn and still_cameras(work) is not None
    if work.manifest.parallax == "full" and not shows_background:
        return share_masks(work, moving)
    frames = work.manifest.frames
    recorded_alike = np.unique(
        [(f.camera_id, f.bracket) for f in frames], axis=0, return_inverse=True
    )
    groups = recorded_alike[1].ravel()
    for own in work.camera_frames():  # frames of two cameras are no neighbors
        clip = video[own], groups[own], train[own], K[own], c2w[own]
        moving[own] = mark_unsteady(moving[own], *clip)
        moving[own] = correct_by_background(moving[own], *clip)
    return share_masks(work, moving)


def given_masks(work: Work) -> np.ndarray:
    """The moving masks (T, H, W) of a data set, or the user's, one file per frame in
    order; InputError where one is missing or of another size.
    """
    m, folder, capture = work.manifest, work.config.masks, work.capture_with("masks")
    if capture is None:
        assert isinstance(folder, Path)
        return user_masks(work, folder)
    size = (m.height, m.width)
    masks = []
    for f in m.frames:
        path = work.picture(f).mask
        mask = np.zeros(size, bool)
        if path is not None:
            mask = maps.moving_mask(path, size, capture.white_moves)
        masks.append(undistorted(work, mask, f.camera_id))
    return np.stack(masks)
