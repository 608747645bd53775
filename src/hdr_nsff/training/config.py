"""The settings of a training run, composed from each room's own, and the presets. Saved
in the run; enough to rebuild it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hdr_nsff.core.errors import InputError
from hdr_nsff.fields import FieldConfig
from hdr_nsff.fields.baselines.hexplane import HexPlaneConfig
from hdr_nsff.fields.baselines.nerf_wt import NerfWTConfig
from hdr_nsff.fields.nsff.branches import GridConfig, MlpConfig
from hdr_nsff.fields.nsff.nsff import NSFFConfig
from hdr_nsff.fields.nsff.two_branches import BranchesConfig
from hdr_nsff.fields.splat.splat import SplatConfig
from hdr_nsff.tonemap.tonemapper import ToneMapConfig
from hdr_nsff.training.objective import LossWeights

VERSION = 2  # of a run's config.json


@dataclass(frozen=True)
class TrainConfig:
    """Train a dynamic HDR radiance field from a prepared scene. Killed runs go on where
    they were.
    """

    scene: Path = Path("scene")
    """Scene folder, as `prepare` wrote it."""
    out: Path = Path("run")
    """Run folder: config, checkpoints, log, previews."""
    field: FieldConfig = dataclasses.field(default_factory=NSFFConfig)
    tonemap: ToneMapConfig = dataclasses.field(default_factory=ToneMapConfig)
    loss: LossWeights = dataclasses.field(default_factory=LossWeights)
    steps: int | None = None
    """Stop after this many steps. The same seed and steps give the same result, also
    through kills and restarts.
    """
    minutes: float | None = 5.0
    """Without `steps`: stop after this many minutes of training; learning rates and
    schedules follow the clock.
    """
    rays: int = 1536
    """Uniformly drawn pixels of a batch; 0: the whole frame."""
    moving_rays: int = 512
    """More pixels of a batch, from the moving mask."""
    moving_until: float = 1.0
    """Share of the run (or phase, for `paper`) up to which moving pixels are added."""
    batches: int = 1
    """Batches (each of one random frame) of a step, over all devices together."""
    period: float = 0.45
    """The schedules' period K as a share of the run; 0: the published K = 1000
    min(max(30, frames), 250) steps.
    """
    prior_fade: float = 1.0
    """Depth and flow weights are multiplied by this every period (published: 0.1)."""
    lr_final: float = 0.05
    """Learning rates fall exponentially to this share of their start over the run; 0:
    the published 0.1 per 300k steps.
    """
    tonemap_lr: float = 2e-3
    anchor_at: float = 0.05
    """Share of the run after which response and exposures are held where they are (1:
    never), unless static points told them: then at once.
    """
    from_priors: bool = True
    """Start the field from the depth prior and the recorded colors (no effect on the
    published network).
    """
    refine_poses: bool = False
    """Correct the training cameras (poses and focal length) a little, by the picture.
    """
    pose_lr: float = 6e-4
    """Of these corrections, as a motion of the picture in shares of its width."""
    squared: bool = False
    """Squared photometric errors (eq. 12-13) instead of absolute ones (the reference).
    """
    saturation: bool = True
    """Trust recorded values near 0 and 1 less in the dynamic terms."""
    bf16: bool = False
    """Network layers in bfloat16 (matters for `paper` only)."""
    seed: int = 0
    device: str = "auto"
    """auto, cpu or cuda."""
    torch_threads: int = 1
    """Threads of torch beside the kernels' own, which do the work: waking more for
    small operations costs more than they give. 0: all.
    """
    checkpoint_seconds: float = 60.0
    """Seconds between checkpoints and preview pictures."""

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` turns back."""
        kinds = [type(self.field).__name__]
        if isinstance(self.field, BranchesConfig):
            kinds.append(type(self.field.encoding).__name__)
        names = {"version": VERSION, "scene": str(self.scene), "out": str(self.out), "kinds": kinds}
        return names | {k: v for k, v in asdict(self).items() if k not in names}

    @staticmethod
    def from_json(data: dict[str, Any]) -> TrainConfig:
        """The config of a run. InputError where it is of another version, or a key is
        missing or unknown.
        """
        if not isinstance(data, dict) or data.get("version") != VERSION:
            raise InputError(
                "the run's config.json is of another version of hdr-nsff; train again into a new folder"
            )
        try:
            data = {k: v for k, v in data.items() if k != "version"}
            parts = {
                "field": read_field(data.pop("kinds"), data["field"]),
                "tonemap": ToneMapConfig(**data["tonemap"]),
                "loss": LossWeights(**data["loss"]),
                "scene": Path(data["scene"]),
                "out": Path(data["out"]),
            }
            config = TrainConfig(**{**data, **parts})
            check(config)
            return config
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(
                f"the run's config.json is from another version or damaged ({error}); train again into a new folder"
            ) from error


