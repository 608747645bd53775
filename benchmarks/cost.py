"""The cost of a training step and of a picture of `splat`, against four quantities.

    python benchmarks/cost.py SCENE --plot docs/images/cost.png

One of Gaussians, pixels, frames of the clip and processor cores varies at a time. The
others stay at 20,000 Gaussians, 240 pixels of width, all frames and all cores. SCENE is
a prepared clip: its frames are resized, dropped, or repeated backwards in memory.
Every measurement runs in a new process. It holds the median milliseconds of a step with
all its losses and of a picture (radiance, depth, motion share, tone-mapped), and the
peak memory of the process.

    python benchmarks/cost.py SCENE ... --prepare --out benchmarks/results/prepare.json

With --prepare nothing is run: it tabulates what `prepare` recorded in each SCENE of the
cost of its steps, per megapixel and frame.
"""

from __future__ import annotations

import multiprocessing
import resource
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
import numpy as np
import torch
from record import Record, make_parser, name_of, restart_prepared
from torch import Tensor
from torch.nn.functional import interpolate

from hdr_nsff.core import distributed
from hdr_nsff.core.process import limit_torch_threads
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import Trainer

MOVING_SHARE = 0.2  # of all Gaussians; hand-chosen, near that of trained scenes
WARM_UP_STEPS = 20  # before the timed ones: kernels are compiled and memory is touched
CORES = numba.config.NUMBA_NUM_THREADS  # that numba may use
DEFAULTS = {"gaussians": 20_000, "width": 240, "frames": 0, "cores": CORES}  # 0: all frames
# Axis: the setting that varies, and its values.
AXES: dict[str, tuple[str, list[int]]] = {
    "gaussians": ("gaussians", [5_000, 10_000, 20_000, 40_000, 80_000]),
    "pixels": ("width", [120, 240, 480, 720, 960]),
    "frames": ("frames", [9, 18, 36, 72]),
    "cores": ("cores", sorted({1, 2, 4, 8, 16, CORES})),
}


def main() -> None:
    parser = make_parser(__doc__, "cost")
    parser.add_argument("scene", type=Path, nargs="+", help="a prepared scene")
    parser.add_argument(
        "--prepare", action="store_true", help="tabulate the recorded cost of preparing it"
    )
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the curves to this PNG")
    parser.add_argument("--steps", type=int, default=60, help="steps and pictures that are timed")
    parser.add_argument(
        "--only", nargs="+", choices=AXES, default=list(AXES), help="the axes to measure"
    )
    args = parser.parse_args()
    if args.prepare:
        record = Record("cost-prepare", args)
        for scene in args.scene:
            for row in prepare_costs(scene):
                record.add({"scene": name_of(scene)} | row)
        record.save()
        return
    restart_prepared()
    record = Record("cost", args, seed=TrainConfig.seed)
    for axis in args.only:
        setting, values = AXES[axis]
        for value in values:
            if setting == "cores" and value > CORES:
                continue
            settings = DEFAULTS | {setting: value}
            # A new process for every measurement: its peak memory counts from zero.
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                row = pool.apply(measure, (args.scene[0], settings, args.steps))
            record.add({"axis": axis} | row)
    record.save()
    if args.plot:
        plot(record.results, args.plot)


def prepare_costs(folder: Path) -> list[dict[str, Any]]:
    """The recorded cost of every step of `prepare`, and of all: seconds of wall clock
    and of processor time, the latter per megapixel and frame, and the peak memory of
    the process up to the step's end.
    """
    manifest = Manifest.load(folder)
    megapixels = manifest.width * manifest.height * len(manifest.frames) / 1e6
    rows = []
    for name, step in manifest.steps.items():
        rows.append(
            {
                "step": name,
                "seconds": step.seconds,
                "cpu_seconds": step.cpu_seconds,
                "peak_memory_gb": round(step.peak_memory_mb / 1024, 2),
            }
        )
    rows.append(
        {
            "step": "all",
            "seconds": sum(row["seconds"] for row in rows),
            "cpu_seconds": sum(row["cpu_seconds"] for row in rows),
            "peak_memory_gb": max(row["peak_memory_gb"] for row in rows),
        }
    )
    size = {
        "pixels": manifest.width * manifest.height,
        "frames": len(manifest.frames),
    }
    return [
        size | row | {"cpu_seconds_per_megapixel": round(row["cpu_seconds"] / megapixels, 3)}
        for row in rows
    ]


