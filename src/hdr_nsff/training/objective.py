"""The paper's objective (eq. 16), term by term, for any field.

Everything here needs a `Render` and a tone mapper only. docs/method.md#eq-16 lists the
terms beside the paper's. Terms of some fields only, and of the tone mapper, have their
weights there; `weighted_terms.py` sums all terms by name. `phase` is the time since the
start in units of the schedule's period K.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hdr_nsff.core.settings import Weight
from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.maths import losses
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.tonemap.base import ToneMapper
from hdr_nsff.training.fused_losses import can_fuse, fused_terms, losses_by_kernels

FLOW_LIMIT_PX = 20.0  # an outlier of the flow prior costs no more (hand-chosen)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of every field; 0 turns one off."""

    photometric: Weight = 1.0
    """Eq. 12: the picture against the recording, uniformly drawn pixels."""
    dynamic: Weight = 1.0
    """The dynamic branch alone (eq. 7), or --moving-rays again; by trust in the rgb."""
    depth: Weight = 0.5
    """Depth prior."""
    flow: Weight = 0.01
    """Optical flow prior, in pixels."""
    mask: Weight = 0.2
    """Cross-entropy of rendered motion and moving mask."""


@dataclass(frozen=True)
class Objective:
    """How the terms are formed."""

    weights: dict[str, float]  # of every term that this run can form
    depth_kind: str  # "scene": disparity in scene units; "relative": up to scale and shift
    near: float  # z-depth, scene units
    squared: bool = False  # eq. 12-13 as printed; False: absolute, as the reference does
    published: bool = False  # terms formed as the reference forms them: see `TrainConfig`
    saturation: bool = True  # trust rgb near 0 and 1 less in the dynamic terms
    fade: float = 0.1  # of the depth and flow terms, every phase

    def terms(
        self, render: Render, batch: PixelBatch, tonemap: ToneMapper, phase: float
    ) -> dict[str, Tensor]:
        """All terms that need only the render, unweighted."""
        rgb = tonemap.record_render(render, batch, leaky=True)
        relative = self.published or self.depth_kind == "relative"
        plain = relative or self.squared or not can_fuse(render, batch)
        kernels = None if plain else losses_by_kernels(rgb)
        if kernels is not None:
            fade = self.fade ** int(phase)
            return fused_terms(kernels, render, rgb, batch, self.near, fade, FLOW_LIMIT_PX)
        uniform = None if batch.all_uniform() else batch.uniform[:, None].to(rgb)
        terms = {"photometric": losses.photometric(rgb, batch.rgb, uniform, self.squared)}
        terms |= self.dynamic(render, rgb, batch, tonemap, phase)
        terms |= self.warped(render, batch, tonemap, phase)
        terms |= self.priors(render, batch, phase)
        if render.scene_flow:
            lengths = [losses.flow_magnitude(flow) for flow in render.scene_flow.values()]
            terms["flow_magnitude"] = torch.stack(lengths)
        return self.reduce(terms)

    def reduce(self, terms: dict[str, Tensor]) -> dict[str, Tensor]:
        """Scalar terms: those with a value per neighbor (n,) are averaged.

        The reference adds them up, so that times inside the clip weigh twice as much as
        its ends.
        """
        reduced = {}
        for name, values in terms.items():
            if values.ndim == 0:
                reduced[name] = values
            else:
                reduced[name] = values.sum() if self.published else values.mean()
        return reduced

    def trust(self, batch: PixelBatch) -> Tensor:
        """Trust (N, 3) in recorded values in the terms of the dynamic content."""
        if self.saturation:
            return losses.saturation_weight(batch.rgb)
        return torch.ones_like(batch.rgb)

    def trusted(self, rgb: Tensor, batch: PixelBatch, share: Tensor) -> Tensor:
        """Errors of `rgb` (N, 3), weighed by trust and by the pixels' shares (N,).

        The reference divides by the sum of the shares alone, so that frames of mostly
        clipped values count less. Ours divides by that of trust times share.
        """
        trust, share = self.trust(batch), share[:, None]
        if self.published:
            return losses.photometric(rgb, batch.rgb, share, self.squared, trust)
        return losses.photometric(rgb, batch.rgb, trust * share, self.squared)

    def dynamic(
        self, render: Render, rgb: Tensor, batch: PixelBatch, tonemap: ToneMapper, phase: float
    ) -> dict[str, Tensor]:
        """Eq. 7: the dynamic branch against the recording.

        It counts everywhere in the first phase, later by its share of the ray. Without
        such a branch, the extra moving pixels count.
        """
        if render.dynamic_radiance is not None:
            rgb = tonemap.record(render.dynamic_radiance, batch, leaky=True)
            motion = render.motion.detach()
            share = motion if phase >= 1 else torch.ones_like(motion)
        elif batch.all_uniform():
            return {}
        else:
            share = (~batch.uniform).to(rgb)
        return {"dynamic": self.trusted(rgb, batch, share)}

    def warped(
        self, render: Render, batch: PixelBatch, tonemap: ToneMapper, phase: float
    ) -> dict[str, Tensor]:
        """Eq. 13 for the neighbors, and through two steps from phase 2 on.

        Disoccluded pixels weigh less, by the confidence of the warp.
        """

        def term(warp: Warp) -> Tensor:
            assert warp.radiance is not None
            rgb = tonemap.record(warp.radiance, batch, leaky=True)
            share = warp.confidence
            if phase >= 1:
                share = share * render.motion.detach()
            return self.trusted(rgb, batch, share)

        warps = [warp for warp in render.warps if warp.radiance is not None]
        single = [term(warp) for warp in warps if abs(warp.offset) == 1]
        double = [term(warp) for warp in warps if abs(warp.offset) == 2 and phase >= 2]
        terms = {}
        if single:
            terms["temporal"] = torch.stack(single)
        if double:
            terms["chain"] = torch.stack(double)
        return terms

    def priors(self, render: Render, batch: PixelBatch, phase: float) -> dict[str, Tensor]:
        """Eq. 14 and the moving mask; depth and flow fade by `fade` every phase."""
        terms = {}
        fade = self.fade ** int(phase)
        depth = render.depth if render.dynamic_depth is None else render.dynamic_depth
        relative = self.published or self.depth_kind == "relative"
        if batch.disparity is not None and relative:
            terms["depth"] = fade * losses.depth_relative(depth, batch.disparity)
        elif batch.disparity is not None:
            trust = batch.disparity_confidence
            terms["depth"] = fade * losses.depth_scene(depth, batch.disparity, trust, self.near)
        flows = []
        limit = None if self.published else FLOW_LIMIT_PX
        for warp in render.warps:
            if warp.offset in batch.flow:
                target, valid = batch.flow[warp.offset], batch.flow_valid[warp.offset]
                flows.append(losses.optical_flow(warp.flow, target, valid, limit))
        if flows:
            terms["flow"] = fade * torch.stack(flows)
        if batch.moving is not None:
            certain = None if batch.outline is None else (~batch.outline).float()
            terms["mask"] = losses.motion_mask(render.motion, batch.moving, certain)
        return terms
