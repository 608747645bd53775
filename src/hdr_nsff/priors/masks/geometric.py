"""Which pixels move by themselves: those whose optical flow the camera's own motion
does not explain.

Flow between neighbors is chained over a few frames, so that slow motion rises above the
noise of flow. `rough_mask` needs no poses: it asks whether a pixel obeys the epipolar
geometry (or the homography) that most pixels obey. `geometric_mask` has poses: it asks
whether one depth explains where a pixel goes in all frames around it. That also finds
what moves along epipolar lines, and asks no depth of cameras that only turn. Either way
the static answer must also explain the pictures worse than the flow does: where there
is no texture flow is a guess, and a guess convicts nobody. True is moving.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from hdr_nsff.core.progress import say, track
from hdr_nsff.geometry.round_trip import follow
from hdr_nsff.priors.poses.rotation import epipolar, homography

REACH = 6  # neighbors looked at on each side
WORKING = 100_000  # pixels: larger frames are judged on a coarser grid
QUIET, LOUD = (
    0.6,
    1.0,
)  # pixels: bounds of the noise of flow; the best flow still errs by so much beside edges
LIKELY, SURE = (
    1.25,
    2.5,
)  # residual in units of noise: how far a moving object reaches, and what proves one
HIGHEST = 4.0  # residuals beyond this many units of noise say no more than this
# pixels: where image noise alone shifts a patch by more than this, it is asked little
# and its neighbors instead
TEXTURE = 0.6
SMALLEST = 0.0012  # share of the frame below which nothing counts as an object
HOLE = 0.05  # share of the frame below which what movers (and the frame's edge) enclose moves too
LARGEST = 0.6  # share of a frame beyond which a mask is doubted
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class Step:
    """What chained flow says about one other frame."""

    frame: int
    count: int  # links from here to there
    flow: np.ndarray  # (H, W, 2) px
    valid: np.ndarray  # (H, W) bool


@dataclass(frozen=True)
class Footage:
    """A clip on the working grid, and for every frame the flow that leads to the next
    and to the previous one.
    """

    gray: np.ndarray  # (T, H, W) float32, equalized
    flow: np.ndarray  # (P, H, W, 2) px of the working grid
    valid: np.ndarray  # (P, H, W) bool
    to: tuple[
        dict[int, tuple[int, int]], dict[int, tuple[int, int]]
    ]  # forward, backward: frame -> (pair, other frame)
    coarseness: int  # pixels of the frames per pixel of the working grid
    size: tuple[int, int]  # height, width of the frames


Misses = Callable[
    [int, list[Step]], np.ndarray
]  # frame, what flow says -> (steps, H, W, 2) px from flow's end to the static answer


def rough_mask(
    flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray, video: np.ndarray
) -> np.ndarray:
    """Moving pixels (T, H, W) bool from flow alone: those that disagree with any one
    epipolar geometry, or with any one homography where that explains the footage.

    `flow` (P, H, W, 2) px and `valid` (P, H, W) bool of `pairs` (P, 2) (from, to);
    `video` (T, H, W, 3) equalized rgb in [0, 1]. A frame that no pair starts from has
    nothing moving.
    """
    footage = prepared(flow, valid, pairs, video)
    miss = homography_miss if planar(footage) else epipolar_miss
    return judge(
        footage,
        lambda frame, steps: np.stack([miss(s.flow, s.valid) for s in steps]),
        "rough masks",
    )


def geometric_mask(
    flow: np.ndarray,
    valid: np.ndarray,
    pairs: np.ndarray,
    video: np.ndarray,
    K: np.ndarray,
    c2w: np.ndarray,
) -> np.ndarray:
    """Moving pixels (T, H, W) bool: those that no one depth explains in all the frames
    around.

    As `rough_mask`, with `K` (3, 3) or (T, 3, 3) pixels and `c2w` (T, 3, 4) OpenCV.
    """
    footage = prepared(flow, valid, pairs, video)
    K = (
        np.broadcast_to(K, (len(c2w), 3, 3))
        * np.array([1 / footage.coarseness, 1 / footage.coarseness, 1])[:, None]
    )
    return judge(footage, lambda frame, steps: static_miss(frame, steps, K, c2w), "masks")


def prepared(flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray, video: np.ndarray) -> Footage:
    """The clip on a grid of at most `WORKING` pixels; of each frame's flows, those to
    the nearest frame in each direction.
    """
    to: tuple[dict[int, tuple[int, int]], dict[int, tuple[int, int]]] = ({}, {})
    for p, (i, j) in enumerate(np.asarray(pairs, int).reshape(-1, 2).tolist()):
        known = to[int(j < i)]
        if i not in known or abs(j - i) < abs(known[i][1] - i):
            known[i] = (p, j)
    height, width = video.shape[1:3]
    coarseness = int(np.ceil(np.sqrt(height * width / WORKING)))
    small = (-(-width // coarseness), -(-height // coarseness))

    def shrunk(image: np.ndarray) -> np.ndarray:
        image = image.astype(np.float32)
        return cv2.resize(image, small, interpolation=cv2.INTER_AREA) if coarseness > 1 else image

    return Footage(
        gray=np.stack([shrunk(cv2.GaussianBlur(frame @ LUMA, (0, 0), 0.7)) for frame in video]),
        flow=np.array([shrunk(f) / coarseness for f in flow], np.float32).reshape(
            -1, *small[::-1], 2
        ),
        valid=np.array([shrunk(v) > 0.5 for v in valid], bool).reshape(-1, *small[::-1]),
        to=to,
        coarseness=coarseness,
        size=(height, width),
    )


def steps_from(footage: Footage, frame: int) -> list[Step]:
    """The frames up to `REACH` links after and before `frame`, with the flow chained to
    them.
    """
    found = []
    for direction in footage.to:
        at, total, valid = (
            frame,
            np.zeros((*footage.gray.shape[1:], 2), np.float32),
            np.ones(footage.gray.shape[1:], bool),
        )
        for count in range(1, REACH + 1):
            if at not in direction:
                break
            pair, at = direction[at]
            valid = valid & (follow(footage.valid[pair].astype(np.float32), total, fill=0.0) > 0.99)
            total = total + follow(footage.flow[pair], total)
            found.append(Step(at, count, total, valid))
    return found


def grid(shape: tuple[int, ...]) -> np.ndarray:
    """Pixel centers (H, W, 2), xy."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.stack([x, y], -1) + 0.5


