"""Learned keypoints and matches: ALIKED (Zhao et al. 2023) or DISK (Tyszkiewicz et al.
2020), matched by LightGlue (Lindenberger et al. 2023), for structure from motion where
SIFT finds too little in common. kornia's implementations; this is its only door.

Keypoints are pixels of the pictures, centers at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import track
from hdr_nsff.priors.weights import find

Matcher = Literal["sift", "aliked", "disk"]
LIMIT = 1024  # keypoints of a picture
SPARE = 2  # times as many are looked for, since some lie where they must not


def check_matcher(matcher: Matcher) -> None:
    """InputError where kornia or the weights of `matcher` are missing."""
    if matcher != "sift":
        features()
        matcher_weights(matcher)


def matcher_weights(matcher: Matcher) -> list[Path]:
    """The weights that `matcher` reads; InputError where they are not to be had."""
    return [] if matcher == "sift" else [find(matcher), find(f"{matcher}-lightglue")]


def features() -> Any:
    """kornia.feature; InputError where kornia is not installed."""
    try:
        import kornia.feature
    except ImportError as error:
        raise InputError(
            f"--matcher: kornia cannot be imported ({error}); `pip install 'hdr-nsff[neural]'`, or use --matcher sift"
        ) from error
    return kornia.feature


def match_pictures(
    pictures: Sequence[np.ndarray],
    usable: Sequence[np.ndarray],
    pairs: Sequence[tuple[int, int]],
    matcher: Matcher,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Keypoints of every picture, (N, 2) pixels, and of every pair which of them match,
    (M, 2) rows of the two.

    `pictures` (H, W, 3) rgb in [0, 1]; `usable` (H, W): keypoints lie where it is above
    0.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    extractor, glue = network(matcher, device)
    with torch.inference_mode():
        found = [
            describe(extractor, p, u, device)
            for p, u in track(list(zip(pictures, usable, strict=True)), f"poses: {matcher}")
        ]
        matches = [match(glue, found[a], found[b]) for a, b in track(pairs, "poses: lightglue")]
    return [f["keypoints"][0].cpu().numpy() + 0.5 for f in found], matches


def network(matcher: Matcher, device: torch.device) -> tuple[Any, Any]:
    """The network that finds keypoints, and the one that matches them, with their
    weights.
    """
    kf = features()
    extractor = (
        kf.ALIKED("aliked-n16", SPARE * LIMIT, detection_threshold=-1.0)
        if matcher == "aliked"
        else kf.DISK()
    )
    glue = kf.LightGlue(None, input_dim=128, flash=False)
    own = read(matcher)
    fill(extractor, own.get("extractor", own), matcher)
    renamed = {}
    for key, value in read(f"{matcher}-lightglue").items():  # the authors' first names -> today's
        kind, _, rest = key.partition(".")
        number, _, tail = rest.partition(".")
        renamed[
            f"transformers.{number}.{kind}.{tail}" if kind in ("self_attn", "cross_attn") else key
        ] = value
    fill(glue, renamed, f"{matcher}-lightglue")
    return extractor.to(device).eval(), glue.to(device).eval()


def read(name: str) -> dict[str, Any]:
    """The weights `name`; InputError where their file cannot be read."""
    path = find(name)
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises several unrelated types
        raise InputError(
            f"{path}: not a readable torch state dict ({type(error).__name__}); `hdr-nsff weights {name}` says how to get it"
        ) from error


def fill(module: torch.nn.Module, state: dict[str, Tensor], name: str) -> None:
    """Put weights into a network; InputError where they do not fit. What only training
    needs may be left over.
    """
    try:
        lacking = set(module.load_state_dict(state, strict=False).missing_keys) & {
            n for n, _ in module.named_parameters()
        }
    except RuntimeError as error:
        raise InputError(
            f"weights {name}: do not fit its network ({' '.join(str(error).split())[:150]}); get them anew"
        ) from error
    if lacking:
        raise InputError(
            f"weights {name}: {min(lacking)} is missing; get them anew (`hdr-nsff weights {name}`)"
        )


def describe(
    extractor: Any, picture: np.ndarray, usable: np.ndarray, device: torch.device
) -> dict[str, Tensor]:
    """The `LIMIT` strongest usable keypoints of a picture as LightGlue takes them:
    keypoints (1, N, 2) with centers at whole numbers, descriptors (1, N, 128),
    image_size (1, 2) width and height.
    """
    rgb = (
        torch.from_numpy(np.ascontiguousarray(picture, np.float32))
        .permute(2, 0, 1)[None]
        .to(device)
    )
    if type(extractor).__name__ == "DISK":
        seen = extractor(rgb, n=SPARE * LIMIT, pad_if_not_divisible=True)[0]
        scores = seen.detection_scores
    else:
        seen = extractor(rgb)[0]
        scores = seen.keypoint_scores
    at = seen.keypoints.round().long().cpu().numpy()
    allowed = (
        usable[at[:, 1].clip(0, usable.shape[0] - 1), at[:, 0].clip(0, usable.shape[1] - 1)] > 0
    )
    rows = torch.argsort(
        torch.where(torch.from_numpy(allowed).to(device), scores, -torch.inf),
        descending=True,
        stable=True,
    )
    rows = rows[: min(LIMIT, int(allowed.sum()))]
    size = torch.tensor([[picture.shape[1], picture.shape[0]]], device=device, dtype=torch.float32)
    return {
        "keypoints": seen.keypoints[rows][None].float(),
        "descriptors": seen.descriptors[rows][None].float(),
        "image_size": size,
    }


def match(glue: Any, a: dict[str, Tensor], b: dict[str, Tensor]) -> np.ndarray:
    """Rows (M, 2) of the keypoints of two pictures that match."""
    if min(a["keypoints"].shape[1], b["keypoints"].shape[1]) < 2:
        return np.zeros((0, 2), np.int64)
    return glue({"image0": a, "image1": b})["matches"][0].cpu().numpy()


def enlarged(frame: np.ndarray, scale: int) -> np.ndarray:
    """A frame (H, W, 3) in [0, 1], `scale` times larger."""
    return (
        frame
        if scale == 1
        else cv2.resize(
            frame.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC
        ).clip(0, 1)
    )
