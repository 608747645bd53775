"""A process that works for structure from motion reports its progress to its parent."""

from __future__ import annotations


def send(*words: object) -> None:
    """Send one line to the parent."""
    print(*words, flush=True)
