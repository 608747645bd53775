"""The camera's response from static points seen in several exposures (Debevec and Malik
1997), before anything is trained.

Unknown is G = ln g^-1, the log exposure of a recorded value z. Where the paper keeps G
itself smooth, we write G(z) = a ln z + H(z) and keep H smooth: the darks then fall back
on a gamma curve, not on a straight line. H is linear between nodes even in
asin(sqrt(z)), dense at both ends, so that a saturating shoulder is smooth in it. Every
channel has its own G, the exposures are common. One linear least squares, reweighted a
few times against points that moved, were hidden or fell into shadow.

With no exposure known the recordings tell G and the log exposures only up to one common
factor (E^p explains them as well as E). That factor is then first chosen so that the
curves are, on average, as steep over the mid-tones as sRGB, which is off by a few per
cent (real video: 4 %, gamma 2.2: 7 %, a contrasty S-curve: 20 % and more), and then so
that the steps are usual ones, whole stops above all (bracketing.py). Their proportions
are measured.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from hdr_nsff.radiometry.bracketing import likely_factor

if TYPE_CHECKING:
    pass

LOW, HIGH = 3 / 255, 252.5 / 255  # recorded values outside tell too little
SATURATED = 254.5 / 255
NODES = 40
UNKNOWNS = NODES + 2  # the nodes of H, a and b
TYPICAL = (1.1, 0.5)  # a and b half way between gamma 2.2 and sRGB
LN2 = float(np.log(2))
MIN_SHARED = 60  # points that two brackets must share to be linked
MAX_MISFIT = 0.35  # stops: beyond this the points are not the same points


@dataclass(frozen=True)
class Samples:
    """Points recorded in several exposures."""

    rgb: np.ndarray  # (P, B, 3) recorded, in [0, 1]
    valid: np.ndarray  # (P, B, 3) bool: seen there, and away from black and saturation
    saturated: np.ndarray  # (P, B, 3) bool: seen there, and saturated


@dataclass(frozen=True)
class View:
    """One recorded frame with what is needed to find its static points in other frames."""

    image: np.ndarray  # (H, W, 3) recorded, in [0, 1]
    bracket: int
    time: float  # in frames
    K: np.ndarray  # (3, 3) pixels
    c2w: np.ndarray  # (3, 4) OpenCV, scene units
    disparity: np.ndarray  # (H, W) 1 / z-depth, scene units
    confidence: np.ndarray | None = None  # (H, W) in [0, 1]
    moving: np.ndarray | None = None  # (H, W) bool


@dataclass(frozen=True)
class ResponseFit:
    """A response curve and the exposures of the brackets."""

    x: np.ndarray  # (256,) exposure in [0, 1], even in x^(1/2.2)
    y: np.ndarray  # (3, 256) recorded value, rising from 0 to 1
    ev: np.ndarray  # (B,) log2 exposure, 0 at the reference bracket
    misfit: float  # median absolute misfit of a point's exposure, in stops
    guessed: bool  # no exposure was known: the common factor of all of `ev` is the likeliest one


@dataclass
class Equations:
    """One channel's linear equations `design @ [H, a, log exposures] = target`, the
    points' own radiance eliminated by centering.
    """

    design: np.ndarray  # (P, B, unknowns)
    target: np.ndarray  # (P, B)
    weight: (
        np.ndarray
    )  # (P, B) inverse variance of an observation up to a factor, 0 where it is not valid
    robust: np.ndarray  # (P, B) in (0, 1]

    def centered(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights (P, B), design and target, the last two minus their weighted mean
        over every point's observations.
        """
        w = self.weight * self.robust
        total = np.maximum(w.sum(1, keepdims=True), 1e-12)
        design = self.design - (w[..., None] * self.design).sum(1, keepdims=True) / total[..., None]
        return w, design, self.target - (w * self.target).sum(1, keepdims=True) / total

    def residuals(self, solution: np.ndarray) -> np.ndarray:
        """FrameError (P, B) of log exposure; 0 where nothing was observed."""
        _, design, target = self.centered()
        return np.where(self.weight > 0, target - design @ solution, 0.0)


