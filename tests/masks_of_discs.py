"""Motion masks of discs, for tests of prompts."""

import numpy as np

HEIGHT, WIDTH = 80, 120
Y, X = np.indices((HEIGHT, WIDTH)) + 0.5


def disc(x: float, y: float, radius: float) -> np.ndarray:
    """A disc (HEIGHT, WIDTH) bool."""
    return np.hypot(X - x, Y - y) < radius


def two_discs(count: int = 9) -> np.ndarray:
    """Masks (count, HEIGHT, WIDTH) of a disc that grows until frame 6 while it moves
    right, and a smaller one that moves left below it.
    """
    large = [disc(30 + 4 * t, 25, 10 + min(t, 12 - t)) for t in range(count)]
    small = [disc(90 - 5 * t, 65, 8) for t in range(count)]
    return np.stack(large) | np.stack(small)
