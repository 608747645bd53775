"""Correctness and speed on a CUDA device, one measurement after the other.

    python benchmarks/gpu.py                  # or benchmarks/gpu.sh
    python benchmarks/gpu.py --only twins "splat 720x480"

Every result is printed and written as soon as it is there; a second start measures
what is missing, as long as the device and the commit are the same. What does not fit
into `--minutes` is left for another start. Steps per second are of closed-form scenes
of 12 frames with every loss; frames per second are rendered and kept on the device.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from record import ROOT, Record, code_version, gpu_name, make_parser, restart_prepared
from torch import Tensor

from hdr_nsff.core import distributed
from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.nsff.encodings import AdditiveGrid
from hdr_nsff.fields.splat import cuda_backends
from hdr_nsff.fields.splat.rasterize import rasterize
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import Trainer

SIZES = ((240, 136), (720, 480), (1280, 720))
MAX_ERROR = 1e-4  # of the largest number: twins that differ by more are wrong
# of the norm of a step's gradient: rounding alone, which turns signs of pixels' errors
# and the order of Gaussians, makes up to 0.016 (measured on a CPU, once)
MAX_STEP_ERROR = 0.05
COMPARED_STEPS = 4
NUM_LOCAL = 500  # time-local Gaussians of these steps
GOAL_DB = (33.0, 27.5)  # the demo's PSNR and that of its movers, on the CPU
DEMO_MINUTES = 1.0  # of training
DEMO_SHARES = (0.08, 0.17, 0.25, 0.33, 0.5, 0.67, 0.83)
DEMO_VIEWS = 6
PUBLISHED_STEPS = 250_000


def main() -> None:
    parser = make_parser(__doc__, "gpu")
    parser.add_argument("--minutes", type=float, default=9.0, help="after which none is started")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="measurements by name")
    parser.add_argument("--steps", type=int, default=200, help="steps that are timed")
    parser.add_argument("--warm-up", type=int, default=60, help="steps before these")
    parser.add_argument("--device", default="cuda", help="the device; cpu tries the script out")
    args = parser.parse_args()
    device = torch.device(args.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("benchmarks/gpu.py: this torch sees no CUDA device", file=sys.stderr)
        raise SystemExit(2)
    restart_prepared()
    record = Record("gpu", args, seed=0, device=device)
    record.results = earlier_results(args.out, device)
    done = {result["name"] for result in record.results}
    measurements = all_measurements(args, device)
    if unknown := set(args.only or ()) - set(measurements):
        parser.error(f"--only: no measurement is named {sorted(unknown)}; {sorted(measurements)}")
    start = time.monotonic()
    for name, measure in measurements.items():
        if name in done or (args.only and name not in args.only):
            continue
        if time.monotonic() - start > 60 * args.minutes:
            print(f"{name}: left for another start of this command")
            continue
        record.add({"name": name, **try_to(measure)})
        record.save(show=False)
    print(f"results: {args.out}")
    if any("error" in result for result in record.results):
        raise SystemExit(1)


def all_measurements(
    args: argparse.Namespace, device: torch.device
) -> dict[str, Callable[[], dict[str, Any]]]:
    """Every measurement by its name, the important ones first."""
    found: dict[str, Callable[[], dict[str, Any]]] = {"twins": partial(compare_twins, device)}
    found["steps"] = partial(compare_steps, device)
    for size in SIZES:
        name = "splat {}x{}".format(*size)
        found[name] = partial(measure_training, "splat", size, False, args, device)
    found["demo"] = partial(run_demo, device)
    small = SIZES[0]
    found["grid"] = partial(measure_training, "grid", small, False, args, device)
    found["paper"] = partial(measure_training, "paper", small, False, args, device)
    found["paper bf16"] = partial(measure_training, "paper", small, True, args, device)
    if device.type == "cuda" and torch.cuda.device_count() > 1:
        found["two GPUs"] = partial(compare_processes, args)
    return found


def earlier_results(path: Path, device: torch.device) -> list[dict[str, Any]]:
    """What an earlier start has measured here, at this commit, without an error."""
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError):
        return []
    gpu = document["machine"]["gpu"]
    same = document["commit"] == code_version()[0] and gpu == gpu_name(device)
    return [r for r in document["results"] if "error" not in r] if same else []


def try_to(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The numbers and seconds of a measurement, or its error: the others still run."""
    start = time.monotonic()
    try:
        result = measure()
    except Exception as error:  # of any type: it is the result
        result = {"error": f"{type(error).__name__}: {error}"}
    return result | {"wall_seconds": round(time.monotonic() - start, 1)}