def read_field(kinds: list[str], values: dict[str, Any]) -> FieldConfig:
    """The field's settings from plain data; `kinds` names their types, outermost first."""
    known: dict[str, Any] = {c.__name__: c for c in (*get_args(FieldConfig), GridConfig, MlpConfig)}
    if len(kinds) > 1:
        values = {**values, "encoding": known[kinds[1]](**values["encoding"])}
    field = known[kinds[0]](**values)
    if not isinstance(field, FieldConfig):
        raise TypeError(f"{kinds[0]} is no field")
    return field


ABOVE_ZERO = {"minutes", "finest", "motion_cell"}
FROM_ONE = {
    "steps",
    "batches",
    "bases",
    "color_knots",
    "brightness_knots",
    "opacity_knots",
    "samples",
    "render_samples",
    "levels",
}
FROM_ONE |= {
    "depth_cells",
    "max_rows",
    "layers",
    "width",
    "static",
    "code_size",
    "head_width",
    "grow_every",
}
FROM_ONE |= {"density_components", "appearance_components", "coarsest", "finest"}
AT_MOST = {
    "static": 1e8,
    "moving": 1e8,
    "max_rows": 1e9,
    "steps": 1e12,
    "seed": 2**63 - 1,
    "checkpoint_seconds": 1e12,
    "torch_threads": 1024,  # torch crashes where the system refuses it more threads
    "rays": 2**18,  # all samples of a step are in memory at once
    "moving_rays": 2**18,
}  # else a million


def check(settings: Any, prefix: str = "") -> None:
    """InputError that names the option whose value is of the wrong type or cannot be.
    Settings are frozen dataclasses of dataclasses, numbers (none may be negative),
    words, switches and paths.
    """
    hints = get_type_hints(type(settings))
    for f in dataclasses.fields(settings):
        value, option = getattr(settings, f.name), f"--{prefix}{f.name.replace('_', '-')}"
        if not fits(value, hints[f.name]):
            raise InputError(
                f"{option} {value!r:.40}: no such value; `hdr-nsff train --help` lists what there is"
            )
        if dataclasses.is_dataclass(value):
            check(value, f"{prefix}{f.name.replace('_', '-')}.")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            low, high = 1 if f.name in FROM_ONE else 0, AT_MOST.get(f.name, 1e6)
            if not low <= value <= high or (f.name in ABOVE_ZERO and value == 0):
                least = "above 0" if f.name in ABOVE_ZERO else f"from {low}"
                raise InputError(f"{option} {value!r:.40}: choose a number {least} to {high:g}")


def fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a type as written in a dataclass."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_args(kind):
        return any(fits(value, k) for k in get_args(kind))
    if kind is float:
        return type(value) in (int, float) and -1e300 < value < 1e300
    return type(value) is kind or (kind is Path and isinstance(value, Path))


def splat() -> TrainConfig:
    """4D Gaussians: minutes to train on a CPU, tens of small frames a second. Flow and
    rigidity are looked at every second step each.
    """
    weights = LossWeights(
        dynamic=0.0,
        temporal=0.0,
        chain=0.0,
        cycle=0.0,
        flow_magnitude=0.0,
        depth=0.2,
        flow=0.02,
        mask=0.1,
        rigidity=2.0,
    )
    return TrainConfig(field=SplatConfig(), loss=weights, rays=0, moving_rays=0, lr_final=0.03)


def paper() -> TrainConfig:
    """The published settings: METHOD.md 2-3, the P column."""
    weights = LossWeights(
        temporal=1.0, chain=1.0, cycle=1.0, flow_magnitude=0.1, smoothness=0.1, kinetic=0.1, disocclusion=0.1,
        blend_entropy=1e-3, depth=0.04, flow=0.02, mask=0.0, gain_residual=0.0, response_anchor=0.0,
    )  # fmt: skip
    network = NSFFConfig(
        MlpConfig(),
        samples=128,
        render_samples=128,
        compositing="blend",
        radiance="sigmoid",
        density="relu",
        density_noise=1.0,
        cull=False,
    )
    return TrainConfig(
        field=network, tonemap=ToneMapConfig(kind="per_image", knots="even", from_recordings=False), loss=weights, steps=250_000, minutes=None, rays=1024,
        moving_rays=512, batches=1, from_priors=False, period=0.0, prior_fade=0.1, lr_final=0.0, tonemap_lr=5e-4, anchor_at=1.0, torch_threads=0, checkpoint_seconds=600,
    )  # fmt: skip


def tiny() -> TrainConfig:
    """Seconds on a CPU, for tests and for trying out."""
    network = NSFFConfig(
        GridConfig(finest=4.0, depth_cells=24, levels=2, max_rows=2**14),
        samples=16,
        render_samples=24,
        cull_after=20,
    )
    return TrainConfig(field=network, steps=60, minutes=None, rays=192, moving_rays=64, batches=1)


# Baselines (METHOD.md 6); docs/baselines.md says of each what is the same, what had to
# differ and why


