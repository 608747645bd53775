"""How long a clip may be for one scene, and into which segments a longer one is cut.

The limit is that of time: up to it the default time of training grows with the pixels
of all frames, beyond it every frame gets less. Memory sets none: maps are read from the
scene folder.
"""

from __future__ import annotations

from dataclasses import dataclass

from hdr_nsff.training.budget import longest_clip

SEGMENT_SHARE = 0.5  # of the longest clip (hand-chosen: training then takes 21 minutes)


@dataclass(frozen=True)
class Offer:
    """Segments for a clip that is too long."""

    longest: int  # frames of one scene
    seconds: float  # of a segment

    def sentence(self, num_frames: int) -> str:
        """What is wrong with a clip of `num_frames`."""
        return (
            f"{num_frames} frames are long for one scene: beyond {self.longest} of this size the "
            "default time of training grows no more, and every frame gets less of it"
        )

    def advice(self, verb: str) -> str:
        """What to do about it."""
        return f"`{verb} CLIP OUT --segment {self.seconds:g}` cuts the clip into scenes"


def offered_segments(num_frames: int, num_pixels: int, fps: float) -> Offer | None:
    """Segments for a clip of `num_frames` of `num_pixels` each; None where it fits."""
    longest = longest_clip(num_pixels)
    if num_frames <= longest:
        return None
    seconds = SEGMENT_SHARE * longest / fps
    return Offer(longest, int(seconds) if seconds >= 2 else max(round(seconds, 1), 0.1))