def sample(flow: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matches (M, 2), (M, 2) on every fourth pixel of every fourth row where flow is
    valid.
    """
    here = grid(valid.shape)
    chosen = np.zeros(valid.shape, bool)
    chosen[2::4, 2::4] = valid[2::4, 2::4]
    return here[chosen], (here + flow)[chosen]


def planar(footage: Footage) -> bool:
    """Whether homographies explain most of what epipolar geometries explain, over a few
    frames: a camera that only turns.
    """
    planar = general = 0
    for frame in range(0, len(footage.gray), max(1, len(footage.gray) // 12)):
        steps = [s for s in steps_from(footage, frame) if s.valid.mean() > 0.1]
        if steps:
            p, q = sample(steps[-1].flow, steps[-1].valid)
            general += int(epipolar(p, q, 0.5)[1].sum())
            planar += int(homography(p, q, 0.5)[1].sum())
    return planar > 0.6 * general


def epipolar_miss(flow: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """From the flow's end to the nearest point (H, W, 2) px of the epipolar line that
    most valid flow implies; 0 where there is none.
    """
    matrix = epipolar(*sample(flow, valid), 0.5)[0]
    if matrix is None or matrix.shape != (3, 3):
        return np.zeros(flow.shape, np.float32)
    here = grid(valid.shape)
    line = here @ matrix[:, :2].T + matrix[:, 2]  # (H, W, 3) in the other frame
    off = np.sum((here + flow) * line[..., :2], -1) + line[..., 2]
    return (
        -off[..., None]
        * line[..., :2]
        / np.maximum(np.sum(line[..., :2] ** 2, -1), 1e-20)[..., None]
    ).astype(np.float32)


def homography_miss(flow: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """From the flow's end to where the homography that most valid flow obeys leads, (H,
    W, 2) px; 0 where there is none.
    """
    matrix = homography(*sample(flow, valid), 0.5)[0]
    if matrix is None:
        return np.zeros(flow.shape, np.float32)
    here = grid(valid.shape)
    predicted = cv2.perspectiveTransform(here.reshape(-1, 1, 2), matrix).reshape(here.shape)
    return (predicted - here - flow).astype(np.float32)


def static_miss(frame: int, steps: list[Step], K: np.ndarray, c2w: np.ndarray) -> np.ndarray:
    """From the flow's end to where a static point at the best depth would be, (steps,
    H, W, 2) px.

    A point at inverse depth `rho >= 0` along a pixel's ray is, in another camera,
    `turned + rho * shift`; that it lies on the ray through the flow's end is linear in
    rho. Solved over all frames at once, robustly; flow that is not valid counts only
    over one step, and only where nothing is valid.
    """
    here = np.concatenate([grid(steps[0].valid.shape), np.ones((*steps[0].valid.shape, 1))], -1)
    rays = here @ np.linalg.inv(K[frame]).T
    slopes, offsets, trusts = [], [], []
    for s in steps:
        turned = rays @ (c2w[s.frame, :, :3].T @ c2w[frame, :, :3]).T
        shift = c2w[s.frame, :, :3].T @ (c2w[frame, :, 3] - c2w[s.frame, :, 3])
        end = (here[..., :2] + s.flow - K[s.frame, :2, 2]) / K[s.frame, (0, 1), (0, 1)]
        slopes.append((K[s.frame, 0, 0] * (shift[:2] - end * shift[2])).astype(np.float32))
        offsets.append(
            (K[s.frame, 0, 0] * (turned[..., :2] - end * turned[..., 2:])).astype(np.float32)
        )
        trusts.append(np.where(s.valid, 1.0, 1e-3 if s.count == 1 else 0.0).astype(np.float32))
    slope, offset, trust = (
        np.stack(slopes),
        np.stack(offsets),
        np.stack(trusts),
    )  # (steps, H, W, 2), (steps, H, W)
    product, square = np.sum(slope * offset, -1), np.sum(slope**2, -1)
    weight = trust
    for _ in range(3):
        rho = np.maximum(-np.sum(weight * product, 0) / (np.sum(weight * square, 0) + 1e-9), 0)
        miss = slope * rho[..., None] + offset
        weight = trust / (1 + np.sum(miss**2, -1) / 0.25)
    return miss


def judge(footage: Footage, misses: Misses, report: str) -> np.ndarray:
    """Moving pixels (T, H, W) from how far flow is from a static scene's."""
    scores = np.zeros_like(footage.gray)
    for frame in track(range(len(scores)), report):
        steps = steps_from(footage, frame)
        if steps:
            scores[frame] = score(footage, frame, steps, misses(frame, steps))
    for _ in range(2):
        scores = vote(footage, scores)
    height, width = footage.size
    moving = np.zeros((len(scores), height, width), bool)
    for frame, values in enumerate(scores):
        grown = np.kron(
            objects(values).astype(np.uint8), np.ones((footage.coarseness,) * 2, np.uint8)
        )
        moving[frame] = grown[:height, :width] > 0
    large = np.flatnonzero(moving.mean((1, 2)) > LARGEST)
    if len(large):
        say(
            f"{report}: in {len(large)} of {len(scores)} frames more than {LARGEST:.0%} seems to move (first: frame {large[0]}); "
            "if that is wrong, give masks (--masks FOLDER) or flow (--flow FOLDER)"
        )
    return moving