def debevec(
    samples: Samples, ev: Sequence[float | None], reference: int, iterations: int = 8
) -> ResponseFit:
    """Response and exposures from `samples`; `ev` (B,) holds the known log2 exposures,
    None = to be estimated (the reference is 0).

    Every bracket must share points with the others, see `linked`.
    """
    assert samples.valid.shape == samples.rgb.shape and samples.rgb.shape[1] == len(ev), (
        samples.rgb.shape,
        len(ev),
    )
    log_exposure = np.array([LN2 * e if e is not None else 0.0 for e in ev])
    free = [b for b, e in enumerate(ev) if e is None and b != reference]
    guessed = (
        len(free) == len(ev) - 1 and len(free) > 0
    )  # nothing known but the reference: one common factor is free
    if guessed:
        pivot = max(
            free, key=lambda b: int((samples.valid[:, b] & samples.valid[:, reference]).sum())
        )
        log_exposure[pivot] = brightness_ratio(samples, pivot, reference) * LN2
        free.remove(pivot)
    equations = [
        channel_equations(samples.rgb[..., c], samples.valid[..., c], log_exposure, free)
        for c in range(3)
    ]
    log_exposure[free] = [brightness_ratio(samples, b, reference) * LN2 for b in free]
    curves = np.zeros((3, UNKNOWNS))
    curves[:, -2:] = TYPICAL
    noise = reweight(
        equations, curves, log_exposure[free]
    )  # a typical camera tells the worst outliers apart
    for _ in range(iterations):
        curves, log_exposure[free] = solve(equations, noise, len(free))
        noise = reweight(equations, curves, log_exposure[free])
    factor = typical_factor(curves) if guessed else 1.0
    factor *= likely_factor(log_exposure * factor / LN2) if guessed else 1.0
    misfit = np.concatenate(
        [np.abs(r[r != 0]) for r in all_residuals(equations, curves, log_exposure[free])]
    )
    tops = np.array([saturation(samples, c, curves[c], log_exposure) for c in range(3)])
    x, y = response_of(curves * factor, tops * factor)
    return ResponseFit(
        x,
        y,
        log_exposure * factor / LN2,
        float(np.median(misfit) * factor / LN2) if misfit.size else 0.0,
        guessed,
    )


def channel_equations(
    z: np.ndarray, valid: np.ndarray, log_exposure: np.ndarray, free: list[int]
) -> Equations:
    """G(z) - ln E - log exposure = 0 for values z (P, B) of one channel; the exposures
    of the brackets in `free` are unknown.
    """
    design = np.zeros((*z.shape, UNKNOWNS + len(free)))
    design[..., :UNKNOWNS] = basis(z)
    for k, b in enumerate(free):
        design[:, b, UNKNOWNS + k] = -1
    target = np.broadcast_to(
        np.where(np.isin(np.arange(z.shape[1]), free), 0.0, log_exposure), z.shape
    )
    seen_twice = valid & (valid.sum(1, keepdims=True) >= 2)
    weight = np.where(
        seen_twice, z**2 * np.clip((1 - z) / 0.1, 0, 1), 0.0
    )  # ln x is as uncertain as 1 / z; shoulders are flat
    return Equations(design, target, weight, np.ones_like(weight))


def basis(z: np.ndarray) -> np.ndarray:
    """The row [H's hat functions, ln z, ln of sRGB's linear value] (..., 42) whose
    product with a solution is G(z).
    """
    s = 2 / np.pi * np.arcsin(np.sqrt(np.clip(z, 0, 1))) * (NODES - 1)
    hats = np.clip(1 - np.abs(s[..., None] - np.arange(NODES)), 0, 1)
    z = np.maximum(z, 1e-4)
    return np.concatenate([hats, np.log(z)[..., None], np.log(srgb_to_linear(z))[..., None]], -1)


def srgb_to_linear(z: np.ndarray) -> np.ndarray:
    """Linear light of an sRGB value in [0, 1]."""
    return np.where(z <= 0.04045, z / 12.92, ((np.maximum(z, 0.04045) + 0.055) / 1.055) ** 2.4)


