"""How much of wrong poses `train --refine-poses` finds back, and what it does to good
ones. BENCHMARK RUNS on an oracle scene (exact poses, masks, depth and flow), not what
the product does on a clip.

    hdr-nsff synth CLIP --oracle
    python benchmarks/refine_poses.py CLIP/oracle OUT --truth CLIP/truth

Every camera of the scene is turned by 1 degree about a random axis and shifted by 1 %
of the median depth in a random direction. Trained with and without corrections, from
wrong and from good poses. Errors are those of the training cameras after the best
similarity (centers) and the best common rotation; pixels are the root mean square
distance between where a camera sees its points and where it should, after the same
alignment. FOUND is 1 - error after / error before. DRIFT of good poses is the error
after / that of the wrong poses before training.
"""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.geometry import alignment
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.pose_corrections import moved, similarities, typical_depth, visible_motion
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train

DEGREES, SHARE = 1.0, 0.01  # of the perturbation
NAMES = ("rotation_degrees", "ate", "pixels")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, help="a scene folder with exact poses")
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=Path, default=None)
    parser.add_argument("--preset", default="splat", choices=sorted(PRESETS))
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0, help="of the perturbation")
    parser.add_argument("--cases", nargs="+", default=["wrong", "good"], choices=["wrong", "good"])
    parser.add_argument(
        "--only-refined", action="store_true", help="do not train without corrections"
    )
    args = parser.parse_args()
    exact = Scene.open(args.scene)
    wrong = Scene.open(perturbed(args.scene, args.out / "wrong_scene", args.seed))
    before = errors(exact, wrong.train)
    print(f"oracle scene, {args.preset}, {args.steps} steps; wrong poses: {told(before)}")
    for case in args.cases:
        scene = wrong.folder if case == "wrong" else args.scene
        for refine in (True,) if args.only_refined else (False, True):
            out = args.out / f"{args.preset}_{case}_{'refined' if refine else 'held'}"
            config = replace(
                PRESETS[args.preset],
                scene=scene,
                out=out,
                budget=Budget(steps=args.steps, minutes=None),
                refine_poses=refine,
                device="cpu",
            )
            run = Run.open(train(config))
            line = {
                "scene": str(args.scene),
                "case": case,
                "refined": refine,
                **report(run, args.truth),
            }
            after = errors(exact, run.scene.train)
            line |= {k: after[k] for k in NAMES}
            if refine:
                line |= {
                    f"{'found' if case == 'wrong' else 'drift'}_{k}": share(
                        case, after[k], before[k]
                    )
                    for k in NAMES
                }
                line["focal"] = float(
                    run.scene.train[0].camera.K[0, 0] / exact.train[0].camera.K[0, 0] - 1
                )
            print(json.dumps(line), flush=True)


def share(case: str, after: float, before: float) -> float:
    """What was found back of wrong poses, or what good ones lost, as a share of the
    perturbation.
    """
    return 1 - after / before if case == "wrong" else after / before


def told(found: dict[str, float]) -> str:
    """Errors in words."""
    return ", ".join(f"{k} {found[k]:.4g}" for k in NAMES)


def perturbed(folder: Path, out: Path, seed: int) -> Path:
    """A copy of the scene `folder` whose cameras are turned and shifted at random;
    frames with one pose keep one pose.
    """
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(folder, out)
    scene, manifest = Scene.open(folder), Manifest.load(folder)
    unit, rng = typical_depth(scene), np.random.default_rng(seed)
    poses: dict[str, list[list[float]]] = {}
    for entry in manifest.frames:
        turn, shift = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        twist = torch.from_numpy(np.concatenate([np.radians(DEGREES) * turn, SHARE * shift]))
        camera = Camera(
            torch.tensor(entry.K).double(),
            torch.tensor(entry.c2w).double(),
            manifest.width,
            manifest.height,
        )
        entry.c2w = poses.setdefault(str(entry.c2w), moved(camera, twist, unit).c2w.tolist())
    manifest.save(out)
    return out


def errors(scene: Scene, found: list[Frame]) -> dict[str, float]:
    """Rotation (mean degrees), centers (root mean square, scene units) and pixels."""
    true, unit = scene.train, typical_depth(scene)
    a, b = (torch.stack([f.camera.c2w for f in frames]).double() for frames in (true, found))
    between = Rotation.from_matrix((b[:, :, :3] @ a[:, :, :3].mT).numpy()).as_rotvec()
    twists = torch.cat([torch.from_numpy(between), (b[:, :, 3] - a[:, :, 3]) / unit], 1)  # (T, 6)
    metrics = torch.stack([visible_motion(f, scene, unit) for f in true])  # (T, 6, 6)
    roots = torch.linalg.cholesky(metrics).mT
    common = (
        similarities(a[:, :, 3] / unit, turns_only=False).double().view(-1, *twists.shape)
    )  # (7, T, 6)
    columns = torch.einsum("tij,gtj->tig", roots, common).flatten(0, 1)
    moved_by = torch.einsum("tij,tj->ti", roots, twists).flatten()
    left = moved_by - columns @ torch.linalg.lstsq(columns, moved_by[:, None]).solution[:, 0]
    pixels = float((left.square().sum() / len(true)).sqrt()) * true[0].camera.width
    return alignment.pose_errors(a.numpy(), b.numpy()) | {"pixels": pixels}


def report(run: Run, truth: Path | None) -> dict[str, float]:
    """PSNR of held-out views where there is a truth, and of training."""
    told = {"psnr_training": float(np.mean([line.psnr for line in run.log()[-10:]]))}
    if truth is not None:
        told["psnr"] = evaluate_run(run, truth)["headline"]["psnr"]
    return told


if __name__ == "__main__":
    main()
