"""Video to HDR in one go: prepare, train, render, evaluate, report. Each part keeps
what it has done, so a killed run continues with the same command.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json, write_json, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say
from hdr_nsff.evaluation.evaluate import evaluate_run, views_of_clip
from hdr_nsff.evaluation.report import check_place, write_report
from hdr_nsff.fields.build import device_for
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.footage.hold_out import hold_out_spacing
from hdr_nsff.prepare.prepare import PrepareConfig, held_out_truth, prepare_scenes
from hdr_nsff.rendering import export_page
from hdr_nsff.rendering.export_gaussians import GaussianField
from hdr_nsff.rendering.render import render_all
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig, check_config
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

OPTIONS = "options.json"  # of the command, beside its results


@dataclass(frozen=True)
class RunConfig(PrepareConfig):
    """Alternating-exposure footage in; linear HDR novel views at novel times out.

    Does everything: exposures, poses, flow, masks and depth (`prepare`), training
    (`train`), EXR sequence, videos and LDR views (`render`), a page to look around in
    (`export`), held-out quality (`evaluate`), report.html. Killed? The same command
    continues where it was. Every option of `prepare` works here too; with `--segment`
    each segment of a long clip is trained on its own, in OUT/segment_00 and so on, and
    where the picture cuts, each part in OUT/part_00 and so on.
    """

    out: Positional[Path]
    """Folder for everything: scene/, run/, render/, scene.html, report.html."""
    hold_out: int | None = None
    """Keep every N-th frame out of training, for `evaluate`; 0 keeps all in. Default
    8; with a truth folder or a data set's held-out views 0, or those frames of the clip
    that are the truth's views.
    """
    preset: Literal["splat", "grid", "paper", "tiny"] = "splat"
    """splat: 4D Gaussians, minutes on a CPU; grid: a scene flow field on grids,
    likewise; paper: the published network, 250,000 steps, for a GPU; tiny: seconds,
    to try things out.
    """
    minutes: float | None = None
    """Training time instead of the preset's; of each segment or part."""
    shutter: float | Literal["auto"] = 0.0
    """Motion blur (`splat`): share of the time from frame to frame of the clip for
    which the longest exposure takes light; auto: as the exposure times say, where a
    list, EXIF or a GoPro has them.
    """
    refine_poses: bool = False
    """Correct the training cameras (poses and focal length) a little, by the picture.
    """
    truth: Path | None = None
    """Truth folder (from `synth` or `reexpose`) for `evaluate`; then all frames of the
    clip are trained on but those that are the truth's views. A public data set with
    held-out views brings its own.
    """
    seed: int = 0
    device: str = "auto"
    """Where networks of `prepare`, training and rendering run: auto, cpu or cuda."""


def run_all(config: RunConfig) -> None:
    """The whole way from footage to report; prints where the results are."""
    start = time.monotonic()
    settings = train_settings(config)
    device = str(device_for(settings.field, config.device))
    check_truth(config)
    check_place(config.out / "report.html")
    export_page.check_place(config.out / "scene.html")
    check_config(settings)
    footage = prepare_settings(config)
    results: dict[str, Path] = {}
    with writing_to(config.out), lock_output(config.out):
        options = options_for(config)
        runs = trained_runs(config.out)
        if footage.redo and runs and earlier_options(config.out / OPTIONS):
            reason = f"done before {runs[0]} was trained; delete that to do it once more"
            say(f"--redo {' '.join(footage.redo)}: {reason}")
            footage = replace(footage, redo=())
        scenes = prepare_scenes(footage, part_cuts=config.truth is None)
        write_json(config.out / OPTIONS, options)
        truth = config.truth or held_out_truth(footage)
        for scene in scenes:
            if scene == footage.out:
                results = finish_scene(replace(settings, scene=scene, device=device), truth)
                continue
            say(f"{scene.name}: training")
            out = config.out / scene.name / "run"
            own = finish_scene(replace(settings, scene=scene, out=out, device=device), truth)
            results |= {f"{scene.name} {name}": path for name, path in own.items()}
    say(f"done in {(time.monotonic() - start) / 60:.1f} minutes; results:")
    width = max(len(name) for name in results)
    for name, path in results.items():
        say(f"  {name:<{width}} {path}")


def options_for(config: RunConfig) -> dict[str, Any]:
    """The options to be kept beside the results. InputError where a run was trained
    with others: its scene would be prepared anew, and no longer fit it.
    """
    own = options_of(config)
    before = earlier_options(config.out / OPTIONS)
    runs = trained_runs(config.out)
    if runs and before:
        if own["minutes"] is None:
            own["minutes"] = before.get("minutes")
        own["redo"] = own["redo"] or before.get("redo", [])
        changed = [name for name in own if name in before and before[name] != own[name]]
        if changed:
            options = ", ".join("--" + name.replace("_", "-") for name in changed)
            raise InputError(
                f"{config.out}: holds a run that was trained with other options ({options}); "
                f"choose another OUT, or delete {runs[0]} to train again with these"
            )
    return own


