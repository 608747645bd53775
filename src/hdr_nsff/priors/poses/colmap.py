"""The door to pycolmap, for processes that work for structure from motion."""

from __future__ import annotations

from functools import cache
from typing import Any


@cache
def load_pycolmap() -> Any:
    """pycolmap, quiet and seeded. The system's zlib is in place before it brings its
    own.
    """
    import zlib

    import pycolmap

    assert zlib
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(0)
    return pycolmap
