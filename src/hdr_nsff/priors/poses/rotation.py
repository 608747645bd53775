"""Cameras without parallax: a tripod or a pan. Decides whether the footage is of that
kind, and recovers the rotations.

A camera that only turns sees every static point move by the homography `K R_j^T R_i
K^-1` (R camera to world). The rotations of all frames and the focal length are those
that explain the matches between near and far frames at once, so nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from hdr_nsff.priors.poses.matching import PairMatches

DEFAULT_FOV = 60.0  # degrees across the image, where the footage does not tell


@dataclass(frozen=True)
class Panorama:
    """The rotations of a camera that stands still."""

    rotations: np.ndarray  # (T, 3, 3) camera to world; the middle frame looks along +z
    linked: np.ndarray  # (T,) bool: enough matches tie this frame to the others
    focal: float  # pixels
    focal_known: bool  # else the default field of view
    # a sideways shift before something flat explains the matches much better than any
    # turn does
    slides: bool
    explained: float  # share of the matches that these rotations explain to 2 px
    errors: np.ndarray  # (T,) median residual in pixels, NaN where not linked
    # pixels: how far the image center or a corner ever strays from where it lies in the
    # middle frame
    motion: float


def default_focal(width: int) -> float:
    """The focal length in pixels of a camera with the default field of view."""
    return width / 2 / float(np.tan(np.radians(DEFAULT_FOV) / 2))


def epipolar(
    p: np.ndarray, q: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """The fundamental matrix (3, 3) that most of the matches p, q (M, 2) obey, and
    which (M,) bool do, to `threshold` pixels.
    """
    try:
        matrix, inlier = cv2.findFundamentalMat(p, q, cv2.USAC_MAGSAC, threshold, 0.999, 2000)
    except cv2.error:  # raised for matches so degenerate that no model fits at all
        matrix = None
    return (None, np.zeros(len(p), bool)) if matrix is None else (matrix, inlier.ravel() > 0)


def homography(
    p: np.ndarray, q: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """The homography (3, 3) that most of the matches p, q (M, 2) obey, and which (M,)
    bool do, to `threshold` pixels.
    """
    try:
        matrix, inlier = cv2.findHomography(
            p, q, cv2.USAC_MAGSAC, threshold, maxIters=2000, confidence=0.999
        )
    except cv2.error:
        matrix = None
    return (None, np.zeros(len(p), bool)) if matrix is None else (matrix, inlier.ravel() > 0)


def rotation_share(
    matches: list[PairMatches], found: Panorama, width: int, height: int, least: int = 30
) -> float | None:
    """How much of what an epipolar geometry explains these rotations explain as well,
    in [0, 1], over pairs far apart in time.

    Near 1 for a camera that only turns, well below with parallax; a flat scene does not
    deceive it. Explained means to 1.5 pixels, or 0.4 % of the width. None where too few
    pairs far apart match at all.
    """
    wide = max((m.j - m.i for m in matches), default=0) / 6
    center, tolerance = np.array([width / 2, height / 2]), max(1.5, 0.004 * width)
    rotational = general = 0
    for m in matches:
        if m.j - m.i < wide or len(m.p) < least:
            continue
        static = epipolar(m.p, m.q, 1.0)[1]
        if static.sum() < least:
            continue
        ends = np.tile([m.i, m.j], (int(static.sum()), 1))
        predicted = turned(found.rotations, found.focal, ends, m.p[static] - center)[0]
        rotational += int(
            (np.linalg.norm(predicted + center - m.q[static], axis=1) < tolerance).sum()
        )
        general += int(static.sum())
    return rotational / general if general >= 5 * least else None


def panorama(matches: list[PairMatches], count: int, width: int, height: int) -> Panorama | None:
    """Rotations of all `count` frames, and the focal length where the turn is wide
    enough to tell. None where nothing matches.
    """
    kept, homographies = planar_matches(matches)
    if not kept:
        return None
    center = np.array([width / 2, height / 2])
    rotations, linked = chain(kept, homographies, count, default_focal(width), center)
    kept = [m for m in kept if linked[m.i] and linked[m.j]]
    ends = np.repeat([(m.i, m.j) for m in kept], [len(m.p) for m in kept], axis=0)  # (M, 2)
    p, q = (np.concatenate(x) - center for x in ([m.p for m in kept], [m.q for m in kept]))
    rotations, _, _ = refine(rotations, default_focal(width), ends, p, q, False)
    free, focal, spread = refine(rotations, default_focal(width), ends, p, q, True)
    fov = np.degrees(2 * np.arctan(width / 2 / focal))
    known = bool(spread < 0.05 and 25 < fov < 120)
    # through an endlessly long lens a turn is a shift of the picture
    slides = bool(fov <= 25) and cost(rotations, default_focal(width), ends, p, q) > 1.5 * cost(
        free, focal, ends, p, q
    )
    rotations, focal = (free, focal) if known else (rotations, default_focal(width))
    residual = np.linalg.norm(turned(rotations, focal, ends, p)[0] - q, axis=1)
    errors = np.full(count, np.nan)
    for t in np.unique(ends):
        errors[t] = np.median(residual[(ends == t).any(1)])
    rotations = rotations[count // 2].T @ rotations
    return Panorama(
        rotations=rotations,
        linked=linked,
        focal=focal,
        focal_known=known,
        slides=slides,
        explained=float((residual < 2).mean()),
        errors=errors,
        motion=stray(rotations[linked], focal, width, height),
    )


def planar_matches(
    matches: list[PairMatches], least: int = 20, most: int = 60
) -> tuple[list[PairMatches], list[np.ndarray]]:
    """Of every pair that a homography explains (at least `least` matches, a third of
    all): at most `most` of those matches, and the homography.
    """
    kept, homographies = [], []
    for m in matches:
        if len(m.p) < least:
            continue
        h, inlier = homography(m.p, m.q, 1.5)
        chosen = np.flatnonzero(inlier)
        if h is not None and len(chosen) >= max(least, len(m.p) / 3):
            chosen = chosen[np.linspace(0, len(chosen) - 1, min(most, len(chosen))).astype(int)]
            kept.append(PairMatches(m.i, m.j, m.p[chosen], m.q[chosen]))
            homographies.append(h)
    return kept, homographies


def chain(
    kept: list[PairMatches],
    homographies: list[np.ndarray],
    count: int,
    focal: float,
    center: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """First rotations (T, 3, 3) along the best-matched tree of pairs, and which frames
    (T,) it reaches from the best-linked one.
    """
    K = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    edges = {
        (m.i, m.j): nearest_rotation(np.linalg.inv(K) @ h @ K)
        for m, h in zip(kept, homographies, strict=True)
    }  # R_j^T R_i
    i, j = np.array(list(edges)).T
    lengths = 1.0 / np.array([len(m.p) for m in kept]) * (1 + 0.01 * (j - i))
    tree = minimum_spanning_tree(coo_matrix((lengths, (i, j)), shape=(count, count)))
    order, parent = max(
        (
            breadth_first_order(tree, int(t), directed=False)
            for t in np.unique(i)[:: max(1, len(np.unique(i)) // 8)]
        ),
        key=lambda found: len(found[0]),
    )
    rotations, linked = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count, bool)
    linked[order] = True
    for t in order[1:]:
        s = parent[t]
        rotations[t] = rotations[s] @ (edges[(s, t)].T if (s, t) in edges else edges[(t, s)])
    return rotations, linked


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) nearest to a matrix known up to scale."""
    u, _, vt = np.linalg.svd(matrix / np.cbrt(np.linalg.det(matrix)))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt


def turned(
    rotations: np.ndarray, focal: float, ends: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where frame j sees points `p` (M, 2) of frame i, both in pixels from the image
    center, and their directions (M, 3) in frame j.
    """
    bearing = np.concatenate([p / focal, np.ones((len(p), 1))], 1)
    seen = np.einsum(
        "mji,mj->mi", rotations[ends[:, 1]], np.einsum("mij,mj->mi", rotations[ends[:, 0]], bearing)
    )
    return focal * seen[:, :2] / np.maximum(seen[:, 2:], 1e-3), seen


def refine(
    rotations: np.ndarray,
    focal: float,
    ends: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    free_focal: bool,
    steps: int = 40,
) -> tuple[np.ndarray, float, float]:
    """Rotations and focal length with the least robust (Cauchy, 1 px) residual over all
    matches, by Levenberg-Marquardt; and how uncertain the logarithm of the focal length
    is (standard deviation).

    `rotations` (T, 3, 3) camera to world; `ends` (M, 2) the frames i, j of each match;
    `p`, `q` (M, 2) pixels from the image center.
    """
    damping, least = 1e-4, cost(rotations, focal, ends, p, q)
    normal, right = normal_equations(rotations, focal, ends, p, q, free_focal)
    for _ in range(steps):
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
        turned_on = rotations @ Rotation.from_rotvec(step[:-1].reshape(-1, 3)).as_matrix()
        longer = float(focal * np.exp(np.clip(step[-1], -0.3, 0.3)))
        now = cost(turned_on, longer, ends, p, q)
        if now >= least:
            damping *= 10
            if damping > 1e6:
                break
            continue
        rotations, focal, damping = turned_on, longer, damping / 10
        normal, right = normal_equations(rotations, focal, ends, p, q, free_focal)
        if least - now < 1e-7 * least:
            break
        least = now
    residual = np.linalg.norm(turned(rotations, focal, ends, p)[0] - q, axis=1)
    # a point is matched about ten times over: those errors are one error
    return (
        rotations,
        focal,
        float(1.48 * np.median(residual) * np.sqrt(np.linalg.inv(normal)[-1, -1] * 10)),
    )


def normal_equations(
    rotations: np.ndarray,
    focal: float,
    ends: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    free_focal: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """J^T W J (3T + 1, 3T + 1) and J^T W r (3T + 1) of the matches; unknowns are three
    turns per frame and the logarithm of the focal length.
    """
    count = len(rotations)
    predicted, seen = turned(rotations, focal, ends, p)
    residual = q - predicted  # (M, 2)
    weight = 1 / (1 + np.sum(residual**2, 1))
    jacobian = derivatives(rotations, focal, ends, p, seen)  # (M, 2, 7)
    columns = np.concatenate(
        [
            3 * ends[:, :1] + np.arange(3),
            3 * ends[:, 1:] + np.arange(3),
            np.full((len(p), 1), 3 * count),
        ],
        1,
    )
    normal, right = np.zeros((3 * count + 1,) * 2), np.zeros(3 * count + 1)
    np.add.at(
        normal,
        (columns[:, :, None], columns[:, None, :]),
        np.einsum("mki,m,mkj->mij", jacobian, weight, jacobian),
    )
    np.add.at(right, columns, np.einsum("mki,m,mk->mi", jacobian, weight, residual))
    normal[np.diag_indices(3 * count)] += (
        1e-3 * focal**2
    )  # holds the common turn, which is free, and frames without matches
    normal[-1, -1] += 1.0 if free_focal else 1e18
    return normal, right


def cost(
    rotations: np.ndarray, focal: float, ends: np.ndarray, p: np.ndarray, q: np.ndarray
) -> float:
    """The mean robust residual that `refine` lowers, `log(1 + r^2)`, of matches in
    pixels from the image center.
    """
    return float(np.mean(np.log1p(np.sum((turned(rotations, focal, ends, p)[0] - q) ** 2, 1))))


def derivatives(
    rotations: np.ndarray, focal: float, ends: np.ndarray, p: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """How `turned` moves (M, 2, 7) when frame i turns (3, right-hand perturbation),
    frame j turns (3), log focal grows (1).
    """
    z = np.maximum(seen[:, 2], 1e-3)
    project = np.zeros((len(p), 2, 3))  # pixels per direction
    project[:, 0, 0] = project[:, 1, 1] = focal / z
    project[:, :, 2] = -focal * seen[:, :2] / z[:, None] ** 2
    bearing = np.concatenate([p / focal, np.ones((len(p), 1))], 1)
    relative = np.einsum("mki,mkj->mij", rotations[ends[:, 1]], rotations[ends[:, 0]])  # R_j^T R_i
    by_i = -project @ relative @ cross(bearing)
    by_j = project @ cross(seen)
    shrink = np.einsum("mij,mj->mi", relative[:, :, :2], -p / focal)
    by_focal = focal * seen[:, :2] / z[:, None] + np.einsum("mki,mi->mk", project, shrink)
    return np.concatenate([by_i, by_j, by_focal[:, :, None]], 2)


def cross(v: np.ndarray) -> np.ndarray:
    """Matrices (M, 3, 3) with `cross(v) @ w == np.cross(v, w)`."""
    m = np.zeros((len(v), 3, 3))
    m[:, 0, 1], m[:, 0, 2], m[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return m - np.swapaxes(m, 1, 2)


def stray(rotations: np.ndarray, focal: float, width: int, height: int) -> float:
    """The farthest, in pixels, that any of `rotations` (T, 3, 3) carries the image's
    center or a corner from where the middle frame has it.
    """
    spots = np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]]) * np.array([width, height]) / 2
    middle = len(rotations) // 2
    ends = np.stack(
        [np.repeat(np.arange(len(rotations)), 5), np.full(5 * len(rotations), middle)], 1
    )
    p = np.tile(spots, (len(rotations), 1))
    return float(np.linalg.norm(turned(rotations, focal, ends, p)[0] - p, axis=1).max())
