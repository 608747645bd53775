"""Black bars around the picture: letterbox and pillarbox.

They stay where they are while the camera moves, so that masks, movers and the field
would take them for things that follow it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hdr_nsff.footage.footage import Bars, Footage
from hdr_nsff.footage.ingest import decode


@dataclass(frozen=True)
class BarsTuning:
    """What counts as bars (hand-chosen). Both sides have to be black to the same width,
    which a picture's own dark borders hardly are.
    """

    first_frames: int = 12  # that show whether there may be bars at all
    max_frames: int = 300  # from the first one used, in which bars stay black
    max_black: float = 0.07  # recorded: limited-range black shown as full range is 0.063
    black_share: float = 0.98  # of the pixels of a row or column
    min_share: float = 0.01  # of the picture's height or width, of a bar
    max_difference: float = 0.1  # of the widths of both bars, relative to the wider ...
    max_difference_px: int = 2  # ... or in pixels
    soft_px: int = 1  # more that is cut, since scaling and compression blur the edge
    max_cut: float = 0.6  # of the height or width, of both bars together
    min_bright: float = 0.2  # recorded: what half of the pixels between the bars reach


def with_bars(footage: Footage, start: int = 0, tuning: BarsTuning = BarsTuning()) -> Footage:
    """The footage with the bars that its frames have, which `read_frames` cuts off.

    Recorded footage of one camera is looked at, from its frame `start` on; linear
    frames come from no player.
    """
    if footage.linear or len(footage.cameras) > 1:
        return footage
    return replace(footage, bars=find_bars(footage, start, tuning))


def find_bars(footage: Footage, start: int = 0, tuning: BarsTuning = BarsTuning()) -> Bars:
    """The bars of recorded footage; none where frames differ in size."""
    brightest: np.ndarray | None = None  # (H, W) recorded, over the frames so far
    frames = decode(footage, footage.cameras[0], range(start, start + tuning.max_frames))
    for count, (_, _, image, _) in enumerate(frames, start=1):
        gray = image.max(-1)
        if brightest is None:
            brightest = gray
        elif gray.shape != brightest.shape:
            return Bars()
        brightest = np.maximum(brightest, gray)
        lit = count >= tuning.first_frames and np.median(brightest) > tuning.max_black
        if lit and not bars_of(brightest, tuning):
            return Bars()
    return Bars() if brightest is None else bars_of(brightest, tuning)


def bars_of(brightest: np.ndarray, tuning: BarsTuning = BarsTuning()) -> Bars:
    """The bars in the brightest values (H, W) that pixels take."""
    black = brightest <= tuning.max_black
    rows = bar_width(black.mean(1) >= tuning.black_share, tuning)
    columns = bar_width(black.mean(0) >= tuning.black_share, tuning)
    bars = Bars(rows, columns)
    if np.median(bars.cut(brightest)) < tuning.min_bright:
        return Bars()
    return bars


def bar_width(is_black: np.ndarray, tuning: BarsTuning = BarsTuning()) -> int:
    """The width to cut at both ends of black lines (N,) bool; 0 where there are no two
    bars of about the same width.
    """
    if is_black.all():
        return 0
    first, last = int(np.argmin(is_black)), int(np.argmin(is_black[::-1]))
    narrow, wide = min(first, last), max(first, last)
    allowed = max(tuning.max_difference_px, tuning.max_difference * wide)
    if narrow < max(1, tuning.min_share * len(is_black)) or wide - narrow > allowed:
        return 0
    width = wide + tuning.soft_px
    return width if 2 * width <= tuning.max_cut * len(is_black) else 0
