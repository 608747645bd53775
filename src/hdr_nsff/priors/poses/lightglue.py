"""Learned keypoints and matches for structure from motion where SIFT finds too little
in common: ALIKED (Zhao et al. 2023) or DISK (Tyszkiewicz et al. 2020), matched by
LightGlue (Lindenberger et al. 2023). kornia's implementations; only this file imports
kornia.

Keypoints are pixels of the images, centers at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import track
from hdr_nsff.core.tensors import CPU
from hdr_nsff.priors.weights import find

Matcher = Literal["sift", "aliked", "disk"]
# attention blocks whose names differ between the authors' weights and kornia's network
RENAMED_BLOCKS = ("self_attn", "cross_attn")


@dataclass(frozen=True)
class LightGlueTuning:
    """How many keypoints are matched."""

    max_keypoints: int = 1024  # per image (LightGlue's evaluation: up to 2048)
    # times as many are detected, since masks remove some (hand-chosen)
    candidate_factor: int = 2


def check_matcher(matcher: Matcher) -> None:
    """InputError where kornia or the weights of `matcher` are missing."""
    if matcher != "sift":
        kornia_features()
        matcher_weights(matcher)


def matcher_weights(matcher: Matcher) -> list[Path]:
    """The weights that `matcher` reads; InputError where they cannot be found."""
    if matcher == "sift":
        return []
    return [find(matcher), find(f"{matcher}-lightglue")]


def kornia_features() -> Any:
    """The module kornia.feature; InputError where kornia is not installed."""
    try:
        import kornia.feature
    except ImportError as error:
        raise InputError(
            f"--matcher: kornia cannot be imported ({error}); "
            "`pip install 'hdr-nsff[neural]'`, or use --matcher sift"
        ) from error
    return kornia.feature


def match_images(
    images: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    pairs: Sequence[tuple[int, int]],
    matcher: Matcher,
    tuning: LightGlueTuning = LightGlueTuning(),
    device: torch.device = CPU,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Keypoints (N, 2) of every image, and matches (M, 2) of every pair, rows of both.

    `images` (H, W, 3) rgb in [0, 1]; keypoints lie where `masks` (H, W) are above 0.
    The networks run on `device`. InputError where kornia or weights are missing.
    """
    extractor, lightglue = load_networks(matcher, device, tuning)
    with torch.inference_mode():
        keypoints = [
            extract_keypoints(extractor, image, mask, device, tuning)
            for image, mask in track(list(zip(images, masks, strict=True)), f"poses: {matcher}")
        ]
        matches = [
            match_keypoints(lightglue, keypoints[a], keypoints[b])
            for a, b in track(pairs, "poses: lightglue")
        ]
    return [k["keypoints"][0].cpu().numpy() + 0.5 for k in keypoints], matches


def load_networks(
    matcher: Matcher, device: torch.device, tuning: LightGlueTuning = LightGlueTuning()
) -> tuple[Any, Any]:
    """The network that extracts keypoints, and LightGlue, with their weights."""
    kornia = kornia_features()
    if matcher == "aliked":
        num_candidates = tuning.candidate_factor * tuning.max_keypoints
        extractor = kornia.ALIKED("aliked-n16", num_candidates, detection_threshold=-1.0)
    else:
        extractor = kornia.DISK()
    lightglue = kornia.LightGlue(None, input_dim=128, flash=False)
    stored = read_state_dict(matcher)
    load_weights(extractor, stored.get("extractor", stored), matcher)
    stored_lightglue = read_state_dict(f"{matcher}-lightglue")
    renamed = {kornia_name(key): value for key, value in stored_lightglue.items()}
    load_weights(lightglue, renamed, f"{matcher}-lightglue")
    return extractor.to(device).eval(), lightglue.to(device).eval()


def kornia_name(key: str) -> str:
    """kornia's name of a weight of LightGlue, from the authors' name.

    "self_attn.3.ffn" is "transformers.3.self_attn.ffn"; other names are the same.
    """
    block, _, rest = key.partition(".")
    if block not in RENAMED_BLOCKS:
        return key
    number, _, tail = rest.partition(".")
    return f"transformers.{number}.{block}.{tail}"


def read_state_dict(name: str) -> dict[str, Any]:
    """The weights `name`; InputError where their file cannot be read."""
    path = find(name)
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch raises several unrelated types
        raise InputError(
            f"{path}: not a readable torch state dict ({type(error).__name__}); "
            f"`hdr-nsff weights {name}` shows how to get it"
        ) from error


def load_weights(module: torch.nn.Module, state: dict[str, Tensor], name: str) -> None:
    """Load weights into a network; InputError where they do not fit. Buffers that only
    training needs may be missing.
    """
    try:
        missing = module.load_state_dict(state, strict=False).missing_keys
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:150]
        raise InputError(
            f"weights {name}: do not fit their network ({reason}); "
            f"download them again (`hdr-nsff weights {name}`)"
        ) from error
    missing_parameters = set(missing) & {n for n, _ in module.named_parameters()}
    if missing_parameters:
        raise InputError(
            f"weights {name}: {min(missing_parameters)} is missing; "
            f"download them again (`hdr-nsff weights {name}`)"
        )


def extract_keypoints(
    extractor: Any,
    image: np.ndarray,
    mask: np.ndarray,
    device: torch.device,
    tuning: LightGlueTuning = LightGlueTuning(),
) -> dict[str, Tensor]:
    """The strongest keypoints of an `image` (H, W, 3) where `mask` (H, W) is above 0,
    in LightGlue's format.

    keypoints (1, N, 2) with centers at whole numbers, descriptors (1, N, 128),
    image_size (1, 2) width and height.
    """
    height, width = image.shape[:2]
    channels_first = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)
    rgb = channels_first[None].to(device)
    if type(extractor).__name__ == "DISK":
        num_candidates = tuning.candidate_factor * tuning.max_keypoints
        detected = extractor(rgb, n=num_candidates, pad_if_not_divisible=True)[0]
        scores = detected.detection_scores
    else:
        detected = extractor(rgb)[0]
        scores = detected.keypoint_scores
    x, y = detected.keypoints.round().long().cpu().numpy().T
    allowed = mask[y.clip(0, height - 1), x.clip(0, width - 1)] > 0
    allowed_scores = torch.where(torch.from_numpy(allowed).to(device), scores, -torch.inf)
    strongest_first = torch.argsort(allowed_scores, descending=True, stable=True)
    rows = strongest_first[: min(tuning.max_keypoints, int(allowed.sum()))]
    return {
        "keypoints": detected.keypoints[rows][None].float(),
        "descriptors": detected.descriptors[rows][None].float(),
        "image_size": torch.tensor([[width, height]], device=device, dtype=torch.float32),
    }


def match_keypoints(lightglue: Any, a: dict[str, Tensor], b: dict[str, Tensor]) -> np.ndarray:
    """Rows (M, 2) of the keypoints of two images that match."""
    if min(a["keypoints"].shape[1], b["keypoints"].shape[1]) < 2:
        return np.zeros((0, 2), np.int64)
    return lightglue({"image0": a, "image1": b})["matches"][0].cpu().numpy()


def upsample(frame: np.ndarray, scale: int) -> np.ndarray:
    """A frame (H, W, 3) in [0, 1], `scale` times larger."""
    if scale == 1:
        return frame
    enlarged = cv2.resize(
        frame.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC
    )
    return enlarged.clip(0, 1)
