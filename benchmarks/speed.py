"""Training speed and memory on a prepared scene: rays and steps per second with every
loss, after culling has settled.

    python benchmarks/speed.py SCENE [--preset grid] [--steps 100] [--device cpu]
    [--bf16]

Prints one JSON line. For `paper` it also says how long the published 250,000 steps
would take at that pace (published: 15 h).
"""

import argparse
import json
import platform
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from hdr_nsff.core import distributed
from hdr_nsff.core.process import prepare_process
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import Trainer


def main() -> None:
    prepare_process()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--preset", default="grid", choices=PRESETS)
    parser.add_argument("--steps", type=int, default=100, help="steps that are timed")
    parser.add_argument(
        "--warm-up",
        type=int,
        default=150,
        help="steps before, so that kernels are compiled and culling has settled",
    )
    parser.add_argument("--device", default="auto")
    parser.add_argument(
        "--rays", type=int, help="uniform rays of a batch, and no others, instead of the preset's"
    )
    parser.add_argument("--bf16", action="store_true")
    args = parser.parse_args()
    device = pick_device(args.device)
    total = args.warm_up + args.steps
    with tempfile.TemporaryDirectory() as folder:
        config = replace(
            PRESETS[args.preset],
            scene=args.scene,
            out=Path(folder),
            budget=Budget(steps=2 * total, minutes=None),
            bf16=args.bf16,
        )
        if args.rays is not None:
            config = replace(config, rays=args.rays, moving_rays=0)
        trainer = Trainer(config, Scene.open(args.scene), device, distributed.Ranks())

        def run(steps: int) -> float:
            start = time.perf_counter()
            for _ in range(steps):
                trainer.step()
                trainer.clock = replace(trainer.clock, step=trainer.clock.step + 1)
            if device.type == "cuda":
                torch.cuda.synchronize()
            return time.perf_counter() - start

        run(args.warm_up)
        seconds = run(args.steps)
    rays = (
        config.rays + config.moving_rays or trainer.scene.train[0].image[..., 0].numel()
    ) * config.batches
    result = {
        "preset": args.preset,
        "device": torch.cuda.get_device_name()
        if device.type == "cuda"
        else f"{platform.machine()}, {torch.get_num_threads()} threads",
        "torch": torch.__version__,
        "samples": getattr(config.field, "samples", None),  # Gaussians have none
        "steps_per_second": round(args.steps / seconds, 3),
        "rays_per_second": round(rays * args.steps / seconds),
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }
    if device.type == "cuda":
        result["peak_gpu_gb"] = round(torch.cuda.max_memory_allocated() / 2**30, 2)
    if args.preset == "paper":
        result["hours_for_250k_steps"] = round(250_000 * seconds / args.steps / 3600, 2)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
