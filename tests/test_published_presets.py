"""Schedules, rates and sizes of the published presets."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import random_field, small, trainer

from hdr_nsff.fields.baselines.hexplane import HexPlane
from hdr_nsff.scene.batch import draw_pixels
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.budget import Clock
from hdr_nsff.training.optimizers import Optimizers
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.sampling import draw_batch

K = 36_000  # steps of a phase of a clip of 36 frames

# settings by their path in the config
PAPER = {
    "rays": 1024, "moving_rays": 512, "squared": False, "saturation": True,
    "published": True, "from_priors": False, "tonemap_lr": 5e-4, "refine_poses": False,
    "batches": 1, "bf16": False,
    "budget.steps": 250_000, "schedule.prior_fade": 0.1, "schedule.lr_final": 0.0,
    "schedule.period": 0.0,
    "loss.photometric": 1.0, "loss.dynamic": 1.0, "loss.depth": 0.04, "loss.flow": 0.02 / 2,
    "loss.mask": 0.0,
    "tonemap.kind": "per_image", "tonemap.knots": "even", "tonemap.leak": 0.01,
    "tonemap.from_recordings": False, "tonemap.loss.response_smoothness": 1e-3,
    "field.loss.temporal": 1.0, "field.loss.chain": 1.0, "field.loss.cycle": 2 / 3,
    "field.loss.flow_magnitude": 0.1, "field.loss.smoothness": 0.1 / 3,
    "field.loss.kinetic": 0.1 / 3, "field.loss.disocclusion": 0.1,
    "field.loss.blend_entropy": 1e-3, "field.loss.distortion": 1e-3,
    "field.encoding.layers": 8, "field.encoding.width": 256, "field.encoding.skip_after": 5,
    "field.encoding.octaves": 10, "field.encoding.direction_octaves": 4,
    "field.encoding.lr": 5e-4, "field.samples": 128, "field.compositing": "blend",
    "field.radiance": "sigmoid", "field.density": "relu", "field.density_noise": 1.0,
    "field.opaque_end": True, "field.cull": False, "field.split": True,
}  # fmt: skip
NO_CURVE = {k: v for k, v in PAPER.items() if not k.startswith("tonemap.")}
NSFF_PAPER = NO_CURVE | {"squared": True, "saturation": False, "tonemap.kind": "none"}
NO_FLOW = {k: v for k, v in NSFF_PAPER.items() if not k.startswith(("field.loss.", "loss."))}
NERF_WT_PAPER = NO_FLOW | {
    "moving_rays": 0, "loss.photometric": 1.0, "loss.dynamic": 0.0, "loss.depth": 0.0,
    "field.compositing": "superpose", "field.density": "softplus", "field.density_noise": 0.0,
    "field.code_size": 48, "field.time_code_size": 16,
}  # fmt: skip
HEXPLANE_PAPER = {
    "rays": 4096, "moving_rays": 0, "squared": True, "saturation": False, "from_priors": False,
    "budget.steps": 25_000, "schedule.lr_final": 0.1, "tonemap.kind": "sigmoid",
    "tonemap_lr": 0.02, "loss.photometric": 1.0, "loss.depth": 0.0,
    "field.density_components": 24, "field.appearance_components": 48,
    "field.coarsest": 64, "field.finest": 200, "field.grow_every": 3000, "field.width": 128,
    "field.emptiness": 10.0, "field.total_variation": 1e-4, "field.plane_lr": 0.02,
    "field.network_lr": 1e-3,
}  # fmt: skip


PUBLISHED = {
    "paper": PAPER,
    "nsff-paper": NSFF_PAPER,
    "nerf-wt-paper": NERF_WT_PAPER,
    "hdr-hexplane-paper": HEXPLANE_PAPER,
}


@pytest.mark.parametrize("preset", PUBLISHED)
def test_the_presets_have_the_published_numbers(preset: str) -> None:
    numbers = PUBLISHED[preset]

    def value(path: str) -> object:
        found: object = PRESETS[preset]
        for name in path.split("."):
            found = getattr(found, name)
        return found

    assert {path: value(path) for path in numbers} == pytest.approx(numbers)


def at_phase(phase: float) -> Clock:
    """The clock of `paper` after so many phases of a clip of 36 frames."""
    config = PRESETS["paper"]
    return Clock(config.budget, config.schedule, num_frames=36, step=round(phase * K))


def test_the_picture_of_the_chain_waits_for_phase_two_and_takes_turns(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    config = small("paper", toy_folder, tmp_path / "run")
    t = trainer(config, toy)
    chained = []
    for phase in (0.5, 1.97, 2.03):
        t.clock = at_phase(phase)
        chained.append(t.draw(0).chain != 0)
    assert chained == [False, False, True]
    steps = [replace(at_phase(2.5), step=s) for s in (6, 7, 8)]
    turns = [draw_batch(config, toy, clock, 0, chained=True).chain for clock in steps]
    assert turns in ([1, -1, 1], [-1, 1, -1])


def test_everything_of_paper_learns_at_the_published_rate(toy: Scene) -> None:
    config = PRESETS["paper"]
    field, tonemap = random_field("paper", toy), tone_mapper_for(config.tonemap, toy)
    groups = field.param_groups() + tonemap.param_groups(config.tonemap_lr)
    optimizers = Optimizers(groups)
    optimizers.step(0.25, progress=0.5)
    (adam,) = optimizers.by_name.values()
    assert [g["lr"] for g in adam.param_groups] == pytest.approx([0.25 * 5e-4] * len(groups))
    assert {g["betas"] for g in adam.param_groups} == {(0.9, 0.999)}
    assert {g["eps"] for g in adam.param_groups} == {1e-8}
    learned = {id(p) for g in groups for p in g.params}
    assert learned == {id(p) for m in (field, tonemap) for p in m.parameters()}
    assert at_phase(3.0).lr_share == pytest.approx(0.1 ** (3 * K / 300_000))


def test_hexplane_has_a_time_slice_per_two_frames_and_smooths_all_planes(toy: Scene) -> None:
    field = random_field("hdr-hexplane-paper", toy)
    assert isinstance(field, HexPlane)
    assert field.density_planes.time.shape[2] == math.ceil(len(toy.times) / 2)
    batch = draw_pixels(toy, 2, 8, 0, torch.Generator().manual_seed(0))
    tonemap = tone_mapper_for(small("hdr-hexplane-paper").tonemap, toy)
    _, own = field(replace(batch, recorder=tonemap.recorder(0, 0, 0, True)))
    both = field.density_planes.total_variation() + field.appearance_planes.total_variation()
    torch.testing.assert_close(own["total_variation"], both)
