"""The paper's objective (eq. 16, METHOD.md 3), term by term, for any field: everything
here needs a `Render` and a tone mapper only.

The field's own per-sample regularizers and the tone mapper's come in by name. Keys are
the field names of `LossWeights`; a term without a weight is an error. `phase` is the
time since the start in units of the schedule's period K.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from hdr_nsff.fields.base import Render, Warp
from hdr_nsff.maths import losses
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.tonemap.tonemapper import ToneMapper


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms; 0 turns one off. Defaults are the `grid` preset's."""

    photometric: float = 1.0
    """Eq. 12: blended render against the recording, uniformly drawn pixels."""
    dynamic: float = 1.0
    """The dynamic branch alone (eq. 7) or the moving pixels again (densities that add
    up), saturation-weighted.
    """
    temporal: float = 0.3
    """Eq. 13: renders warped from the neighboring times."""
    chain: float = 0.1
    """The same through two steps, from phase 2 on."""
    cycle: float = 0.5
    flow_magnitude: float = 0.01
    smoothness: float = 0.1
    kinetic: float = 0.1
    disocclusion: float = 0.02
    blend_entropy: float = 0.0
    depth: float = 0.5
    """Depth prior; fades, see `prior_fade`."""
    flow: float = 0.01
    """Optical-flow prior, in pixels; fades, see `prior_fade`."""
    mask: float = 0.2
    """Cross-entropy between rendered motion and the moving mask."""
    opacity: float = 0.01
    """Mean opacity of Gaussians: what is not needed fades and is used elsewhere."""
    scale: float = 0.01
    """Mean scale of Gaussians, in units of the near depth."""
    trajectory: float = 30.0
    """Square of third differences of the shared motions, in units of the near depth."""
    brightness_drift: float = 0.01
    """Square of static Gaussians' changes of log radiance in time."""
    opacity_offsets: float = 1e-3
    """Square of moving Gaussians' changes of opacity logit from one knot to the next.
    """
    color_change: float = 0.01
    """Square of moving Gaussians' changes of log radiance from one color knot to the
    next.
    """
    rigidity: float = 1.0
    """Square of the differences in how neighboring moving Gaussians mix the shared
    motions.
    """
    sh1: float = 0.01
    """Square of Gaussians' changes of log radiance with the direction of view."""
    transient: float = 0.01
    """Mean optical thickness of a sample of NeRF-W's transient branch."""
    total_variation: float = 1e-4
    """Mean square differences of neighbors in HexPlane's planes."""
    pose: float = 1e-4
    """What the drawn camera's corrections cost: of its pose by a Cauchy prior, of its
    focal length squared (`refine_poses`).
    """
    response_smoothness: float = 1e-3
    unit_exposure: float = 0.5
    """Distance of a network response from mid gray at the unit exposure."""
    gain_residual: float = 1.0
    response_anchor: float = 100.0