def compare_twins(device: torch.device) -> dict[str, Any]:
    """Largest differences of maps and gradients to the CPU's kernels, relative to the
    largest number of each.
    """
    backend = "CPU"
    if device.type == "cuda":
        found = cuda_backends.find_backend(str(device))
        backend = found.description
        if found.composite is None:  # the CPU would be compared with itself
            return {"error": f"nothing draws Gaussians on the GPU: {found.fault}"}
    generator = torch.Generator().manual_seed(0)
    count, width, height = 5000, 320, 240
    z = 1 + 4 * torch.rand(count, 1, generator=generator)
    across = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([1.4, 1.1]) * z
    parts = [
        torch.cat([across, z], 1),
        torch.randn(count, 4, generator=generator),
        0.005 + 0.05 * torch.rand(count, 3, generator=generator),
        0.05 + 0.5 * torch.rand(count, generator=generator),
        torch.randn(count, 6, generator=generator),
    ]
    K = torch.tensor([[250.0, 0, 160], [0, 250, 120], [0, 0, 1]])
    camera = Camera(K, torch.eye(4)[:3], width, height)
    weight = torch.rand(height, width, 8, generator=generator)

    def draw(where: torch.device) -> list[Tensor]:
        leaves = [part.to(where, copy=True).requires_grad_() for part in parts]
        pose = camera.c2w.to(where, copy=True).requires_grad_()
        maps = rasterize(*leaves, to_device(camera, where).moved(pose))
        seen = torch.cat([maps.features, maps.depth[..., None], maps.alpha[..., None]], -1)
        (seen * weight.to(where)).sum().backward()
        gradients = [leaf.grad for leaf in (*leaves, pose)]
        return [t.cpu() for t in (seen.detach(), *gradients) if t is not None]

    names = ("maps", "means", "quaternions", "scales", "opacities", "features", "pose")
    pairs = zip(names, draw(device), draw(torch.device("cpu")), strict=True)
    errors = {name: float((a - b).abs().max() / b.abs().max()) for name, a, b in pairs}
    result: dict[str, Any] = {"backend": backend, "largest_differences": errors}
    if not within(MAX_ERROR, errors):
        result["error"] = f"the twins differ by more than {MAX_ERROR}"
    return result


def compare_steps(device: torch.device) -> dict[str, Any]:
    """Differences of four training steps' terms and gradients to the CPU's, and of a
    grid's, as shares of the norm of each.

    Steps of `splat`, which draws no noise: some have flow, the others rigidity. The ten
    largest are kept.
    """
    places = torch.device("cpu"), device
    with tempfile.TemporaryDirectory() as name:
        scene = toy_scene(SIZES[0], Path(name))
        expected, found = (
            gradients_of_steps(scene, Path(name) / "scene", Path(name) / str(i), place)
            for i, place in enumerate(places)
        )
    steps = {name: relative_error(found[name], value) for name, value in expected.items()}
    expected, found = (gradients_of_grid(place) for place in places)
    grid = {name: relative_error(found[name], value) for name, value in expected.items()}
    largest = dict(sorted(steps.items(), key=lambda item: -item[1])[:10])
    result: dict[str, Any] = {"differences": largest, "of_a_grid": grid}
    if not (within(MAX_STEP_ERROR, steps) and within(MAX_ERROR, grid)):
        result["error"] = "a step or a grid differs from the CPU's"
    return result


def within(bound: float, errors: dict[str, float]) -> bool:
    """Whether no error is larger than a bound, or not a number."""
    return all(error <= bound for error in errors.values())


def relative_error(found: Tensor, expected: Tensor) -> float:
    """The norm of the difference, relative to the norm of what is expected, if any."""
    norm, off = float(expected.norm()), float((found - expected).norm())
    return off / norm if norm else off


