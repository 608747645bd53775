"""The least-squares problem of bundle adjustment for one mover.

Unknowns are canonical points and the rotation and translation of every time, observed
by tracks in cameras with known poses. Levenberg-Marquardt, whose steps are those of
`bundle_steps.py`, with Huber weights. Weak priors hold what the tracks leave open: the
mean z-depth of every time, the third differences of the path, whose covariance is
estimated from the path, the second differences of the rotation, and the extent of the
shape.

All points and translations are relative to the group's center, in scene units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError
from scipy.spatial.transform import Rotation

from hdr_nsff.geometry import pinhole
from hdr_nsff.maths.differences import differences
from hdr_nsff.priors.movers import bundle_kernels as kernels
from hdr_nsff.priors.movers.bundle_steps import NormalEquations, solve_damped
from hdr_nsff.priors.movers.rigid_motion import RigidGroup, canonical_points
from hdr_nsff.priors.movers.tracks import Tracks
from hdr_nsff.priors.movers.tuning import BUNDLE_TUNING, BundleTuning

# observations that a point needs; one leaves its depth open
MIN_OBSERVATIONS = 2


@dataclass(frozen=True)
class Cameras:
    """Known cameras of the tracks' times."""

    K: np.ndarray  # (T, 3, 3) pixels
    c2w: np.ndarray  # (T, 3, 4) OpenCV, scene units
    when: np.ndarray  # (T,) the times themselves, ascending, in frames of the footage

    def at(self, times: np.ndarray) -> Cameras:
        """The cameras at the `times` (S,)."""
        return Cameras(self.K[times], self.c2w[times], self.when[times])


@dataclass(frozen=True)
class BundleState:
    """The unknowns."""

    points: np.ndarray  # (N, 3) canonical
    rotations: np.ndarray  # (T, 3, 3) world from canonical
    translations: np.ndarray  # (T, 3)


@dataclass(frozen=True)
class Reprojection:
    """A state's points as the cameras see them."""

    error: np.ndarray  # (N, T, 2) px, 0 where not visible
    depth: np.ndarray  # (N, T) z-depth, 0 where not visible


@dataclass(frozen=True)
class PriorResiduals:
    """Residuals of the priors, in standard deviations."""

    depth: np.ndarray  # (T,) mean z-depth
    path: np.ndarray  # (P, 3) third differences of the path
    rotation: np.ndarray  # (R, 3) second differences of the rotation
    shape: np.ndarray  # (N, 3) distance of points from the middle


@dataclass(frozen=True)
class ReprojectionTerms:
    """Terms of `NormalEquations`, of the reprojection errors alone: a block for every
    time.
    """

    pose_blocks: np.ndarray  # (T, 6, 6)
    points: np.ndarray  # (N, 3, 3)
    points_poses: np.ndarray  # (N, 3, T, 6)
    pose_gradient: np.ndarray  # (T, 6)
    point_gradient: np.ndarray  # (N, 3)


