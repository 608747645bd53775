"""The presets of `train`: ours, the paper's, the published baselines, and ablations.

docs/baselines.md says of each baseline what is the same, what had to differ and why.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from hdr_nsff.fields.baselines.hexplane import HexPlaneConfig
from hdr_nsff.fields.baselines.nerf_wt import NerfWTConfig
from hdr_nsff.fields.nsff.branches import GridConfig, MlpConfig
from hdr_nsff.fields.nsff.nsff import NDC_TO_CUBE, NSFFConfig, SceneFlowLosses
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.tonemap.base import ToneMapConfig, ToneMapLosses
from hdr_nsff.training.budget import Budget, Schedule
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.objective import LossWeights

PICTURE_ALONE = LossWeights(photometric=1.0, dynamic=0.0, depth=0.0, flow=0.0, mask=0.0)
NO_TONE_MAPPER = ToneMapConfig(kind="none")
PUBLISHED_SCHEDULE = Schedule(period=0.0, prior_fade=0.1, lr_final=0.0)
PUBLISHED_STEPS = Budget(steps=250_000, minutes=None)
# the published fields: networks, no culling, ReLU densities with noise
PUBLISHED_SAMPLES = 128
# published terms are means over axes, ours add the axes up
AXES, IMAGE_AXES = 3, 2
# the same on a CPU, see `small`
SMALL_STEPS = 12_000
SMALL_PERIOD = 0.144  # of the run, as the published K is for 36 frames
SMALL_SAMPLES = 32
# NeRF-W weighs mean transient density by 0.01 and squared errors by 1 / (2 beta^2).
# This is the ratio of the two at beta's minimum, 0.03: beta itself is left out.
NERF_W_TRANSIENT = 0.01 * 2 * 0.03**2


def splat() -> TrainConfig:
    """4D Gaussians, minutes on a CPU. Flow and rigidity are compared every second step
    each.
    """
    return TrainConfig(
        field=SplatConfig(),
        loss=LossWeights(dynamic=0.0, depth=0.2, flow=0.02, mask=0.01),
        schedule=Schedule(lr_final=0.03),
        rays=0,
        moving_rays=0,
    )


def paper() -> TrainConfig:
    """The published network, losses and schedules (docs/method.md)."""
    field = NSFFConfig(
        encoding=MlpConfig(),
        loss=SceneFlowLosses(
            temporal=1.0,
            chain=1.0,
            cycle=1.0 / NDC_TO_CUBE / AXES,  # published in NDC, here in cube units
            flow_magnitude=0.1,
            smoothness=0.1 / AXES,
            kinetic=0.1 / AXES,
            disocclusion=0.1,
            blend_entropy=1e-3,
            distortion=1e-3,
        ),
        samples=PUBLISHED_SAMPLES,
        render_samples=PUBLISHED_SAMPLES,
        compositing="blend",
        radiance="sigmoid",
        density="relu",
        density_noise=1.0,
        opaque_end=True,
        cull=False,
    )
    tonemap = ToneMapConfig(
        kind="per_image",
        knots="even",
        from_recordings=False,
        loss=ToneMapLosses(gain_residual=0.0, response_anchor=0.0, vignetting=0.0),
    )
    return TrainConfig(
        field=field,
        tonemap=tonemap,
        loss=LossWeights(depth=0.04, flow=0.02 / IMAGE_AXES, mask=0.0),
        budget=PUBLISHED_STEPS,
        schedule=PUBLISHED_SCHEDULE,
        rays=1024,
        moving_rays=512,
        published=True,
        from_priors=False,
        tonemap_lr=5e-4,
        anchor_at=1.0,
        torch_threads=0,
        checkpoint_seconds=600.0,
    )


def small(published: TrainConfig) -> TrainConfig:
    """A published network for a CPU and frames of 120x68: the same objective and code
    with narrower networks in bfloat16, no octaves finer than such pixels, fewer rays
    and samples, and faster rates for a twentieth of the steps.

    `paper-small` takes 2,505 seconds on one core that computes in bfloat16. Four
    held-out views are at 22.1 dB after half of its steps, at 23.8 dB at the end
    (docs/results.md).
    """
    assert isinstance(published.field, NSFFConfig | NerfWTConfig)
    return replace(
        published,
        field=replace(
            published.field,
            encoding=MlpConfig(layers=6, width=96, skip_after=3, octaves=7, lr=2e-3),
            samples=SMALL_SAMPLES,
            render_samples=SMALL_SAMPLES,
        ),
        budget=Budget(steps=SMALL_STEPS, minutes=None),
        schedule=replace(published.schedule, period=SMALL_PERIOD, lr_final=0.1),
        rays=224,
        moving_rays=min(64, published.moving_rays),
        moving_until=SMALL_PERIOD,
        bf16=True,
        tonemap_lr=1e-2,
        checkpoint_seconds=60.0,
    )


def tiny() -> TrainConfig:
    """Seconds on a CPU, to try things out."""
    field = NSFFConfig(
        encoding=GridConfig(finest=4.0, depth_cells=24, levels=2, max_rows=2**14),
        samples=16,
        render_samples=24,
        cull_after=20,
    )
    return TrainConfig(field=field, budget=Budget(steps=60, minutes=None), rays=192, moving_rays=64)


def nsff_paper() -> TrainConfig:
    """NSFF at its published size: `paper` without a tone mapper.

    Its errors are squared and trust every recorded value.
    """
    return replace(paper(), tonemap=NO_TONE_MAPPER, squared=True, saturation=False)


def nsff() -> TrainConfig:
    """The same on the grids of `grid`, its schedules as the same shares of the run."""
    published = nsff_paper()
    assert isinstance(published.field, NSFFConfig)
    return replace(
        published,
        field=NSFFConfig(loss=published.field.loss, compositing="blend", radiance="sigmoid"),
        loss=replace(published.loss, depth=0.5, flow=0.01),
        budget=Budget(minutes=5.0),
        schedule=Schedule(period=0.12, prior_fade=0.5, lr_final=0.05),
        rays=1536,
        moving_until=0.12,
        from_priors=True,
        torch_threads=1,
        checkpoint_seconds=60.0,
    )


def nerf_wt_paper() -> TrainConfig:
    """NeRF-W with time at the size of its public implementation."""
    field = NerfWTConfig(
        encoding=MlpConfig(),
        transient=NERF_W_TRANSIENT,
        transient_cost="density",
        samples=PUBLISHED_SAMPLES,
        render_samples=PUBLISHED_SAMPLES,
        compositing="superpose",
        density="softplus",
        opaque_end=True,
        cull=False,
    )
    return replace(nsff_paper(), field=field, loss=PICTURE_ALONE, moving_rays=0)


def nerf_wt() -> TrainConfig:
    """The same on the grids of `grid`, with the geometry that grids need."""
    return TrainConfig(
        field=NerfWTConfig(),
        tonemap=NO_TONE_MAPPER,
        loss=replace(PICTURE_ALONE, depth=0.5),
        squared=True,
        saturation=False,
        moving_rays=0,
    )


def hexplane_paper() -> TrainConfig:
    """HDR-HexPlane at its published size."""
    return TrainConfig(
        field=HexPlaneConfig(),
        tonemap=ToneMapConfig(kind="sigmoid"),
        loss=PICTURE_ALONE,
        budget=Budget(steps=25_000, minutes=None),
        schedule=Schedule(lr_final=0.1),
        rays=4096,
        moving_rays=0,
        tonemap_lr=0.02,
        anchor_at=1.0,
        from_priors=False,
        squared=True,
        saturation=False,
        torch_threads=0,
        checkpoint_seconds=600.0,
    )


def hexplane() -> TrainConfig:
    """HDR-HexPlane for minutes on a CPU: smaller grids and batches.

    Its rates are those for a twentieth of the steps.
    """
    field = HexPlaneConfig(
        coarsest=48,
        finest=128,
        grow_every=200,
        emptiness=5.0,
        samples=32,
        render_samples=48,
        cull_after=50,
        plane_lr=0.05,
        network_lr=5e-3,
    )
    return replace(
        hexplane_paper(),
        field=field,
        budget=Budget(minutes=5.0),
        rays=512,
        tonemap_lr=1e-3,
        torch_threads=1,
        checkpoint_seconds=120.0,
    )


# Ablations of ours

RESPONSES: dict[str, Literal["none", "fixed", "mlp", "per_image"]] = {
    "response-none": "none",
    "response-fixed": "fixed",
    "response-mlp": "mlp",
    "response-per-image": "per_image",
}
OF_SPLAT = (*RESPONSES, "no-flow", "no-depth", "sigmoid")
ABLATIONS = (*OF_SPLAT, "no-saturation")  # those of `grid`
OF_PAPER_SMALL = ("no-split", "response-none", "response-fixed", "no-flow", "no-depth")


def ablated(config: TrainConfig, name: str) -> TrainConfig:
    """A preset with one thing changed: `ABLATIONS`, or `no-split` of a scene flow
    field.
    """
    match name:
        case "no-flow":  # nor does the start use flow
            return replace(config, loss=replace(config.loss, flow=0.0))
        case "no-depth":
            return replace(config, loss=replace(config.loss, depth=0.0), from_priors=False)
        case "no-split":
            assert isinstance(config.field, NSFFConfig)
            return replace(config, field=replace(config.field, split=False))
        case "no-saturation":
            return replace(config, saturation=False)
        case "sigmoid":
            assert not isinstance(config.field, HexPlaneConfig), "its sigmoid is the camera's"
            return replace(config, field=replace(config.field, radiance="sigmoid"))
        case _:
            return replace(config, tonemap=replace(config.tonemap, kind=RESPONSES[name]))


def ablations() -> dict[str, TrainConfig]:
    """By name, `grid-no-flow` and the like."""
    changes = [
        ("splat", splat(), OF_SPLAT),
        ("grid", TrainConfig(), ABLATIONS),
        ("paper-small", small(paper()), OF_PAPER_SMALL),
    ]
    return {
        f"{preset}-{name}": ablated(config, name)
        for preset, config, names in changes
        for name in names
    }


METHODS: dict[str, TrainConfig] = {
    "splat": splat(),
    "grid": TrainConfig(),
    "paper": paper(),
    "paper-small": small(paper()),
    "tiny": tiny(),
    "nsff": nsff(),
    "nsff-paper": nsff_paper(),
    "nsff-paper-small": small(nsff_paper()),
    "nerf-wt": nerf_wt(),
    "nerf-wt-paper": nerf_wt_paper(),
    "nerf-wt-paper-small": small(nerf_wt_paper()),
    "hdr-hexplane": hexplane(),
    "hdr-hexplane-paper": hexplane_paper(),
}
PRESETS: dict[str, TrainConfig] = METHODS | ablations()