def measure(folder: Path, settings: dict[str, int], steps: int) -> dict[str, Any]:
    """Median milliseconds of a step and of a picture, and peak memory."""
    scene = Scene.open(folder)
    camera = scene.train[0].camera
    width = settings["width"]
    height = round(width * camera.height / camera.width)
    frames = repeat_frames(scene.train, settings["frames"] or len(scene.train))
    shown = [frame.index for frame in frames]
    scale = np.array([width / camera.width, height / camera.height])
    resized = [resize_frame(frame, width, height) for frame in frames]
    scene = replace(
        scene,
        train=[replace(frame, index=t) for t, frame in enumerate(resized)],
        test=[],
        movers=tuple(repeat_mover(mover, shown, scale) for mover in scene.movers),
    )
    moving = round(MOVING_SHARE * settings["gaussians"])
    field = SplatConfig(static=settings["gaussians"] - moving, moving=moving)
    budget = Budget(steps=100 * steps, minutes=None)
    with tempfile.TemporaryDirectory() as out:
        config = replace(PRESETS["splat"], field=field, scene=folder, out=Path(out), budget=budget)
        trainer = Trainer(config, scene, torch.device("cpu"), distributed.Ranks())
        numba.set_num_threads(settings["cores"])

        def step() -> None:
            trainer.step()
            trainer.clock = replace(trainer.clock, step=trainer.clock.step + 1)

        def picture() -> None:
            limit_torch_threads(config.torch_threads)
            frame = scene.train[trainer.clock.step % len(scene.train)]
            render = trainer.field.render(frame.camera, frame.time, scene_flow=False)
            trainer.tonemapper.develop(render.radiance, 0.0)

        step_ms = median_milliseconds(step, steps)
        picture_ms = median_milliseconds(picture, steps)
    return {
        "gaussians": settings["gaussians"],
        "pixels": width * height,
        "frames": len(frames),
        "cores": settings["cores"],
        "step_ms": step_ms,
        "picture_ms": picture_ms,
        "peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
    }


def median_milliseconds(action: Callable[[], None], repeats: int) -> float:
    """Median time of `action` over `repeats` calls, after a warm-up."""
    times = []
    for i in range(WARM_UP_STEPS + repeats):
        start = perf_counter()
        action()
        if i >= WARM_UP_STEPS:
            times.append(perf_counter() - start)
    return round(1e3 * statistics.median(times), 2)


def repeat_frames(frames: list[Frame], count: int) -> list[Frame]:
    """The first `count` frames; a shorter clip continues backwards and forwards again.

    Frames after the clip's end have no flow.
    """
    back_and_forth = [*frames, *reversed(frames)]
    result = []
    for t in range(count):
        frame = back_and_forth[t % len(back_and_forth)]
        neighbors = {offset: t + offset for offset in (1, -1) if 0 <= t + offset < count}
        with_flow = {o for o in neighbors if o in frame.flow} if t < len(frames) else set()
        flow = {offset: frame.flow[offset] for offset in with_flow}
        flow_valid = {offset: frame.flow_valid[offset] for offset in with_flow}
        result.append(
            replace(frame, time=float(t), neighbors=neighbors, flow=flow, flow_valid=flow_valid)
        )
    return result


def resize_frame(frame: Frame, width: int, height: int) -> Frame:
    """The frame and its priors at another size, by nearest neighbors."""
    scale = torch.tensor([width / frame.camera.width, height / frame.camera.height])

    def resize(image: Tensor | None) -> Any:
        if image is None:
            return None
        channels = image[..., None] if image.ndim == 2 else image
        planes = channels.permute(2, 0, 1)[None].float()  # (1, C, H, W)
        resized = interpolate(planes, (height, width), mode="nearest")[0].permute(1, 2, 0)
        return resized.reshape(height, width, *image.shape[2:]).contiguous().to(image.dtype)

    return replace(
        frame,
        camera=frame.camera.resized(width, height),
        image=resize(frame.image),
        moving=resize(frame.moving),
        outline=resize(frame.outline),
        disparity=resize(frame.disparity),
        disparity_confidence=resize(frame.disparity_confidence),
        flow={offset: resize(flow) * scale for offset, flow in frame.flow.items()},
        flow_valid={offset: resize(valid) for offset, valid in frame.flow_valid.items()},
    )


def repeat_mover(mover: Mover, shown: list[int], scale: np.ndarray) -> Mover:
    """The mover in a clip whose frames show those of the indices `shown`, resized."""
    time_of = {int(index): t for t, index in enumerate(mover.frames)}
    frames = [t for t, index in enumerate(shown) if index in time_of]
    times = [time_of[shown[t]] for t in frames]
    return replace(
        mover,
        frames=np.array(frames),
        pixels=mover.pixels[:, times] * scale,
        trust=mover.trust[:, times],
        rotations=mover.rotations[times],
        translations=mover.translations[times],
        known=mover.known[times],
    )


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for every axis: milliseconds of a step and of a picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    axes = list(dict.fromkeys(row["axis"] for row in rows))
    figure, panels = plt.subplots(
        1, len(axes), figsize=(3.4 * len(axes), 3.2), sharey=True, squeeze=False
    )
    for axis, panel in zip(axes, panels[0], strict=True):
        of_axis = [row for row in rows if row["axis"] == axis]
        values = [row[axis] for row in of_axis]
        for key, label in (("step_ms", "a training step"), ("picture_ms", "a picture")):
            panel.plot(values, [row[key] for row in of_axis], marker="o", label=label)
        panel.set(xlabel=axis, xscale="log", yscale="log")
        panel.set_xticks(values, [short_number(value) for value in values], fontsize=8)
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    ticks = [2, 5, 10, 20, 50, 100, 200]
    panels[0][0].set_ylabel("milliseconds")
    panels[0][0].set_yticks(ticks, [str(tick) for tick in ticks])
    panels[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def short_number(value: int) -> str:
    """A number for a tick: thousands as k."""
    return f"{round(value / 1000)}k" if value >= 1000 else str(value)


if __name__ == "__main__":
    main()
