"""Moving masks: pixels whose optical flow the camera's own motion does not explain.

`rough_mask` needs no poses: it tests whether a pixel obeys the epipolar geometry, or
the homography, that most pixels obey. `geometric_mask` has poses: it tests whether one
depth explains a pixel's flow to all frames around. That also finds motion along
epipolar lines, and needs no depth for cameras that only turn.

Either way the static explanation must also match the images worse than the flow does:
without texture, flow is a guess, and a guess proves no motion. True means moving.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import say, track
from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry.round_trip import follow
from hdr_nsff.priors.masks.geometric_tuning import GEOMETRIC_MASK_TUNING, GeometricMaskTuning
from hdr_nsff.priors.masks.static_residuals import (
    ChainedFlow,
    FlowClip,
    chain_flow,
    epipolar_residual,
    homography_residual,
    is_planar,
    static_residual,
    working_clip,
)

SIGMA_PER_MAD = 1.48  # standard deviation of a Gaussian per median absolute deviation
LAPLACIAN_GAIN = 20.0  # sum of the squared entries of the 3 x 3 Laplacian

# frame, chained flow -> residuals (chains, H, W, 2) px
Residuals = Callable[[int, list[ChainedFlow]], np.ndarray]


def rough_mask(
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    video: ArrayStack,
    tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING,
) -> np.ndarray:
    """Moving pixels (T, H, W) bool from flow alone, without poses.

    They disagree with the epipolar geometry of most pixels, or with their homography
    where homographies explain the footage. `flow` (P, H, W, 2) px and `valid` (P, H, W)
    bool are of `pairs` (P, 2) (from, to); `video` (T, H, W, 3) is equalized rgb in
    [0, 1]. Nothing moves in a frame that no pair starts from.
    """
    clip = working_clip(flow, valid, pairs, video, tuning)
    residual = homography_residual if is_planar(clip, tuning) else epipolar_residual

    def residuals(frame: int, chains: list[ChainedFlow]) -> np.ndarray:
        return np.stack([residual(chained.flow, chained.valid, tuning) for chained in chains])

    return segment_motion(clip, residuals, "rough masks", tuning)


def geometric_mask(
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    video: ArrayStack,
    K: np.ndarray,
    c2w: np.ndarray,
    tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING,
    evidence: np.ndarray | None = None,
) -> np.ndarray:
    """Moving pixels (T, H, W) bool: no one depth explains their flow to all neighbors.

    The arguments are those of `rough_mask`, with `K` (3, 3) or (T, 3, 3) px and `c2w`
    (T, 3, 4) OpenCV. Other `evidence` (T, H, W) of motion, in units of its noise, is
    added to that of flow.
    """
    clip = working_clip(flow, valid, pairs, video, tuning)
    scale = np.append(clip.scale, 1)[:, None]
    small_K = np.broadcast_to(K, (len(c2w), 3, 3)) * scale

    def residuals(frame: int, chains: list[ChainedFlow]) -> np.ndarray:
        return static_residual(frame, chains, small_K, c2w, tuning)

    return segment_motion(clip, residuals, "masks", tuning, evidence)


def segment_motion(
    clip: FlowClip,
    residuals: Residuals,
    report: str,
    tuning: GeometricMaskTuning,
    evidence: np.ndarray | None = None,
) -> np.ndarray:
    """Moving pixels (T, H, W) bool from the residuals against a static scene, and from
    other `evidence` (T, H, W).
    """
    scores = np.zeros_like(clip.gray)
    for frame in track(range(len(scores)), report):
        chains = chain_flow(clip, frame, tuning)
        if chains:
            scores[frame] = motion_score(clip, frame, chains, residuals(frame, chains), tuning)
    for _ in range(tuning.votes):
        scores = temporal_median(clip, scores)
    if evidence is not None:
        small = clip.gray.shape[2], clip.gray.shape[1]
        for frame, other in enumerate(evidence):
            shrunk = cv2.resize(other, small, interpolation=cv2.INTER_AREA)
            scores[frame] = tuning.flow_share * scores[frame] + tuning.other_share * shrunk

    height, width = clip.size
    moving = np.zeros((len(scores), height, width), bool)
    for frame, score in enumerate(scores):
        objects = extract_objects(score, tuning).astype(np.uint8)
        nearest = cv2.INTER_NEAREST_EXACT
        moving[frame] = cv2.resize(objects, (width, height), interpolation=nearest) > 0
    warn_of_large_masks(moving, report, tuning)
    return moving


def warn_of_large_masks(moving: np.ndarray, report: str, tuning: GeometricMaskTuning) -> None:
    """Report the frames in which more pixels seem to move than is plausible."""
    large = np.flatnonzero(moving.mean((1, 2)) > tuning.doubtful_share)
    if len(large):
        say(
            f"{report}: in {len(large)} of {len(moving)} frames more than "
            f"{tuning.doubtful_share:.0%} of the pixels seem to move (first: frame {large[0]}); "
            "if that is wrong, give masks (--mask FOLDER) or flow (--flow FOLDER)"
        )


def motion_score(
    clip: FlowClip,
    frame: int,
    chains: list[ChainedFlow],
    residuals: np.ndarray,
    tuning: GeometricMaskTuning,
) -> np.ndarray:
    """Smoothed evidence (H, W) against a static scene, in units of the noise of flow.

    It is the root mean square of the `residuals` (chains, H, W, 2) px over valid flow.
    Where none is valid, it is the smaller one of the two neighbors: what is occluded on
    one side is visible on the other.
    """
    confidence = texture_confidence(clip.gray[frame], tuning)
    units = np.empty(residuals.shape[:3], np.float32)
    for n, chained in enumerate(chains):
        length = np.linalg.norm(residuals[n], axis=-1)
        noise = flow_noise(length, chained, confidence, clip.coarseness, tuning)
        evidence = photometric_evidence(clip, frame, chained, residuals[n], tuning)
        units[n] = np.minimum(length / noise, tuning.max_score) * evidence

    valid = np.stack([chained.valid for chained in chains])
    count = valid.sum(0)
    mean_square = np.sum(units**2 * valid, 0) / np.maximum(count, 1)
    smaller = np.min(units[[chained.count == 1 for chained in chains]], 0)
    score = np.where(count > 0, np.sqrt(mean_square), smaller)
    occlusion = np.where(count > 0, 1, tuning.occluded_confidence).astype(np.float32)
    smooth = fill_by_confidence(score, confidence * occlusion, tuning)

    # the median filter of OpenCV takes large windows for 8 bits only
    levels = np.rint(smooth * (255 / tuning.max_score)).astype(np.uint8)
    diameter = 2 * round(len(levels) / tuning.rows_per_median_px) + 1
    return cv2.medianBlur(levels, diameter).astype(np.float32) * (tuning.max_score / 255)


def flow_noise(
    length: np.ndarray,
    chained: ChainedFlow,
    confidence: np.ndarray,
    coarseness: int,
    tuning: GeometricMaskTuning,
) -> float:
    """The standard deviation (px) of chained flow, from the median of its residuals.

    `length` (H, W) px is that of the residuals, of which valid ones on texture count
    (`confidence` (H, W) in [0, 1]).
    """
    known = chained.valid & (confidence > tuning.min_texture)
    noise = tuning.max_noise_px
    if known.sum() > tuning.min_noise_pixels:
        noise = SIGMA_PER_MAD * float(np.median(length[known]))
    lowest = tuning.min_noise_px / coarseness
    highest = tuning.max_noise_px * np.sqrt(chained.count) / coarseness
    return np.clip(noise, lowest, highest)


def photometric_evidence(
    clip: FlowClip,
    frame: int,
    chained: ChainedFlow,
    residual: np.ndarray,
    tuning: GeometricMaskTuning,
) -> np.ndarray:
    """Evidence (H, W), in [0, 1], that flow matches the images better than `residual`.

    The static explanation is `flow + residual`, with `residual` (H, W, 2) px.
    """
    here = clip.gray[frame]
    other = clip.gray[chained.frame]
    window = (tuning.window_px, tuning.window_px)
    flow_difference = np.abs(follow(other, chained.flow) - here)
    static_difference = np.abs(follow(other, chained.flow + residual) - here)
    flow_error = cv2.boxFilter(flow_difference, -1, window)
    static_error = cv2.boxFilter(static_difference, -1, window)
    allowed = tuning.evidence_slope * flow_error + tuning.evidence_floor
    return np.clip((static_error - flow_error) / allowed, 0, 1)


def texture_confidence(
    gray: np.ndarray, tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING
) -> np.ndarray:
    """How well (H, W), in [0, 1], a pixel's neighborhood determines its position.

    `1 / (1 + (std / texture_px)^2)`, with std in pixels from the smaller eigenvalue of
    the structure tensor and the image's own noise (Foerstner and Guelch 1987).
    """
    window = (tuning.window_px, tuning.window_px)
    laplacian = cv2.Laplacian(gray, cv2.CV_32F, ksize=1)
    # running sums end a little below 0 where texture stops
    variance = np.maximum(cv2.boxFilter(laplacian**2, -1, window), 0) / LAPLACIAN_GAIN
    deviation = np.sqrt(variance)
    noise = np.percentile(deviation, tuning.image_noise_percentile)
    noise = np.clip(noise, tuning.min_image_noise, tuning.max_image_noise)

    x = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    y = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    xx = cv2.boxFilter(x * x, -1, window, normalize=False)
    xy = cv2.boxFilter(x * y, -1, window, normalize=False)
    yy = cv2.boxFilter(y * y, -1, window, normalize=False)
    smaller = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return 1 / (1 + (noise / tuning.texture_px) ** 2 / np.maximum(smaller, 1e-9))


def fill_by_confidence(
    values: np.ndarray, confidence: np.ndarray, tuning: GeometricMaskTuning
) -> np.ndarray:
    """`values` (H, W) averaged by `confidence` (H, W), from coarse to fine.

    Each pixel so uses the smallest neighborhood that has confidence (normalized
    convolution, Knutsson and Westin 1993).
    """
    weight = tuning.coarser_weight
    mean = float(np.sum(values * confidence) / max(float(confidence.sum()), 1e-6))
    filled = np.full_like(values, mean)
    for sigma in tuning.smoothing_sigmas_px:
        total = cv2.GaussianBlur(confidence, (0, 0), sigma)
        weighted = cv2.GaussianBlur(values * confidence, (0, 0), sigma)
        filled = (weighted + weight * filled) / (total + weight)
    return filled


def temporal_median(clip: FlowClip, scores: np.ndarray) -> np.ndarray:
    """The median (T, H, W) of each pixel's score and those before and after.

    They are read along the flow to the neighboring frames. Where only one of the two is
    linked, it is the mean.
    """
    voted = scores.copy()
    for frame in range(len(scores)):
        votes = [scores[frame]]
        for links in (clip.forward, clip.backward):
            if frame in links:
                pair, other = links[frame]
                votes.append(follow(scores[other], clip.flow[pair]))
        voted[frame] = np.median(votes, 0)
    return voted


def extract_objects(scores: np.ndarray, tuning: GeometricMaskTuning) -> np.ndarray:
    """Moving objects (H, W) bool of one frame's `scores` (H, W).

    An object is connected where motion is likely, certain in part, and not tiny. It is
    closed, its holes are filled, and it is grown by one pixel.
    """
    labels, _ = ndimage.label(scores > tuning.likely)
    min_pixels = tuning.min_object_share * scores.size
    pixels = np.bincount(labels.ravel())
    certain_pixels = np.bincount(labels.ravel(), weights=(scores > tuning.certain).ravel())
    kept = (pixels >= min_pixels) & (certain_pixels >= min_pixels * tuning.min_certain_share)
    kept[0] = False  # the background
    objects = kept[labels].astype(np.uint8)

    radius = max(1, round(len(scores) / tuning.rows_per_closing_px))
    objects = cv2.morphologyEx(objects, cv2.MORPH_CLOSE, ellipse(2 * radius + 1))
    holes, _ = ndimage.label(objects == 0)
    small_hole = np.bincount(holes.ravel()) < tuning.max_hole_share * scores.size
    objects = np.where(small_hole[holes], 1, objects).astype(np.uint8)
    return cv2.dilate(objects, ellipse(3)) > 0


def ellipse(diameter: int) -> np.ndarray:
    """A round structuring element."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (diameter, diameter))
