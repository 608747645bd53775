"""Quality between training times: the same cameras at half-frame and at frame times.

    hdr-nsff synth interior RIG --views rig --oracle
    hdr-nsff train splat --scene RIG/oracle --out RUN --minutes 2
    python benchmarks/half_frames.py RIG FOLDER RUN [RUN ...]

For every held-out view of RIG at a half-frame time, FOLDER/truth gets that view half a
frame earlier, at its own time, and half a frame later. They are path-traced once; an
interrupted command continues. Camera and exposure stay the same, so the difference
of the means is that of interpolation in time. `group` in the metrics.json of a run
compares other cameras at other times as well. This command overwrites the run's
metrics.json: evaluate the run again afterwards.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from record import Record, make_parser, name_of, restart_prepared

from hdr_nsff.core.io import read_json
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.synth.scenes import SCENES
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.settings import SynthConfig, parse_ev, parse_size
from hdr_nsff.synth.synth import claim, render, write_truth
from hdr_nsff.synth.views import clip_views, held_out_views
from hdr_nsff.training.run_folder import Run

SCORES = ("psnr", "psnr_moving", "ssim", "mu5000", "mu5000_moving")


def main() -> None:
    parser = make_parser(__doc__, "half_frames")
    parser.add_argument("rig", type=Path, help="a folder that `synth --views rig` wrote")
    parser.add_argument("folder", type=Path, help="for the views between frames; made here")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument(
        "--spp",
        type=int,
        help="paths per pixel of the views; default: those of RIG's held-out views",
    )
    args = parser.parse_args()
    restart_prepared()
    seed = make_truth(args.rig, args.folder, args.spp)
    record = Record("half_frames", args, seed=seed)
    for run in args.runs:
        record.add({"run": name_of(run)} | measure(run, args.folder / "truth"))
    record.save()


def measure(run: Path, truth: Path) -> dict[str, Any]:
    """Mean scores at half-frame times and at frame times, and their differences."""
    views = evaluate_run(Run.open(run), truth)["views"]
    half = [view for view in views if view["time"] % 1]
    whole = [view for view in views if not view["time"] % 1]
    result: dict[str, Any] = {"half_views": len(half), "whole_views": len(whole)}
    for name in SCORES:
        at_half = mean_score(half, name)
        at_whole = mean_score(whole, name)
        result[name] = {
            "half": at_half,
            "whole": at_whole,
            "difference": at_half - at_whole,
        }
    return result


def mean_score(views: list[dict[str, Any]], name: str) -> float:
    """The mean over the views that have this score; NaN where none has."""
    values = [view[name] for view in views if view.get(name) is not None]
    return float(np.mean(values)) if values else float("nan")


def make_truth(rig: Path, out: Path, spp: int | None) -> int:
    """Path-trace the views into `out`; return the seed of the rendering."""
    settings = read_json(rig / "truth" / "truth.json")["settings"]
    known = {field.name for field in fields(SynthConfig)}
    config = SynthConfig(out=out, **{k: v for k, v in settings.items() if k in known})
    config = replace(config, truth_spp=spp or config.truth_spp)
    scene, size = SCENES[config.name], parse_size(config.size)
    evs = parse_ev(str(config.ev))
    K = intrinsics(*size)
    reference = int(np.argsort(evs)[len(evs) // 2])
    held_out = held_out_views(
        scene, config.frames, int(config.truth_spp or 0), config.seed, config.views
    )
    between = [view for view in held_out if view.time % 1]
    assert between, f"{rig} holds out no view between two frames; write it with --views rig"
    assert len(between) % len(evs) == 0, (
        "the views take the exposures in turn, so that their number has to be a multiple of "
        f"{len(evs)} for every camera to keep one exposure; there are {len(between)}"
    )
    shots = []
    for offset in (-0.5, 0.0, 0.5):
        for k, view in enumerate(between):
            time = view.time + offset
            shots.append(replace(view, time=time, name=f"view_{k}_{time:04.1f}"))
    claim(config)
    render(shots, K, size, config)
    clip = clip_views(scene, config.frames, 1, config.seed, config.views)
    write_truth(clip, shots, K, [ev - evs[reference] for ev in evs], reference, config)
    return config.seed


if __name__ == "__main__":
    main()
