"""Lens distortion: where a real lens puts what a pinhole camera would see, and pictures
brought from one to the other.

The model is that of Brown 1971 as OpenCV and COLMAP (RADIAL, OPENCV) have it. A point
(x, y) of the image plane at depth 1 is recorded at

    x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y

Pixels have their centers at +0.5. Undistorted pictures have the size of the recorded
ones, and the widest view that shows no pixel from outside of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from hdr_nsff.geometry import pinhole

UNDISTORT_STEPS = 50  # of Newton's method, which ends earlier where it converges
UNDISTORT_ERROR = 1e-9  # image plane at depth 1
ZOOM_RANGE = (0.25, 4.0)  # of focal lengths that are tried for an undistorted picture
ZOOM_STEPS = 40  # of bisection
BORDER_POINTS = 65  # along each side of a picture


@dataclass(frozen=True)
class Lens:
    """The camera of recorded pictures: a pinhole, and the distortion of its lens."""

    K: np.ndarray  # (3, 3) pixels
    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2
    width: int  # pixels that K is for
    height: int

    def resized(self, width: int, height: int) -> Lens:
        """The same lens for pictures of another size."""
        scale = np.array([width / self.width, height / self.height, 1])
        return replace(self, K=self.K * scale[:, None], width=width, height=height)

    def bend(self, plane: np.ndarray) -> np.ndarray:
        """Where the lens brings points (..., 2) of the image plane at depth 1."""
        x, y = plane[..., 0], plane[..., 1]
        k1, k2, p1, p2 = self.distortion
        with np.errstate(over="ignore", invalid="ignore"):  # a model that no lens has
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2 * r2
            bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([bent_x, bent_y], -1)

    def distort(self, pixels: np.ndarray, K: np.ndarray) -> np.ndarray:
        """Where the lens records (..., 2) what a pinhole camera `K` (3, 3) sees at
        `pixels` (..., 2).
        """
        bent = self.bend(pinhole.camera_rays(pixels, K)[..., :2])
        return pinhole.to_pixels(pinhole.homogeneous(bent), self.K)

    def undistort(self, pixels: np.ndarray, K: np.ndarray) -> np.ndarray:
        """Where a pinhole camera `K` (3, 3) sees (..., 2) what the lens recorded at
        `pixels` (..., 2), by Newton's method. Where the lens records nothing, that is
        the farthest that it does record.
        """
        recorded = pinhole.camera_rays(pixels, self.K)[..., :2]
        plane, limit = recorded, np.sqrt(self.rising_square())
        for _ in range(UNDISTORT_STEPS):
            error = recorded - self.bend(plane)
            plane = plane + self.newton_step(plane, error)
            with np.errstate(divide="ignore", invalid="ignore"):
                plane = plane * np.fmin(1, limit / np.linalg.norm(plane, axis=-1, keepdims=True))
            if not (np.abs(error).max(initial=0) > UNDISTORT_ERROR):
                break
        return pinhole.to_pixels(pinhole.homogeneous(plane), K)

    def newton_step(self, plane: np.ndarray, error: np.ndarray) -> np.ndarray:
        """By how much (..., 2) points of the image plane have to move for the lens to
        bring them farther by `error` (..., 2), to the first order.
        """
        x, y = plane[..., 0], plane[..., 1]
        k1, k2, p1, p2 = self.distortion
        with np.errstate(all="ignore"):  # a model that no lens has
            r2 = x * x + y * y
            radial, slope = 1 + k1 * r2 + k2 * r2 * r2, 2 * k1 + 4 * k2 * r2
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x  # d bent_x / d x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            inverse = np.stack([yy, -xy, -xy, xx], -1) / (xx * yy - xy * xy)[..., None]
        return np.einsum("...ij,...j->...i", inverse.reshape(*plane.shape, 2), error)

    def undistorted_pixels(self) -> np.ndarray:
        """Where the camera `pinhole()` sees (H, W, 2) what the pixels recorded."""
        return self.undistort(pinhole.pixel_centers(self.height, self.width), self.pinhole())

    def border(self) -> np.ndarray:
        """Points (N, 2) along the border of a picture, in pixels."""
        along = np.linspace(0, 1, BORDER_POINTS)
        zero, one = np.zeros_like(along), np.ones_like(along)
        sides = [(along, zero), (along, one), (zero, along), (one, along)]
        shares = np.concatenate([np.stack(side, -1) for side in sides])
        return shares * np.array([self.width, self.height])

    def pinhole(self) -> np.ndarray:
        """K (3, 3) of undistorted pictures: the shortest focal length at which all of
        their pixels were recorded.
        """
        border, size = self.border(), np.array([self.width, self.height])
        short, long = ZOOM_RANGE
        for _ in range(ZOOM_STEPS):
            zoom = (short + long) / 2
            recorded = self.distort(border, zoomed(self.K, zoom))
            inside = ((recorded >= 0) & (recorded <= size)).all()
            short, long = (short, zoom) if inside else (zoom, long)
        return zoomed(self.K, long)

    def unzoomed(self, K: np.ndarray) -> np.ndarray:
        """The camera `K` (3, 3) of undistorted pictures, estimated from them, at the
        focal length of the lens: what a pinhole camera in its place would have
        recorded.
        """
        return zoomed(K, self.K[0, 0] / self.pinhole()[0, 0])

    def wide_pinhole(self) -> tuple[np.ndarray, int, int]:
        """K (3, 3), width and height of the smallest pinhole picture, at the focal
        length of the lens, that shows all that the lens records.
        """
        outline = self.undistort(self.border(), self.K)
        low = np.floor(outline.min(0)).astype(int) - 1
        width, height = np.ceil(outline.max(0)).astype(int) + 1 - low
        K = self.K.copy()
        K[:2, 2] -= low
        return K, int(width), int(height)

    def max_displacement_px(self) -> float:
        """By how many pixels the lens moves a corner of the picture at most."""
        width, height = self.width, self.height
        corners = np.array([(0.0, 0), (width, 0), (0, height), (width, height)])
        with np.errstate(all="ignore"):  # impossible numbers are refused elsewhere
            return float(np.linalg.norm(self.distort(corners, self.K) - corners, axis=-1).max())

    def is_one_to_one(self) -> bool:
        """Whether pixels further out see further out, up to the corners."""
        # squared radius before a barrel lens, over that where it is recorded
        needed = 2.0 if self.distortion[0] < 0 else 1.0
        return self.rising_square() >= needed * self.border_square()

    def border_square(self) -> float:
        """The largest squared radius of recorded pixels on the image plane."""
        return float((pinhole.camera_rays(self.border(), self.K)[..., :2] ** 2).sum(-1).max())

    def rising_square(self) -> float:
        """Up to which squared radius of the image plane points further out are recorded
        further out; at most four times that of the corners.
        """
        k1, k2, _, _ = self.distortion
        r2 = self.border_square()
        squares = np.linspace(0, 4 * r2, 257)  # r2 and 2 r2 are among them
        rises = np.logical_and.accumulate(1 + 3 * k1 * squares + 5 * k2 * squares**2 > 0)
        return float(squares[rises].max())


def zoomed(K: np.ndarray, zoom: float) -> np.ndarray:
    """K (3, 3) with its focal lengths times `zoom`."""
    return K * np.array([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])


def undistorted_picture(picture: np.ndarray, lens: Lens) -> np.ndarray:
    """A recorded picture (H, W) or (H, W, C) as the pinhole camera `lens.pinhole()`
    would have recorded it; boolean pictures are taken from the nearest pixel.
    """
    height, width = picture.shape[:2]
    lens = lens.resized(width, height)
    return sample(picture, lens.distort(pinhole.pixel_centers(height, width), lens.pinhole()))


def undistorted_map(values: np.ndarray, lens: Lens) -> np.ndarray:
    """A map (H, W) of a recorded picture as that of the pinhole camera
    `lens.pinhole()`, from the nearest pixels: what it holds has no mean across edges.
    """
    height, width = values.shape
    lens = lens.resized(width, height)
    recorded = lens.distort(pinhole.pixel_centers(height, width), lens.pinhole())
    return sample_nearest(values, recorded)


def distorted_picture(picture: np.ndarray, K: np.ndarray, lens: Lens) -> np.ndarray:
    """The picture (H, W) or (H, W, C) that the lens records of what a pinhole camera
    `K` (3, 3) sees as `picture`; it has the size of the lens.
    """
    return sample(picture, lens.undistort(pinhole.pixel_centers(lens.height, lens.width), K))


def sample(picture: np.ndarray, pixels: np.ndarray, linear: bool = False) -> np.ndarray:
    """A picture (H, W) or (H, W, C) read at `pixels` (h, w, 2), between its pixels by a
    cubic, or `linear`, and beyond its border as there. One of bool is read at the
    nearest pixel.
    """
    places = np.ascontiguousarray(pixels - 0.5, np.float32)
    x, y = places[..., 0], places[..., 1]
    edge = cv2.BORDER_REPLICATE
    if picture.dtype == bool:
        return sample_nearest(picture.astype(np.uint8), pixels) > 0
    values = np.ascontiguousarray(picture, np.float32)
    if linear:
        return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=edge))
    read = np.asarray(cv2.remap(values, x, y, cv2.INTER_CUBIC, borderMode=edge))
    return read.clip(values.min(), values.max())


def sample_nearest(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """A picture (H, W) read at the pixels nearest to `pixels` (h, w, 2), and beyond its
    border as there: for numbers that have no meaning in between.
    """
    places = np.ascontiguousarray(pixels - 0.5, np.float32)
    x, y = places[..., 0], places[..., 1]
    values = np.ascontiguousarray(picture)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE))


def undistortion(lens: Lens) -> np.ndarray:
    """By how much (H, W, 2) px undistorting moves each pixel of a recorded picture."""
    return lens.undistorted_pixels() - pinhole.pixel_centers(lens.height, lens.width)


def undistorted_flow(
    flow: np.ndarray, valid: np.ndarray, lens: Lens, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flow (H, W, 2) px and its validity (H, W) between recorded pictures, as a pinhole
    camera would have seen it; `shift` is that of `undistortion`.

    It is not valid where it leaves the undistorted picture.
    """
    size = np.array([lens.width, lens.height])
    pixels = pinhole.pixel_centers(lens.height, lens.width)
    recorded = lens.distort(pixels, lens.pinhole())
    target = recorded + sample(flow, recorded, linear=True)
    target = target + sample(shift, target, linear=True)
    inside = ((target >= 0) & (target <= size)).all(-1)
    return (target - pixels).astype(np.float32), sample(valid, recorded) & inside
