"""The distance of single moving pixels: cameras that jump show it, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
from posed_planes import F, H, W, cameras_at, neighbors, posed_video

from hdr_nsff.geometry import pinhole
from hdr_nsff.priors.movers.pixel_distance import (
    FlowEnds,
    believe_well_placed,
    equations,
    pixel_distances,
    pixel_errors,
)
from hdr_nsff.priors.movers.tuning import PixelDistanceTuning
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.posed_video import PosedVideo

COUNT = 9
Z = 2.0  # of a plane that moves before the cameras
TURNS = np.array([[-0.1, 0.0, 0], [0.1, 0.05, 0], [0.0, -0.1, 0]])  # of a rig, one by one
RIG = np.tile(TURNS, (COUNT // 3, 1))
GLIDE = np.outer(np.arange(COUNT), [0.03, 0.01, 0.0])


def path(times: np.ndarray) -> np.ndarray:
    """Positions (T, 3) of the plane: it speeds up."""
    return np.stack([0.02 * times + 0.002 * times**2, 0.01 * times, 0 * times], -1)


def mover(rigid: bool) -> Mover:
    """The mover of all pixels: one track in the middle of the picture."""
    return Mover(
        frames=np.arange(COUNT),
        pixels=np.full((1, COUNT, 2), [W / 2, H / 2]),
        trust=np.ones((1, COUNT)),
        points=np.zeros((1, 3)),
        rotations=np.tile(np.eye(3), (COUNT, 1, 1)),
        translations=np.zeros((COUNT, 3)),
        center=np.zeros(3),
        known=np.ones(COUNT, bool),
        error=1.0,
        rigid=rigid,
    )


class MovingPlane:
    """A plane with a hole in its mask, its exact flow, and a depth that is 15 % off."""

    def __init__(self, eyes: np.ndarray, times: np.ndarray | None = None) -> None:
        moving = np.ones((COUNT, H, W), bool)
        moving[:, :10] = False
        self.clip = posed_video(cameras_at(*eyes), moving)
        if times is not None:
            self.clip = replace(self.clip, times=times)
        self.pairs = neighbors(COUNT)
        place = path(self.clip.times) - eyes
        shift = [F / Z * (place[j] - place[i])[:2] for i, j in self.pairs]
        self.flow = np.broadcast_to(np.array(shift, np.float32)[:, None, None], (16, H, W, 2))
        self.valid = np.ones((16, H, W), bool)
        self.disparity = np.full((COUNT, H, W), 1.15 / Z, np.float32)
        self.confidence = np.full((COUNT, H, W), 0.2, np.float32)
        self.mover = mover(rigid=False)

    def found(self, **other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Disparity and confidence, with some of the arguments replaced."""
        given = {
            "flow": self.flow,
            "valid": self.valid,
            "disparity": self.disparity,
            "confidence": self.confidence,
        }
        given |= other
        disparity, sigmas = pixel_distances(self.clip, pairs=self.pairs, **given)
        confidence = believe_well_placed(given["confidence"], self.clip, sigmas, [self.mover])
        return np.array(disparity), np.array(confidence)


UNEVEN = np.array([0.0, 1, 2, 4, 5, 6, 7, 9, 10])  # two frames are held out


@pytest.mark.parametrize("times", [None, UNEVEN])
def test_cameras_in_turn_show_the_distance_of_every_pixel(times: np.ndarray | None) -> None:
    plane = MovingPlane(RIG, times)
    disparity, confidence = plane.found()
    inner = np.s_[3:-3, 14:-4, 4:-4]  # whose flow stays within the picture
    assert np.abs(disparity[inner] * Z - 1).max() < 0.02
    assert (confidence[inner] == np.float32(PixelDistanceTuning().confidence)).all()
    assert np.array_equal(disparity[:, :10], plane.disparity[:, :10])  # at rest
    assert np.array_equal(confidence[:, :10], plane.confidence[:, :10])


def test_a_camera_that_glides_shows_nothing() -> None:
    plane = MovingPlane(GLIDE)
    disparity, confidence = plane.found()
    assert np.allclose(disparity, plane.disparity, rtol=0.01)
    assert np.array_equal(confidence, plane.confidence)


def test_a_rigid_mover_has_a_shape_that_is_believed_more() -> None:
    plane = MovingPlane(RIG)
    plane.mover = mover(rigid=True)
    _, confidence = plane.found()
    assert np.array_equal(confidence, plane.confidence)


