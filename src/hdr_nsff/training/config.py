"""The settings of a training run, composed from each room's own. Saved in the run as
config.json; enough to rebuild it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le
from tyro.conf import arg

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.settings import (
    Advanced,
    Rate,
    Share,
    Weight,
    from_plain,
    to_plain,
    with_changes,
)
from hdr_nsff.fields.baselines.hexplane import HexPlaneConfig
from hdr_nsff.fields.baselines.nerf_wt import NerfWTConfig
from hdr_nsff.fields.build import FieldConfig
from hdr_nsff.fields.nsff.nsff import NSFFConfig
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.training.budget import Budget, Schedule
from hdr_nsff.training.objective import LossWeights

VERSION = 2  # of a run's config.json
HELP = "hdr-nsff train --help"
MAX_SEED = 2**63 - 1
MAX_RAYS = 2**18  # of a batch: beyond it, no machine has the memory


@dataclass(frozen=True)
class TrainConfig:
    """Train a dynamic HDR radiance field from a prepared scene. The same command
    continues a killed run. Settings that are no flags here, such as learning rates, are
    changed by --set; config.json of any run lists them all.
    """

    scene: Path = Path("scene")
    """Scene folder, as `prepare` wrote it."""
    out: Path = Path("run")
    """Run folder: config, checkpoints, log, previews."""
    budget: Annotated[Budget, arg(name="")] = dataclasses.field(default_factory=Budget)
    field: FieldConfig = dataclasses.field(default_factory=NSFFConfig)
    tonemap: ToneMapConfig = dataclasses.field(default_factory=ToneMapConfig)
    loss: LossWeights = dataclasses.field(default_factory=LossWeights)
    schedule: Advanced[Schedule] = dataclasses.field(default_factory=Schedule)
    rays: Annotated[int, Ge(0), Le(MAX_RAYS)] = 1536
    """Uniformly drawn pixels of a batch; 0: the whole frame."""
    moving_rays: Annotated[int, Ge(0), Le(MAX_RAYS)] = 512
    """More pixels of a batch, from the moving mask."""
    moving_until: Advanced[Weight] = 1.0
    """Share of the run (or phase, for `paper`) up to which moving pixels are added."""
    batches: Annotated[int, Ge(1), Le(4096)] = 1
    """Batches (each of one random frame) of a step, over all devices together."""
    tonemap_lr: Advanced[Rate] = 2e-3
    anchor_at: Advanced[Share] = 0.05
    """Share of the run after which response and exposures are held where they are (1:
    never), unless static points determined them: then at once.
    """
    from_priors: Advanced[bool] = True
    """Start the field from the depth prior and the recorded colors."""
    refine_poses: bool = False
    """Learn small corrections of the training cameras: poses and focal length."""
    pose_lr: Advanced[Rate] = 6e-4
    """Of these corrections, as a motion of the picture in shares of its width."""
    pose_prior: Advanced[Weight] = 1e-4
    """What the drawn camera's corrections cost: of its pose by a Cauchy prior, of its
    focal length squared.
    """
    squared: Advanced[bool] = False
    """Squared photometric errors (eq. 12-13); the default is absolute ones."""
    saturation: Advanced[bool] = True
    """Trust recorded values near 0 and 1 less in the dynamic terms."""
    published: Advanced[bool] = False
    """Form the terms as the reference does: both neighbors add up, trust in recorded
    values does not count in means, depth is compared up to scale and shift whatever the
    prior, and errors of flow have no upper limit.
    """
    bf16: Advanced[bool] = False
    """Network layers in bfloat16 where the device has units for it (matters for `paper`
    only).
    """
    seed: Annotated[int, Ge(0), Le(MAX_SEED)] = 0
    device: str = "auto"
    """auto, cpu or cuda."""
    torch_threads: Annotated[int, Ge(0), Le(1024)] = 1
    """Threads of torch beside the kernels' own; 0: all cores."""
    checkpoint_seconds: Annotated[float, Ge(0), Le(1e12)] = 60.0
    """Seconds between checkpoints and preview pictures."""
    set: tuple[str, ...] = ()
    """Any other setting: KEY=VALUE, as in field.lr=0.5 or schedule.lr_final=0.1."""

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` turns back."""
        return {"version": VERSION, **to_plain(self)}

    @staticmethod
    def from_json(data: Any) -> TrainConfig:
        """The config of a run. InputError where it is of another version, or a value is
        missing, unknown or out of bounds.
        """
        again = "train again into a new folder"
        if not isinstance(data, dict) or data.get("version") != VERSION:
            raise InputError(f"the run's config.json is of another version of hdr-nsff; {again}")
        values = {k: v for k, v in data.items() if k != "version"}
        missing = {f.name for f in dataclasses.fields(TrainConfig)} - values.keys()
        try:
            if missing:
                raise InputError(f"no value for {', '.join(sorted(missing))}")
            return from_plain(TrainConfig, values, HELP)
        except InputError as error:
            raise InputError(
                f"the run's config.json is from another version or damaged ({error}); {again}"
            ) from error


def check_config(config: TrainConfig) -> TrainConfig:
    """The config after its `set` changes; InputError where it makes no sense.

    Its scene folder is absolute, so that the run can be opened from anywhere.
    """
    config = with_changes(replace(config, set=()), config.set, HELP)
    for setting, problem in settings_without_effect(config):
        raise InputError(f"{setting}: {problem}, or leave it out")
    f = config.field
    if isinstance(f, HexPlaneConfig) and f.finest < f.coarsest:
        problem = f"fewer cells than --field.coarsest {f.coarsest}, which it starts with"
        raise InputError(f"--field.finest {f.finest}: {problem}; raise it, or lower the other")
    return replace(config, scene=config.scene.resolve())


def settings_without_effect(config: TrainConfig) -> Iterator[tuple[str, str]]:
    """Settings that would change nothing, as a user writes them, and what to do."""
    loss, field = config.loss, config.field
    if config.moving_rays and not config.rays:
        yield f"--moving-rays {config.moving_rays}", "whole frames are drawn; give --rays too"
    if loss.dynamic and isinstance(field, SplatConfig | HexPlaneConfig) and not config.moving_rays:
        problem = "this preset has no such term; give --rays and --moving-rays too"
        yield f"--loss.dynamic {loss.dynamic:g}", problem
    if loss.flow and isinstance(field, NerfWTConfig | HexPlaneConfig):
        yield f"--loss.flow {loss.flow:g}", "this method has no scene flow; choose another"
    if loss.mask and isinstance(field, HexPlaneConfig):
        problem = "this method does not tell moving content from static; choose another"
        yield f"--loss.mask {loss.mask:g}", problem
