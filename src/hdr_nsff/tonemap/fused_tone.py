"""Curve, gain and regularizers of the shared tone mapper by CUDA kernels: one launch
each, where plain torch takes about fifty for these few numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from hdr_nsff.fields.kernels.cuda.launch import launch
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


def fused_recording(
    learned: Learned, held: Held, bracket: int, camera_id: int, frame: int | None
) -> tuple[Tensor, Tensor]:
    """The gain (3,) of a frame, and the curve (3, K) of its camera."""
    which = camera_id, bracket, -1 if frame is None else frame
    curves, gain, _ = Tone.apply(held, which, *learned.tensors())
    return gain, curves[0]


def fused_regularizers(learned: Learned, held: Held) -> dict[str, Tensor]:
    """The terms of all curves, and of everything that keeps them in place."""
    _, _, terms = Tone.apply(held, None, *learned.tensors())
    names = TERM_NAMES if len(learned.vignetting) else TERM_NAMES[:3]
    return dict(zip(names, terms.unbind(), strict=False))


class Tone(torch.autograd.Function):
    """Curves (1, 3, K), gain (3,), nothing; or without `which`, the terms (4,) last."""

    @staticmethod
    def forward(
        ctx: Any, held: Held, which: tuple[int, int, int] | None, *learned: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        logits, ev, white, residual, vignetting = (t.detach().contiguous() for t in learned)
        num_cameras = len(logits) if which is None else 1
        num_knots = logits.shape[2] + 1
        assert num_knots <= MAX_KNOTS, num_knots
        anchors = held.curve, held.ev, held.white_balance
        parts = logits, held.known, held.unknown, ev, held.drift, white, residual, *anchors
        numbers = held.min_step, *(which or (0, 0, -1)), int(held.anchored)
        ctx.given = *parts, vignetting, *numbers
        values = logits.new_empty(num_cameras, 3, num_knots)
        gain = logits.new_empty(3)
        terms = logits.new_zeros(len(TERM_NAMES)) if which is None else logits.new_empty(0)
        launch("tone", (3 * num_cameras, 1), MAX_KNOTS, *ctx.given, values, gain, terms)
        ctx.made, ctx.of_terms = (values, gain), which is None
        ctx.set_materialize_grads(False)
        return values, gain, terms

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> Any:
        logits, ev, white, residual = (ctx.given[i] for i in (0, 3, 5, 6))
        vignetting = ctx.given[10]
        values, gain = ctx.made
        made = [torch.empty_like(t) for t in (logits, ev, white, residual, vignetting)]
        missing = values[:0], gain[:0], gain[:0]
        d = [m if g is None or not g.numel() else g for g, m in zip(grads, missing, strict=True)]
        if len(values) < len(logits):  # of the other cameras
            made[0].zero_()
        grid = 3 * len(values), 1
        given = (*ctx.given, values, gain, *(g.contiguous() for g in d))
        launch("tone_backward", grid, MAX_KNOTS, *given, *made)
        unused = not ctx.of_terms
        return None, None, *made[:4], None if unused else made[4]
