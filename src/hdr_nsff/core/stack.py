"""Arrays of one shape, read or computed one at a time when they are asked for.

A clip of any length then needs the memory of the few frames that a step works on. A
`Stack` is indexed and iterated like an array (N, ...), but it never holds all of it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from threading import Lock
from typing import Any, TypeVar, overload

import numpy as np

Make = Callable[[int], np.ndarray]


class Stack:
    """Arrays (N, ...) made one at a time; `np.asarray` makes all."""

    def __init__(self, make: Make, shape: tuple[int, ...]) -> None:
        """`make(k)` is the k-th of the `shape[0]` arrays of shape `shape[1:]`."""
        self.make = make
        self.shape = shape

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self.make(k) for k in range(len(self)))

    def __getitem__(self, index: Any) -> Any:
        """An array, part of it, or for a slice, a list or a mask a smaller stack."""
        if isinstance(index, tuple):
            return self[index[0]][index[1:]]
        if isinstance(index, int | np.integer):
            k = int(index)
            if not -len(self) <= k < len(self):
                raise IndexError(f"{k} of {len(self)} arrays")
            return self.make(k % len(self))
        chosen = np.arange(len(self))[index]
        return Stack(lambda k: self.make(int(chosen[k])), (len(chosen), *self.shape[1:]))

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        arrays = list(self)
        whole = np.stack(arrays) if arrays else np.zeros(self.shape)
        return whole if dtype is None else whole.astype(dtype)


ArrayStack = np.ndarray | Stack
Item = TypeVar("Item")


class LazyList(Sequence[Item]):
    """Items made when they are asked for; the last `keep` of them are kept."""

    def __init__(self, make: Callable[[int], Item], length: int, keep: int = 0) -> None:
        self.make: Callable[[int], Item] = lru_cache(keep)(make) if keep else make
        self.positions = range(length)

    def __len__(self) -> int:
        return len(self.positions)

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> list[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | list[Item]:
        if isinstance(index, slice):
            return [self.make(k) for k in self.positions[index]]
        return self.make(self.positions[index])


def map_stack(
    function: Callable[[np.ndarray, int], np.ndarray],
    stack: ArrayStack,
    shape: tuple[int, ...] | None = None,
) -> ArrayStack:
    """`function(array, k)` of every array: at once for an array (N, ...), when asked
    for of a stack. `shape` is that of one result, by default that of one array.
    """
    if isinstance(stack, np.ndarray):
        return np.stack([function(array, k) for k, array in enumerate(stack)])
    one = stack.shape[1:] if shape is None else shape
    return Stack(lambda k: function(stack.make(k), k), (len(stack), *one))


def with_pixels(stack: ArrayStack, masks: np.ndarray, values: Sequence[np.ndarray]) -> ArrayStack:
    """The maps (N, H, W) of a stack with `values` (M,) of each at the pixels of its
    mask, `masks` (N, H, W) bool.
    """

    def patched(array: np.ndarray, k: int) -> np.ndarray:
        array = array.copy()
        array[masks[k]] = values[k]
        return array

    return map_stack(patched, stack)


class LazyMap(Mapping[int, np.ndarray]):
    """Arrays by key, made when they are asked for."""

    def __init__(self, makers: Mapping[int, Callable[[], np.ndarray]]) -> None:
        self.makers = dict(makers)

    def __getitem__(self, key: int) -> np.ndarray:
        return self.makers[key]()

    def __iter__(self) -> Iterator[int]:
        return iter(self.makers)

    def __len__(self) -> int:
        return len(self.makers)


def by_key(keys: Sequence[int], stack: ArrayStack) -> LazyMap:
    """The arrays of a stack by keys that stand for them, in order."""
    return LazyMap({key: partial(stack.__getitem__, k) for k, key in enumerate(keys)})


class RecentArrays:
    """The arrays used last, up to `limit` bytes in all; threads may share it."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.arrays: OrderedDict[Any, np.ndarray] = OrderedDict()
        self.bytes = 0
        self.lock = Lock()

    def get(self, key: Any, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array of a key, made where it is not kept. Not to be written to."""
        with self.lock:
            if key in self.arrays:
                self.arrays.move_to_end(key)
                return self.arrays[key]
        array = make()
        with self.lock:
            if key not in self.arrays:
                self.arrays[key] = array
                self.bytes += array.nbytes
            while self.bytes > self.limit and len(self.arrays) > 1:
                _, oldest = self.arrays.popitem(last=False)
                self.bytes -= oldest.nbytes
        return array


def spread_frames(count: int, limit: int) -> np.ndarray:
    """Up to `limit` of `count` frames, spread evenly over the clip."""
    return np.unique(np.linspace(0, count - 1, min(limit, count)).astype(int))
