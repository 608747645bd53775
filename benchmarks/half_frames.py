"""How much worse views between two frames are than views at them: the same cameras, the
same exposures, at whole and at half times.

    hdr-nsff synth interior RIG --views rig --oracle
    hdr-nsff train splat --scene RIG/oracle --out RUN --minutes 2
    python benchmarks/half_frames.py RIG OUT RUN [RUN ...]

OUT becomes a folder like RIG whose truth is, for every half-time view that RIG holds
out, that view half a frame earlier, at its own time, and half a frame later:
path-traced anew, which is resumable. Compared are the means over the cameras, the whole
times' taken together. `group` of RUN's own metrics.json compares other cameras at other
times, and so more than interpolation. RUN's metrics.json is overwritten: evaluate it
again.
"""

import argparse
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.io import read_json
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.synth.scenes import SCENES
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.settings import SynthConfig, parse_ev, parse_size
from hdr_nsff.synth.synth import claim, render, write_truth
from hdr_nsff.synth.views import clip_views, held_out_views
from hdr_nsff.training.run_folder import Run

SHOWN = ("psnr", "psnr_moving", "ssim", "mu5000", "mu5000_moving")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rig", type=Path, help="what `synth` wrote")
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument(
        "--spp",
        type=int,
        help="paths per pixel of the views; default: those of RIG's held-out views",
    )
    args = parser.parse_args()
    make_truth(args.rig, args.out, args.spp)
    for run in args.runs:
        views = evaluate_run(Run.open(run), args.out / "truth")["views"]
        half, whole = ([v for v in views if bool(v["time"] % 1) == h] for h in (True, False))
        print(run, f"{len(half)} views at half times, {len(whole)} at whole ones")
        for name in SHOWN:
            a, b = (float(np.mean([v[name] for v in some])) for some in (half, whole))
            print(f"  {name:14} half {a:.3f}  whole {b:.3f}  difference {a - b:+.3f}", flush=True)


def make_truth(rig: Path, out: Path, spp: int | None) -> None:
    """OUT/truth of the half times' cameras, half a frame before, at, and half a frame
    after.
    """
    settings = read_json(rig / "truth" / "truth.json")["settings"]
    known = {f.name for f in fields(SynthConfig)}
    config = SynthConfig(out=out, **{k: v for k, v in settings.items() if k in known})
    config = replace(config, truth_spp=spp or config.truth_spp)
    scene, size, evs = SCENES[config.name], parse_size(config.size), parse_ev(str(config.ev))
    K, reference = intrinsics(*size), int(np.argsort(evs)[len(evs) // 2])
    held = held_out_views(
        scene, config.frames, int(config.truth_spp or 0), config.seed, config.views
    )
    halves = [s for s in held if s.time % 1]
    assert len(halves) % len(evs) == 0, (
        "exposures go round with the views: each camera must meet one exposure"
    )
    shots = [
        replace(s, time=s.time + d, name=f"view_{k}_{s.time + d:04.1f}")
        for d in (-0.5, 0.0, 0.5)
        for k, s in enumerate(halves)
    ]
    claim(config)
    render(shots, K, size, config)
    clip = clip_views(scene, config.frames, 1, config.seed, config.views)
    write_truth(clip, shots, K, [e - evs[reference] for e in evs], reference, config)


if __name__ == "__main__":
    main()
