"""Arrays made one at a time behave like an array."""

import numpy as np

from hdr_nsff.core.stack import LazyList, RecentArrays, Stack, by_key, map_stack

WHOLE = np.arange(24.0).reshape(4, 3, 2)
STACK = Stack(lambda k: WHOLE[k], WHOLE.shape)


def test_a_stack_is_indexed_like_an_array():
    mask = np.array([True, False, True, False])
    assert np.array_equal(np.asarray(STACK), WHOLE)
    assert np.array_equal(STACK[-1], WHOLE[-1])
    assert np.array_equal(STACK[2, :, 1], WHOLE[2, :, 1])
    assert np.array_equal(np.asarray(STACK[mask]), WHOLE[mask])
    assert np.array_equal(np.asarray(STACK[1:3][[1]]), WHOLE[1:3][[1]])


def test_mapping_a_stack_gives_what_mapping_an_array_gives():
    mapped = map_stack(lambda array, k: array + k, STACK)
    assert np.array_equal(np.asarray(mapped), map_stack(lambda array, k: array + k, WHOLE))


def test_arrays_by_key_are_made_when_asked_for():
    made = []
    stack = Stack(lambda k: made.append(k) or WHOLE[k], WHOLE.shape)  # type: ignore[func-returns-value]
    arrays = by_key([7, 9], stack[[0, 3]])
    assert made == [] and list(arrays) == [7, 9]
    assert np.array_equal(arrays[9], WHOLE[3]) and made == [3]


def test_recent_arrays_forget_the_oldest_beyond_their_limit():
    recent = RecentArrays(2 * WHOLE[0].nbytes)
    for key in (0, 1, 0, 2):
        recent.get(key, lambda: WHOLE[0].copy())
    assert list(recent.arrays) == [0, 2] and recent.bytes == 2 * WHOLE[0].nbytes


def test_a_lazy_list_keeps_the_last_items():
    made = []
    items = LazyList(lambda k: made.append(k) or k, 5, keep=2)  # type: ignore[func-returns-value]
    assert [items[k] for k in (0, 1, 0, -1)] == [0, 1, 0, 4] and made == [0, 1, 4]
    assert items[1:3] == [1, 2]
