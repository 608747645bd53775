"""The tuning constants of movers: one record per task, and all of them together.

Every value is hand-chosen on rendered scenes, except where another origin is named.
"Pixels" (px) are those of the frames; a share is in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TrackTuning:
    """Tuning constants of tracks along flow, hand-chosen on rendered scenes."""

    stride_px: int = 3
    """Least distance of the pixels at which tracks start, in x and in y."""
    max_starts: int = 30_000
    """Larger movers have sparser tracks: time and memory go with their number. No clip
    that the others were chosen on has as many.
    """
    start_frames: int = 12
    """Frames, spread over the clip, in which tracks start."""
    min_region_share: float = 1e-3
    """Share of the frame below which a moving region needs no track."""
    further_rounds: int = 4
    """Rounds of starting tracks in regions that no track reaches."""
    smoothing_radius_px: int = 2
    """Flow is averaged over the square of this radius before it is followed."""
    max_flow_difference_px: float = 2.0
    """Flow that differs more from a pixel's belongs to another object. A track ends
    where interpolation changes its flow by half of this.
    """
    min_frames: int = 3
    """Frames in which a track must be visible."""
    min_trust: float = 0.02
    """Added to the trust in depth, so that no visible point has a weight of zero."""


TRACK_TUNING = TrackTuning()


@dataclass(frozen=True)
class RigidityTuning:
    """Tuning constants of the test whether a mover is rigid."""

    max_residual_ratio: float = 1.33
    """Residual of a rigid mover's flow relative to that of the static scene. Chosen on
    real clips and the demo: rendered boxes have 0.6 to 1.3 (2.4 before cameras that
    jump), people 1.6 to 6.5, their raised arms alone 1.1 to 1.5. An arm of 1.36 that
    counts as rigid costs 0.6 dB on moving pixels, a car of 1.31 that does not 0.1 dB.
    """
    max_shape_error: float = 0.25
    """Median distance of a rigid mover's tracks from its shape, in their standard
    deviations: rendered boxes have 0.06 to 0.15, pieces of a hammer 0.2, people and
    hands mostly 0.26 to 0.8, a talking face 0.45. Where the static scene shakes, flow
    alone would call the face rigid."""
    min_uncertainty_px: float = 0.1
    """Flow is never taken to be surer than this, exact flow of a rendered scene
    neither."""
    touching_px: float = 6.0
    """Distance of the nearest tracks of two movers that touch; more where tracks are
    sparse."""
    min_touching_share: float = 0.8
    """Of the times at which a mover is seen: a part of another one touches it in more.
    A wrist touches the hand in all of them, rendered bodies that pass each other do in
    half of them."""


RIGIDITY_TUNING = RigidityTuning()


@dataclass(frozen=True)
class SynchronizedTuning:
    """Tuning constants of the depth that synchronized cameras see at one instant,
    hand-chosen on a rendered rig; half or twice was not measured.
    """

    min_confidence: float = 0.4
    """Of the fused depth of a pixel, in [0, 1]: two cameras that agree have 0.6."""
    min_known_share: float = 0.1
    """Of a region's pixels that are seen twice, for which the others follow them."""
    known_confidence: float = 0.98
    """Of a pixel that is seen twice: its depth is measured, and the mover's distance
    rests on it (on a rendered rig it is off by 1 %, by the path alone by 12 %).
    """
    region_confidence: float = 0.1
    """Of a pixel that follows its region."""


SYNCHRONIZED_TUNING = SynchronizedTuning()


