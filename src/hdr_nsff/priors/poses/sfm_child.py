"""A process that works for structure from motion: it reports progress to its parent and
does not outlive it.
"""

from __future__ import annotations

import os
import threading
import time


def send(*words: object) -> None:
    """Send one line to the parent."""
    print(*words, flush=True)


def die_with_parent() -> None:
    """End this process soon after its parent is gone (killed, too)."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
