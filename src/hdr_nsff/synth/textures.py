"""Procedural pictures for the synthetic room: linear albedo (or sky radiance) as (H, W,
3) float32, detailed at every scale a small frame can show, so that features and optical
flow find something to hold on to everywhere.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

DARK, BRIGHT = 0.04, 0.82  # albedo of ink and of paper


def noise(
    height: int, width: int, rng: np.random.Generator, cells: int = 4, octaves: int = 6
) -> np.ndarray:
    """Value noise with a 1/f spectrum, (H, W) in [0, 1]; the coarsest octave has
    `cells` cells across.
    """
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        n = cells * 2**octave
        grid = rng.random((max(2, n * height // width), n), dtype=np.float32)
        total += np.asarray(
            cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC), np.float32
        ) / 2 ** (0.7 * octave)
    low, high = np.percentile(total, [1, 99])
    return np.clip((total - low) / (high - low), 0, 1)


def color(
    rng: np.random.Generator, low: float = DARK, high: float = BRIGHT, saturation: float = 0.5
) -> np.ndarray:
    """A random albedo (3,), its lightness spread evenly in log scale."""
    lightness = np.exp(rng.uniform(np.log(low), np.log(high)))
    return np.clip(
        lightness * (1 + saturation * (rng.random(3) - 0.5) * 2), DARK / 2, BRIGHT
    ).astype(np.float32)


def bricks(
    height: int,
    width: int,
    rng: np.random.Generator,
    rows: int = 14,
    base: tuple = (0.42, 0.22, 0.15),
) -> np.ndarray:
    """Courses of bricks, each its own shade, with light mortar and grain."""
    image = np.full((height, width, 3), 0.55, np.float32)
    h = height / rows
    for row in range(rows):
        edges = np.cumsum(rng.uniform(1.6, 3.0, 64)) * h - 3 * h * rng.random()
        for left, right in itertools.pairwise(edges):
            shade = np.asarray(base) * np.exp(rng.normal(0, 0.55)) * (1 + 0.25 * rng.normal(size=3))
            top, low = (int(row * h), int((row + 0.9) * h))
            image[top:low, max(0, int(left)) : max(0, int(right - 0.1 * h))] = np.clip(
                shade, DARK, BRIGHT
            )
    return grained(image, rng, 0.6)


def planks(
    height: int,
    width: int,
    rng: np.random.Generator,
    rows: int = 9,
    base: tuple = (0.36, 0.22, 0.12),
) -> np.ndarray:
    """Boards along x, each its own shade, with grain along the board, knots and dark
    gaps.
    """
    image = np.empty((height, width, 3), np.float32)
    edges = np.linspace(0, height, rows + 1).astype(int)
    for top, low in itertools.pairwise(edges):
        cuts = np.unique(np.r_[0, rng.integers(0, width, 2), width])
        for left, right in itertools.pairwise(cuts):
            image[top:low, left:right] = np.clip(
                np.asarray(base) * np.exp(rng.normal(0, 0.5)), DARK, BRIGHT
            )
            image[top:low, max(0, right - 2) : right] *= 0.25
        image[max(top, low - 2) : low] *= 0.25
    grain = cv2.resize(
        noise(height, max(8, width // 8), rng, 8, 5), (width, height), interpolation=cv2.INTER_CUBIC
    )
    image *= (0.5 + grain)[..., None]
    for _ in range(height * width // 4000):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.ellipse(
            image,
            center,
            (int(rng.integers(3, 8)), int(rng.integers(2, 4))),
            0,
            0,
            360,
            (0.05, 0.03, 0.02),
            -1,
        )
    return grained(image, rng, 0.3)


def tiles(height: int, width: int, rng: np.random.Generator, rows: int = 10) -> np.ndarray:
    """A mosaic floor: square tiles of random shade, every third with a figure of its
    own, dark joints.
    """
    image = np.full((height, width, 3), 0.08, np.float32)
    side = height / rows
    for i in range(rows):
        for j in range(int(np.ceil(width / side))):
            top, left, size = int(i * side), int(j * side), int(side) - 2
            image[top : top + size, left : left + size] = color(rng, 0.08, 0.75, 0.35)
            center = (int(left + size / 2), int(top + size / 2))
            match rng.integers(4):
                case 0:
                    cv2.circle(
                        image,
                        center,
                        int(size * rng.uniform(0.2, 0.4)),
                        color(rng).tolist(),
                        -1,
                        cv2.LINE_AA,
                    )
                case 1:
                    box = cv2.boxPoints(
                        (center, (size * 0.6, size * 0.3), float(rng.uniform(0, 180)))
                    )
                    cv2.fillPoly(image, [box.astype(np.int32)], color(rng).tolist(), cv2.LINE_AA)
                case _:
                    pass
    return grained(image, rng, 0.5)


def poster(
    height: int, width: int, rng: np.random.Generator, paper: float = 0.6, figures: int = 60
) -> np.ndarray:
    """Print: overlapping discs, bars and triangles from large to small, and lines of
    letters.
    """
    image = np.full((height, width, 3), 255 * paper * (0.7 + 0.6 * color(rng, 0.3, 0.8))).astype(
        np.uint8
    )  # letters need 8 bits
    for k in range(figures):
        size = max(4.0, 0.7 * min(height, width) / (1 + k) ** 0.4)
        x, y = int(rng.integers(width)), int(rng.integers(height))
        ink = (255 * color(rng, DARK, BRIGHT, 0.7)).tolist()
        match rng.integers(4):
            case 0:
                cv2.circle(image, (x, y), int(size / 2), ink, -1, cv2.LINE_AA)
            case 1:
                box = cv2.boxPoints(
                    ((x, y), (size, size * rng.uniform(0.2, 0.8)), float(rng.uniform(0, 180)))
                )
                cv2.fillPoly(image, [box.astype(np.int32)], ink, cv2.LINE_AA)
            case 2:
                triangle = np.array([x, y]) + rng.normal(0, size / 2, (3, 2))
                cv2.fillPoly(image, [triangle.astype(np.int32)], ink, cv2.LINE_AA)
            case _:
                word = "".join(chr(c) for c in rng.integers(65, 91, 4))
                cv2.putText(
                    image,
                    word,
                    (x, y),
                    cv2.FONT_HERSHEY_SIMPLEX,
                    size / 40,
                    ink,
                    max(1, int(size / 12)),
                    cv2.LINE_AA,
                )
    return grained(image.astype(np.float32) / 255, rng, 0.3)


def plaster(height: int, width: int, rng: np.random.Generator, base: float = 0.5) -> np.ndarray:
    """Old plaster: stains at several scales and dark specks."""
    stains = noise(height, width, rng, 6, 6)
    image = base * (0.35 + 1.0 * stains)[..., None] * np.array([1.0, 0.96, 0.88], np.float32)
    for _ in range(height * width // 700):
        center = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.circle(
            image,
            center,
            int(rng.integers(1, 5)),
            color(rng, 0.06, 0.6, 0.2).tolist(),
            -1,
            cv2.LINE_AA,
        )
    return np.clip(image, DARK, BRIGHT).astype(np.float32)


def books(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """A row of book spines of other heights and shades, with title bars, before a dark
    back.
    """
    image = np.full((height, width, 3), 0.05, np.float32)
    x = 0
    while x < width:
        w = int(rng.integers(max(3, width // 30), max(5, width // 12)))
        top = int(height * rng.uniform(0.02, 0.3))
        image[top:, x : x + w - 1] = color(rng, 0.06, 0.75, 0.7)
        for _ in range(3):
            y = int(rng.uniform(top, height * 0.92))
            image[y : y + max(2, height // 16), x + 1 : x + w - 2] = color(rng)
        x += w
    return grained(image, rng, 0.2)


def sky(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """What a window shows, as radiance around 1 to 3 (the sun's veil higher): clouds,
    roofs and bare trees before them.
    """
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    clear = (
        np.array([0.55, 0.95, 1.7], np.float32) * (1 - y)
        + np.array([1.5, 1.6, 1.7], np.float32) * y
    )
    cloud = np.clip(noise(height, width, rng, 4, 6) * 1.8 - 0.6, 0, 1)[..., None]
    image = clear * (1 - cloud) + 2.6 * cloud
    yy, xx = np.mgrid[:height, :width].astype(np.float32)
    image += (
        5
        * np.exp(-(((xx - 0.72 * width) ** 2 + (yy - 0.25 * height) ** 2) / (0.09 * width) ** 2))[
            ..., None
        ]
    )
    x = 0
    while x < width:
        w = int(rng.integers(width // 14, width // 6))
        top = int(height * rng.uniform(0.6, 0.85))
        image[top:, x : x + w] = color(rng, 0.15, 0.7, 0.4)
        for row in range(top + 4, height - 4, 9):
            for column in range(x + 4, min(x + w, width) - 6, 8):
                image[row : row + 4, column : column + 4] = color(rng, 0.06, 1.6, 0.3)
        x += w
    return np.ascontiguousarray(image, np.float32)


def grained(image: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """`image` times 1/f grain, kept a physical albedo."""
    grain = noise(image.shape[0], image.shape[1], rng, 12, 5)[..., None]
    return np.clip(image * (1 + strength * (grain - 0.5)), DARK / 2, BRIGHT).astype(np.float32)