@dataclass(frozen=True)
class RigidGroupsTuning:
    """Tuning constants of groups and their motion, hand-chosen on rendered scenes."""

    link_spacings: float = 2.0
    """Tracks that come this near each other are neighbors, in distances of their
    starts.
    """
    parting_px: float = 1.0
    """Fastest change of distance per frame at which the affinity of two neighbors falls
    by a factor of e.
    """
    parts: int = 10
    """Parts that the graph of neighbors is cut into, before they are merged."""
    min_piece_share: float = 0.01
    """Share of all tracks from which pieces of a part are parts of their own, where no
    chain of neighbors connects them.
    """
    min_tracks_per_part: int = 3
    """Fewer tracks than this times `parts` remain one part."""
    cut_iterations: int = 1000
    """Of the eigensolver; a connected graph takes about ten."""
    max_sampled_tracks: int = 1000
    """Tracks that merging is decided from."""
    max_residual_ratio: float = 1.3
    """A common motion may have this many times the residual of a group's own ..."""
    depth_error_share: float = 0.1
    """... plus this share of the group's size, which wrong depth may cause."""
    min_group_share: float = 0.04
    """Share of all tracks below which a group is dropped."""

    min_tracks: int = 3
    """Tracks that a step of motion, and the position of a group in a frame, need."""
    min_known_share: float = 0.7
    """Share of a track's visible frames in which a motion must be known to be compared
    with it.
    """
    min_shared_frames: int = 3
    """Frames in which both groups must be visible to be compared there."""
    max_gap_frames: int = 6
    """Frames for which an object may be out of sight."""
    max_gap_sizes: float = 3.0
    """Distance over such a gap, in sizes of the group."""
    min_separate_frames: int = 2
    """Frames in different patches from which on two groups are separate ..."""
    min_separate_share: float = 0.3
    """... if they are more than this share of the frames they are both visible in."""

    min_rotation_points: int = 6
    """Points below which no rotation is fitted; a rotation needs 3 exact ones."""
    min_unlinked_points: int = 6
    """Points whose median continues a path where no track links two times."""
    robust_rounds: int = 5
    """Reweighted fits of a rigid motion."""
    refit_rounds: int = 4
    """Rounds that fit poses to canonical points, and canonical points to poses."""


RIGID_GROUPS_TUNING = RigidGroupsTuning()


@dataclass(frozen=True)
class BundleTuning:
    """Tuning constants of bundle adjustment, hand-chosen on rendered scenes.

    Shares of depth and distance are of the mover's mean z-depth.
    """

    iterations: int = 25
    """Levenberg-Marquardt iterations of a solution."""
    initial_damping: float = 1e-3
    """Share that is first added to the diagonal of the normal equations."""
    damping_decrease: float = 4.0
    """Factor by which damping falls after a step that lowers the cost."""
    damping_increase: float = 8.0
    """Factor by which damping grows after a step that does not."""
    max_damping: float = 1e6
    """Damping at which a solution has converged."""
    max_tracks: int = 200
    """Tracks that poses are estimated from."""
    max_gap_times: int = 12
    """Times without a track, over which a motion is still smooth; longer gaps are left
    out, since a solution costs the cube of its times.
    """
    min_tracks: int = 3
    """Tracks that a shape, the depth of a time, and the link of two times need."""
    flow_noise_px: float = 0.4
    """Standard deviation of one step of a track; errors of neighbors are correlated."""
    min_depth_share: float = 1e-3
    """Points nearer than this share of the prior's depth project from there."""
    min_distance_share: float = 0.05
    """Lower bound of a mover's distance, as a share of the prior's depth."""

    depth_sigma: float = 0.25
    """Standard deviation of the prior's mean z-depth, as a share of it, where the depth
    is trusted little: one observation for all times that tracks link.
    """
    trusted_depth_sigma: float = 0.01
    """The same where the depth is trusted fully."""
    short_path_depth_sigma: float = 0.02
    """Upper bound of the same, per time, for a path too short to determine depth."""
    untrusted_confidence: float = 0.52
    """Trust up to which depth counts as trusted little; geometric depth of movers
    claims 0.5.
    """

    path_sigma: float = 0.001
    """Lower bound of the standard deviation of the path's third differences, as a share
    of z-depth, in each direction.
    """
    initial_path_sigma: float = 0.01
    """The same before any path is known, in all directions."""
    min_path_rows: int = 6
    """Third differences that a path needs to determine its smoothness and distance."""
    smoothness_rounds: int = 4
    """Rounds of estimating the path's smoothness and solving again."""
    rotation_sigma_rad: float = float(np.radians(2.0))
    """Standard deviation of second differences of the rotation."""
    shape_sigma: float = 2.0
    """Standard deviation of a point's distance from the middle, in mover sizes."""

    reversal_rounds: int = 4
    """Rounds of searching for reversed depth."""
    reversal_splits: int = 12
    """Times, about, at which a reversal may end."""
    min_reversal_frames: int = 3
    """Distance of those times, at least."""
    reversal_iterations: int = 8
    """Iterations after which a reversed candidate is judged."""
    max_reversal_cost_ratio: float = 0.98
    """Cost, relative to the cost before, that a reversal must reach."""

    def sigma_of_depth(self, trust: float) -> float:
        """The relative standard deviation of mean z-depth, for a trust in [0, 1]."""
        share = np.clip((trust - self.untrusted_confidence) / (1 - self.untrusted_confidence), 0, 1)
        return float(self.depth_sigma + share * (self.trusted_depth_sigma - self.depth_sigma))

    def trust_in_depth(self, sigma: np.ndarray) -> np.ndarray:
        """The trust of depth that has these relative standard deviations."""
        share = (self.depth_sigma - sigma) / (self.depth_sigma - self.trusted_depth_sigma)
        return self.untrusted_confidence + (1 - self.untrusted_confidence) * np.clip(share, 0, 1)


