"""What a progress line says of the rest."""

from hdr_nsff.core.progress import progress_of


def test_time_left_follows_the_time_so_far() -> None:
    assert progress_of(2, 8, 3.0) == " of 8, 9 s left"


def test_without_a_total_or_beyond_it_nothing_is_left_to_say() -> None:
    assert progress_of(2, None, 3.0) == ""
    assert progress_of(9, 8, 3.0) == ""
