"""Where learned vignetting starts: at what static points show that a camera saw at
several distances from the axis.

A point of the scene has one radiance. What its recordings in two frames differ by is
the fall-off between two radii, and an error of the frames' gains. Robust least squares
of log radiance (Huber 1964) finds both: training alone would let the field take over
most of the fall-off, since brightness of the scene is learned faster.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.tonemap.base import ToneMapper
from hdr_nsff.tonemap.vignetting import Vignetting, squared_tangent

GAPS = (2, 3, 4, 6, 8, 12, 16, 24, 32)  # between the frames of a pair
MAX_PAIRS = 90
POINTS_PER_PAIR = 400
LOW, HIGH = 0.1, 0.9  # recorded values that are trusted
MIN_CONFIDENCE = 0.1  # of the disparity
MAX_DISPARITY_ERROR = 0.05  # share, between a point and the map of the other frame
HUBER = 0.05  # natural log of radiance: larger errors count linearly
ROUNDS = 8  # of reweighting
RIDGE = 0.01  # of an observation's weight per observation: weak, towards none
MIN_POINTS = 500
MIN_EFFECT = 0.03  # at the corner: less is left to training
DEGREES = (1, 2, 3)  # of r^2


@torch.no_grad()
def start_vignetting(lens: Vignetting, tonemapper: ToneMapper, scene: Scene) -> None:
    """Start the coefficients of every camera where static points show them.

    Depth that is known up to scale and shift does not lead from frame to frame: they
    stay at none then, and training alone learns them.
    """
    if scene.manifest.depth_kind != "scene":
        return
    generator = np.random.default_rng(0)
    for camera_id in range(len(lens.coefficients)):
        frames = [(k, f) for k, f in enumerate(scene.train) if f.camera_id == camera_id]
        pairs = [(a, a + gap) for gap in GAPS for a in range(len(frames) - gap)]
        kept = np.linspace(0, len(pairs) - 1, min(MAX_PAIRS, len(pairs))).astype(int)
        corner = float(lens.corners[camera_id])
        parts = []
        for a, b in (pairs[k] for k in kept):
            r2, change = compare(tonemapper, frames[a], frames[b], corner, generator)
            gains = np.zeros((len(change), len(frames)))
            gains[:, a], gains[:, b] = 1, -1
            parts.append((np.concatenate([r2, gains], 1), change))
        rows = np.concatenate([part for part, _ in parts]) if parts else np.zeros((0, 3))
        if len(rows) < MIN_POINTS:
            continue
        log_shares = robust_fit(rows, np.concatenate([change for _, change in parts]))
        coefficients = as_polynomial(log_shares[:3])
        if abs(coefficients.sum()) >= MIN_EFFECT:
            lens.coefficients[camera_id] = torch.from_numpy(coefficients).float()


def compare(
    tonemapper: ToneMapper,
    one: tuple[int, Frame],
    other: tuple[int, Frame],
    corner: float,
    generator: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Differences of r^2, r^4, r^6 (N, 3), and of log radiance (N,), of static points
    in two frames (position, frame).
    """
    (k, a), (j, b) = one, other
    nothing = np.zeros((0, 3)), np.zeros(0)
    if a.disparity is None or b.disparity is None:
        return nothing
    image, there = blurred(a.image), blurred(b.image)
    usable = ((image > LOW) & (image < HIGH)).all(-1) & (a.disparity > 0)
    if a.disparity_confidence is not None:
        usable &= a.disparity_confidence > MIN_CONFIDENCE
    if a.moving is not None:
        usable &= ~a.moving
    places = usable.nonzero()
    if not len(places):
        return nothing
    places = places[generator.choice(len(places), min(POINTS_PER_PAIR, len(places)), False)]
    pixels = places.flip(1) + 0.5
    rays = a.camera.rays(pixels)
    depth = 1 / a.disparity[places[:, 0], places[:, 1]]
    seen, z = b.camera.project(rays.origins + depth[:, None] * rays.directions)
    x, y = seen.floor().long().unbind(-1)
    inside = (x >= 0) & (x < b.camera.width) & (y >= 0) & (y < b.camera.height) & (z > 0)
    x, y = x.clamp(0, b.camera.width - 1), y.clamp(0, b.camera.height - 1)
    rgb = there[y, x]
    kept = inside & ((rgb > LOW) & (rgb < HIGH)).all(-1)
    kept &= (b.disparity[y, x] * z - 1).abs() < MAX_DISPARITY_ERROR
    if b.moving is not None:
        kept &= ~b.moving[y, x]
    first = image[places[:, 0], places[:, 1]][kept]
    radiance = tonemapper.inverse(first, a.bracket, a.camera_id, k)
    radiance_there = tonemapper.inverse(rgb[kept], b.bracket, b.camera_id, j)
    change = (radiance.clamp_min(1e-9) / radiance_there.clamp_min(1e-9)).log().mean(-1)
    r2 = (squared_tangent(a.camera, pixels) / corner)[kept].double().numpy()
    r2_there = (squared_tangent(b.camera, seen) / corner)[kept].double().numpy()
    powers = np.stack([r2**n - r2_there**n for n in DEGREES], 1)
    return powers, change.double().numpy()


def blurred(image: Tensor) -> Tensor:
    """An image (H, W, 3) averaged over 3x3 pixels."""
    return torch.from_numpy(cv2.blur(image.cpu().numpy(), (3, 3)))


def robust_fit(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The solution (C,) of `rows` (N, C) x = `values` (N,), least squares for small and
    least absolute errors for large residuals, with a weak prior towards 0.
    """
    weights = np.ones(len(rows))
    solution = np.zeros(rows.shape[1])
    prior = RIDGE * len(rows) * np.eye(rows.shape[1]) * 1e-2
    for _ in range(ROUNDS):
        weighted = rows * weights[:, None]
        solution = np.linalg.solve(weighted.T @ rows + prior, weighted.T @ values)
        error = np.abs(values - rows @ solution)
        weights = HUBER / np.maximum(error, HUBER)
    return solution


def as_polynomial(log_shares: np.ndarray) -> np.ndarray:
    """v1, v2, v3 of the share of light with the log polynomial `log_shares` (3,)."""
    r2 = np.linspace(0, 1, 33)
    powers = np.stack([r2**n for n in DEGREES], 1)
    share = np.exp(np.clip(powers @ log_shares, -2.0, 0.5))
    return np.linalg.lstsq(powers, share - 1, rcond=None)[0]
