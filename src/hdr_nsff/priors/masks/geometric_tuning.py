"""The tuning constants of moving masks from flow, in one record for all files of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GeometricMaskTuning:
    """Tuning constants of moving masks, hand-chosen on rendered scenes.

    Pixels (px) are those of the working grid, except where the frames' are named.
    """

    working_pixels: int = 100_000
    """Frames with more pixels are judged on a coarser grid."""
    blur_px: float = 0.7
    """Standard deviation of the blur of the gray frames, in pixels of the frames."""
    reach_frames: int = 6
    """Neighbors on each side that flow is chained to."""

    ransac_px: float = 0.5
    """Inlier threshold of epipolar geometries and homographies."""
    planar_tests: int = 12
    """Frames, about, at which both are compared."""
    planar_min_valid: float = 0.1
    """Share of valid flow that such a comparison needs."""
    planar_share: float = 0.6
    """Homographies describe the footage if their inliers exceed this share of those of
    epipolar geometries.
    """
    robust_px: float = 0.5
    """Residual at which a frame counts half for a pixel's depth (Cauchy weight)."""
    depth_iterations: int = 3
    """Reweighted least-squares solutions for a pixel's depth."""
    invalid_trust: float = 1e-3
    """Weight of invalid flow to the next frame; it decides where no flow is valid."""

    min_noise_px: float = 0.6
    """Lower bound of the noise of flow, in pixels of the frames: the best flow still
    errs by so much near edges.
    """
    max_noise_px: float = 1.0
    """Upper bound of the noise of flow over one link, in pixels of the frames."""
    min_noise_pixels: int = 50
    """Textured valid pixels that an estimate of the noise needs."""
    max_score: float = 4.0
    """Residuals are limited to this many units of noise."""

    window_px: int = 5
    """Side of the windows of photometric errors, gradients and image noise."""
    evidence_slope: float = 0.3
    """The flow is fully preferred if the static match has a photometric error larger by
    this share ...
    """
    evidence_floor: float = 0.003
    """... plus this (gray in [0, 1])."""
    texture_px: float = 0.6
    """Uncertainty of a patch's position at which its texture counts half."""
    image_noise_percentile: float = 20.0
    """Of local standard deviations, taken as the noise of the image."""
    min_image_noise: float = 0.003
    """Lower bound of the noise of the image (gray in [0, 1])."""
    max_image_noise: float = 0.012
    """Upper bound of the noise of the image (gray in [0, 1])."""
    min_texture: float = 0.5
    """Texture confidence that a pixel needs to enter the estimate of the noise."""

    smoothing_sigmas_px: tuple[float, ...] = (16.0, 8.0, 4.0, 2.0, 1.0)
    """Standard deviations of the neighborhoods that scores are averaged over, from
    coarse to fine.
    """
    coarser_weight: float = 0.1
    """Weight of the coarser average at each of them."""
    occluded_confidence: float = 0.3
    """Confidence in scores where no flow is valid, relative to others."""
    rows_per_median_px: float = 45.0
    """The median filter's radius is one pixel for this many rows."""
    votes: int = 2
    """Rounds of the median over time."""

    flow_share: float = 0.65
    """Factor on the score of flow where there is other evidence, such as the visits of
    a rig's cameras (both chosen on four rendered rigs, by the mean overlap with the
    truth; 0.5 or 0.8 lowers it by 0.01).
    """
    other_share: float = 0.36
    """Factor on that evidence."""
    likely: float = 1.25
    """Score, in units of noise, that connects the pixels of an object."""
    certain: float = 2.5
    """Score, in units of noise, that proves an object."""
    min_object_share: float = 0.0012
    """Share of the frame below which nothing counts as an object."""
    min_certain_share: float = 0.25
    """Certain pixels that an object needs, as a share of the smallest object's."""
    rows_per_closing_px: float = 68.0
    """Objects are closed with a radius of one pixel for this many rows."""
    max_hole_share: float = 0.05
    """Holes below this share of the frame, enclosed by objects or by the frame's edge,
    are filled.
    """
    doubtful_share: float = 0.6
    """Share of a frame from which on a warning says that too much seems to move."""


GEOMETRIC_MASK_TUNING = GeometricMaskTuning()
