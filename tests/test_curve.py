"""Which views the curves of a benchmark are of."""

from __future__ import annotations

from hdr_nsff.bench.curve import spread


def test_views_are_spread_from_first_to_last() -> None:
    assert spread(list("abcdefghijklmnop"), 4) == list("afkp")  # type: ignore[arg-type]
    assert spread(list("ab"), 4) == list("ab")  # type: ignore[arg-type]