def solve(equations: list[Equations], noise: float, num_free: int) -> tuple[np.ndarray, np.ndarray]:
    """Curves (3, 41) and unknown log exposures. H is held smooth the more firmly, the
    noisier the points are: they are noisy on both sides of an equation, which no number
    of them averages away.
    """
    size = 3 * UNKNOWNS + num_free
    matrix, right = np.zeros((size, size)), np.zeros(size)
    second = np.diff(np.eye(NODES), 2, axis=0)
    curvature = np.einsum("ki,kj->ij", second, second)
    for c, e in enumerate(equations):
        w, design, target = e.centered()
        at = np.r_[c * UNKNOWNS : (c + 1) * UNKNOWNS, 3 * UNKNOWNS : size]
        weighted = (w[..., None] * design).reshape(-1, len(at))
        matrix[np.ix_(at, at)] += weighted.T @ design.reshape(-1, len(at))
        right[at] += weighted.T @ target.reshape(-1)
        nodes = np.arange(c * UNKNOWNS, c * UNKNOWNS + NODES)
        matrix[np.ix_(nodes, nodes)] += (3e4 + 300 * w.sum()) * noise**2 * curvature
        matrix[at, at] += 1e-6 + 1e-9 * w.sum()  # H's mean is the unit of E: any value will do
        a, b = nodes[-1] + 1, nodes[-1] + 2
        matrix[[a, b], [a, b]] += 30 * noise**2  # few points: half gamma 2.2, half sRGB
        right[[a, b]] += np.array(TYPICAL) * 30 * noise**2
    solution = np.linalg.solve(matrix, right)
    return solution[: 3 * UNKNOWNS].reshape(3, UNKNOWNS), solution[3 * UNKNOWNS :]


def all_residuals(
    equations: list[Equations], curves: np.ndarray, log_exposure: np.ndarray
) -> list[np.ndarray]:
    """Every channel's misfit (P, B)."""
    return [e.residuals(np.concatenate([curves[c], log_exposure])) for c, e in enumerate(equations)]


def reweight(equations: list[Equations], curves: np.ndarray, log_exposure: np.ndarray) -> float:
    """Set the Cauchy weights from the misfits; gives back the robust standard deviation
    of a misfit of weight 1.
    """
    scaled = [
        r * np.sqrt(e.weight)
        for e, r in zip(equations, all_residuals(equations, curves, log_exposure), strict=True)
    ]
    seen = np.concatenate([s[s != 0] for s in scaled])
    noise = 1.48 * float(np.median(np.abs(seen))) + 1e-6 if seen.size else 0.05
    for e, s in zip(equations, scaled, strict=True):
        e.robust = 1 / (1 + (s / (2.4 * noise)) ** 2)
    return noise


def typical_factor(curves: np.ndarray) -> float:
    """The factor on G that makes the mean curve as steep as sRGB over recorded values
    0.1 to 0.9.
    """
    z = np.linspace(0.1, 0.9, 161)
    mine = (basis(z) @ curves.T).mean(-1)
    srgb = np.log(srgb_to_linear(z))
    mine, srgb = mine - mine.mean(), srgb - srgb.mean()
    return float(mine @ srgb / (mine @ mine))


def saturation(
    samples: Samples, channel: int, curve: np.ndarray, log_exposure: np.ndarray
) -> float:
    """G(1), the log exposure at which the channel saturates: the level that best parts
    saturated from unsaturated recordings of points whose exposure another, darker
    bracket tells. Extrapolated where fewer than 30 of either kind are known.
    """
    valid, saturated = samples.valid[..., channel], samples.saturated[..., channel]
    extrapolated = float(basis(np.array(1.0)) @ curve)
    told = np.where(
        valid, basis(samples.rgb[..., channel]) @ curve, np.nan
    )  # (P, B) log exposure of what was recorded
    above, below, off = [], [], []
    for dark, light in itertools.permutations(range(valid.shape[1]), 2):
        if log_exposure[dark] < log_exposure[light]:
            level = told[:, dark] - log_exposure[dark] + log_exposure[light]
            both = valid[:, dark] & valid[:, light]
            above.append(level[valid[:, dark] & saturated[:, light]])
            below.append(level[both])
            off.append(np.abs(level - told[:, light])[both])
    misfit = np.concatenate(off)
    same = (
        misfit <= 3 * np.median(misfit) if misfit.size else misfit > 0
    )  # the others fell into shadow between the two
    high, low = np.sort(np.concatenate(above)), np.sort(np.concatenate(below)[same])
    floor = float(basis(np.array(HIGH)) @ curve)
    if min(len(high), len(low)) < 30:
        return max(extrapolated, floor)
    candidates = np.linspace(floor - 0.5, max(extrapolated, floor) + 1.0, 301)
    wrong = np.searchsorted(high, candidates) + len(low) - np.searchsorted(low, candidates)
    best = candidates[wrong == wrong.min()]
    return max(float(best.mean()), floor + 1e-3)


