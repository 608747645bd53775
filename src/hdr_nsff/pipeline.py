"""Video to HDR in one go: prepare, train, render, evaluate, report. Each part keeps
what it has done, so a killed run goes on.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.evaluation.evaluate import evaluate_run, views_of_clip
from hdr_nsff.evaluation.report import check_place, write_report
from hdr_nsff.footage.ingest import every_of
from hdr_nsff.prepare.prepare import PrepareConfig, held_out_truth, prepare
from hdr_nsff.rendering.render import render_all
from hdr_nsff.scene.manifest import Protocol
from hdr_nsff.training.config import PRESETS, check
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train


@dataclass(frozen=True)
class RunConfig:
    """Alternating-exposure footage in; linear HDR novel views at novel times out.

    Does everything: exposures, poses, flow, masks and depth (`prepare`), training
    (`train`), EXR sequence, videos and LDR views (`render`), held-out quality
    (`evaluate`), report.html. Killed? The same command goes on where it was.
    """

    clip: Positional[Path]
    """Footage: a video, a folder of frames, or a folder of such folders (one per
    synchronized camera); or a public data set, see `prepare --help`.
    """
    out: Positional[Path]
    """Folder for everything: scene/, run/, render/, report.html."""
    exposures: str | None = None
    """Exposure times of one cycle in seconds, e.g. 1/1000,1/250,1/60. Default: CSV
    beside the clip, EXIF, else learned.
    """
    ev: str | None = None
    """The same as log2 exposures, e.g. -4,-2,0."""
    preset: Literal["splat", "grid", "paper", "tiny"] = "splat"
    """splat: 4D Gaussians, minutes on a CPU; grid: a scene flow field on grids,
    likewise; paper: the published network (hours on a GPU); tiny: seconds, to try
    things out.
    """
    minutes: float | None = None
    """Training time instead of the preset's."""
    truth: Path | None = None
    """Truth folder (from `synth` or `reexpose`) for `evaluate`; then all frames of the
    clip are trained on but those that are the truth's views. A public data set with
    held-out views brings its own.
    """
    poses: Path | None = None
    """Given poses (COLMAP model, transforms.json, poses_bounds.npy) instead of
    structure from motion.
    """
    protocol: Protocol | None = None
    """Split the clip as the published tables do, see `prepare --help`; instead of
    --hold-out, and with held-out views to be evaluated on.
    """
    hold_out: int | None = None
    """Keep every this many frames for `evaluate`. Default: 8; with a truth folder, or
    where a data set brings held-out views, 0, or those frames of the clip that are the
    truth's views.
    """
    max_size: int = 640
    """Longest side in pixels; larger frames are shrunk."""
    seed: int = 0
    device: str = "auto"
    """auto, cpu or cuda."""


def run_all(config: RunConfig) -> None:
    """The whole way from footage to report; prints where the results are."""
    start = time.monotonic()
    pick_device(config.device)
    if config.truth is not None and not config.truth.is_dir():
        raise InputError(
            f"--truth {config.truth}: no such folder; `synth` and `reexpose` write one, or leave the option out"
        )
    check_place(config.out / "report.html")
    settings = replace(
        PRESETS[config.preset], out=config.out / "run", seed=config.seed, device=config.device
    )
    if config.minutes is not None:
        settings = replace(settings, minutes=config.minutes, steps=None)
    check(settings)
    footage = PrepareConfig(
        clip=config.clip, out=config.out / "scene", exposures=config.exposures, ev=config.ev, max_size=config.max_size,
        hold_out=held_out_every(config), protocol=config.protocol, poses=config.poses,
    )  # fmt: skip
    scene = prepare(footage)
    truth = config.truth or held_out_truth(footage)
    with writing_to(config.out):
        run = Run.open(train(replace(settings, scene=scene)), config.device)
        results = render_all(run, config.out / "render")
        evaluate_run(run, truth)
        results["report"] = write_report(run, config.out / "report.html", config.out / "render")
    say(f"done in {(time.monotonic() - start) / 60:.1f} minutes; results:")
    for name, path in results.items():
        say(f"  {name:<16} {path}")


def held_out_every(config: RunConfig) -> int | None:
    """`--hold-out` for `prepare`, so that no frame is trained on that the truth is made
    of: beside a truth of other places or times nothing is kept out, beside one of the
    clip's own frames these are. None leaves it to `prepare`. InputError where the truth
    cannot be followed.
    """
    frames = views_of_clip(config.truth) if config.truth is not None else []
    if config.hold_out is not None or config.protocol is not None or config.truth is None:
        return config.hold_out
    if not frames:
        return 0
    every = every_of(frames)
    if every is None:
        named = ", ".join(map(str, frames[:4])) + ", ..." * (len(frames) > 4)
        raise InputError(
            f"--truth {config.truth}: its views are frames {named} of the clip, which are not every so many; choose with --hold-out what is kept "
            "out of training"
        )
    return every