NOTHING = LossWeights(
    **{f.name: 0.0 for f in dataclasses.fields(LossWeights)} | {"photometric": 1.0}
)
LDR = ToneMapConfig(kind="none")


def nsff_paper() -> TrainConfig:
    """NSFF at its published size: `paper` without a tone mapper, with squared errors
    that trust every recorded value.
    """
    return replace(paper(), tonemap=LDR, squared=True, saturation=False)


def nsff() -> TrainConfig:
    """The same on the grids of `grid`, its schedules as the same shares of the run."""
    published = nsff_paper()
    field = NSFFConfig(compositing="blend", radiance="sigmoid")
    weights = replace(published.loss, depth=0.5, flow=0.01)
    return replace(
        published, field=field, loss=weights, steps=None, minutes=5.0, rays=1536, from_priors=True, period=0.12, moving_until=0.12,
        prior_fade=0.5, lr_final=0.05, torch_threads=1, checkpoint_seconds=60,
    )  # fmt: skip


def nerf_wt_paper() -> TrainConfig:
    """NeRF-W with time at the size of its public implementation."""
    field = NerfWTConfig(
        MlpConfig(), samples=128, render_samples=128, density="relu", density_noise=1.0, cull=False
    )
    return replace(nsff_paper(), field=field, loss=replace(NOTHING, transient=0.01), moving_rays=0)


def nerf_wt() -> TrainConfig:
    """The same on the grids of `grid`, with the geometry that grids need."""
    weights = replace(NOTHING, transient=0.01, depth=0.5)
    return TrainConfig(
        field=NerfWTConfig(),
        tonemap=LDR,
        loss=weights,
        squared=True,
        saturation=False,
        moving_rays=0,
    )


def hexplane_paper() -> TrainConfig:
    """HDR-HexPlane at its published size."""
    return TrainConfig(
        field=HexPlaneConfig(), tonemap=ToneMapConfig(kind="sigmoid"), loss=replace(NOTHING, total_variation=1e-4), steps=25_000,
        minutes=None, rays=4096, moving_rays=0, lr_final=0.1, tonemap_lr=1e-3, anchor_at=1.0, from_priors=False, squared=True,
        saturation=False, torch_threads=0, checkpoint_seconds=600,
    )  # fmt: skip


def hexplane() -> TrainConfig:
    """The same for minutes on a CPU: smaller grids and batches, and rates for a
    twentieth of the steps.
    """
    field = HexPlaneConfig(
        coarsest=48, finest=128, grow_every=200, emptiness=5.0, samples=32, render_samples=48, cull_after=50, plane_lr=0.05, network_lr=5e-3
    )  # fmt: skip
    return replace(
        hexplane_paper(),
        field=field,
        steps=None,
        minutes=5.0,
        rays=512,
        torch_threads=1,
        checkpoint_seconds=120,
    )


# Ablations of ours


RESPONSES: dict[str, Literal["none", "fixed", "mlp", "per_image"]] = {
    "response-none": "none",
    "response-fixed": "fixed",
    "response-mlp": "mlp",
    "response-per-image": "per_image",
}
ABLATIONS = (*RESPONSES, "no-flow", "no-depth", "no-saturation", "sigmoid")


def ablated(config: TrainConfig, name: str) -> TrainConfig:
    """A preset with one thing changed; `name` is one of `ABLATIONS`."""
    match name:
        case "no-flow":  # nor is the flow looked at before training
            return replace(config, loss=replace(config.loss, flow=0.0))
        case "no-depth":
            return replace(config, loss=replace(config.loss, depth=0.0), from_priors=False)
        case "no-saturation":
            return replace(config, saturation=False)
        case "sigmoid":
            assert not isinstance(config.field, HexPlaneConfig), "its sigmoid is the camera's"
            return replace(config, field=replace(config.field, radiance="sigmoid"))
        case _:
            return replace(config, tonemap=replace(config.tonemap, kind=RESPONSES[name]))


def ablations() -> dict[str, TrainConfig]:
    """By name, `grid-no-flow` and the like. Gaussians have no term that saturation
    weighs.
    """
    presets = {"splat": splat(), "grid": TrainConfig()}
    return {
        f"{p}-{a}": ablated(config, a)
        for p, config in presets.items()
        for a in ABLATIONS
        if (p, a) != ("splat", "no-saturation")
    }


METHODS: dict[str, TrainConfig] = {
    "splat": splat(),
    "grid": TrainConfig(),
    "paper": paper(),
    "tiny": tiny(),
    "nsff": nsff(),
    "nsff-paper": nsff_paper(),
    "nerf-wt": nerf_wt(),
    "nerf-wt-paper": nerf_wt_paper(),
    "hdr-hexplane": hexplane(),
    "hdr-hexplane-paper": hexplane_paper(),
}
PRESETS: dict[str, TrainConfig] = METHODS | ablations()
