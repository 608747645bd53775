"""Parameters that are learned alike, as fields, tone mappers and cameras hand them to
the optimizers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class ParamGroup:
    """Parameters that share their learning rate.

    With `row_marks`, one (rows,) uint8 tensor per parameter (rows, 4), only marked rows
    are moved (`TouchedAdam`), and the optimizer clears the marks.
    """

    params: Sequence[Tensor]
    lr: float
    betas: tuple[float, float] | None = None  # the optimizer's default where None
    eps: float | None = None
    row_marks: list[Tensor] | None = None
    start: float = 0.0  # share of the run before which the rate is 0
