"""Rigs whose cameras stand still: each of them sees its background at other times."""

from __future__ import annotations

import numpy as np

from hdr_nsff.prepare.work import Work


def still_cameras(work: Work) -> np.ndarray | None:
    """The camera (T,) of every frame, where all of several cameras stand still; None
    elsewhere.
    """
    m = work.manifest
    if m.rig > 1:
        return np.array(m.places)
    cameras = np.array([f.camera_id for f in m.frames])
    _, first, of_frame = np.unique(cameras, return_index=True, return_inverse=True)
    c2w = work.cameras()[1]
    return cameras if len(first) > 1 and np.array_equal(c2w, c2w[first][of_frame]) else None