def test_invalid_flow_shows_nothing() -> None:
    plane = MovingPlane(RIG)
    disparity, _ = plane.found(valid=np.zeros_like(plane.valid))
    assert np.array_equal(disparity, plane.disparity)


def test_flow_that_is_not_a_number_shows_nothing() -> None:
    plane = MovingPlane(RIG)
    flow = plane.flow.copy()
    flow[:, :, 30:] = np.nan
    disparity, _ = plane.found(flow=flow)
    assert np.isfinite(disparity).all()
    assert np.abs(disparity[3:-3, 14:-4, 4:16] * Z - 1).max() < 0.02


def test_what_is_believed_more_stays() -> None:
    plane = MovingPlane(RIG)
    confidence = plane.confidence.copy()
    confidence[:, :, :20] = 0.98
    disparity, _ = plane.found(confidence=confidence)
    assert np.array_equal(disparity[:, :, :20], plane.disparity[:, :, :20])
    assert (disparity[3:-3, 14:-4, 24:-4] != plane.disparity[3:-3, 14:-4, 24:-4]).all()


def test_flow_that_no_smooth_motion_explains_is_not_believed() -> None:
    plane = MovingPlane(RIG)
    jumps = np.random.default_rng(0).normal(0, 6, (16, 1, 1, 2)).astype(np.float32)
    _, confidence = plane.found(flow=plane.flow + jumps)
    assert np.array_equal(confidence, plane.confidence)


def test_a_pixel_says_what_least_squares_over_its_projections_says() -> None:
    """Information and pull of one pixel, against numeric derivatives of projections."""
    tuning = PixelDistanceTuning(robust_rounds=1)
    rng = np.random.default_rng(1)
    turned = np.linalg.qr(np.eye(3) + 0.02 * rng.standard_normal((COUNT, 3, 3)))[0]
    turned *= np.sign(np.einsum("tii->ti", turned))[:, None]
    c2w = np.concatenate([turned, RIG[..., None]], -1)
    clip = replace(posed_video(c2w), times=UNEVEN)
    pixel, rho = np.array([[30.5, 22.5]]), np.array([0.4])
    frames = [3, 5, 6, 2, 1]
    ends = [
        FlowEnds(j, pixel + rng.normal(0, 2, (1, 2)), np.array([True]), links)
        for j, links in zip(frames, [1, 2, 3, 1, 2], strict=True)
    ]

    def misses(unknowns: np.ndarray) -> np.ndarray:
        """Pixels (2 C,) between projections and ends, times the z-depth there."""
        result = []
        for end in ends:
            point = moved_point(clip, pixel, rho * (1 + unknowns[0]), unknowns[1:], end.frame)
            seen, z = pinhole.project(point, clip.K[end.frame], c2w[end.frame])
            result.append((seen - end.pixels)[0] * (z[0] * rho[0] * (1 + unknowns[0])))
        return np.concatenate(result)

    step = 1e-5
    slopes = np.stack([(misses(e) - misses(-e)) / (2 * step) for e in step * np.eye(10)], 1)
    weight = np.repeat([1 / (tuning.noise_px**2 * end.links) for end in ends], 2)
    sigmas = [tuning.velocity_sigma_px, tuning.acceleration_sigma_px, tuning.jerk_sigma_px]
    prior = np.diag([0.0, *np.repeat(sigmas, 3) ** -2.0])
    normal = slopes.T @ (weight[:, None] * slopes) + prior
    target = -slopes.T @ (weight * misses(np.zeros(10)))
    inverse = np.linalg.inv(normal)
    found = pixel_errors(*equations(clip, 4, pixel, rho, ends, tuning), tuning)[:, 0]
    assert found[0] == pytest.approx(1 / inverse[0, 0], rel=1e-4)
    assert found[1] == pytest.approx((inverse @ target)[0] / inverse[0, 0], rel=1e-3)
    assert found[3] == 0  # ten equations for ten unknowns


def moved_point(
    clip: PosedVideo, pixel: np.ndarray, rho: np.ndarray, motion: np.ndarray, frame: int
) -> np.ndarray:
    """The world point (1, 3) of `pixel` of frame 4 at another frame's time, moved by
    velocity, acceleration and jerk (9,) in pixels at its distance.
    """
    tau = clip.times[frame] - clip.times[4]
    powers = np.array([tau, tau**2 / 2, tau**3 / 6])
    moved = powers @ motion.reshape(3, 3) / clip.K[4, 0, 0]  # relative to the distance
    return clip.unproject(4, pixel, rho) + moved / rho @ clip.c2w[4, :, :3].T
