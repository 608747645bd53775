"""The step `movers`: which pixels of the masks it follows the second time."""

import numpy as np

from hdr_nsff.prepare.steps.movers import within_outlines


def test_masks_lose_their_outline_and_thin_movers_stay_whole() -> None:
    moving = np.zeros((1, 20, 30), bool)
    moving[0, 4:16, 4:16] = True  # 12 x 12: an outline of 2 pixels leaves 8 x 8
    moving[0, 5:15, 22:25] = True  # 3 pixels wide: nothing would be left
    inside = within_outlines(moving)[0]
    assert inside[:, :20].sum() == 64
    assert inside[6:14, 6:14].all()
    assert np.array_equal(inside[:, 20:], moving[0, :, 20:])
