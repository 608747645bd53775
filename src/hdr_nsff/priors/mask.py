"""Which pixels move by themselves: those whose optical flow the camera's own motion does not explain.

Flow between neighbours is chained over a few frames, so that slow motion rises above the noise of flow. `rough_mask` needs no
poses: it asks whether a pixel obeys the epipolar geometry (or the homography) that most pixels obey. `geometric_mask` has poses: it asks
whether one depth explains where a pixel goes in all frames around it. That also finds what moves along epipolar lines, asks no depth
of cameras that only turn, and forgives a pixel that is hidden in some of the frames: only the others are asked. Residuals are
measured in units of the static scene's own noise, voted on along the flow, and cleaned up. True is moving."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from hdr_nsff.priors.flow import follow
from hdr_nsff.priors.rotation import epipolar, homography
from hdr_nsff.progress import say, track

REACH = 6  # neighbours looked at on each side
WORKING = 100_000  # pixels: larger frames are judged on a coarser grid
QUIET, LOUD = 0.15, 1.0  # pixels: bounds of the noise of flow over one step
LIKELY, SURE = 2.5, 5.0  # residual in units of noise: how far a moving object reaches, and what proves one
HIGHEST = 8.0  # residuals beyond this many units of noise say no more than this
SMALLEST = 0.0012  # share of the frame below which nothing counts as an object
LARGEST = 0.6  # share of a frame beyond which a mask is doubted


@dataclass(frozen=True)
class Step:
    """What chained flow says about one other frame."""

    frame: int
    count: int  # links from here to there
    flow: np.ndarray  # (H, W, 2) px
    valid: np.ndarray  # (H, W) bool


@dataclass(frozen=True)
class Links:
    """For every frame the flow that leads to the next and to the previous one, on the working grid."""

    flow: np.ndarray  # (P, H, W, 2) px of the working grid
    valid: np.ndarray  # (P, H, W) bool
    to: tuple[dict[int, tuple[int, int]], dict[int, tuple[int, int]]]  # forward, backward: frame -> (pair, other frame)
    coarseness: int  # pixels of the frames per pixel of the working grid
    size: tuple[int, int]  # height, width of the frames


Residuals = Callable[[int, list[Step]], np.ndarray]  # frame, what flow says -> (steps, H, W) px, also where flow is not valid


def rough_mask(flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Moving pixels (T, H, W) bool from flow alone: those that disagree with any one epipolar geometry, or with any one homography
    where that explains the footage.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) bool of `pairs` (P, 2) (from, to); T is one more than the last frame named."""
    links = link(flow, valid, pairs)
    count = int(np.max(pairs)) + 1 if len(pairs) else 0
    fit = homography_residual if planar(links, count) else epipolar_residual
    return judge(links, count, lambda frame, steps: np.stack([fit(s.flow, s.valid) for s in steps]), "rough masks")