@dataclass(frozen=True)
class Objective:
    """How the terms are formed."""

    weights: LossWeights
    depth_kind: str  # "scene": disparity in scene units; "relative": known up to scale and shift
    near: float  # z-depth, scene units
    squared: bool = False  # eq. 12-13 as printed; False: absolute, as the reference does
    saturation: bool = True  # trust recorded values near 0 and 1 less in the dynamic terms
    fade: float = 0.1  # of the depth and flow terms, every phase
    flow_limit: float | None = 20.0  # pixels: an outlier of the flow prior costs no more than this

    def terms(
        self, render: Render, batch: PixelBatch, tonemap: ToneMapper, phase: float
    ) -> dict[str, Tensor]:
        """All terms that need only the render, unweighted."""
        rgb = self.recorded(render.radiance, batch, tonemap) if render.rgb is None else render.rgb
        uniform = None if batch.uniform.all() else batch.uniform[:, None].to(rgb)
        terms = {"photometric": losses.photometric(rgb, batch.rgb, uniform, self.squared)}
        terms |= self.dynamic(render, rgb, batch, tonemap, phase)
        terms |= self.warped(render, batch, tonemap, phase)
        terms |= self.priors(render, batch, phase)
        if render.scene_flow:
            terms["flow_magnitude"] = torch.stack(
                [losses.flow_magnitude(f) for f in render.scene_flow.values()]
            ).mean()
        return terms

    def recorded(self, radiance: Tensor, batch: PixelBatch, tonemap: ToneMapper) -> Tensor:
        """What the batch's camera would have recorded of `radiance` (N, 3)."""
        return tonemap(radiance, batch.bracket, batch.camera_id, batch.frame, leaky=True)

    def trust(self, batch: PixelBatch) -> Tensor:
        """Trust (N, 3) in the recorded values where what is compared to them is the
        dynamic content.
        """
        return (
            losses.saturation_weight(batch.rgb) if self.saturation else torch.ones_like(batch.rgb)
        )

    def dynamic(
        self, render: Render, rgb: Tensor, batch: PixelBatch, tonemap: ToneMapper, phase: float
    ) -> dict[str, Tensor]:
        """The dynamic branch against the recording: everywhere in the first phase,
        later by its share of the ray.
        """
        if render.dynamic_radiance is None and batch.uniform.all():
            return {}
        trust = self.trust(batch)
        if render.dynamic_radiance is not None:
            alone = self.recorded(render.dynamic_radiance, batch, tonemap)
            share = render.motion.detach()[:, None] if phase >= 1 else torch.ones_like(trust)
            return {"dynamic": losses.photometric(alone, batch.rgb, trust * share, self.squared)}
        extra = (~batch.uniform)[:, None].to(trust)
        return {"dynamic": losses.photometric(rgb, batch.rgb, trust * extra, self.squared)}

    def warped(
        self, render: Render, batch: PixelBatch, tonemap: ToneMapper, phase: float
    ) -> dict[str, Tensor]:
        """Eq. 13 for the neighbors, and through two steps from phase 2 on; weighted by
        what is not disoccluded.
        """
        seen = [w for w in render.warps if w.radiance is not None]
        if not seen:
            return {}
        trust = self.trust(batch)
        share = render.motion.detach() if phase >= 1 else torch.ones_like(render.motion)

        def term(w: Warp) -> Tensor:
            assert w.radiance is not None
            rgb = self.recorded(w.radiance, batch, tonemap)
            return losses.photometric(
                rgb, batch.rgb, trust * (w.confidence * share)[:, None], self.squared
            )

        single = [term(w) for w in seen if abs(w.offset) == 1]
        double = [term(w) for w in seen if abs(w.offset) == 2 and phase >= 2]
        terms = {"temporal": torch.stack(single).mean()} if single else {}
        return terms | ({"chain": torch.stack(double).mean()} if double else {})

    def priors(self, render: Render, batch: PixelBatch, phase: float) -> dict[str, Tensor]:
        """Depth, optical flow and moving mask; depth and flow are multiplied by `fade`
        every phase.
        """
        terms, fade = {}, self.fade ** int(phase)
        depth = render.depth if render.dynamic_depth is None else render.dynamic_depth
        if batch.disparity is not None:
            confidence = (
                torch.ones_like(batch.disparity)
                if batch.disparity_confidence is None
                else batch.disparity_confidence
            )
            if self.depth_kind == "scene":
                terms["depth"] = fade * losses.depth_scene(
                    depth, batch.disparity, confidence, self.near
                )
            else:
                terms["depth"] = fade * losses.depth_relative(depth, batch.disparity)
        flows = [
            losses.optical_flow(
                w.flow, batch.flow[w.offset], batch.flow_valid[w.offset], self.flow_limit
            )
            for w in render.warps
            if w.offset in batch.flow
        ]
        if flows:
            terms["flow"] = fade * torch.stack(flows).mean()
        if batch.moving is not None:
            terms["mask"] = losses.motion_mask(
                render.motion,
                batch.moving,
                None if batch.outline is None else (~batch.outline).float(),
            )
        return terms

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """The weighted sum. KeyError-like AssertionError for a term without a weight."""
        known = {f.name: getattr(self.weights, f.name) for f in fields(self.weights)}
        unknown = set(terms) - set(known)
        assert not unknown, f"terms without a weight in LossWeights: {sorted(unknown)}"
        counting = torch.stack([value for name, value in terms.items() if known[name]])
        return (
            counting * torch.tensor([known[name] for name in terms if known[name]]).to(counting)
        ).sum()
