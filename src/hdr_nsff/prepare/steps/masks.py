"""The step `masks`: which pixels of each frame move by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import mask_gray
from hdr_nsff.footage.datasets import maps
from hdr_nsff.footage.frame_files import RECORDED, natural_key, sorted_folders
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.neural import sam2_masks
from hdr_nsff.prepare.still_cameras import still_cameras
from hdr_nsff.prepare.tracks import share_masks
from hdr_nsff.prepare.work import Work
from hdr_nsff.priors.masks.background import correct_by_background
from hdr_nsff.priors.masks.geometric import geometric_mask


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
        note=f"{moving.mean():.1%} of the pixels move",
        details={"source": "given" if given else c.masks or "motion"},
        maps={"mask": {f.index: mask for f, mask in zip(m.frames, moving, strict=True)}},
    )


def estimated_masks(work: Work) -> np.ndarray:
    """Moving masks (T, H, W) from flow and poses; also from the visits of a rig's
    cameras, or from the background, where a camera shows it at other times.
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
        moving[own] = correct_by_background(
            moving[own], video[own], groups[own], train[own], K[own], c2w[own]
        )
    return share_masks(work, moving)


def given_masks(work: Work) -> np.ndarray:
    """The moving masks (T, H, W) of a data set, or the user's, one file per frame in
    order; InputError where one is missing or of another size.
    """
    m, folder, capture = work.manifest, work.config.masks, work.capture_with("masks")
    size = (m.height, m.width)
    masks = []
    if capture is not None:
        for f in m.frames:
            path = work.picture(f).mask
            mask = np.zeros(size, bool)
            if path is not None:
                mask = maps.moving_mask(path, size, capture.white_moves)
            masks.append(mask)
        return np.stack(masks)
    assert isinstance(folder, Path)
    brightest = 0.0
    for f, path in zip(m.frames, given_files(work, folder, RECORDED), strict=True):
        gray = mask_gray(path)
        mask, brightest = gray > 0.5, max(brightest, float(gray.max()))
        if mask.shape != size:
            raise InputError(
                f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]}, "
                f"frame {f.index} is {m.width}x{m.height}; make it that size"
            )
        masks.append(mask)
    if 0 < brightest <= 0.5:
        raise InputError(
            f"{folder}: no mask is white anywhere, the brightest pixel is {255 * brightest:.3g} of "
            "255; paint moving pixels white (255)"
        )
    return np.stack(masks)


def given_files(work: Work, folder: Path, suffixes: set[str]) -> list[Path]:
    """The file for each frame in the user's folder of maps: as many files as frames, in
    order (of each camera, in a folder like the footage's).
    """
    folders = [folder]
    if len(work.footage.cameras) > 1:
        folders = sorted_folders(folder)
    found = [
        path
        for each in folders
        for path in sorted(each.iterdir(), key=natural_key)
        if path.suffix.lower() in suffixes
    ]
    count = len(work.manifest.frames)
    rows: Sequence[int] = range(count)
    if work.segment is not None:
        count, rows = work.segment.clip_frames, work.segment.rows
    if len(found) != count:
        raise InputError(
            f"{folder}: {len(found)} maps for {count} frames; one per used frame, in order"
        )
    return [found[row] for row in rows]