def response_of(
    curves: np.ndarray, tops: np.ndarray, num: int = 256
) -> tuple[np.ndarray, np.ndarray]:
    """x (num,) even in x^(1/2.2) and the response y (3, num): exp(G - top) made
    monotone and inverted, ending at (1, 1).

    Where G falls, it is replaced by the mean of its upper and lower monotone envelopes.
    """
    z = np.linspace(0, HIGH, 1025)[1:]
    x = np.linspace(0, 1, num) ** 2.2
    y = []
    for g, top in zip((basis(z) @ curves.T).T, tops, strict=True):
        rising = (np.maximum.accumulate(g) + np.minimum.accumulate(g[::-1])[::-1]) / 2
        known = np.exp(
            np.minimum(rising - top, -1e-6) + np.linspace(-1e-9, 0, len(z))
        )  # strictly rising, below 1
        y.append(np.interp(x, np.concatenate([[0], known, [1]]), np.concatenate([[0], z, [1]])))
    return x, np.stack(y)


def linked(samples: Samples, brackets: Collection[int]) -> bool:
    """Whether the points link all of `brackets` to each other, directly or through
    others, by `MIN_SHARED` points each.
    """
    seen = samples.valid.all(-1).astype(np.float64)
    shared = np.einsum("pi,pj->ij", seen, seen) >= MIN_SHARED
    reached = np.arange(len(shared)) == min(brackets)
    for _ in brackets:
        reached = reached | (shared & reached).any(1)
    return bool(reached[list(brackets)].all())


def brightness_ratio(samples: Samples, bracket: int, reference: int) -> float:
    """EV of `bracket` against `reference`: median log2 ratio of the points both record,
    through gamma 2.2.
    """
    both = samples.valid[:, bracket] & samples.valid[:, reference]
    ratio = np.log2(samples.rgb[:, bracket][both] / samples.rgb[:, reference][both])
    return 2.2 * float(np.median(ratio)) if ratio.size else 0.0


def brightness_ev(
    images: Sequence[np.ndarray], brackets: Sequence[int], reference: int, num_brackets: int
) -> list[float]:
    """EV of every bracket (B,) from brightness alone: the gray levels' quantiles,
    compared between brackets next to each other in brightness where both are away from
    black and saturation, through gamma 2.2. Good to half a stop where all see the same
    scene.
    """
    share = np.linspace(0.02, 0.98, 97)
    levels = {
        b: np.quantile(
            np.concatenate(
                [i.mean(-1).ravel() for i, j in zip(images, brackets, strict=True) if j == b]
            ),
            share,
        )
        for b in set(brackets)
    }
    order = sorted(levels, key=lambda b: float(np.median(levels[b])))
    ev = {order[0]: 0.0}
    for dark, light in itertools.pairwise(order):
        both = (levels[dark] > LOW) & (levels[light] < HIGH)
        ratio = (
            np.log2(levels[light][both] / levels[dark][both]) * 2.2 if both.any() else np.ones(1)
        )
        ev[light] = ev[dark] + float(np.median(ratio))
    base = ev.get(reference, 0.0)
    return [ev.get(b, base) - base for b in range(num_brackets)]