def gradients_of_steps(
    scene: Scene, folder: Path, out: Path, device: torch.device
) -> dict[str, Tensor]:
    """Terms and gradients of steps of an untrained `splat`, which are not taken."""
    preset, budget = PRESETS["splat"], Budget(steps=1000, minutes=None)
    field = replace(preset.field, local=NUM_LOCAL)
    config = replace(preset, scene=folder, out=out, field=field, budget=budget)
    config.out.mkdir()
    trainer = Trainer(config, scene, device, distributed.Ranks())
    static, local = trainer.field.static, trainer.field.local
    local.means.data[:, :3] = static.means.data[:NUM_LOCAL]
    local.means.data[:, 3] = torch.arange(NUM_LOCAL, device=device) % len(scene.train)
    local.log_scales.data[:, :3] = static.log_scales.data[:NUM_LOCAL]
    generator = torch.Generator().manual_seed(0)
    for name, p in trainer.field.named_parameters():  # fits nothing, and nothing is round
        size = 0.01 if name.endswith("means") else 0.2
        p.data += size * (1 + torch.randn(p.shape, generator=generator)).to(device)
    trainer.monitor.read_every = 1
    trainer.optimizers.step = lambda *rates: None  # type: ignore[method-assign]
    found: dict[str, Tensor] = {}
    for step in range(1, 1 + COMPARED_STEPS):
        trainer.clock = replace(trainer.clock, step=step)
        for name, value in trainer.step().items():
            found[f"{name} {step}"] = torch.tensor(value)
        for module in (trainer.field, trainer.tonemapper):
            for name, p in module.named_parameters():
                if p.grad is not None and p.numel():
                    found[f"{name} {step}"] = p.grad.cpu().clone()
                p.grad = None
    return found


def gradients_of_grid(device: torch.device) -> dict[str, Tensor]:
    """Values of a grid with a hashed level at some points, and both gradients."""
    generator = torch.Generator().manual_seed(0)
    grid = AdditiveGrid([(8, 6, 4, 3), (64, 48, 32, 3)], num_knots=3, max_rows=2**14)
    grid.table.data.copy_(torch.randn(grid.table.shape, generator=generator))
    points, weights = (torch.rand(20_000, n, generator=generator) for n in (3, 4))
    grid, coords = grid.to(device), points.to(device, copy=True).requires_grad_()
    values = grid(coords, 0.6)
    (values * weights.to(device)).sum().backward()
    made = {"values": values.detach(), "points": coords.grad, "table": grid.table.grad}
    return {name: value.cpu() for name, value in made.items() if value is not None}


def toy_scene(size: tuple[int, int], folder: Path) -> Scene:
    """A closed-form scene of 12 frames with a card that moves."""
    sys.path.insert(0, str(ROOT / "tests"))
    from toy_scene import ToyScene

    return Scene.open(ToyScene(*size, frames=12).write(folder / "scene"))


def measure_training(
    preset: str,
    size: tuple[int, int],
    bf16: bool,
    args: argparse.Namespace,
    device: torch.device,
) -> dict[str, Any]:
    """Steps per second and peak memory of a preset, and frames per second after it."""
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = toy_scene(size, folder)
        budget = Budget(steps=10 * (args.warm_up + args.steps), minutes=None)
        config = replace(
            PRESETS[preset], scene=folder / "scene", out=folder / "run", budget=budget, bf16=bf16
        )
        config.out.mkdir()
        trainer = Trainer(config, scene, device, distributed.Ranks())
        train_steps(trainer, args.warm_up, device)
        seconds = train_steps(trainer, args.steps, device)
    result: dict[str, Any] = {
        "steps_per_second": round(args.steps / seconds, 2),
        "frames_per_second": round(frames_per_second(trainer, device), 2),
    }
    if device.type == "cuda":
        result["peak_gpu_gb"] = round(torch.cuda.max_memory_allocated(device) / 2**30, 2)
    if preset == "splat":
        counts = len(trainer.field.static), len(trainer.field.moving), len(trainer.field.local)
        result["gaussians"] = sum(counts)
    if preset == "paper":
        result["hours_for_250k_steps"] = round(PUBLISHED_STEPS * seconds / args.steps / 3600, 2)
    return result


