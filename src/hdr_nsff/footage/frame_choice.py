"""The choice of frames and of their size, checked: what makes no sense is refused."""

from __future__ import annotations

from pathlib import Path

from hdr_nsff.core.errors import InputError, shorten

# pixels: SSIM compares windows of this size (Wang et al. 2004), optical flow needs 9
MIN_SIDE = 11
MIN_MAX_SIZE = 32  # pixels: least longest side that frames may be shrunk to


def check_choice(
    start: int, end: int | None, stride: int, max_size: int, hold_out: int | None
) -> None:
    """InputError for a choice of frames that makes no sense for any footage."""
    if start < 0 or stride < 1 or (end is not None and end <= start):
        last = "the end" if end is None else end
        raise InputError(
            f"frames {shorten(start)} to {shorten(last)} in steps of {shorten(stride)}: "
            "nothing to read; correct --start, --end, --stride"
        )
    check_max_size(max_size)
    if hold_out is not None and (hold_out < 0 or hold_out == 1):
        problem = "leaves nothing to train on" if hold_out == 1 else "no number of frames"
        advice = "use 2 or more to hold out every N-th frame, 0 for none"
        raise InputError(f"--hold-out {shorten(hold_out)}: {problem}; {advice}")


def check_max_size(max_size: int) -> None:
    """InputError for a longest side that shrinks every clip to nothing."""
    if max_size < MIN_MAX_SIZE:
        raise InputError(f"--max-size {shorten(max_size)}: too small; use at least {MIN_MAX_SIZE}")


def no_frame(clip: Path, start: int, count: int) -> str:
    """The sentence for a `start` beyond the end of a clip of `count` frames, 0 where
    their number is unknown.
    """
    has = f", which has {count}, counted from 0" if count else ""
    return f"--start {start}: no frame {start} in {clip}{has}; choose a smaller number"


def check_frame_size(clip: Path, width: int, height: int) -> None:
    """InputError for frames that are too small to match or to compare."""
    if min(width, height) < MIN_SIDE:
        raise InputError(
            f"{clip}: frames are {width}x{height} pixels, at least {MIN_SIDE}x{MIN_SIDE} are "
            "needed; choose larger frames, or a larger --max-size"
        )
