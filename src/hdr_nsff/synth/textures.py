"""Procedural textures of the synthetic scenes: linear albedo (or sky radiance) as
(H, W, 3) float32, detailed at every scale that a small frame can show, so that features
and optical flow find something to match everywhere.

Their shapes, shades and counts are chosen by eye on rendered scenes.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

DARK, BRIGHT = 0.04, 0.82  # albedo of ink and of paper
FILLED = -1  # OpenCV's thickness of a filled figure
KNOT = (0.05, 0.03, 0.02)  # albedo of a knot in wood


def noise(
    height: int, width: int, rng: np.random.Generator, cells: int = 4, octaves: int = 6
) -> np.ndarray:
    """Value noise with a 1/f spectrum, (H, W) in [0, 1]; the coarsest octave has
    `cells` cells across.
    """
    total = np.zeros((height, width), np.float32)
    for octave in range(octaves):
        columns = cells * 2**octave
        rows = max(2, columns * height // width)
        layer = enlarge(rng.random((rows, columns), dtype=np.float32), height, width)
        total += layer / 2 ** (0.7 * octave)
    low, high = np.percentile(total, [1, 99])
    return np.clip((total - low) / (high - low), 0, 1)


def enlarge(grid: np.ndarray, height: int, width: int) -> np.ndarray:
    """A map (h, w) at another size, by cubic interpolation."""
    return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC))


def color(
    rng: np.random.Generator, low: float = DARK, high: float = BRIGHT, saturation: float = 0.5
) -> np.ndarray:
    """A random albedo (3,), its lightness spread evenly in log scale."""
    lightness = np.exp(rng.uniform(np.log(low), np.log(high)))
    tint = 1 + saturation * (rng.random(3) - 0.5) * 2
    return np.clip(lightness * tint, DARK / 2, BRIGHT).astype(np.float32)


def bricks(
    height: int,
    width: int,
    rng: np.random.Generator,
    rows: int = 14,
    base: tuple = (0.42, 0.22, 0.15),
) -> np.ndarray:
    """Courses of bricks, each its own shade, with light mortar and grain."""
    image = np.full((height, width, 3), 0.55, np.float32)
    course = height / rows
    for row in range(rows):
        top = int(row * course)
        bottom = int((row + 0.9) * course)
        edges = np.cumsum(rng.uniform(1.6, 3.0, 64)) * course - 3 * course * rng.random()
        for left, right in itertools.pairwise(edges):
            shade = np.asarray(base) * np.exp(rng.normal(0, 0.55)) * (1 + 0.25 * rng.normal(size=3))
            columns = slice(max(0, int(left)), max(0, int(right - 0.1 * course)))
            image[top:bottom, columns] = np.clip(shade, DARK, BRIGHT)
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
    for top, bottom in itertools.pairwise(edges):
        cuts = np.unique(np.r_[0, rng.integers(0, width, 2), width])
        for left, right in itertools.pairwise(cuts):
            shade = np.asarray(base) * np.exp(rng.normal(0, 0.5))
            image[top:bottom, left:right] = np.clip(shade, DARK, BRIGHT)
            image[top:bottom, max(0, right - 2) : right] *= 0.25
        image[max(top, bottom - 2) : bottom] *= 0.25
    grain = enlarge(noise(height, max(8, width // 8), rng, 8, 5), height, width)
    image *= (0.5 + grain)[..., None]
    for _ in range(height * width // 4000):
        center = random_pixel(height, width, rng)
        axes = int(rng.integers(3, 8)), int(rng.integers(2, 4))
        cv2.ellipse(image, center, axes, 0, 0, 360, KNOT, FILLED)
    return grained(image, rng, 0.3)


def tiles(height: int, width: int, rng: np.random.Generator, rows: int = 10) -> np.ndarray:
    """A mosaic floor: square tiles of random shade, half of them with a figure, dark
    joints.
    """
    image = np.full((height, width, 3), 0.08, np.float32)
    side = height / rows
    size = int(side) - 2
    columns = int(np.ceil(width / side))
    for i, j in itertools.product(range(rows), range(columns)):
        top = int(i * side)
        left = int(j * side)
        image[top : top + size, left : left + size] = color(rng, 0.08, 0.75, 0.35)
        center = (int(left + size / 2), int(top + size / 2))
        match rng.integers(4):
            case 0:
                disc(image, center, int(size * rng.uniform(0.2, 0.4)), color(rng))
            case 1:
                angle = float(rng.uniform(0, 180))
                box = cv2.boxPoints((center, (size * 0.6, size * 0.3), angle))
                polygon(image, box, color(rng))
            case _:
                pass
    return grained(image, rng, 0.5)


def poster(
    height: int, width: int, rng: np.random.Generator, paper: float = 0.6, figures: int = 60
) -> np.ndarray:
    """Print: overlapping discs, bars and triangles from large to small, and lines of
    letters.
    """
    shade = 255 * paper * (0.7 + 0.6 * color(rng, 0.3, 0.8))
    image = np.full((height, width, 3), shade).astype(np.uint8)  # letters need 8 bits
    for k in range(figures):
        size = max(4.0, 0.7 * min(height, width) / (1 + k) ** 0.4)
        x, y = random_pixel(height, width, rng)
        ink = 255 * color(rng, DARK, BRIGHT, 0.7)
        match rng.integers(4):
            case 0:
                disc(image, (x, y), int(size / 2), ink)
            case 1:
                bar = (size, size * rng.uniform(0.2, 0.8))
                polygon(image, cv2.boxPoints(((x, y), bar, float(rng.uniform(0, 180)))), ink)
            case 2:
                polygon(image, np.array([x, y]) + rng.normal(0, size / 2, (3, 2)), ink)
            case _:
                word = "".join(chr(c) for c in rng.integers(65, 91, 4))
                letters(image, word, (x, y), size, ink)
    return grained(image.astype(np.float32) / 255, rng, 0.3)


def plaster(height: int, width: int, rng: np.random.Generator, base: float = 0.5) -> np.ndarray:
    """Old plaster: stains at several scales and dark specks."""
    stains = noise(height, width, rng, 6, 6)
    image = base * (0.35 + 1.0 * stains)[..., None] * np.array([1.0, 0.96, 0.88], np.float32)
    for _ in range(height * width // 700):
        center = random_pixel(height, width, rng)
        disc(image, center, int(rng.integers(1, 5)), color(rng, 0.06, 0.6, 0.2))
    return np.clip(image, DARK, BRIGHT).astype(np.float32)


def books(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """A row of book spines of different heights and shades, with title bars, before a
    dark back.
    """
    image = np.full((height, width, 3), 0.05, np.float32)
    x = 0
    while x < width:
        thickness = int(rng.integers(max(3, width // 30), max(5, width // 12)))
        top = int(height * rng.uniform(0.02, 0.3))
        image[top:, x : x + thickness - 1] = color(rng, 0.06, 0.75, 0.7)
        for _ in range(3):
            y = int(rng.uniform(top, height * 0.92))
            bar = slice(y, y + max(2, height // 16))
            image[bar, x + 1 : x + thickness - 2] = color(rng)
        x += thickness
    return grained(image, rng, 0.2)


def sky(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """The view from a window, as radiance around 1 to 3 (higher around the sun): houses
    before clouds.
    """
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    zenith = np.array([0.55, 0.95, 1.7], np.float32)
    horizon = np.array([1.5, 1.6, 1.7], np.float32)
    clear = zenith * (1 - y) + horizon * y
    cloud = np.clip(noise(height, width, rng, 4, 6) * 1.8 - 0.6, 0, 1)[..., None]
    image = clear * (1 - cloud) + 2.6 * cloud
    image += 5 * sun_glow(height, width)[..., None]
    x = 0
    while x < width:
        house = int(rng.integers(width // 14, width // 6))
        top = int(height * rng.uniform(0.6, 0.85))
        image[top:, x : x + house] = color(rng, 0.15, 0.7, 0.4)
        rows = range(top + 4, height - 4, 9)
        columns = range(x + 4, min(x + house, width) - 6, 8)
        for row, column in itertools.product(rows, columns):
            image[row : row + 4, column : column + 4] = color(rng, 0.06, 1.6, 0.3)
        x += house
    return np.ascontiguousarray(image, np.float32)


def sun_glow(height: int, width: int) -> np.ndarray:
    """Brightness (H, W) around the sun, 1 at its place."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    squared_distance = (x - 0.72 * width) ** 2 + (y - 0.25 * height) ** 2
    return np.exp(-(squared_distance / (0.09 * width) ** 2))