def train_steps(trainer: Trainer, count: int, device: torch.device) -> float:
    """Seconds of `count` steps."""
    synchronize(device)
    start = time.perf_counter()
    for _ in range(count):
        trainer.step()
        trainer.clock = replace(trainer.clock, step=trainer.clock.step + 1)
    synchronize(device)
    return time.perf_counter() - start


def frames_per_second(trainer: Trainer, device: torch.device) -> float:
    """Pictures of training frames per second, for a second at least."""
    frames = trainer.scene.train
    trainer.field.eval()
    trainer.field.render(frames[0].camera, frames[0].time, scene_flow=False)
    synchronize(device)
    start, count = time.perf_counter(), 0
    while time.perf_counter() - start < 1.0:
        frame = frames[count % len(frames)]
        trainer.field.render(frame.camera, frame.time, scene_flow=False)
        count += 1
        synchronize(device)
    return count / (time.perf_counter() - start)


def synchronize(device: torch.device) -> None:
    """Wait for the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def run_demo(device: torch.device) -> dict[str, Any]:
    """PSNR of the demo's held-out views over training time, all pixels and movers."""
    from hdr_nsff.bench.curve import curve_of
    from hdr_nsff.evaluation.evaluate import evaluate_run
    from hdr_nsff.training.run_folder import Run
    from hdr_nsff.training.train import train

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = time.monotonic()
        code = "import sys; from hdr_nsff.cli import main; sys.exit(main())"
        words = ["prepare", str(ROOT / "demo/clip.mp4"), str(folder / "scene")]
        subprocess.run([sys.executable, "-c", code, *words], check=True, stdout=sys.stderr)
        prepare_seconds = time.monotonic() - start
        budget = Budget(steps=None, minutes=DEMO_MINUTES)
        config = replace(
            PRESETS["splat"],
            scene=folder / "scene",
            out=folder / "run",
            budget=budget,
            device=str(device),
        )
        train(config, keep_at=DEMO_SHARES, previews=False)
        run = Run.open(folder / "run", str(device))
        evaluate_run(run, ROOT / "demo/truth")
        curve, _ = curve_of(run, ROOT / "demo/truth", DEMO_VIEWS)
    points = [
        {"seconds": point.seconds, "psnr": point.scores.get("psnr", 0.0)}
        | {"psnr_moving": point.scores.get("psnr_moving", 0.0)}
        for point in curve
    ]
    reached = [
        p["seconds"] for p in points if p["psnr"] >= GOAL_DB[0] and p["psnr_moving"] >= GOAL_DB[1]
    ]
    return {
        "prepare_seconds": round(prepare_seconds, 1),
        "goal_db": GOAL_DB,
        "seconds_to_goal": min(reached, default=None),
        "curve": points,
    }


def compare_processes(args: argparse.Namespace) -> dict[str, Any]:
    """Steps per second of `splat` with 4 batches a step, on one GPU and on two."""
    return {f"steps_per_second_{count}": measure_processes(count, args.steps) for count in (1, 2)}


def measure_processes(count: int, steps: int) -> float:
    """Steps per second in `count` processes, by the run's own clock."""
    from hdr_nsff.core.io import write_json

    script = (
        "import json, sys\n"
        "from hdr_nsff.training.config import TrainConfig\n"
        "from hdr_nsff.training.train import train\n"
        "train(TrainConfig.from_json(json.loads(open(sys.argv[1]).read())), previews=False)\n"
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        toy_scene(SIZES[1], folder)
        config = replace(
            PRESETS["splat"],
            scene=folder / "scene",
            out=folder / "run",
            budget=Budget(steps=4 * steps // 25 * 25, minutes=None),
            batches=4,
        )
        write_json(folder / "given.json", config.to_json())
        (folder / "script.py").write_text(script)
        launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
        command = [sys.executable, *launcher, str(folder / "script.py")]
        subprocess.run([*command, str(folder / "given.json")], check=True, env=dict(os.environ))
        lines = (folder / "run/log.jsonl").read_text().splitlines()
        first, last = json.loads(lines[0]), json.loads(lines[-1])
    return round((last["step"] - first["step"]) / (last["seconds"] - first["seconds"]), 2)


if __name__ == "__main__":
    main()
