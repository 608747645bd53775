"""What better priors would bring: a scene trained with some of its priors exact.

    hdr-nsff synth interior CLIP --oracle
    hdr-nsff prepare CLIP/clip.mp4 SCENE --hold-out 0
    python benchmarks/replace_priors.py SCENE CLIP/oracle FOLDER --truth CLIP/truth \\
        --what masks mover-depth

ORACLE RUNS: they show what holds a result back, not what the program does on a clip.
FOLDER/scene becomes a copy of SCENE with the named priors of the oracle scene. With
--truth, SCENE and that copy are trained, and the file of results holds their scores;
without, only the copy is made. Poses stay those of SCENE. The oracle's depth is scaled
to them by the similarity of the camera paths. `depth` replaces the depth of all pixels,
`mover-depth` that of moving pixels.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from record import Record, make_parser, name_of, restart_prepared

from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_npy, write_npy
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

STEPS = {"masks": "masks", "mover-depth": "depth", "depth": "depth", "flow": "flow"}
SCORES = ("psnr", "psnr_moving", "ssim", "mu5000", "mu5000_moving")  # of the headline


def main() -> None:
    parser = make_parser(__doc__, "replace_priors")
    parser.add_argument("scene", type=Path, help="a prepared scene")
    parser.add_argument("oracle", type=Path, help="the oracle scene of the same clip")
    parser.add_argument("folder", type=Path, help="for the new scene and the runs; made here")
    parser.add_argument("--what", nargs="+", choices=STEPS, required=True, help="exact priors")
    parser.add_argument("--truth", type=Path, help="train, and measure on these exact views")
    parser.add_argument("--preset", default="splat", choices=PRESETS)
    parser.add_argument("--steps", type=int, default=1500, help="of both runs")
    args = parser.parse_args()
    restart_prepared()
    scene = replace_priors(args.scene, args.oracle, args.folder / "scene", args.what)
    print(f"oracle scene: {scene}, with exact {', '.join(args.what)}")
    if args.truth is None:
        return
    record = Record("replace_priors", args, seed=TrainConfig.seed)
    record.add({"replaced": []} | train_and_score(args.scene, args.folder / "before", args))
    record.add({"replaced": args.what} | train_and_score(scene, args.folder / "after", args))
    record.save()


def train_and_score(scene: Path, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Scores of a run on the exact views."""
    budget = Budget(steps=args.steps, minutes=None)
    config = replace(PRESETS[args.preset], scene=scene, out=out, budget=budget)
    headline = evaluate_run(Run.open(train(config)), args.truth)["headline"]
    return {"scene": name_of(scene)} | {name: headline.get(name) for name in SCORES}


def replace_priors(folder: Path, oracle_folder: Path, out: Path, what: list[str]) -> Path:
    """A copy of a scene with exact priors; returns its folder."""
    manifest, oracle = Manifest.load(folder), Manifest.load(oracle_folder)
    if len(manifest.frames) != len(oracle.frames):
        raise SystemExit(
            f"{folder} has {len(manifest.frames)} frames and {oracle_folder} has "
            f"{len(oracle.frames)}; prepare the same clip with --hold-out 0"
        )
    shutil.copytree(folder, out)
    scale = units_per_true_unit(manifest, oracle)
    for entry, exact in zip(manifest.frames, oracle.frames, strict=True):
        if "depth" in what or "mover-depth" in what:
            replace_depth(out, entry, oracle_folder, exact, scale, everywhere="depth" in what)
        if "masks" in what:
            shutil.copy(oracle_folder / str(exact.mask), out / str(entry.mask))
        if "flow" in what:
            replace_flow(out, entry, oracle_folder, exact)
    for name in {STEPS[prior] for prior in what}:
        changes = {"provenance": "given", "note": "of an oracle"}
        manifest.steps[name] = manifest.steps[name].model_copy(update=changes)
    manifest.save(out)
    return out


def units_per_true_unit(manifest: Manifest, oracle: Manifest) -> float:
    """Units of the scene per unit of the oracle, from the two camera paths."""
    true = np.array([frame.c2w for frame in oracle.frames])
    estimated = np.array([frame.c2w for frame in manifest.frames])
    similarity = alignment.umeyama(true[:, :, 3], estimated[:, :, 3])
    if similarity is None:
        raise SystemExit("the camera does not move enough to fix the scale of depth")
    return similarity.scale


def replace_flow(out: Path, entry: FrameEntry, oracle: Path, exact: FrameEntry) -> None:
    """The oracle's flow to every frame that both have flow to."""
    for other in entry.flow.keys() & exact.flow.keys():
        shutil.copy(oracle / exact.flow[other].flow, out / entry.flow[other].flow)
        shutil.copy(oracle / exact.flow[other].valid, out / entry.flow[other].valid)


def replace_depth(
    out: Path, entry: FrameEntry, oracle: Path, exact: FrameEntry, scale: float, everywhere: bool
) -> None:
    """The oracle's disparity with full confidence, everywhere or at moving pixels."""
    where = np.ones(1, bool) if everywhere else read_mask(oracle / str(exact.mask))
    path = out / str(entry.disparity)
    disparity = read_npy(oracle / str(exact.disparity)).astype(np.float32) / scale
    write_npy(path, np.where(where, disparity, read_npy(path)).astype(np.float16))
    if entry.disparity_confidence:
        path = out / entry.disparity_confidence
        write_npy(path, np.where(where, 1, read_npy(path)).astype(np.float16))


if __name__ == "__main__":
    main()
