"""Training speed and memory of presets on prepared scenes.

    python benchmarks/speed.py SCENE ... --preset grid splat --steps 100

Counts steps and rays per second with every loss, after enough steps that kernels are
compiled and culling no longer changes. The peak memory is that of the process so far:
name the smallest scene first. `--bf16` measures every preset once more in bfloat16.
For `paper` it extrapolates to the published 250,000 steps (published: 15 h).
"""

from __future__ import annotations

import argparse
import platform
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from record import Record, make_parser, name_of, restart_prepared

from hdr_nsff.core import distributed
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import Trainer

PUBLISHED_STEPS = 250_000


def main() -> None:
    parser = make_parser(__doc__, "speed")
    parser.add_argument("scene", type=Path, nargs="+", help="a prepared scene")
    parser.add_argument("--preset", nargs="+", default=["grid"], choices=PRESETS)
    parser.add_argument("--steps", type=int, default=100, help="steps that are timed")
    parser.add_argument("--warm-up", type=int, default=150, help="steps before these")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N")
    parser.add_argument(
        "--rays", type=int, help="uniform rays of a batch, and no others, instead of the preset's"
    )
    parser.add_argument("--bf16", action="store_true", help="measure in bfloat16 as well")
    args = parser.parse_args()
    restart_prepared()
    precisions = (False, True) if args.bf16 else (False,)
    record = Record("speed", args, seed=TrainConfig.seed)
    for folder in args.scene:
        for preset in args.preset:
            for bf16 in precisions:
                record.add(measure(folder, preset, bf16, args))
    record.save()


def measure(
    scene_folder: Path, preset: str, bf16: bool, args: argparse.Namespace
) -> dict[str, Any]:
    """Steps and rays per second of one preset on a scene, and peak memory so far."""
    scene = Scene.open(scene_folder)
    device = pick_device(args.device)
    budget = Budget(steps=2 * (args.warm_up + args.steps), minutes=None)
    with tempfile.TemporaryDirectory() as folder:
        config = replace(
            PRESETS[preset], scene=scene_folder, out=Path(folder), budget=budget, bf16=bf16
        )
        if args.rays is not None:
            config = replace(config, rays=args.rays, moving_rays=0)
        trainer = Trainer(config, scene, device, distributed.Ranks())
        train_steps(trainer, args.warm_up, device)
        seconds = train_steps(trainer, args.steps, device)
    whole_frame = scene.train[0].camera.width * scene.train[0].camera.height
    rays = (config.rays + config.moving_rays or whole_frame) * config.batches
    result = {
        "scene": name_of(scene_folder),
        "pixels": whole_frame,
        "frames": len(scene.train),
        "preset": preset,
        "bf16": bf16,
        "device": device_name(device),
        "samples": getattr(config.field, "samples", None),  # Gaussians have none
        "steps_per_second": round(args.steps / seconds, 3),
        "rays_per_second": round(rays * args.steps / seconds),
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    if device.type == "cuda":
        result["peak_gpu_gb"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
    if preset == "paper":
        hours = PUBLISHED_STEPS * seconds / args.steps / 3600
        result["hours_for_250k_steps"] = round(hours, 2)
    return result


def train_steps(trainer: Trainer, count: int, device: torch.device) -> float:
    """Seconds of `count` steps."""
    start = time.perf_counter()
    for _ in range(count):
        trainer.step()
        trainer.clock = replace(trainer.clock, step=trainer.clock.step + 1)
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def device_name(device: torch.device) -> str:
    """The GPU's name, or the processor and the threads that torch uses."""
    if device.type == "cuda":
        return torch.cuda.get_device_name()
    return f"{platform.machine()}, {torch.get_num_threads()} threads"


if __name__ == "__main__":
    main()
