"""Recognizes a camera that stands still, whatever moves before it.

Behind movers the detail of the background stays in its place through the whole clip.
Keypoints do not tell this apart where most of them are on a mover, on leaves in the
wind or on water; a camera that moves leaves no detail in its place.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from hdr_nsff.core.stack import ArrayStack, spread_frames
from hdr_nsff.priors.poses.rotation_adjustment import MAD_TO_SIGMA
from hdr_nsff.radiometry.local_detail import LocalDetailTuning, local_detail

MAX_FIT_ROUNDS = 5  # of reweighting


@dataclass(frozen=True)
class StillCameraTuning:
    """When detail stays in its place. Of 34 recorded clips eight from a tripod keep
    that of a fifth of the picture or more, in 12 cells or more, shifted by at most 0.3
    pixels (by 0.4 in a quarter of the picture, in half of the frames), and two, beside
    a man with a sheet of paper, that of 12 % in five cells and of 7 % in six, shifted
    by 0.1 where it is seen; the others that of 27 % at most, or shifted by 0.5 pixels
    or more in a frame of twenty.
    """

    max_frames: int = 120  # that are looked at, spread over the clip
    clipped_px: int = 7  # detail within this width of clipped pixels does not count
    neighborhood_px: float = 3.0  # standard deviation of what is compared around a pixel
    min_strength: float = 0.05  # mean square of the background's detail there
    min_correlation: float = 0.7  # of a frame's detail with the background's
    min_presence: float = 0.7  # share of the frames with such detail
    min_recorded: float = 0.25  # share of the frames that did not clip the pixel
    min_share: float = 0.15  # of the picture that keeps its detail ...
    cells: int = 4  # ... spread over the cells of a grid of as many rows and columns ...
    min_cells: int = 9  # ... of which so many hold detail: not a dashboard
    max_shift_px: float = 0.5  # of the frames' pixels, by which detail may shift ...
    still_share: float = 0.95  # ... in this share of the frames
    # a quarter of the picture moves where it shifts by more in half of the frames: a
    # zoom or a roll leaves the middle where it is
    max_quarter_shift_px: float = 0.6
    # of the kept detail, in quarters that move (2 % is the hair of a woman who moves
    # before a still camera; a zoom or a roll moves nearly all)
    max_moving_share: float = 0.2
    # Or less, with a part of it in an upper corner, where people who fill the picture
    # let a wall be seen, and no dashboard is; shifted less than in any hand, in the
    # frames that show so much of it (the sheet hides it in a fifth of a clip).
    min_share_above: float = 0.05
    min_corner_share: float = 0.03
    max_shift_above_px: float = 0.2
    min_shown: float = 0.5
    # Or little, somebody before a plain wall, where the left and the right side of the
    # picture hardly change, and the detail in them keeps its place: a camera that moves
    # brings other detail in there. Of nine recorded clips that move, six change by 0.47
    # or more on a side, and in the others detail there shifts by 0.33 pixels or more in
    # half of the frames; by 0.15 at most in four of a man before a wall.
    edge_share: float = 0.06  # of the picture's width, of a side that may not change
    max_change_calm: float = 0.3  # share of an edge's recorded pixels that differ
    side_share: float = 0.12  # of the picture's width, of a side whose detail counts
    min_share_calm: float = 0.01  # of the picture, of detail kept there
    max_median_shift_calm_px: float = 0.2
    # Or hardly any, where no other poses are found: so much detail, in so many cells,
    # shifted by less than this share of the picture's width (a bottle in a hand before
    # a plain wall leaves 4 % in 6 cells, shifted by 0.3 %)
    min_share_last: float = 0.02
    min_cells_last: int = 3
    max_shift_share_last: float = 0.003
    # A camera shakes where detail that is spread over the picture shifts by less than
    # this share of its width (a camera in a car: 0.3 %; of 11 recorded clips that move,
    # three have such detail, all of which turn in place)
    max_shake_share: float = 0.01
    # and does not grow by more than this in half of the frames, as far things do before
    # a camera that walks towards them (a GoPro's in 12 to 40 frames: 0.6 to 0.7 %;
    # nine clips that shake, turn or stand still: 0.17 % at most)
    max_growth: float = 0.003
    detail: LocalDetailTuning = field(default_factory=LocalDetailTuning)


@dataclass(frozen=True)
class Detail:
    """The detail of frames, and of what is behind movers."""

    frames: np.ndarray  # (F, h, w)
    recorded: np.ndarray  # (F, h, w) bool: nothing nearby is clipped
    background: np.ndarray  # (h, w)
    kept: np.ndarray  # (h, w) bool: where it is that of most frames
    scale: float  # pixels of the frames for one of these maps

    def shifts(self, part: np.ndarray) -> np.ndarray:
        """By how many pixels (F,) the background shifts in `part` (h, w)."""
        pairs = zip(self.frames, self.recorded, strict=True)
        return self.scale * np.array(
            [shift_of(frame, self.background, part & seen) for frame, seen in pairs]
        )

    def growths(self, part: np.ndarray) -> np.ndarray:
        """By which share (F,) the background grows or shrinks in `part` (h, w)."""
        pairs = zip(self.frames, self.recorded, strict=True)
        return np.array([growth_of(frame, self.background, part & seen) for frame, seen in pairs])

    def shown(self, tuning: StillCameraTuning) -> np.ndarray:
        """The share (F,) of the kept detail that each frame shows, 0 where it clips
        all.
        """
        shares = []
        for frame, seen in zip(self.frames, self.recorded, strict=True):
            judged = self.kept & seen
            alike = is_alike(frame, self.background, tuning)[judged]
            shares.append(alike.mean() if judged.any() else 0.0)
        return np.array(shares)


def still_camera_shifts(
    video: ArrayStack,
    clipped: ArrayStack | None = None,
    tuning: StillCameraTuning = StillCameraTuning(),
) -> np.ndarray | None:
    """By how many pixels (F,) the background shifts in frames spread over a clip; None
    where the camera does not stand still.

    `video` (T, H, W, 3) at one brightness; `clipped` (T, H, W) bool: pixels without
    information.
    """
    found = detail_of(video, clipped, tuning)
    for shifts_if in (shifts_if_spread, shifts_if_above, shifts_if_calm):
        shifts = shifts_if(found, tuning)
        if shifts is not None:
            return shifts
    return None


def nearly_still_shifts(
    video: ArrayStack,
    clipped: ArrayStack | None = None,
    tuning: StillCameraTuning = StillCameraTuning(),
) -> np.ndarray | None:
    """The same of a camera that may shake a little, for footage that has no other
    poses: the little detail that is no mover's hardly shifts.
    """
    found = detail_of(video, clipped, tuning)
    if found.kept.mean() < tuning.min_share_last:
        return None
    if occupied_cells(found.kept, tuning.cells) < tuning.min_cells_last:
        return None
    shifts = found.shifts(found.kept)
    small = shifts < tuning.max_shift_share_last * video.shape[2]
    return shifts if small.mean() >= tuning.still_share else None


def shaken_background(
    video: ArrayStack,
    clipped: ArrayStack | None = None,
    tuning: StillCameraTuning = StillCameraTuning(),
) -> np.ndarray | None:
    """Where (H, W) bool the background is behind movers, of a camera that only shakes;
    None where it moves farther, or forward. Arguments as of `still_camera_shifts`.
    """
    found = detail_of(video, clipped, tuning)
    if not is_spread(found.kept, tuning):
        return None
    height, width = video.shape[1:3]
    small = found.shifts(found.kept) < tuning.max_shake_share * width
    if small.mean() < tuning.still_share:
        return None
    if np.median(found.growths(found.kept)) > tuning.max_growth:
        return None
    kept = found.kept.astype(np.uint8)
    return cv2.resize(kept, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def detail_of(video: ArrayStack, clipped: ArrayStack | None, tuning: StillCameraTuning) -> Detail:
    """The detail of frames spread over a clip."""
    chosen = spread_frames(len(video), tuning.max_frames)
    details = np.stack([local_detail(video[t], tuning.detail) for t in chosen])
    size = details.shape[:0:-1]
    recorded = np.ones(details.shape, bool)
    if clipped is not None:
        recorded = np.stack([recorded_detail(clipped[t], size, tuning) for t in chosen])
    background = median_of_recorded(details, recorded)
    kept = kept_detail(details, recorded, background, tuning)
    return Detail(details, recorded, background, kept, video.shape[2] / details.shape[2])


def shifts_if_spread(found: Detail, tuning: StillCameraTuning) -> np.ndarray | None:
    """The shifts (F,) of a still camera whose background is spread over the picture."""
    if not is_spread(found.kept, tuning):
        return None
    shifts = found.shifts(found.kept)
    if (shifts < tuning.max_shift_px).mean() < tuning.still_share:
        return None
    return shifts if holds_in_quarters(found, tuning) else None


def shifts_if_above(found: Detail, tuning: StillCameraTuning) -> np.ndarray | None:
    """The shifts (F,) of a still camera behind movers that let little of the background
    be seen, a part of it in an upper corner.
    """
    above = max(corner.mean() for corner in quarters(found.kept)[:2])
    if above < tuning.min_corner_share or found.kept.mean() < tuning.min_share_above:
        return None
    if is_spread(found.kept, tuning):
        return None
    shown = found.shown(tuning) >= tuning.min_shown
    if shown.mean() < tuning.min_presence:
        return None
    shifts = found.shifts(found.kept)
    if (shifts[shown] < tuning.max_shift_above_px).mean() < tuning.still_share:
        return None
    return shifts if holds_in_quarters(found, tuning) else None


def shifts_if_calm(found: Detail, tuning: StillCameraTuning) -> np.ndarray | None:
    """The shifts (F,) of a still camera before a plain wall: the picture's sides are
    calm.
    """
    part = found.kept & sides(found.kept.shape, tuning.side_share)
    if part.mean() < tuning.min_share_calm or not has_calm_edges(found, tuning):
        return None
    shifts = found.shifts(part)
    if (shifts < tuning.max_shift_px).mean() < tuning.still_share:
        return None
    return shifts if np.median(shifts) <= tuning.max_median_shift_calm_px else None


def recorded_detail(
    clipped: np.ndarray, size: tuple[int, int], tuning: StillCameraTuning
) -> np.ndarray:
    """Where (h, w) no pixel nearby is `clipped` (H, W); `size` is w, h."""
    near = cv2.dilate(clipped.astype(np.uint8), np.ones((tuning.clipped_px,) * 2, np.uint8))
    return cv2.resize(near, size, interpolation=cv2.INTER_NEAREST) == 0


def median_of_recorded(details: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """The median (h, w) over time of `details` (F, h, w) where `recorded`; else 0."""
    ordered = np.sort(np.where(recorded, details, np.inf), axis=0)
    middle = np.maximum(recorded.sum(0) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[None], 0)[0]
    return np.where(recorded.any(0), median, 0.0).astype(np.float32)


def kept_detail(
    details: np.ndarray, recorded: np.ndarray, background: np.ndarray, tuning: StillCameraTuning
) -> np.ndarray:
    """Where (h, w) the detail of the background is that of most frames (F, h, w)."""
    strength = around(background**2, tuning)
    present = np.zeros(background.shape, int)
    for detail, seen in zip(details, recorded, strict=True):
        present += seen & is_alike(detail, background, tuning)
    enough = np.maximum(recorded.sum(0), tuning.min_recorded * len(details))
    return (strength > tuning.min_strength) & (present > tuning.min_presence * enough)


def around(values: np.ndarray, tuning: StillCameraTuning) -> np.ndarray:
    """The mean (h, w) of `values` (h, w) around each pixel."""
    return cv2.GaussianBlur(values, (0, 0), tuning.neighborhood_px)


def is_alike(detail: np.ndarray, background: np.ndarray, tuning: StillCameraTuning) -> np.ndarray:
    """Where (h, w) `detail` correlates with that of the background (h, w)."""
    norm = np.sqrt(around(detail**2, tuning) * around(background**2, tuning)) + 1e-6
    return around(detail * background, tuning) > tuning.min_correlation * norm


def sides(shape: tuple[int, ...], share: float) -> np.ndarray:
    """The left and the right side (h, w) of a picture, each a `share` of its width."""
    width = max(1, round(share * shape[1]))
    columns = np.zeros(shape, bool)
    columns[:, :width] = columns[:, -width:] = True
    return columns


def has_calm_edges(found: Detail, tuning: StillCameraTuning) -> bool:
    """Whether the detail of the frames hardly ever differs from that of the background,
    neither at the left edge nor at the right one.
    """
    changed = np.zeros(found.background.shape, int)
    for detail, seen in zip(found.frames, found.recorded, strict=True):
        strong = around(detail**2, tuning) > tuning.min_strength
        changed += seen & strong & ~is_alike(detail, found.background, tuning)
    share = changed / np.maximum(found.recorded.sum(0), 1)
    edges = sides(share.shape, tuning.edge_share)
    left, right = np.split(np.where(edges, share, np.nan), [share.shape[1] // 2], axis=1)
    return bool(max(np.nanmean(left), np.nanmean(right)) < tuning.max_change_calm)


def holds_in_quarters(found: Detail, tuning: StillCameraTuning) -> bool:
    """Whether nearly all kept detail is in quarters of the picture that do not move."""
    still = [
        part.mean()
        for part in quarters(found.kept)
        if np.median(found.shifts(part)) <= tuning.max_quarter_shift_px
    ]
    return bool(sum(still) >= (1 - tuning.max_moving_share) * found.kept.mean())


def is_spread(kept: np.ndarray, tuning: StillCameraTuning) -> bool:
    """Whether detail is `kept` (h, w) in enough of the picture, spread over it."""
    enough = bool(kept.mean() >= tuning.min_share)
    return enough and occupied_cells(kept, tuning.cells) >= tuning.min_cells


def occupied_cells(kept: np.ndarray, cells: int) -> int:
    """How many of `cells` x `cells` parts of a picture have any `kept` (h, w) pixel."""
    rows = [np.array_split(row, cells, axis=1) for row in np.array_split(kept, cells)]
    return sum(bool(part.any()) for row in rows for part in row)


def quarters(kept: np.ndarray) -> list[np.ndarray]:
    """The `kept` pixels (h, w) of each quarter of the picture."""
    height, width = kept.shape
    low, right = np.indices(kept.shape) * 2 >= np.array([height, width])[:, None, None]
    return [kept & (low == y) & (right == x) for y in (False, True) for x in (False, True)]


def shift_of(detail: np.ndarray, background: np.ndarray, chosen: np.ndarray) -> float:
    """By how many pixels `detail` is shifted against `background` (h, w) in `chosen`
    pixels; infinite where these do not determine it.
    """
    down, right = np.gradient(background)
    differences = (background - detail)[chosen]
    return float(np.linalg.norm(robust_fit([right[chosen], down[chosen]], differences)))


def growth_of(detail: np.ndarray, background: np.ndarray, chosen: np.ndarray) -> float:
    """By which share `detail` is larger (or smaller) than `background` (h, w) in
    `chosen` pixels; infinite where these do not determine it.
    """
    if not chosen.any():
        return float(np.inf)
    down, right = (gradient[chosen] for gradient in np.gradient(background))
    y, x = (places - places.mean() for places in np.nonzero(chosen))
    radius = float(np.sqrt(np.mean(x**2 + y**2))) or 1.0
    columns = [right, down, (x * right + y * down) / radius]
    motion = robust_fit(columns, (background - detail)[chosen])
    return float(abs(motion[2])) / radius


def robust_fit(columns: list[np.ndarray], differences: np.ndarray) -> np.ndarray:
    """The motion (K,) whose `columns` (N,) of slopes sum up to `differences` (N,), by
    robust least squares (Lucas and Kanade 1981); infinite where not determined.
    """
    slopes, differences = np.stack(columns, -1).astype(float), differences.astype(float)
    weights, motion = np.ones(len(differences)), np.full(len(columns), np.inf)
    for _ in range(MAX_FIT_ROUNDS):
        normal = (slopes * weights[:, None]).T @ slopes
        if np.linalg.cond(normal) > 1e6 or not len(differences):
            return np.full(len(columns), np.inf)
        motion = np.linalg.solve(normal, slopes.T @ (weights * differences))
        residual = differences - slopes @ motion
        scale = MAD_TO_SIGMA * float(np.median(np.abs(residual))) + 1e-6
        weights = 1 / (1 + (residual / scale) ** 2)
    return motion