class BundleProblem:
    """Residuals of a state, their derivatives, and the minimization.

    `usable` bool marks the members of the group that have a point; `members` and all
    other arrays of N are of those. `times` (T,) are positions among the clip's, by
    default one after the other: motion is smooth only between consecutive ones.
    """

    def __init__(
        self,
        tracks: Tracks,
        group: RigidGroup,
        cameras: Cameras,
        tuning: BundleTuning = BUNDLE_TUNING,
        times: np.ndarray | None = None,
    ) -> None:
        self.tuning = tuning
        visible = (tracks.trust[group.members] > 0) & group.known
        prior_points = tracks.points[group.members] - group.center
        start = canonical_points(prior_points, visible, group.rotations, group.translations)
        self.usable = np.isfinite(start[:, 0]) & (visible.sum(1) >= MIN_OBSERVATIONS)
        members = self.members = group.members[self.usable]  # (N,)
        self.visible = visible[self.usable]  # (N, T)
        self.start = start[self.usable]  # (N, 3)
        self.pixels = np.nan_to_num(tracks.pixels[members])  # (N, T, 2)
        self.noise = tuning.flow_noise_px * np.sqrt(1.0 + tracks.age[members])  # (N, T) px
        self.K = np.ascontiguousarray(cameras.K, np.float64)
        self.eyes = cameras.c2w[:, :, 3] - group.center  # (T, 3)
        self.c2w = np.concatenate([cameras.c2w[:, :, :3], self.eyes[..., None]], -1)
        self.w2c = np.swapaxes(self.c2w[:, :, :3], 1, 2).copy()  # (T, 3, 3), rotation only
        self.middle = np.zeros(3)
        self.size = 1.0
        if len(members):
            self.middle = np.median(self.start, 0)
            self.size = np.median(np.linalg.norm(self.start - self.middle, axis=-1)) + 1e-9
        positions = np.arange(len(self.K)) if times is None else times
        self.init_differences(positions, cameras.when)
        self.init_depth_prior(prior_points[self.usable], tracks.trust[members])

    def init_differences(self, positions: np.ndarray, when: np.ndarray) -> None:
        """Difference operators over the times, one row for every three or four
        consecutive ones, and which rows of the path are supported.

        `positions` (T,) tell which are consecutive; `when` (T,) they are is uneven
        where frames are missing or held out.
        """
        known = np.diff(positions) == 1  # (T - 1,)
        self.second_differences = differences(when, known, 2)  # (R, T)
        self.third_differences = differences(when, known, 3)  # (P, T)
        self.turn_differences = turn_differences(when, known)  # (R, T - 1)
        # (T, T) products of the differences, which all steps share
        self.path_products = self.third_differences.T @ self.third_differences
        self.turn_products = self.second_differences.T @ self.second_differences
        self.turn_products /= self.tuning.rotation_sigma_rad**2
        # makes third differences, as shares of z-depth, standard deviations
        self.path_whitening = np.eye(3) / self.tuning.initial_path_sigma  # (3, 3)
        min_tracks = self.tuning.min_tracks
        self.depth_known = self.visible.sum(0) >= min_tracks  # (T,)
        linked = (self.visible[:, 1:] & self.visible[:, :-1]).sum(0) >= min_tracks
        # (T,) the run of linked times, within which depth has one unknown factor
        self.run = np.concatenate([[0], np.cumsum(~linked)])
        four_in_a_row = known[2:] & known[1:-1] & known[:-2]
        in_one_run = (self.run[3:] == self.run[:-3])[four_in_a_row]
        num_unknown = (np.abs(self.third_differences) > 0) @ ~self.depth_known
        self.path_rows = (num_unknown == 0) & in_one_run  # (P,)

    def init_depth_prior(self, prior_points: np.ndarray, trust: np.ndarray) -> None:
        """The prior of mean z-depth, from the tracks' points and trust in them.

        `prior_points` (N, T, 3), `trust` (N, T).
        """
        tuning = self.tuning
        depth = pinhole.to_camera(prior_points, self.c2w)[..., 2]
        count = np.maximum(self.visible.sum(0), 1)
        depth = np.where(self.visible, np.nan_to_num(depth), 0)
        self.mean_depth = depth.sum(0) / count  # (T,)
        self.prior_distance = 1.0
        if self.depth_known.any():
            self.prior_distance = np.median(self.mean_depth[self.depth_known])
        num_known = max(int(self.depth_known.sum()), 1)
        # (T, 3) derivative of the mean z-depth of all times by translations
        self.distance_gradient = self.depth_known[:, None] * self.w2c[:, 2] / num_known

        median_trust = np.median(trust[self.visible]) if self.visible.any() else 0.0
        sigma = tuning.sigma_of_depth(float(median_trust))
        if self.path_rows.sum() >= tuning.min_path_rows:
            # one observation for all times of a run
            times_in_run = np.bincount(self.run, self.depth_known)[self.run]
            sigmas = sigma * np.sqrt(np.maximum(times_in_run, 1))
        else:
            sigmas = np.full(len(self.K), min(sigma, tuning.short_path_depth_sigma))
        self.depth_sigma = self.prior_distance * sigmas  # (T,)

    def minimize(self, state: BundleState, iterations: int) -> tuple[BundleState, float]:
        """The state after at most `iterations` damped steps, and its cost."""
        tuning = self.tuning
        cost = self.cost(state)
        damping = tuning.initial_damping
        equations: NormalEquations | None = None  # of the state
        for _ in range(iterations):
            equations = equations or self.normal_equations(state)
            try:
                candidate = self.damped_step(state, equations, damping)
                candidate_cost = self.cost(candidate)
            except LinAlgError:  # more damping determines the step
                candidate_cost = np.inf
            if candidate_cost < cost:
                state, cost, equations = candidate, candidate_cost, None
                damping /= tuning.damping_decrease
            else:
                damping *= tuning.damping_increase
            if damping > tuning.max_damping:
                break
        return state, cost

    def solve_points(self, state: BundleState, iterations: int | None = None) -> BundleState:
        """The same poses with this problem's points fitted to them, by damped steps.

        The points start from `points_on_rays`; `iterations` is that of the tuning
        without one.
        """
        tuning = self.tuning
        iterations = tuning.iterations if iterations is None else iterations
        state = replace(state, points=self.points_on_rays(state))
        sigma, middle = self.shape_sigma(state), np.median(state.points, 0)
        costs = self.point_costs(state, middle)
        damping = np.full(len(costs), tuning.initial_damping)
        for _ in range(iterations):
            terms = self.reprojection_terms(state)
            hessian = terms.points + np.eye(3) / sigma**2
            hessian += damping[:, None, None] * hessian * np.eye(3)
            gradient = terms.point_gradient + (state.points - middle) / sigma**2
            moved = state.points - np.linalg.solve(hessian, gradient[..., None])[..., 0]
            moved_costs = self.point_costs(replace(state, points=moved), middle)
            better = moved_costs < costs
            state = replace(state, points=np.where(better[:, None], moved, state.points))
            costs = np.where(better, moved_costs, costs)
            damping *= np.where(better, 1 / tuning.damping_decrease, tuning.damping_increase)
        return state

    def point_costs(self, state: BundleState, middle: np.ndarray) -> np.ndarray:
        """The part of the cost (N,) that each point has, about the `middle` (3,)."""
        distances = (state.points - middle) / self.shape_sigma(state)
        return self.huber(self.reproject(state)).sum(1) + 0.5 * (distances**2).sum(1)

    def points_on_rays(self, state: BundleState) -> np.ndarray:
        """Median over time of canonical points (N, 3) at the z-depth of the center."""
        depth = pinhole.to_camera(state.translations, self.c2w)[..., 2]
        world = pinhole.unproject(self.pixels, depth, self.K, self.c2w)
        back = np.einsum("tji,ntj->nti", state.rotations, world - state.translations)
        return np.nanmedian(np.where(self.visible[..., None], back, np.nan), 1)

    def reproject(self, state: BundleState) -> Reprojection:
        """The points of a state in all cameras."""
        error, depth = np.empty(self.pixels.shape), np.empty(self.visible.shape)
        kernels.reproject_points(*self.observed(state), self.min_depth, error, depth)
        return Reprojection(error, depth)

    def observed(self, state: BundleState) -> tuple[np.ndarray, ...]:
        """Points, poses, cameras and observations of a state, for the kernels."""
        shifts = state.translations - self.eyes
        return (
            *(np.ascontiguousarray(a) for a in (state.points, state.rotations, shifts)),
            *(self.w2c, self.K, self.pixels, self.noise, self.visible),
        )

    @property
    def min_depth(self) -> float:
        """The z-depth from which nearer points project, scene units."""
        return self.tuning.min_depth_share * self.prior_distance

    def prior_residuals(self, state: BundleState, depth: np.ndarray) -> PriorResiduals:
        """The residuals of all priors; `depth` (N, T) is that of `Reprojection`."""
        mean_depth = depth.sum(0) / np.maximum(self.visible.sum(0), 1)
        change = (mean_depth - self.mean_depth) / self.depth_sigma
        path = self.third_differences @ state.translations / self.distance(state)
        relative = state.rotations[1:] @ np.swapaxes(state.rotations[:-1], 1, 2)
        steps = Rotation.from_matrix(relative).as_rotvec()
        return PriorResiduals(
            depth=np.where(self.depth_known, change, 0),
            path=path @ self.path_whitening,
            rotation=self.turn_differences @ steps / self.tuning.rotation_sigma_rad,
            shape=(state.points - self.middle) / self.shape_sigma(state),
        )

    def distance(self, state: BundleState) -> float:
        """The mover's distance: its mean z-depth over all times, scene units."""
        distance = float((self.distance_gradient * (state.translations - self.eyes)).sum())
        return max(distance, self.tuning.min_distance_share * self.prior_distance)

    def shape_sigma(self, state: BundleState) -> float:
        """Standard deviation of a point's distance from the middle, scene units.

        It grows with the mover's distance, since pixels leave that scale open.
        """
        sigma = self.tuning.shape_sigma * self.size
        return sigma * self.distance(state) / self.prior_distance

    def path_terms(self, state: BundleState, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The terms (3 T, 3 T) and (T, 3) of the path's residuals (P, 3), for the
        translations.

        The residuals are shares of the distance. In scene units, every mover could
        lower them by approaching the camera, since near movers move less. The
        derivative of one residual is (D W - path g) / distance with the differences D,
        the whitening W, and the gradient g of the distance.
        """
        whitening, gradient = self.path_whitening, self.distance_gradient
        along = self.third_differences.T @ path @ whitening  # (T, 3)
        squared = (path**2).sum()
        matrix = np.kron(self.path_products, whitening.T @ whitening)
        half = np.outer(along - 0.5 * squared * gradient, gradient)
        matrix -= half + half.T
        distance = self.distance(state)
        return matrix / distance**2, (along - squared * gradient) / distance

    def fit_path_whitening(self, state: BundleState) -> None:
        """Set the prior's smoothness, per direction, to that of the state's path.

        A mover that goes to and fro does so along a line or in a plane. Across it only
        the shake of the camera remains, and that determines the distance. Nothing is
        set where too little of the path was visible.
        """
        if self.path_rows.sum() < self.tuning.min_path_rows:
            return
        path = (self.third_differences @ state.translations)[self.path_rows]
        path = path / self.distance(state)
        floor = self.tuning.path_sigma**2 * np.eye(3)
        variance, axes = np.linalg.eigh(path.T @ path / len(path) + floor)
        self.path_whitening = axes / np.sqrt(variance) @ axes.T

    def cost(self, state: BundleState) -> float:
        """Half the sum of squares of all residuals, with Huber's loss of the errors."""
        reprojection = self.reproject(state)
        huber = self.huber(reprojection)[self.visible].sum()
        priors = self.prior_residuals(state, reprojection.depth)
        squares = [
            (residual**2).sum()
            for residual in (priors.depth, priors.path, priors.rotation, priors.shape)
        ]
        return float(huber + 0.5 * sum(squares))

    def huber(self, reprojection: Reprojection) -> np.ndarray:
        """Huber's loss (N, T) of the errors, 0 where not visible."""
        length = np.linalg.norm(reprojection.error, axis=-1) / self.noise
        return np.where(length < 1, 0.5 * length**2, length - 0.5)

    def reprojection_terms(self, state: BundleState) -> ReprojectionTerms:
        """The Gauss-Newton terms of the reprojection errors alone."""
        count, num = self.visible.shape
        terms = ReprojectionTerms(
            pose_blocks=np.zeros((num, 6, 6)),
            points=np.zeros((count, 3, 3)),
            points_poses=np.zeros((count, 3, num, 6)),
            pose_gradient=np.zeros((num, 6)),
            point_gradient=np.zeros((count, 3)),
        )
        kernels.accumulate(
            *self.observed(state),
            self.min_depth,
            terms.pose_blocks,
            terms.points,
            terms.points_poses,
            terms.pose_gradient,
            terms.point_gradient,
        )
        return terms

    def normal_equations(self, state: BundleState) -> NormalEquations:
        """The Gauss-Newton system of the reprojection errors and all priors."""
        num = self.visible.shape[1]
        priors = self.prior_residuals(state, self.reproject(state).depth)
        terms = self.reprojection_terms(state)
        pose_blocks, pose_gradient = terms.pose_blocks, terms.pose_gradient
        points, point_gradient = terms.points, terms.point_gradient

        # mean z-depth
        by_depth = np.concatenate([np.zeros((num, 3)), self.w2c[:, 2]], -1)
        by_depth = by_depth / self.depth_sigma[:, None] * self.depth_known[:, None]
        pose_blocks = pose_blocks + by_depth[:, :, None] * by_depth[:, None]
        pose_gradient = pose_gradient + by_depth * priors.depth[:, None]
        poses = np.zeros((num, 6, num, 6))
        poses[np.arange(num), :, np.arange(num)] = pose_blocks

        # path
        path_matrix, path_gradient = self.path_terms(state, priors.path)
        poses[:, 3:, :, 3:] += path_matrix.reshape(num, 3, num, 3)

        # shape, whose standard deviation grows with the distance
        sigma = self.shape_sigma(state)
        distance = self.distance(state)
        points = points + np.eye(3) / sigma**2
        point_gradient = point_gradient + priors.shape / sigma
        relative_gradient = self.distance_gradient / distance  # (T, 3)
        squared = (priors.shape**2).sum()
        pose_gradient[:, 3:] += path_gradient - squared * self.distance_gradient / distance
        by_distance = np.sqrt(squared) * self.distance_gradient.reshape(-1) / distance
        outer = np.outer(by_distance, by_distance)
        poses[:, 3:, :, 3:] += outer.reshape(num, 3, num, 3)

        # rotation
        for axis in range(3):
            poses[:, axis, :, axis] += self.turn_products
        by_turn = self.second_differences.T @ priors.rotation
        pose_gradient[:, :3] += by_turn / self.tuning.rotation_sigma_rad
        return NormalEquations(
            poses=poses.reshape(6 * num, 6 * num),
            points=points,
            points_poses=terms.points_poses.reshape(len(points), 3, 6 * num),
            by_size=priors.shape / sigma,
            by_distance=np.concatenate([np.zeros((num, 3)), -relative_gradient], 1).reshape(-1),
            pose_gradient=pose_gradient.reshape(-1),
            point_gradient=point_gradient,
        )

    def damped_step(
        self, state: BundleState, equations: NormalEquations, damping: float
    ) -> BundleState:
        """The state after one damped Gauss-Newton step by its `equations`."""
        pose_step, point_step = solve_damped(equations, self.visible, damping)
        pose_step = pose_step.reshape(-1, 6)
        rotations = Rotation.from_rotvec(pose_step[:, :3]).as_matrix() @ state.rotations
        return BundleState(
            state.points + point_step, rotations, state.translations + pose_step[:, 3:]
        )


def turn_differences(when: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Matrix (R, T - 1) that makes second differences of the rotation from the turns
    between one time and the next.

    As `differences` of order 2 has it: the difference of two angular velocities, times
    the mean of their steps.
    """
    steps = np.diff(when)  # (T - 1,)
    firsts = np.nonzero(known[1:] & known[:-1])[0]  # (R,)
    rows = np.zeros((len(firsts), len(steps)))
    for row, k in zip(rows, firsts, strict=True):
        row[k : k + 2] = np.array([-1, 1]) / steps[k : k + 2] * steps[k : k + 2].mean()
    return rows
