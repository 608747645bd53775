"""What every weight of the objective is worth: a scene is trained with all of them,
then with one at a time set to 0.

    python benchmarks/loss_weights.py SCENE --truth TRUTH [--preset splat] [--steps
    2000] [--only depth,flow] [--jobs 2]

Prints one JSON line per run: PSNR over full and moving pixels and mu-law PSNR of the
radiance, and how much each fell. Two seeds of the full objective come first:
differences smaller than theirs say nothing.
"""

import argparse
import json
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path

import numba

from hdr_nsff.core.io import read_json
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

TERMS = {"psnr": "full", "psnr_moving": "moving", "mu5000": "hdr"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--preset", default="splat", choices=PRESETS)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--only", help="these weights, by name; default: all that are not 0")
    parser.add_argument("--jobs", type=int, default=1, help="runs side by side, one thread each")
    args = parser.parse_args()
    whole = replace(
        PRESETS[args.preset], scene=args.scene, budget=Budget(steps=args.steps, minutes=None)
    )
    names = [n for n, w in asdict(whole.loss).items() if w and n != "photometric"]
    names = args.only.split(",") if args.only else names
    runs = [("all", whole), ("all, another seed", replace(whole, seed=1))]
    runs += [(f"no {n}", replace(whole, loss=replace(whole.loss, **{n: 0.0}))) for n in names]
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        found = pool.map(score, [config for _, config in runs], [args.truth] * len(runs))
        full: dict[str, float] = {}
        for (name, _), values in zip(runs, found, strict=True):
            full = full or values
            change = {f"{k}_change": round(v - full[k], 2) for k, v in values.items()}
            print(
                json.dumps({"run": name} | {k: round(v, 2) for k, v in values.items()} | change),
                flush=True,
            )


def score(config: TrainConfig, truth: Path) -> dict[str, float]:
    """Decibels of a run, trained in a folder of its own that is thrown away."""
    numba.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        out = train(replace(config, out=Path(folder) / "run"))
        evaluate_run(Run.open(out), truth)
        headline = read_json(out / "metrics.json")["headline"]
    return {new: headline[old] for old, new in TERMS.items()}


if __name__ == "__main__":
    main()
