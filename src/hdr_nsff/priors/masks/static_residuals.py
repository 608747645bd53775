"""Residuals of optical flow against a static scene.

Without poses, a static scene obeys an epipolar geometry or a homography; with poses,
one depth per pixel explains its flow to all frames. Flow between neighbors is chained
over a few frames, so that slow motion rises above the noise of flow.

A residual leads from the end of a pixel's flow to the position where a static scene
would put it, in pixels of the working grid, x then y; pixel centers are at +0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hdr_nsff.core.stack import ArrayStack
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.round_trip import follow
from hdr_nsff.priors.masks.geometric_tuning import GEOMETRIC_MASK_TUNING, GeometricMaskTuning
from hdr_nsff.priors.poses.rotation import epipolar, homography
from hdr_nsff.radiometry.common_range import LUMA

TINY = float(np.finfo(np.float32).tiny)  # a divisor that is 0: whatever the unit of length
SAMPLING = 4  # pixels: matches are taken on every fourth column of every fourth row
Links = dict[int, tuple[int, int]]  # frame -> (pair, other frame)


@dataclass(frozen=True)
class ChainedFlow:
    """Flow from one frame to another, chained over the frames between."""

    frame: int
    """The other frame."""
    count: int
    """Links from here to there."""
    flow: np.ndarray
    """(H, W, 2) px."""
    valid: np.ndarray
    """(H, W) bool."""


@dataclass(frozen=True)
class FlowClip:
    """A clip on the working grid, with the flow that links its frames."""

    gray: np.ndarray
    """(T, H, W) float32, equalized, in [0, 1]."""
    flow: np.ndarray
    """(P, H, W, 2) px of the working grid."""
    valid: np.ndarray
    """(P, H, W) bool."""
    forward: Links
    """To the nearest later frame."""
    backward: Links
    """To the nearest earlier frame."""
    coarseness: int
    """Pixels of the frames per pixel of the working grid, in x and in y; a little less
    where the grid's size was rounded up.
    """
    size: tuple[int, int]
    """Height and width of the frames."""

    @property
    def scale(self) -> np.ndarray:
        """Pixels of the working grid per pixel of the frames, (2,) float64: x, y."""
        height, width = self.gray.shape[1:]
        return np.array([width / self.size[1], height / self.size[0]])


def working_clip(
    flow: ArrayStack,
    valid: ArrayStack,
    pairs: np.ndarray,
    video: ArrayStack,
    tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING,
) -> FlowClip:
    """The clip on a grid of at most `working_pixels`, with each frame's shortest links.

    The arguments are those of `rough_mask`.
    """
    forward: Links = {}
    backward: Links = {}
    for p, (i, j) in enumerate(np.asarray(pairs, int).reshape(-1, 2).tolist()):
        links = backward if j < i else forward
        if i not in links or abs(j - i) < abs(links[i][1] - i):
            links[i] = (p, j)

    height, width = video.shape[1:3]
    coarseness = int(np.ceil(np.sqrt(height * width / tuning.working_pixels)))
    small_height, small_width = -(-height // coarseness), -(-width // coarseness)

    def shrink(image: np.ndarray) -> np.ndarray:
        image = image.astype(np.float32)
        if coarseness == 1:
            return image
        return cv2.resize(image, (small_width, small_height), interpolation=cv2.INTER_AREA)

    gray = [shrink(cv2.GaussianBlur(frame @ LUMA, (0, 0), tuning.blur_px)) for frame in video]
    step = np.array([width / small_width, height / small_height], np.float32)
    small_flow = np.array([shrink(f) / step for f in flow], np.float32)
    small_valid = np.array([shrink(v) > 0.5 for v in valid], bool)
    return FlowClip(
        gray=np.stack(gray),
        flow=small_flow.reshape(-1, small_height, small_width, 2),
        valid=small_valid.reshape(-1, small_height, small_width),
        forward=forward,
        backward=backward,
        coarseness=coarseness,
        size=(height, width),
    )


def chain_flow(
    clip: FlowClip, frame: int, tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING
) -> list[ChainedFlow]:
    """The flow from `frame` to all frames within `reach_frames` links.

    Later frames come first, then earlier ones, the nearest of each first.
    """
    shape = clip.gray.shape[1:]
    chains = []
    for links in (clip.forward, clip.backward):
        current = frame
        flow = np.zeros((*shape, 2), np.float32)
        valid = np.ones(shape, bool)
        for count in range(1, tuning.reach_frames + 1):
            if current not in links:
                break
            pair, current = links[current]
            link_valid = follow(clip.valid[pair].astype(np.float32), flow, fill=0.0) > 0.99
            valid = valid & link_valid
            flow = flow + follow(clip.flow[pair], flow)
            chains.append(ChainedFlow(current, count, flow, valid))
    return chains


def sample_matches(flow: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matches (M, 2), (M, 2) on a sparse grid of pixels, where flow is valid (H, W)."""
    starts = pinhole.pixel_centers(*valid.shape)
    chosen = np.zeros(valid.shape, bool)
    grid = np.s_[SAMPLING // 2 :: SAMPLING, SAMPLING // 2 :: SAMPLING]
    chosen[grid] = valid[grid]
    return starts[chosen], (starts + flow)[chosen]


def is_planar(clip: FlowClip, tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING) -> bool:
    """Whether homographies explain most of what epipolar geometries explain.

    Then the camera only turns, or the scene is a plane. Flow over several frames is
    compared, at a few frames of the clip.
    """
    planar_inliers = 0
    epipolar_inliers = 0
    step = max(1, len(clip.gray) // tuning.planar_tests)
    for frame in range(0, len(clip.gray), step):
        chains = [
            chained
            for chained in chain_flow(clip, frame, tuning)
            if chained.valid.mean() > tuning.planar_min_valid
        ]
        if chains:
            p, q = sample_matches(chains[-1].flow, chains[-1].valid)
            epipolar_inliers += int(epipolar(p, q, tuning.ransac_px)[1].sum())
            planar_inliers += int(homography(p, q, tuning.ransac_px)[1].sum())
    return planar_inliers > tuning.planar_share * epipolar_inliers


def epipolar_residual(
    flow: np.ndarray, valid: np.ndarray, tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING
) -> np.ndarray:
    """Residuals (H, W, 2) px to the epipolar lines that most valid flow implies.

    A residual ends at the nearest point of the line; it is 0 where no epipolar geometry
    is found. `flow` is (H, W, 2) px, `valid` (H, W) bool.
    """
    matrix, _ = epipolar(*sample_matches(flow, valid), tuning.ransac_px)
    if matrix is None or matrix.shape != (3, 3):
        return np.zeros(flow.shape, np.float32)
    starts = pinhole.pixel_centers(*valid.shape)
    lines = starts @ matrix[:, :2].T + matrix[:, 2]  # (H, W, 3) in the other frame
    normals = lines[..., :2]
    offsets = np.sum((starts + flow) * normals, -1) + lines[..., 2]
    squared_norms = np.maximum(np.sum(normals**2, -1), 1e-20)
    return (-offsets[..., None] * normals / squared_norms[..., None]).astype(np.float32)


def homography_residual(
    flow: np.ndarray, valid: np.ndarray, tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING
) -> np.ndarray:
    """Residuals (H, W, 2) px to the homography that most valid flow obeys.

    They are 0 where no homography is found. `flow` is (H, W, 2) px, `valid` (H, W).
    """
    matrix, _ = homography(*sample_matches(flow, valid), tuning.ransac_px)
    if matrix is None:
        return np.zeros(flow.shape, np.float32)
    starts = pinhole.pixel_centers(*valid.shape)
    ends = cv2.perspectiveTransform(starts.reshape(-1, 1, 2), matrix).reshape(starts.shape)
    return (ends - starts - flow).astype(np.float32)


def static_residual(
    frame: int,
    chains: list[ChainedFlow],
    K: np.ndarray,
    c2w: np.ndarray,
    tuning: GeometricMaskTuning = GEOMETRIC_MASK_TUNING,
) -> np.ndarray:
    """Residuals (chains, H, W, 2) px to static points at each pixel's best depth.

    A pixel at disparity `rho >= 0` falls on the homogeneous `rotated + rho * shift` of
    another frame (`pinhole.transfer`); that this is the flow's end is linear in rho.
    Rho is solved from all frames at once, robustly (Cauchy weights). Invalid flow
    counts over one link only, and only where nothing is valid. `K` is (T, 3, 3) px of
    the working grid, `c2w` (T, 3, 4) OpenCV.
    """
    starts = pinhole.pixel_centers(*chains[0].valid.shape)
    homogeneous = pinhole.homogeneous(starts)  # (H, W, 3)
    slopes = []  # residual = slope * rho + offset
    offsets = []
    trusts = []
    for chained in chains:
        other = chained.frame
        rotation, shift = pinhole.transfer(K[frame], c2w[frame], K[other], c2w[other])
        rotated = homogeneous @ rotation.T
        end = starts + chained.flow
        slopes.append((shift[:2] - end * shift[2]).astype(np.float32))
        offsets.append((rotated[..., :2] - end * rotated[..., 2:]).astype(np.float32))
        invalid_trust = tuning.invalid_trust if chained.count == 1 else 0.0
        trusts.append(np.where(chained.valid, 1.0, invalid_trust).astype(np.float32))
    slope = np.stack(slopes)  # (chains, H, W, 2)
    offset = np.stack(offsets)
    trust = np.stack(trusts)  # (chains, H, W)

    product = np.sum(slope * offset, -1)
    square = np.sum(slope**2, -1)
    weight = trust
    for _ in range(tuning.depth_iterations):
        rho = -np.sum(weight * product, 0) / (np.sum(weight * square, 0) + TINY)
        rho = np.maximum(rho, 0)
        residual = slope * rho[..., None] + offset
        weight = trust / (1 + np.sum(residual**2, -1) / tuning.robust_px**2)
    return residual
