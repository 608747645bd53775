"""What a step of training and a picture cost, against Gaussians, pixels, frames of the
clip and processor cores.

    python benchmarks/cost.py SCENE [--plot PLOT.png] [--steps 60] [--only
    gaussians,pixels,frames,cores]

SCENE is a prepared clip; its frames are resized, left out or played again backwards in
memory. One thing at a time varies, the others stay at 240x136 pixels, 20,000 Gaussians,
all frames and all cores. Prints one JSON line per measurement: the median milliseconds
of a step with all its losses and of a picture (radiance, depth, motion share,
tone-mapped), and the peak memory of that measurement's own process.
"""

import argparse
import json
import multiprocessing
import os
import resource
import statistics
import tempfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from hdr_nsff.core import distributed
from hdr_nsff.core.process import limit_torch_threads, prepare_process
from hdr_nsff.fields.splat.splat import SplatConfig
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import Trainer

MOVING = 0.2  # of all Gaussians
WARM_UP = 20  # steps
CORES = os.cpu_count() or 1
USUAL = {"gaussians": 20_000, "width": 240, "frames": 0, "cores": CORES}  # 0: all
AXES: dict[str, tuple[str, list[int]]] = {
    "gaussians": ("gaussians", [5_000, 10_000, 20_000, 40_000, 80_000]),
    "pixels": ("width", [120, 240, 480, 720, 960]),
    "frames": ("frames", [9, 18, 36, 72]),
    "cores": ("cores", sorted({1, 2, 4, 8, 16, CORES})),
}


def main() -> None:
    prepare_process()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--only", default=",".join(AXES), help="the axes to measure")
    args = parser.parse_args()
    rows = []
    for axis in args.only.split(","):
        setting, values = AXES[axis]
        for value in values:
            if setting == "cores" and value > CORES:
                continue
            with multiprocessing.get_context("spawn").Pool(
                1
            ) as process:  # a process of its own, for its peak memory
                rows.append(
                    {"axis": axis}
                    | process.apply(measured, (args.scene, USUAL | {setting: value}, args.steps))
                )
            print(json.dumps(rows[-1]), flush=True)
    if args.plot:
        plot(rows, args.plot)


def measured(folder: Path, setting: dict[str, int], steps: int) -> dict[str, Any]:
    """Median milliseconds of a step and of a picture, and peak memory."""
    scene = Scene.open(folder)
    camera = scene.train[0].camera
    width, height = setting["width"], round(setting["width"] * camera.height / camera.width)
    frames = at_length(scene.train, setting["frames"] or len(scene.train))
    scene = replace(scene, train=[resized(f, width, height) for f in frames], test=[])
    moving = round(MOVING * setting["gaussians"])
    with tempfile.TemporaryDirectory() as out:
        field = SplatConfig(static=setting["gaussians"] - moving, moving=moving)
        config = replace(
            PRESETS["splat"],
            field=field,
            scene=folder,
            out=Path(out),
            budget=Budget(steps=100 * steps, minutes=None),
        )
        trainer = Trainer(config, scene, torch.device("cpu"), distributed.Ranks())
        numba.set_num_threads(setting["cores"])

        def step() -> None:
            trainer.step()
            trainer.clock = replace(trainer.clock, step=trainer.clock.step + 1)

        def picture() -> None:
            limit_torch_threads(config.torch_threads)
            frame = scene.train[trainer.clock.step % len(scene.train)]
            render = trainer.field.render(frame.camera, frame.time, scene_flow=False)
            trainer.tonemapper.develop(render.radiance, 0.0)

        spent = {"step_ms": timed(step, steps), "picture_ms": timed(picture, steps)}
    about = {
        "gaussians": setting["gaussians"],
        "pixels": width * height,
        "frames": len(frames),
        "cores": setting["cores"],
    }
    return (
        about
        | spent
        | {"peak_memory_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)}
    )


def timed(do: Any, times: int) -> float:
    """Median milliseconds."""
    spent = []
    for i in range(WARM_UP + times):
        start = perf_counter()
        do()
        if i >= WARM_UP:
            spent.append(perf_counter() - start)
    return round(1e3 * statistics.median(spent), 2)


def at_length(frames: list[Frame], count: int) -> list[Frame]:
    """The first `count` frames; where there are too few, the clip goes on backwards and
    forwards again, without flow.
    """
    there_and_back = [*frames, *reversed(frames)]
    longer = []
    for t in range(count):
        f = there_and_back[t % len(there_and_back)]
        near = {o: t + o for o in (1, -1) if 0 <= t + o < count}
        told = {o for o in near if o in f.flow} if t < len(frames) else set()
        flow, valid = {o: f.flow[o] for o in told}, {o: f.flow_valid[o] for o in told}
        longer.append(replace(f, time=float(t), neighbors=near, flow=flow, flow_valid=valid))
    return longer


def resized(frame: Frame, width: int, height: int) -> Frame:
    """The frame and its priors with another number of pixels."""
    scale = torch.tensor([width / frame.camera.width, height / frame.camera.height])

    def nearest(image: Tensor | None) -> Any:
        if image is None:
            return None
        layers = (
            image[None, None].float() if image.ndim == 2 else image.permute(2, 0, 1)[None].float()
        )
        other = interpolate(layers, (height, width), mode="nearest")[0]
        return (other[0] if image.ndim == 2 else other.permute(1, 2, 0).contiguous()).to(
            image.dtype
        )

    return replace(
        frame,
        camera=frame.camera.resized(width, height),
        image=nearest(frame.image),
        moving=nearest(frame.moving),
        outline=nearest(frame.outline),
        disparity=nearest(frame.disparity),
        disparity_confidence=nearest(frame.disparity_confidence),
        flow={o: nearest(f) * scale for o, f in frame.flow.items()},
        flow_valid={o: nearest(v) for o, v in frame.flow_valid.items()},
    )


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for every axis: milliseconds of a step and of a picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    axes_measured = list(dict.fromkeys(r["axis"] for r in rows))
    figure, panels = plt.subplots(
        1, len(axes_measured), figsize=(3.4 * len(axes_measured), 3.2), sharey=True, squeeze=False
    )
    for axis, panel in zip(axes_measured, panels[0], strict=True):
        some = [r for r in rows if r["axis"] == axis]
        for what, label in (("step_ms", "a training step"), ("picture_ms", "a picture")):
            panel.plot([r[axis] for r in some], [r[what] for r in some], marker="o", label=label)
        values = [r[axis] for r in some]
        panel.set(xlabel=axis, xscale="log", yscale="log")
        panel.set_xticks(
            values, [f"{round(v / 1000)}k" if v >= 1000 else str(v) for v in values], fontsize=8
        )
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    panels[0][0].set_ylabel("milliseconds")
    panels[0][0].set_yticks(
        [2, 5, 10, 20, 50, 100, 200], ["2", "5", "10", "20", "50", "100", "200"]
    )
    panels[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