def random_pixel(height: int, width: int, rng: np.random.Generator) -> tuple[int, int]:
    """(x, y) anywhere in a picture."""
    x = int(rng.integers(width))
    return x, int(rng.integers(height))


def disc(image: np.ndarray, center: tuple[int, int], radius: int, ink: np.ndarray) -> None:
    """Draw a filled circle."""
    cv2.circle(image, center, radius, ink.tolist(), FILLED, cv2.LINE_AA)


def polygon(image: np.ndarray, corners: np.ndarray, ink: np.ndarray) -> None:
    """Draw a filled polygon of corners (P, 2) px."""
    cv2.fillPoly(image, [corners.astype(np.int32)], ink.tolist(), cv2.LINE_AA)


def letters(
    image: np.ndarray, word: str, place: tuple[int, int], size: float, ink: np.ndarray
) -> None:
    """Draw a word about `size` pixels high."""
    stroke = max(1, int(size / 12))
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, word, place, font, size / 40, ink.tolist(), stroke, cv2.LINE_AA)


def grained(image: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """`image` times 1/f grain, kept a physical albedo."""
    grain = noise(image.shape[0], image.shape[1], rng, 12, 5)[..., None]
    return np.clip(image * (1 + strength * (grain - 0.5)), DARK / 2, BRIGHT).astype(np.float32)
