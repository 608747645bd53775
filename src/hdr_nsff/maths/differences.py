"""Differences of what is sampled at uneven times, as between the frames of a clip from
which some are missing or held out.
"""

from __future__ import annotations

import math

import numpy as np


def differences(times: np.ndarray, known: np.ndarray, order: int) -> np.ndarray:
    """Matrix (rows, n) of differences of an order over every run of order + 1 samples.

    The samples are at `times` (n,), and only runs count whose steps are all `known`
    (n - 1,). They are divided differences, which vanish for polynomials below the
    order, scaled so that even steps give the usual ones, as (-1, 3, -3, 1).
    """
    rows = []
    for start in range(len(times) - order):
        if known[start : start + order].all():
            t = times[start : start + order + 1]
            gaps = t[:, None] - t[None] + np.eye(order + 1)
            mean_step = (t[-1] - t[0]) / order
            row = np.zeros(len(times))
            row[start : start + order + 1] = math.factorial(order) * mean_step**order
            row[start : start + order + 1] /= gaps.prod(1)
            rows.append(row)
    return np.array(rows).reshape(-1, len(times))


def averaged_with_neighbors(values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The mean of every sample (n, C) at `times` (n,) and of the straight line between
    its two neighbors there: (1, 2, 1) / 4 where times are even.

    A straight line stays as it is, whatever the gaps. The first and the last sample
    stay.
    """
    before, after = np.diff(times)[:-1, None], np.diff(times)[1:, None]
    straight = (after * values[:-2] + before * values[2:]) / (before + after)
    return np.concatenate([values[:1], (values[1:-1] + straight) / 2, values[1:][-1:]])
