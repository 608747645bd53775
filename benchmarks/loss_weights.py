"""The worth of every loss weight: training without one term at a time.

    python benchmarks/loss_weights.py SCENE --truth TRUTH --preset splat --steps 2000

Every run sets one weight of the objective to 0. The file holds each run's PSNR of all
and of moving pixels, mu-law PSNR of the radiance, and their change against the full
objective. The full objective is trained with two seeds: changes smaller than their
difference are noise.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numba
from record import Record, make_parser, restart_prepared

from hdr_nsff.core.io import read_json
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

SCORES = ("psnr", "psnr_moving", "mu5000")  # of the headline of metrics.json


def main() -> None:
    parser = make_parser(__doc__, "loss_weights")
    parser.add_argument("scene", type=Path, help="a prepared scene")
    parser.add_argument("--truth", type=Path, required=True, help="a folder with exact views")
    parser.add_argument("--preset", default="splat", choices=PRESETS)
    parser.add_argument("--steps", type=int, default=2000, help="of every run")
    parser.add_argument(
        "--only", nargs="+", metavar="WEIGHT", help="these weights; default: all that are not 0"
    )
    parser.add_argument("--jobs", type=int, default=1, help="runs at once, one thread each")
    args = parser.parse_args()
    restart_prepared()
    budget = Budget(steps=args.steps, minutes=None)
    full = replace(PRESETS[args.preset], scene=args.scene, budget=budget)
    runs = runs_without(full, args.only)
    record = Record("loss_weights", args, seed=full.seed)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        all_scores = pool.map(score, runs.values(), [args.truth] * len(runs))
        baseline: dict[str, float] = {}
        for name, scores in zip(runs, all_scores, strict=True):
            baseline = baseline or scores
            record.add(row(name, runs[name], scores, baseline))
    record.save()


def runs_without(full: TrainConfig, only: list[str] | None) -> dict[str, TrainConfig]:
    """The full objective with two seeds, then every term left out, by name."""
    weights = weights_by_name(full)
    used = [name for name, weight in weights.items() if weight and name != "photometric"]
    unknown = set(only or ()) - set(weights)
    if unknown:
        raise SystemExit(f"no such weight: {', '.join(unknown)}; choose from {', '.join(weights)}")
    runs = {"full": full, "full, another seed": replace(full, seed=full.seed + 1)}
    for name in only or used:
        runs[f"no {name}"] = without(full, name)
    return runs


def weights_by_name(config: TrainConfig) -> dict[str, float]:
    """The weights of the objective, of the field and of the tone mapper."""
    weights = asdict(config.loss) | asdict(config.tonemap.loss)
    if hasattr(config.field, "loss"):
        weights |= asdict(config.field.loss)
    return weights


def without(config: TrainConfig, name: str) -> TrainConfig:
    """The settings with one weight at 0, wherever it is kept."""
    change = {name: 0.0}
    if name in asdict(config.loss):
        return replace(config, loss=replace(config.loss, **change))
    if name in asdict(config.tonemap.loss):
        losses = replace(config.tonemap.loss, **change)
        return replace(config, tonemap=replace(config.tonemap, loss=losses))
    field: Any = config.field
    return replace(config, field=replace(field, loss=replace(field.loss, **change)))


def row(
    name: str, config: TrainConfig, scores: dict[str, float], baseline: dict[str, float]
) -> dict[str, Any]:
    """Scores of a run, and their change against the full objective."""
    change = {f"{key}_change": round(scores[key] - baseline[key], 3) for key in scores}
    rounded = {key: round(value, 3) for key, value in scores.items()}
    return {"run": name, "seed": config.seed} | rounded | change


def score(config: TrainConfig, truth: Path) -> dict[str, float]:
    """Decibels of one run, trained in a temporary folder."""
    numba.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        out = train(replace(config, out=Path(folder) / "run"))
        evaluate_run(Run.open(out), truth)
        headline = read_json(out / "metrics.json")["headline"]
    return {name: headline[name] for name in SCORES if headline.get(name) is not None}


if __name__ == "__main__":
    main()