BUNDLE_TUNING = BundleTuning()


@dataclass(frozen=True)
class MotionSegmentationTuning:
    """Tuning constants of motion segmentation, hand-chosen on rendered scenes.

    Errors are reprojection errors in standard deviations of a track's noise.
    """

    min_shape_tracks: int = 60
    """Tracks that a group needs for a shape."""
    min_shape_times: int = 4
    """Times that a group needs for a shape: fewer have no third differences."""
    max_error: float = 1.5
    """Error above which a shape, or a track's motion, is rejected."""
    equal_error: float = 0.25
    """Motions whose errors differ by less explain a track equally well."""
    rounds: int = 3
    """Rounds of merging groups, assigning tracks and fitting the changed groups."""
    min_known_share: float = 0.7
    """Share of a track's visible frames in which a motion must be known."""
    point_iterations: int = 6
    """Iterations that place a track's point for given poses."""
    min_piece_share: float = 0.5
    """Smallest piece of an object that was hidden, relative to `min_group_share`."""
    min_visible_share: float = 0.1
    """A group is visible where more than this share of its peak number of tracks is."""
    max_return_radii: float = 4.0
    """Distance in the image at which an object may return, in its radii."""
    max_changed_share: float = 0.01
    """Groups of which a smaller share of tracks changed are not fitted again."""
    min_shared_members: float = 0.7
    """Share, of the members of two groups, that both have where the adjustment of one
    goes on from that of the other.
    """
    min_shared_times: float = 0.95
    """Share of a group's visible times at which the other's motion is known, then."""


MOTION_SEGMENTATION_TUNING = MotionSegmentationTuning()


@dataclass(frozen=True)
class MoverDistanceTuning:
    """Tuning constants of the distance of movers, hand-chosen on rendered scenes."""

    min_region_share: float = 1e-3
    """Share of the frame below which a moving region is no object."""
    min_motion_difference_px: float = 1.0
    """Difference of motion per step at which two parts of a region are two objects."""
    min_landing_share: float = 1 / 3
    """Share of a region that must land on another one to be linked to it."""
    core_share: float = 0.5
    """The core of a region is deeper inside than this share of its greatest depth."""
    min_valid_share: float = 0.4
    """Share of a region's core whose flow must be valid for its motion to count."""
    max_growth: float = 1.25
    """Ratio of areas over one step of unknown motion that one object may have."""

    surface_percentile: float = 95.0
    """Percentile of the static disparity behind a region: its nearest surface."""
    disparity_ratio: float = 1.1
    """An object's expected disparity, relative to that surface."""
    prior_sigma: float = 0.25
    """Standard deviation of the logarithm of that ratio."""
    change_sigma: float = 0.1
    """Standard deviation of each polynomial coefficient of z-depth over time but the
    constant one, as a share of z-depth.
    """
    max_disparity_ratio: float = 8.0
    """Upper bound of an object's disparity, relative to the surface behind it."""

    min_scale_points: int = 30
    """Pixels of flow that determine a region's growth in the picture."""
    max_scale_points: int = 400
    """Pixels of flow that are used for it."""
    size_sigma: float = 0.02
    """Relative standard deviation of a mover's size over the clip, which counts as one
    observation in all.
    """
    size_rounds: int = 3
    """Solutions of a path: the mean z-depth of one scales the sizes of the next."""

    max_drift_degree: int = 3
    """Degree of the polynomial that ties integrated flow to the region's centroid."""
    frames_per_drift_degree: int = 4
    """Frames of known motion for each degree of it."""
    max_depth_degree: int = 4
    """Degree of the polynomial of z-depth over time."""
    rows_per_depth_degree: int = 7
    """Third differences, or pairs of frames, for each degree of it."""
    min_path_rows: int = 6
    """Third differences of a path that may determine depth."""
    huber_rounds: int = 10
    """Reweighted solutions of a path."""
    huber_medians: float = 1.5
    """Threshold of the Huber weights, in medians of the residuals."""
    signal_to_noise: float = 2.0
    """A path counts in full only if the mean square of its third differences exceeds
    this many times the noise left; it counts nothing below that.
    """

    max_confidence: float = 0.5
    """Confidence of an object whose distance is known to `full_confidence_sigma`."""
    full_confidence_sigma: float = 0.05
    """Relative standard deviation of distance up to which confidence is largest."""
    min_confidence: float = 0.1
    """Confidence of an object whose distance is known from the prior alone."""


