"""Curve, gain and regularizers of the shared tone mapper by CUDA kernels: one launch,
where plain torch takes about a hundred for these few numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.kernels.cuda.launch import few_zeros, launch
from hdr_nsff.fields.kernels.cuda.layout import MAX_KNOTS

TERM_NAMES = ("response_smoothness", "gain_residual", "response_anchor", "vignetting")


@dataclass(frozen=True)
class Learned:
    """What a shared tone mapper has learned."""

    logits: Tensor  # (C, 3, K - 1) of the curves' steps
    ev: Tensor  # (U,) of unknown brackets
    white_balance: Tensor  # (C - 1, 3) natural log
    residual: Tensor  # (F, 3) natural log, or (0, 3)
    vignetting: Tensor  # (C, 3), or (0, 3)

    def tensors(self) -> tuple[Tensor, ...]:
        """All of them, in this order."""
        return self.logits, self.ev, self.white_balance, self.residual, self.vignetting


@dataclass(frozen=True)
class Held:
    """What it holds, and its settings."""

    known: Tensor  # (B,) EV, 0 where unknown
    unknown: Tensor  # (U,) brackets to learn
    drift: Tensor  # (F, 3) natural log
    curve: Tensor  # (C, 3, K) that `anchor` held
    ev: Tensor  # (B,)
    white_balance: Tensor  # (C - 1, 3)
    anchored: bool
    min_step: float


@dataclass(frozen=True)
class Recording:
    """What records a frame, and the terms that keep all that was learned in place."""

    gain: Tensor  # (3,) of the frame
    curve: Tensor  # (3, K) of its camera
    terms: dict[str, Tensor]


def fused_recording(
    learned: Learned, held: Held, bracket: int, camera_id: int, frame: int | None
) -> Recording:
    """Everything of one frame, in one launch; without a `frame`, of any other view."""
    which = camera_id, bracket, -1 if frame is None else frame
    curve, gain, terms = Tone.apply(held, which, *learned.tensors())
    names = TERM_NAMES if len(learned.vignetting) else TERM_NAMES[:3]
    return Recording(gain, curve, dict(zip(names, terms.unbind(), strict=False)))


class Tone(torch.autograd.Function):
    """The curve (3, K) of `which` camera, the gain (3,) and the terms (4,)."""

    @staticmethod
    def forward(
        ctx: Any, held: Held, which: tuple[int, int, int], *learned: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        logits, ev, white, residual, vignetting = (t.detach().contiguous() for t in learned)
        num_knots = logits.shape[2] + 1
        assert num_knots <= MAX_KNOTS, num_knots
        anchors = held.curve, held.ev, held.white_balance
        parts = logits, held.known, held.unknown, ev, held.drift, white, residual, *anchors
        ctx.given = *parts, vignetting, held.min_step, *which, int(held.anchored)
        values = logits.new_empty(len(logits), 3, num_knots)
        gain, terms = logits.new_empty(3), few_zeros(logits, len(TERM_NAMES))
        launch("tone", (3 * len(logits), 1), MAX_KNOTS, *ctx.given, values, gain, terms)
        ctx.made = values, gain.detach()  # a result itself would hold on to its own graph
        ctx.set_materialize_grads(False)
        return values[which[0]], gain, terms

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> Any:
        logits, ev, white, residual = (ctx.given[i] for i in (0, 3, 5, 6))
        vignetting = ctx.given[10]
        values, gain = ctx.made
        made = [torch.empty_like(t) for t in (logits, ev, white, residual, vignetting)]
        missing = values[:0, 0], gain[:0], gain[:0]
        d = [m if g is None else g.contiguous() for g, m in zip(grads, missing, strict=True)]
        launch("tone_backward", (3 * len(logits), 1), MAX_KNOTS, *ctx.given, *ctx.made, *d, *made)
        shaped = None if d[2] is missing[2] else made[4]  # the lens has no part in the others
        return None, None, *made[:4], shaped