def score(footage: Footage, frame: int, steps: list[Step], misses: np.ndarray) -> np.ndarray:
    """How much (H, W) the `misses` (steps, H, W, 2) speak against a static scene, in
    units of its noise, smoothed over a neighborhood.

    The root mean square over valid flow; where none is valid, the smaller one of the
    two neighbors: what one side hides, the other shows.
    """
    textured = texture(footage.gray[frame])
    units = np.empty(misses.shape[:3], np.float32)
    for n, s in enumerate(steps):
        residual = np.linalg.norm(misses[n], axis=-1)
        known = s.valid & (textured > 0.5)
        usual = 1.48 * float(np.median(residual[known])) if known.sum() > 50 else LOUD
        noise = np.clip(
            usual, QUIET / footage.coarseness, LOUD * np.sqrt(s.count) / footage.coarseness
        )
        units[n] = np.minimum(residual / noise, HIGHEST) * worse(footage, frame, s, misses[n])
    valid = np.stack([s.valid for s in steps])
    total = valid.sum(0)
    strong = np.sqrt(np.sum(units**2 * valid, 0) / np.maximum(total, 1))
    weak = np.min(units[[s.count == 1 for s in steps]], 0)
    filled = spread(
        np.where(total > 0, strong, weak), textured * np.where(total > 0, 1, 0.3).astype(np.float32)
    )
    levels = np.rint(filled * (255 / HIGHEST)).astype(np.uint8)
    return cv2.medianBlur(levels, 2 * round(len(levels) / 45) + 1).astype(np.float32) * (
        HIGHEST / 255
    )


