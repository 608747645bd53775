"""Exposure cycles detected from brightness alone.

    python benchmarks/exposure_cycles.py CLIP [CLIP ...]

CLIP is a video or a folder of frames. For every clip the file holds the cycle that
`prepare` detects, and the share of short pieces in which the same cycle is detected.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from record import Record, make_parser, name_of

from hdr_nsff.footage.ingest import open_footage, read_frames
from hdr_nsff.radiometry.exposure_cycle import detect_cycle

MAX_SIDE_PX = 640  # of the frames; brightness needs no more
PIECE_FRAMES = (7, 9, 12, 20)  # lengths of the pieces
PIECE_STRIDE = 3  # frames from the start of one piece to the next


def main() -> None:
    parser = make_parser(__doc__, "exposure_cycles")
    parser.add_argument("clips", type=Path, nargs="+", metavar="CLIP")
    args = parser.parse_args()
    record = Record("exposure_cycles", args)
    for clip in args.clips:
        record.add({"clip": name_of(clip)} | measure(clip))
    record.save()


def measure(clip: Path) -> dict[str, Any]:
    """The cycle of the whole clip, and how often its pieces agree."""
    frames = read_frames(open_footage(clip), 0, None, 1, MAX_SIDE_PX)
    video = np.stack([frame.rgb for frame in frames])  # (T, H, W, 3)
    cycle = detect_cycle(video)
    agreeing = []
    for length in PIECE_FRAMES:
        for start in range(0, len(video) - length + 1, PIECE_STRIDE):
            piece = detect_cycle(video[start : start + length])
            agreeing.append(piece.length == cycle.length)
    return {
        "frames": len(video),
        "cycle": cycle.length,
        "dark_to_bright": list(cycle.order),
        "ev_at_gamma_2.2": [round(float(cycle.ev[bracket]), 2) for bracket in cycle.order],
        "confidence": round(float(cycle.confidence), 3),
        "pieces": len(agreeing),
        "pieces_with_this_cycle": sum(agreeing),
    }


if __name__ == "__main__":
    main()
