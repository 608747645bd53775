"""What `train --refine-poses` recovers of wrong poses, and how far it moves exact ones.

    hdr-nsff synth lamp CLIP --oracle
    python benchmarks/refine_poses.py CLIP/oracle FOLDER --truth CLIP/truth

ORACLE RUNS: masks, depth and flow of the scene are exact, so the numbers say nothing
about a clip that is recorded. In the case `wrong`, every camera is turned by 1 degree
about a random axis and shifted by 1 % of the median depth in a random direction; in
`exact`, it stays. Both cases are trained without and with corrections, in FOLDER.
Errors are those of the training cameras after the best similarity (`ate`) and the best
common rotation (`rotation_degrees`). `pixels` is the root mean square distance, after
the same alignment, between where a camera sees its points and where it should.
`recovered` is 1 - error after / error before; `drift` of exact poses is their error
after training / the error of the wrong poses before.
"""

from __future__ import annotations

import argparse
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from record import Record, make_parser, name_of, restart_prepared
from scipy.spatial.transform import Rotation

from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.geometry import alignment
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.pose_corrections import (
    move_camera,
    similarities,
    typical_depth,
    visible_motion,
)
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

# The errors of the wrong poses: what a structure from motion that barely holds leaves
# (hand-chosen).
WRONG_DEGREES = 1.0
WRONG_SHIFT = 0.01  # of the median depth
ERRORS = ("rotation_degrees", "ate", "pixels")
LAST_LOG_LINES = 10  # whose training PSNR is averaged


def main() -> None:
    parser = make_parser(__doc__, "refine_poses")
    parser.add_argument("scene", type=Path, help="a scene folder with exact poses")
    parser.add_argument("folder", type=Path, help="for the runs; made here")
    parser.add_argument("--truth", type=Path, help="a folder with exact views, for their PSNR")
    parser.add_argument("--preset", default="splat", choices=sorted(PRESETS))
    parser.add_argument("--steps", type=int, default=1500, help="of every run")
    parser.add_argument("--seed", type=int, default=0, help="of the wrong poses")
    parser.add_argument(
        "--cases", nargs="+", default=["wrong", "exact"], choices=["wrong", "exact"]
    )
    parser.add_argument(
        "--only-refined", action="store_true", help="do not train without corrections"
    )
    args = parser.parse_args()
    restart_prepared()
    record = Record("refine_poses", args, seed=args.seed)
    exact = Scene.open(args.scene)
    wrong = Scene.open(perturb_poses(args.scene, args.folder / "wrong_scene", args.seed))
    before = pose_errors(exact, wrong.train)
    record.add({"case": "wrong", "refined": None, "steps": 0} | before)
    for case in args.cases:
        for refine in (True,) if args.only_refined else (False, True):
            record.add(measure(case, refine, exact, wrong, before, args))
    record.save()


def measure(
    case: str,
    refine: bool,
    exact: Scene,
    wrong: Scene,
    before: dict[str, float],
    args: argparse.Namespace,
) -> dict[str, Any]:
    """Train one case, and compare its cameras with the exact ones."""
    scene = wrong.folder if case == "wrong" else args.scene
    kind = "refined" if refine else "held"
    config = replace(
        PRESETS[args.preset],
        scene=scene,
        out=args.folder / f"{args.preset}_{case}_{kind}",
        budget=Budget(steps=args.steps, minutes=None),
        refine_poses=refine,
        device="cpu",
    )
    run = Run.open(train(config))
    after = pose_errors(exact, run.scene.train)
    row: dict[str, Any] = {"scene": name_of(args.scene), "case": case, "refined": refine}
    row["steps"] = args.steps
    row |= picture_scores(run, args.truth) | after
    if not refine:
        return row
    for name in ERRORS:
        share = after[name] / before[name]
        if case == "wrong":
            row[f"recovered_{name}"] = 1 - share
        else:
            row[f"drift_{name}"] = share
    focal_lengths = [float(s.train[0].camera.K[0, 0]) for s in (run.scene, exact)]
    row["focal_error"] = focal_lengths[0] / focal_lengths[1] - 1
    return row


def perturb_poses(folder: Path, out: Path, seed: int) -> Path:
    """A copy of a scene whose cameras are turned and shifted at random.

    Frames that share a pose keep one pose.
    """
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(folder, out)
    scene, manifest = Scene.open(folder), Manifest.load(folder)
    unit, rng = typical_depth(scene), np.random.default_rng(seed)
    perturbed: dict[str, list[list[float]]] = {}  # by the exact pose
    for entry in manifest.frames:
        axis, shift = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        twist = np.concatenate([np.radians(WRONG_DEGREES) * axis, WRONG_SHIFT * shift])
        K = torch.tensor(entry.K).double()
        c2w = torch.tensor(entry.c2w).double()
        camera = Camera(K, c2w, manifest.width, manifest.height)
        wrong = move_camera(camera, torch.from_numpy(twist), unit).c2w.tolist()
        entry.c2w = perturbed.setdefault(str(entry.c2w), wrong)
    manifest.save(out)
    return out


def pose_errors(scene: Scene, found: list[Frame]) -> dict[str, float]:
    """Rotation (mean degrees), centers (root mean square, scene units) and pixels."""
    true, unit = scene.train, typical_depth(scene)
    a = torch.stack([frame.camera.c2w for frame in true]).double()
    b = torch.stack([frame.camera.c2w for frame in found]).double()
    turns = Rotation.from_matrix((b[:, :, :3] @ a[:, :, :3].mT).numpy()).as_rotvec()
    shifts = (b[:, :, 3] - a[:, :, 3]) / unit
    twists = torch.cat([torch.from_numpy(turns), shifts], 1)  # (T, 6)
    metrics = torch.stack([visible_motion(frame, scene, unit) for frame in true])  # (T, 6, 6)
    roots = torch.linalg.cholesky(metrics).mT
    basis = similarities(a[:, :, 3] / unit, rotations_only=False).double()
    basis = basis.view(-1, *twists.shape)  # (7, T, 6)
    columns = torch.einsum("tij,gtj->tig", roots, basis).flatten(0, 1)  # (6 T, 7)
    motion = torch.einsum("tij,tj->ti", roots, twists).flatten()
    fit = torch.linalg.lstsq(columns, motion[:, None]).solution[:, 0]
    remaining = motion - columns @ fit
    widths = (remaining.square().sum() / len(true)).sqrt()
    pixels = float(widths) * true[0].camera.width
    return alignment.pose_errors(a.numpy(), b.numpy()) | {"pixels": pixels}


def picture_scores(run: Run, truth: Path | None) -> dict[str, float]:
    """PSNR of training, and of held-out views where there is a truth."""
    last = run.log()[-LAST_LOG_LINES:]
    scores = {"psnr_training": float(np.mean([line.psnr for line in last]))}
    if truth is not None:
        scores["psnr"] = evaluate_run(run, truth)["headline"]["psnr"]
    return scores


if __name__ == "__main__":
    main()