def static_samples(
    views: Sequence[View], num_brackets: int, num: int, rng: np.random.Generator
) -> Samples:
    """Up to `num` static points with what every bracket recorded of them, found through
    disparity and poses.

    Points lie where nothing moves, on smooth surface (a pixel of misplacement then
    costs little), spread over the recorded levels. A bracket is read in the nearest
    frame in time that sees the point: inside, static, disparity agreeing to 8 %.
    """
    maps = [usable(v) for v in views]
    share = max(1, num // max(len(views), 1))
    parts = []
    for source, view in enumerate(views):
        pixels = spread_over_levels(view.image, maps[source].good, share, rng)  # (p, 2) column, row
        depth = 1 / np.maximum(view.disparity[pixels[:, 1], pixels[:, 0]], 1e-9)
        points = unproject(view, pixels + 0.5, depth)
        seen, saturated = np.zeros((2, len(pixels), num_brackets, 3), bool)
        value = np.zeros((len(pixels), num_brackets, 3))
        for other in sorted(range(len(views)), key=lambda i: abs(views[i].time - view.time)):
            b = views[other].bracket
            if abs(views[other].time - view.time) > 3 * num_brackets or (
                other != source and b == view.bracket
            ):
                continue
            good, row, column = sees(views[other], maps[other], points)
            fresh = good & ~(seen | saturated)[:, b].any(-1)
            value[fresh, b] = maps[other].mean[row, column][fresh]
            seen[fresh, b] = maps[other].unclipped[row, column][fresh]
            saturated[fresh, b] = maps[other].saturated[row, column][fresh]
        parts.append(Samples(value, seen, saturated))
    none = np.zeros((0, num_brackets, 3))
    return Samples(
        *(
            np.concatenate([getattr(p, f) for p in parts] or [none])
            for f in ("rgb", "valid", "saturated")
        )
    )


@dataclass(frozen=True)
class Neighborhoods:
    """What the 3x3 pixels around every pixel of a frame are good for."""

    mean: np.ndarray  # (H, W, 3) recorded
    # (H, W, 3) bool: all nine away from black and saturation (a mean over clipped ones
    # is no recording)
    unclipped: np.ndarray
    saturated: np.ndarray  # (H, W, 3) bool: all nine saturated
    good: np.ndarray  # (H, W) bool: smooth, and known to be found again


def usable(view: View) -> Neighborhoods:
    """Where a frame's points can be trusted to be found again in other frames."""
    known = view.disparity > 0
    if view.moving is not None:
        known = known & (cv2.dilate(view.moving.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0)
    if view.confidence is not None:
        known = known & (view.confidence > 0.1)
    return smooth(view.image, known)


def smooth(image: np.ndarray, known: np.ndarray) -> Neighborhoods:
    """The neighborhoods of a recorded `image` (H, W, 3), good where they are smooth and
    `known` (H, W) bool.
    """
    kernel = np.ones((3, 3), np.uint8)
    image = np.ascontiguousarray(image, np.float32)
    low, high = np.asarray(cv2.erode(image, kernel)), np.asarray(cv2.dilate(image, kernel))
    good = ((high - low) < 0.03 + 0.12 * high).all(-1) & known
    return Neighborhoods(
        np.asarray(cv2.blur(image, (3, 3))), (low >= LOW) & (high <= HIGH), low >= SATURATED, good
    )


def spread_over_levels(
    image: np.ndarray, mask: np.ndarray, num: int, rng: np.random.Generator
) -> np.ndarray:
    """Up to `num` pixels (p, 2; column, row) of `mask` (H, W) whose gray levels are as
    evenly spread as the image allows.
    """
    rows, columns = np.nonzero(mask)
    gray = image[rows, columns].mean(-1)
    informative = (gray > LOW) & (gray < HIGH)
    rows, columns, gray = rows[informative], columns[informative], gray[informative]
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    bins = np.minimum((gray * 16).astype(int), 15)
    chance = 1 / np.bincount(bins, minlength=16)[bins]
    chosen = rng.choice(len(rows), min(num, len(rows)), replace=False, p=chance / chance.sum())
    return np.stack([columns[chosen], rows[chosen]], -1)


def unproject(view: View, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """World points (p, 3) at `pixels` (p, 2; centers at +0.5) and z-depth (p,)."""
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], -1) @ np.linalg.inv(view.K).T
    return (rays * depth[:, None]) @ view.c2w[:, :3].T + view.c2w[:, 3]


def sees(
    view: View, maps: Neighborhoods, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which world `points` (p, 3) `view` sees undisturbed (p,), and the pixel each
    falls into: row (p,), column (p,).
    """
    height, width = view.disparity.shape
    local = (points - view.c2w[:, 3]) @ view.c2w[:, :3]
    depth = np.maximum(local[:, 2], 1e-9)
    x, y = ((local / depth[:, None]) @ view.K.T)[:, :2].T
    inside = (local[:, 2] > 0) & (x > 1) & (x < width - 1) & (y > 1) & (y < height - 1)
    column, row = np.where(inside, x, 1).astype(int), np.where(inside, y, 1).astype(int)
    agrees = np.abs(view.disparity[row, column] * depth - 1) < 0.08
    return inside & agrees & maps.good[row, column], row, column
