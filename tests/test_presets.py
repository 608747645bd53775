"""Presets: each changes the parts that its name states, and no setting is in vain."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from presets import random_field, small, trainer

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.settings import with_changes
from hdr_nsff.fields.build import build_field, initialize_field
from hdr_nsff.fields.point_cloud import MAX_SIGMOID_RADIANCE
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.maths import volume
from hdr_nsff.scene.batch import whole_frame
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.budget import Clock
from hdr_nsff.training.config import check_config
from hdr_nsff.training.presets import ABLATIONS, METHODS, PRESETS, ablated
from hdr_nsff.training.sampling import moving_rays
from hdr_nsff.training.start import start_field

NAMES = [name for name in PRESETS if name not in METHODS]


def base_and_change(name: str) -> tuple[str, str]:
    """The preset of an ablation, and what it changes."""
    preset = next(p for p in ("splat", "grid", "paper-small") if name.startswith(f"{p}-"))
    return preset, name.removeprefix(f"{preset}-")


@pytest.mark.parametrize("name", NAMES)
def test_an_ablation_differs_from_its_preset_in_one_part(name: str) -> None:
    preset, change = base_and_change(name)
    base, changed = asdict(PRESETS[preset]), asdict(PRESETS[name])
    parts = {k for k in base if base[k] != changed[k]}
    expected = {
        "no-flow": {"loss"},
        "no-depth": {"loss", "from_priors"},
        "no-saturation": {"saturation"},
        "sigmoid": {"field"},
        "no-split": {"field"},
    }
    if preset == "paper-small":
        expected["no-depth"] = {"loss"}  # it starts at random anyway
    assert parts == expected.get(change, {"tonemap"})


def test_every_ablation_that_makes_sense_is_a_preset() -> None:
    assert {n.removeprefix("grid-") for n in NAMES if n.startswith("grid-")} == set(ABLATIONS)
    assert set(ABLATIONS) - {n.removeprefix("splat-") for n in NAMES if n.startswith("splat-")} == {
        "no-saturation"
    }


def test_the_small_published_presets_change_sizes_alone() -> None:
    """The terms, their weights, how they are formed and the tone mapper stay."""
    for name in ("paper", "nsff-paper", "nerf-wt-paper"):
        published, tiny = asdict(PRESETS[name]), asdict(PRESETS[f"{name}-small"])
        resized = {k for k in published if published[k] != tiny[k]}
        sizes = {"field", "budget", "schedule", "rays", "moving_rays", "moving_until"}
        assert resized - sizes == {"tonemap_lr", "bf16", "checkpoint_seconds"}
        fields = published["field"], tiny["field"]
        changed = {k for k in fields[0] if fields[0][k] != fields[1][k]}
        assert changed == {"encoding", "samples", "render_samples"}


@pytest.mark.parametrize("name", ["paper", "paper-small", "nsff-paper-small"])
def test_rays_of_moving_pixels_end_with_the_first_phase(name: str) -> None:
    config = PRESETS[name]

    def drawn(phase: float) -> int:
        clock = Clock(config.budget, config.schedule, num_frames=36)
        assert config.budget.steps is not None
        step = round(phase * 36 / 250 * config.budget.steps)  # K is 1000 times the frames
        clock = replace(clock, step=step)
        assert clock.phase == pytest.approx(phase, abs=1e-3)
        return moving_rays(config, clock)

    assert drawn(0.99) == config.moving_rays > 0
    assert drawn(1.01) == drawn(6.9) == 0


def test_a_setting_that_would_change_nothing_is_refused() -> None:
    def problem(name: str, **changes: Any) -> str:
        config = PRESETS[name]
        loss = replace(config.loss, **{k: v for k, v in changes.items() if hasattr(config.loss, k)})
        rays = {k: v for k, v in changes.items() if not hasattr(config.loss, k)}
        with pytest.raises(InputError) as error:
            check_config(replace(config, loss=loss, **rays))
        return str(error.value)

    assert "--moving-rays 512: whole frames are drawn" in problem("splat", moving_rays=512)
    assert "--loss.dynamic 1: this preset has no such term" in problem("splat", dynamic=1.0)
    for name in ("nerf-wt", "hdr-hexplane"):
        assert "--loss.flow 0.1: this method has no scene flow" in problem(name, flow=0.1)
    assert "--loss.mask 0.2: this method does not tell" in problem("hdr-hexplane", mask=0.2)
    for config in PRESETS.values():
        check_config(config)


@pytest.mark.parametrize("fast", [True, False])
def test_layers_are_in_bfloat16_where_the_device_computes_in_it(
    toy: Scene, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fast: bool
) -> None:
    monkeypatch.setattr("hdr_nsff.training.train.computes_bf16_fast", lambda device: fast)
    t = trainer(small("paper-small", toy_folder, tmp_path / "run"), toy)
    types = set()
    layers = [m for m in t.field.modules() if isinstance(m, torch.nn.Linear)]
    for layer in layers:
        layer.register_forward_hook(lambda module, given, made: types.add(made.dtype))
    t.step()
    assert layers and types == {torch.bfloat16 if fast else torch.float32}


@pytest.mark.parametrize("name", ["paper-small", "hdr-hexplane"])
def test_geometry_and_compositing_stay_in_float32_beside_layers_in_bfloat16(
    toy: Scene, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("hdr_nsff.training.train.computes_bf16_fast", lambda device: True)
    config = replace(small(name, toy_folder, tmp_path / "run"), bf16=True)
    t = trainer(config, toy)
    seen: dict[str, set[torch.dtype]] = {}

    def watch(owner: Any, function: str) -> None:
        inner = getattr(owner, function)

        def watched(*args: Any, **kwargs: Any) -> Any:
            made = inner(*args, **kwargs)
            parts = made if isinstance(made, tuple) else (getattr(made, "directions", made),)
            seen.setdefault(function, set()).update(part.dtype for part in parts)
            return made

        monkeypatch.setattr(owner, function, watched)

    watch(Camera, "rays")
    watch(Camera, "project")
    watch(type(t.field.space), "encode")
    watch(type(t.field.space), "decode")
    watch(volume, "weighted_sum")
    watch(volume, "alpha_from_density")
    t.step()
    assert {"rays", "encode", "alpha_from_density"} <= set(seen)
    assert name != "paper-small" or {"project", "decode", "weighted_sum"} <= set(seen)
    assert all(types == {torch.float32} for types in seen.values()), seen


def test_a_grid_does_not_start_from_depth_without_units(toy: Scene) -> None:
    manifest = toy.manifest.model_copy(update={"depth_kind": "relative"})
    relative = replace(toy, manifest=manifest)
    said = [
        initialize_field(
            build_field(small("grid").field, scene), scene, lambda rgb, i: rgb, 0.0, True
        )
        for scene in (toy, relative)
    ]
    assert said == ["field: initialized from the depth prior", None]


def test_without_a_split_everything_is_dynamic(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    config = small("paper-small-no-split", toy_folder, tmp_path / "run")
    t = trainer(config, toy)
    batch = t.draw(0)
    render, _ = t.field(batch)
    assert torch.allclose(render.motion, render.opacity, atol=1e-6)
    render.radiance.sum().backward()
    static = t.field.branches.static_trunk.parameters()
    assert not any(p.grad is not None and p.grad.abs().sum() > 0 for p in static)


def test_without_flow_the_field_does_not_start_from_it(
    toy: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(with_flow: bool) -> tuple[bool, ...]:
        """Whether the field is given flow at its start, per training frame."""
        given: list[Scene] = []
        monkeypatch.setattr(
            "hdr_nsff.training.start.initialize_field",
            lambda field, scene, *rest: given.append(scene),
        )
        field, tonemapper = random_field("grid", toy), tone_mapper_for(ToneMapConfig(), toy)
        start_field(field, tonemapper, toy, True, with_flow)
        return tuple(bool(f.flow) or bool(f.flow_valid) for f in given[0].train)

    assert all(start(True)) and not any(start(False))
    assert PRESETS["splat-no-flow"].loss.flow == 0


def test_without_depth_the_prior_neither_paints_nor_pulls() -> None:
    config = ablated(PRESETS["grid"], "no-depth")
    assert not config.from_priors
    assert config.loss.depth == 0
    assert config.loss.flow == PRESETS["grid"].loss.flow


def test_a_sigmoid_keeps_radiance_below_one_and_starts_where_it_is_painted(toy: Scene) -> None:
    bounded, free = random_field("grid-sigmoid", toy), random_field("grid", toy)
    raw = torch.linspace(-30, 30, 61)
    assert float(bounded.to_radiance(raw).max()) <= 1 < float(free.to_radiance(raw).max())
    radiance = torch.tensor([0.02, 0.5, 0.9])
    for field in (bounded, free):
        field.bias.fill_(-1.3)
        torch.testing.assert_close(field.to_radiance(field.from_radiance(radiance)), radiance)
    assert float(bounded.to_radiance(bounded.from_radiance(torch.tensor(40.0)))) < 1


def test_gaussians_with_a_sigmoid_stay_below_one_in_every_part_and_learn_in_every_part(
    toy: Scene,
) -> None:
    config = small("splat-sigmoid").field
    assert isinstance(config, SplatConfig)
    field = build_field(replace(config, view_dependence=True), toy)
    assert isinstance(field, Splat)
    initialize_field(
        field, toy, lambda rgb, *frame: 3 * rgb, 0.5, True
    )  # brighter than 1, the background too
    for g in (field.static, field.moving):
        for p in (g.log_radiance_offsets, g.sh1):  # shades, colors in time, colors by direction
            p.data.add_(torch.randn(p.shape, generator=torch.Generator().manual_seed(1)))
    for time in (0.0, 2.4):
        radiance = field.render(toy.train[0].camera, time).radiance
        assert 0.9 < float(radiance.max()) <= 1 + 1e-5 and float(radiance.min()) >= 0
    render, _ = field(whole_frame(toy, 2))
    render.radiance.sum().backward()
    for g in (field.static, field.moving):
        assert all(
            float(p.grad.abs().max()) > 0
            for p in (g.log_radiance, g.log_radiance_offsets, g.sh1)
            if p.grad is not None
        )
        assert None not in (g.log_radiance.grad, g.log_radiance_offsets.grad, g.sh1.grad)
    assert field.background.grad is not None and float(field.background.grad.abs().min()) > 0


@pytest.mark.parametrize("from_priors", [True, False])
def test_gaussians_with_a_sigmoid_start_in_the_colors_that_are_below_it(
    from_priors: bool, toy: Scene
) -> None:
    fields = [build_field(small(name).field, toy) for name in ("splat-sigmoid", "splat")]
    for field in fields:
        initialize_field(field, toy, lambda rgb, *frame: 3 * rgb, -1.3, from_priors)
    bounded, free = fields
    assert isinstance(bounded, Splat) and isinstance(free, Splat)
    for share in (0.0, 0.3):
        for a, b in ((bounded.static, free.static), (bounded.moving, free.moving)):
            seeded = b.opacity_logits > -10
            torch.testing.assert_close(
                a.radiance(share)[seeded],
                b.radiance(share)[seeded].clamp_max(MAX_SIGMOID_RADIANCE),
                rtol=1e-4,
                atol=1e-6,
            )
    assert torch.allclose(bounded.background.sigmoid(), torch.tensor(-1.3).exp())
    assert torch.allclose(free.background, torch.tensor(-1.3))
    assert not from_priors or bool((free.static.radiance(0.0) > 1).any())  # some had to be held


@pytest.mark.parametrize(
    "name",
    [
        "splat-response-mlp",
        "splat-sigmoid",
        "grid-response-none",
        "grid-response-per-image",
        "splat-no-depth",
    ],
)
def test_ablations_train(name: str, toy: Scene, toy_folder: Path, tmp_path: Path) -> None:
    t = trainer(small(name, toy_folder, tmp_path / "run"), toy)
    for _ in range(2):
        assert all(v == v for v in t.step().values())
        t.clock = replace(t.clock, step=t.clock.step + 1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("field.encoding.max_rows=1000000", "choose a power of two"),
        ("field.samples=1", "choose a number from 2"),
        ("tonemap.min_step=1", "choose a number below 1"),
        ("field.no_such_key=1", "like --set schedule.lr_final=0.1"),
    ],
)
def test_a_setting_out_of_bounds_is_refused_in_a_sentence(change: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        with_changes(PRESETS["grid"], (change,))


def test_the_example_of_a_setting_exists_in_every_preset() -> None:
    for settings in PRESETS.values():
        assert with_changes(settings, ("schedule.lr_final=0.1",)).schedule.lr_final == 0.1