def trained_runs(out: Path) -> list[Path]:
    """The run folders in `out` that hold a checkpoint."""
    runs = [out / "run", *out.glob("*/run")]
    return [run for run in runs if any((run / "checkpoints").glob("step_*"))]


def earlier_options(path: Path) -> dict[str, Any]:
    """The options that an earlier command kept at `path`, empty without; InputError for
    a file that is damaged, or that no `run` wrote.
    """
    if not path.exists():
        return {}
    advice = "move it away, or choose another OUT"
    try:
        before = dict(read_json(path))
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: damaged, or not made by run; {advice}") from error
    if not before.keys() >= {"clip", "preset"}:
        raise InputError(f"{path}: already exists and was not made by run; {advice}")
    return before


def options_of(config: RunConfig) -> dict[str, Any]:
    """The options of `run` as JSON, but for those that change no result; of the clip,
    its name.
    """
    kept = {f.name: getattr(config, f.name) for f in fields(config)}
    kept = {name: value for name, value in kept.items() if name not in ("out", "device")}
    kept["clip"] = config.clip.name
    return dict(json.loads(json.dumps(kept, default=str)))


def finish_scene(settings: TrainConfig, truth: Path | None) -> dict[str, Path]:
    """All that follows `prepare` for one scene; what it made, by name.

    Results lie beside the run, in the folder that holds it.
    """
    assert settings.out is not None
    out = settings.out.parent
    run = Run.open(train(settings), settings.device)
    results = render_all(run, out / "render")
    if isinstance(run.field, GaussianField):
        results["viewer"] = export_page.export_page(run, out / "scene.html")
    evaluate_run(run, truth)
    results["report"] = write_report(run, out / "report.html", out / "render")
    return results


def train_settings(config: RunConfig) -> TrainConfig:
    """The settings of `train`, but for the scene."""
    preset = PRESETS[config.preset]
    settings = replace(
        preset, out=config.out / "run", seed=config.seed, refine_poses=config.refine_poses
    )
    if config.minutes is not None:
        settings = replace(settings, budget=Budget(minutes=config.minutes))
    return with_shutter(settings, config)


def with_shutter(settings: TrainConfig, config: RunConfig) -> TrainConfig:
    """The settings with the motion blur of the clip; InputError for a field that has
    none. The readout of its rolling shutter comes with the scene.
    """
    if isinstance(settings.field, SplatConfig):
        return replace(settings, field=replace(settings.field, shutter=config.shutter))
    if config.shutter:
        raise InputError(
            f"--shutter: --preset {config.preset} takes every frame for a moment; "
            "choose --preset splat, or leave it out"
        )
    if config.readout:
        say(f"--readout: corrects the poses; --preset {config.preset} takes frames for moments")
    return settings


def prepare_settings(config: RunConfig) -> PrepareConfig:
    """The settings of `prepare`: those of the same names here."""
    shared: dict[str, Any] = {f.name: getattr(config, f.name) for f in fields(PrepareConfig)}
    shared |= {"out": config.out / "scene", "hold_out": held_out_every(config)}
    return PrepareConfig(**shared)


def check_truth(config: RunConfig) -> None:
    """InputError where the truth is not there, or counts other frames than training."""
    if config.truth is None:
        return
    if not config.truth.is_dir():
        raise InputError(
            f"--truth {config.truth}: no such folder; `synth` and `reexpose` write one, "
            "or leave the option out"
        )
    if config.segment is not None:
        raise InputError(
            f"--truth {config.truth}: its views belong to the whole clip; leave --segment or "
            "--truth out (segments are evaluated on the frames they hold out)"
        )
    if config.start != 0 or config.stride != 1:
        raise InputError(
            f"--truth {config.truth}: its times count all frames of the clip; "
            "leave --start and --stride out"
        )


def held_out_every(config: RunConfig) -> int | None:
    """`--hold-out` for `prepare`, so that no frame is trained on that the truth is made
    of. Beside a truth of other places or times nothing is held out; beside a truth of
    the clip's own frames these are. None leaves the choice to `prepare`. InputError
    where no `--hold-out`, or a protocol, keeps out those frames.
    """
    frames = views_of_clip(config.truth) if config.truth is not None else []
    if frames and config.protocol is not None:
        raise InputError(
            f"--protocol {config.protocol}: would train on frames of the clip that are the views "
            f"of {config.truth}; leave --protocol out, and these frames are kept out of training"
        )
    if config.hold_out is not None or config.protocol is not None or config.truth is None:
        return config.hold_out
    if not frames:
        return 0
    every = hold_out_spacing(frames)
    if every is None:
        first = ", ".join(str(frame) for frame in frames[:4])
        more = ", ..." if len(frames) > 4 else ""
        raise InputError(
            f"--truth {config.truth}: its views are frames {first}{more} of the clip, which are "
            "not evenly spaced; choose with --hold-out which frames are kept out of training"
        )
    return every
