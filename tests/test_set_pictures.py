"""The exposures at which pictures of the standard set are developed."""

from __future__ import annotations

from hdr_nsff.rendering.set_pictures import three_exposures


def test_three_exposures_span_the_clip() -> None:
    assert three_exposures([0.0, -4.0, -2.0]) == [-4, -2, 0]
    assert three_exposures([0.0, -3.0]) == [-3, -1.5, 0]
    assert three_exposures([0.0]) == [-2, 0, 2]