MOVER_DISTANCE_TUNING = MoverDistanceTuning()


@dataclass(frozen=True)
class PixelDistanceTuning:
    """Tuning constants of the distance of single moving pixels, hand-chosen on rendered
    rigs. Half or twice of noise and window changes the error by less than a tenth.
    """

    reach_frames: int = 3
    """Neighbors on each side that flow is chained to."""
    min_valid: float = 0.99
    """Of the four pixels around a point of a chain, the share that must be valid."""
    noise_px: float = 0.25
    """Standard deviation of flow over one link; more where residuals show it."""
    velocity_sigma_px: float = 20.0
    """Standard deviation of velocity, pixels a frame at the pixel's distance."""
    acceleration_sigma_px: float = 3.0
    """The same of acceleration, pixels a frame^2."""
    jerk_sigma_px: float = 1.0
    """The same of jerk, pixels a frame^3: without it, a fast mover's own motion passes
    for parallax.
    """
    robust_rounds: int = 4
    """Reweighted solutions of a pixel."""
    robust_sigmas: float = 4.0
    """Residual, in its sigmas, at which an end of flow counts half (Cauchy weight)."""
    min_stride_px: int = 2
    """Distance of the pixels that are solved, in x and in y, at least ..."""
    max_pixels: int = 10_000
    """... and more where this many would not do for a frame."""
    window_px: float = 4.0
    """Standard deviation of the Gaussian over which they are averaged."""
    wide_window_px: float = 12.0
    """The same of the surroundings, whose distance a pixel has where it shows none."""
    relief_sigma: float = 0.05
    """Relative standard deviation of a pixel's distance from that: more tears apart
    what one camera shows too little of.
    """
    independent_pixels: float = 2.0
    """Pixels within it whose flow errs independently."""
    prior_sigma: float = 0.2
    """Relative standard deviation of the distance that is refined."""
    max_median_sigma: float = 0.1
    """Relative standard deviation of distance that half of a mover's pixels must reach:
    cloth before a rendered rig has 0.04 to 0.07, things too fast for flow 0.15 to 0.2.
    """
    min_common_sigma: float = 0.05
    """Relative standard deviation of the distance of all pixels of a frame, at least:
    they err alike.
    """
    max_change: float = 0.7
    """Relative change of disparity, at most."""
    confidence: float = 0.6
    """Of the pixels of such a mover: more than that of a track's shape. What is
    believed more stays as it is.
    """


PIXEL_DISTANCE_TUNING = PixelDistanceTuning()


@dataclass(frozen=True)
class MoversTuning:
    """All tuning constants of movers. `dataclasses.replace` changes a record."""

    tracks: TrackTuning = TRACK_TUNING
    groups: RigidGroupsTuning = RIGID_GROUPS_TUNING
    bundle: BundleTuning = BUNDLE_TUNING
    segmentation: MotionSegmentationTuning = MOTION_SEGMENTATION_TUNING
    distance: MoverDistanceTuning = MOVER_DISTANCE_TUNING
    pixels: PixelDistanceTuning = PIXEL_DISTANCE_TUNING
    rigidity: RigidityTuning = RIGIDITY_TUNING
    synchronized: SynchronizedTuning = SYNCHRONIZED_TUNING
    depth_share_without_parallax: float = 0.85
    """Of the distance of everything, where movers stand when there is no parallax: in
    front of the background, or it would shine through them. 0.8 and 0.9 are as good on
    real clips, 1 costs 0.6 to 0.9 dB.
    """
    fallback_smoothing_rounds: int = 2
    """Rounds that smooth the path of all moving pixels together, where no tracks are
    found: a standard deviation of one time.
    """


MOVERS_TUNING = MoversTuning()