def geometric_mask(flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray, K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """Moving pixels (T, H, W) bool: those that no one depth explains in all the frames around.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) bool of `pairs` (P, 2) (from, to); `K` (3, 3) or (T, 3, 3) pixels; `c2w` (T, 3, 4)
    OpenCV. A frame that no pair starts from has nothing moving."""
    links = link(flow, valid, pairs)
    K = np.broadcast_to(K, (len(c2w), 3, 3)) * np.array([1 / links.coarseness, 1 / links.coarseness, 1])[:, None]
    return judge(links, len(c2w), lambda frame, steps: static_residual(frame, steps, K, c2w), "masks")


def link(flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray) -> Links:
    """The nearest neighbour of every frame in each direction that flow leads to, on a grid of at most `WORKING` pixels."""
    to: tuple[dict[int, tuple[int, int]], dict[int, tuple[int, int]]] = ({}, {})
    for p, (i, j) in enumerate(np.asarray(pairs, int).reshape(-1, 2).tolist()):
        known = to[int(j < i)]
        if i not in known or abs(j - i) < abs(known[i][1] - i):
            known[i] = (p, j)
    height, width = flow.shape[1:3]
    coarseness = int(np.ceil(np.sqrt(height * width / WORKING)))
    if coarseness > 1:
        small = (-(-width // coarseness), -(-height // coarseness))
        flow = np.stack([cv2.resize(f.astype(np.float32), small, interpolation=cv2.INTER_AREA) for f in flow]) / coarseness
        valid = np.stack([cv2.resize(v.astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0.5 for v in valid])
    return Links(flow, valid, to, coarseness, (height, width))


def steps_from(links: Links, frame: int) -> list[Step]:
    """The frames up to `REACH` links after and before `frame`, with the flow chained to them."""
    found = []
    for direction in links.to:
        at, total, valid = frame, np.zeros((*links.flow.shape[1:3], 2), np.float32), np.ones(links.flow.shape[1:3], bool)
        for count in range(1, REACH + 1):
            if at not in direction:
                break
            pair, at = direction[at]
            valid = valid & (follow(links.valid[pair].astype(np.float32), total, fill=0.0) > 0.99)
            total = total + follow(links.flow[pair].astype(np.float32), total)
            found.append(Step(at, count, total, valid))
    return found


def grid(shape: tuple[int, ...]) -> np.ndarray:
    """Pixel centres (H, W, 2), xy."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.stack([x, y], -1) + 0.5


def sample(flow: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matches (M, 2), (M, 2) on every fourth pixel of every fourth row where flow is valid."""
    here = grid(valid.shape)
    chosen = np.zeros(valid.shape, bool)
    chosen[2::4, 2::4] = valid[2::4, 2::4]
    return here[chosen], (here + flow)[chosen]


def planar(links: Links, count: int) -> bool:
    """Whether homographies explain nine tenths of what epipolar geometries explain, over the median frame."""
    shares = []
    for frame in range(0, count, max(1, count // 12)):
        steps = [s for s in steps_from(links, frame) if s.valid.mean() > 0.1]
        if steps:
            p, q = sample(steps[-1].flow, steps[-1].valid)
            general = int(epipolar(p, q, 0.5)[1].sum()) if len(p) >= 20 else 0
            if general:
                shares.append(int(homography(p, q, 0.5)[1].sum()) / general)
    return bool(shares) and float(np.median(shares)) > 0.9


def epipolar_residual(flow: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Sampson's distance (H, W) px of the flow from the epipolar geometry that most valid flow obeys; 0 where there is none."""
    p, q = sample(flow, valid)
    matrix = epipolar(p, q, 0.5)[0] if len(p) >= 20 else None
    if matrix is None or matrix.shape != (3, 3):
        return np.zeros(valid.shape)
    here = grid(valid.shape)
    ones = np.ones((*valid.shape, 1))
    start, end = np.concatenate([here, ones], -1), np.concatenate([here + flow, ones], -1)
    line, back = start @ matrix.T, end @ matrix
    slope = np.sum(line[..., :2] ** 2, -1) + np.sum(back[..., :2] ** 2, -1)
    return np.abs(np.sum(end * line, -1)) / np.sqrt(np.maximum(slope, 1e-20))


def homography_residual(flow: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Distance (H, W) px of the flow from the homography that most valid flow obeys; 0 where there is none."""
    p, q = sample(flow, valid)
    matrix = homography(p, q, 0.5)[0] if len(p) >= 20 else None
    if matrix is None:
        return np.zeros(valid.shape)
    here = grid(valid.shape)
    predicted = cv2.perspectiveTransform(here.reshape(-1, 1, 2), matrix).reshape(here.shape)
    return np.linalg.norm(here + flow - predicted, axis=-1)


def static_residual(frame: int, steps: list[Step], K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """How far (steps, H, W), in pixels, the flow ends from where a static point at the best depth would.

    A point at inverse depth `rho >= 0` along a pixel's ray is, in another camera, `turned + rho * shift`; that it lies on the ray
    through the flow's end is linear in rho. Solved over all frames at once, robustly; flow that is not valid counts only over
    one step, and only where nothing is valid."""
    here = np.concatenate([grid(steps[0].valid.shape), np.ones((*steps[0].valid.shape, 1))], -1)
    rays = here @ np.linalg.inv(K[frame]).T
    slopes, offsets, weights = [], [], []
    for s in steps:
        turned = rays @ (c2w[s.frame, :, :3].T @ c2w[frame, :, :3]).T
        shift = c2w[s.frame, :, :3].T @ (c2w[frame, :, 3] - c2w[s.frame, :, 3])
        end = (here[..., :2] + s.flow - K[s.frame, :2, 2]) / K[s.frame, (0, 1), (0, 1)]
        slopes.append((K[s.frame, 0, 0] * (shift[:2] - end * shift[2])).astype(np.float32))
        offsets.append((K[s.frame, 0, 0] * (turned[..., :2] - end * turned[..., 2:])).astype(np.float32))
        weights.append(np.where(s.valid, 1.0, 1e-3 if s.count == 1 else 0.0).astype(np.float32))
    slope, offset, trust = np.stack(slopes), np.stack(offsets), np.stack(weights)  # (steps, H, W, 2), (steps, H, W)
    product, square = np.sum(slope * offset, -1), np.sum(slope**2, -1)
    weight = trust
    for _ in range(3):
        rho = np.maximum(-np.sum(weight * product, 0) / (np.sum(weight * square, 0) + 1e-9), 0)
        residual = np.linalg.norm(slope * rho[..., None] + offset, axis=-1)
        weight = trust / (1 + (residual / 0.5) ** 2)
    return residual


def judge(links: Links, count: int, residuals: Residuals, report: str) -> np.ndarray:
    """Moving pixels (count, H, W) from how far flow is from a static scene's."""
    scores = np.zeros((count, *links.flow.shape[1:3]), np.float32)
    for frame in track(range(count), report):
        steps = steps_from(links, frame)
        if steps:
            scores[frame] = score(residuals(frame, steps), steps, links.coarseness)
    for _ in range(2):
        scores = vote(links, scores)
    height, width = links.size
    moving = np.zeros((count, height, width), bool)
    for frame in range(count):
        found = objects(scores[frame]).astype(np.uint8)
        grown = np.kron(found, np.ones((links.coarseness,) * 2, np.uint8))
        moving[frame] = grown[:height, :width] > 0
    large = np.flatnonzero(moving.mean((1, 2)) > LARGEST)
    if len(large):
        say(
            f"{report}: in {len(large)} of {count} frames more than {LARGEST:.0%} seems to move (first: frame {large[0]}); "
            "if that is wrong, give masks (--masks FOLDER) or flow (--flow FOLDER)"
        )
    return moving


def score(residual: np.ndarray, steps: list[Step], coarseness: int) -> np.ndarray:
    """How much (H, W) the residuals (steps, H, W) speak against a static scene, in units of noise, smoothed over a neighbourhood.

    The root mean square over valid flow; where none is valid, the smaller one of the two neighbours: what one side hides, the other shows."""
    units = np.empty_like(residual)
    for n, s in enumerate(steps):
        usual = 1.48 * float(np.median(residual[n][s.valid])) if s.valid.any() else LOUD
        noise = np.clip(usual, QUIET / coarseness, LOUD * np.sqrt(s.count) / coarseness)
        units[n] = np.minimum(residual[n] / noise, HIGHEST)
    valid = np.stack([s.valid for s in steps])
    total = valid.sum(0)
    strong = np.sqrt(np.sum(units**2 * valid, 0) / np.maximum(total, 1))
    weak = np.min(units[[s.count == 1 for s in steps]], 0)
    levels = np.rint(np.where(total > 0, strong, weak) * (255 / HIGHEST)).astype(np.uint8)
    return cv2.medianBlur(levels, 2 * round(len(levels) / 45) + 1).astype(np.float32) * (HIGHEST / 255)


def vote(links: Links, scores: np.ndarray) -> np.ndarray:
    """The median of each pixel's score and those where it was one frame before and will be one after; the mean where only one is known."""
    voted = scores.copy()
    for frame in range(len(scores)):
        ballots = [scores[frame]]
        for direction in links.to:
            if frame in direction:
                pair, other = direction[frame]
                ballots.append(follow(scores[other], links.flow[pair].astype(np.float32)))
        voted[frame] = np.median(ballots, 0)
    return voted


def objects(scores: np.ndarray) -> np.ndarray:
    """Moving objects (H, W) bool: connected where motion is likely, sure in part, not tiny; closed, filled, and one pixel larger."""
    labels, _ = ndimage.label(scores > LIKELY)
    least = SMALLEST * scores.size
    size = np.bincount(labels.ravel())
    proof = np.bincount(labels.ravel(), weights=(scores > SURE).ravel())
    kept = (size >= least) & (proof >= least / 4)
    kept[0] = False
    found = kept[labels].astype(np.uint8)
    radius = max(1, round(len(scores) / 68))
    found = cv2.morphologyEx(found, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2))
    found = ndimage.binary_fill_holes(found).astype(np.uint8)
    return cv2.dilate(found, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))) > 0
