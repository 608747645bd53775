"""Exposure cycles found from brightness alone: `python benchmarks/exposure_cycles.py
CLIP...`.

Prints what `prepare` finds in each clip, and in how many of its short pieces (7, 9, 12,
20 frames) the same cycle is found.
"""

import sys
from pathlib import Path

import numpy as np

from hdr_nsff.footage.ingest import open_footage, read_frames
from hdr_nsff.radiometry.exposure_cycle import detect_cycle


def main(clips: list[str]) -> None:
    """One line per clip."""
    print(f"{'clip':<28} cycle  dark to bright  EV at gamma 2.2     explained  pieces")
    for clip in clips:
        video = np.stack([f.rgb for f in read_frames(open_footage(Path(clip)), 0, None, 1, 640)])
        cycle = detect_cycle(video)
        pieces = [video[s : s + n] for n in (7, 9, 12, 20) for s in range(0, len(video) - n + 1, 3)]
        same = [detect_cycle(p).length == cycle.length for p in pieces]
        ev = " ".join(f"{cycle.ev[b]:.2f}" for b in cycle.order)
        columns = f"{Path(clip).name:<28} {cycle.length:<6} {cycle.order!s:<15} {ev:<19}"
        print(f"{columns} {cycle.confidence:<10.0%} {sum(same)} of {len(same)}")


if __name__ == "__main__":
    main(sys.argv[1:])