def worse(footage: Footage, frame: int, step: Step, miss: np.ndarray) -> np.ndarray:
    """How clearly (H, W), in [0, 1], the static answer matches the other picture worse
    than the flow does.
    """
    here, there = footage.gray[frame], footage.gray[step.frame]
    by_flow = cv2.boxFilter(np.abs(follow(there, step.flow) - here), -1, (5, 5))
    static = cv2.boxFilter(np.abs(follow(there, step.flow + miss) - here), -1, (5, 5))
    return np.clip((static - by_flow) / (0.3 * by_flow + 0.003), 0, 1)


def texture(gray: np.ndarray) -> np.ndarray:
    """How far (H, W), in [0, 1], a pixel's surroundings fix its position: `1 / (1 +
    (std / TEXTURE)^2)`, std in pixels by the smaller eigenvalue of the structure tensor
    and the image's own noise (Foerstner and Guelch 1987).
    """
    rough = cv2.Laplacian(gray, cv2.CV_32F, ksize=1)
    noise = np.clip(
        np.percentile(np.sqrt(cv2.boxFilter(rough**2, -1, (5, 5)) / 20), 20), 0.003, 0.012
    )
    x, y = (cv2.Sobel(gray, cv2.CV_32F, *d, ksize=3, scale=0.125) for d in ((1, 0), (0, 1)))
    xx, xy, yy = (cv2.boxFilter(v, -1, (5, 5), normalize=False) for v in (x * x, x * y, y * y))
    smaller = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return 1 / (1 + (noise / TEXTURE) ** 2 / np.maximum(smaller, 1e-9))


def spread(values: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """`values` (H, W) averaged by `confidence` (H, W) over as small a neighborhood as
    has any: from coarse to fine.
    """
    filled = np.full_like(
        values, float(np.sum(values * confidence) / max(float(confidence.sum()), 1e-6))
    )
    for sigma in (16.0, 8.0, 4.0, 2.0, 1.0):
        total = cv2.GaussianBlur(confidence, (0, 0), sigma)
        filled = (cv2.GaussianBlur(values * confidence, (0, 0), sigma) + 0.1 * filled) / (
            total + 0.1
        )
    return filled


def vote(footage: Footage, scores: np.ndarray) -> np.ndarray:
    """The median of each pixel's score and those where it was one frame before and will
    be one after; the mean where only one is known.
    """
    voted = scores.copy()
    for frame in range(len(scores)):
        ballots = [scores[frame]]
        for direction in footage.to:
            if frame in direction:
                pair, other = direction[frame]
                ballots.append(follow(scores[other], footage.flow[pair]))
        voted[frame] = np.median(ballots, 0)
    return voted


def objects(scores: np.ndarray) -> np.ndarray:
    """Moving objects (H, W) bool: connected where motion is likely, sure in part, not
    tiny; closed, filled, and one pixel larger.
    """
    labels, _ = ndimage.label(scores > LIKELY)
    least = SMALLEST * scores.size
    size = np.bincount(labels.ravel())
    proof = np.bincount(labels.ravel(), weights=(scores > SURE).ravel())
    kept = (size >= least) & (proof >= least / 4)
    kept[0] = False
    found = kept[labels].astype(np.uint8)
    radius = max(1, round(len(scores) / 68))
    found = cv2.morphologyEx(
        found, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    )
    holes, _ = ndimage.label(found == 0)
    found = np.where((np.bincount(holes.ravel()) < HOLE * scores.size)[holes], 1, found).astype(
        np.uint8
    )
    return cv2.dilate(found, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))) > 0
