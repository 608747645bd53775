"""Frames per second of a field of Gaussians: they move to the frame's time and are
drawn as radiance, depth and motion share, tone-mapped to what a camera records; and the
same with the scene flow to either side.

    python benchmarks/frames.py [--run RUN] [--sizes 240x136,720x480] [--counts
    5000,20000,80000] [--threads 1,2] [--plot PLOT.png]

Without a run, the Gaussians lie on a wall behind a row of movers as a trained field has
them: as many and as large as pixels ask for. With one, its own Gaussians are drawn from
a camera of its scene, at the sizes given. Prints one JSON line per measurement: the
median of repeated frames, each at another time. `--plot` draws milliseconds against
each.
"""

import argparse
import json
import platform
import statistics
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
import torch
from torch import Tensor

from hdr_nsff.core.process import limit_torch_threads, prepare_process
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.fields.splat.splat import Splat, SplatConfig
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.build import build_tone_mapper
from hdr_nsff.training.run_folder import Run

MOVING = 0.2  # of all Gaussians
TIMES = 36  # training times of the made-up field


def main() -> None:
    prepare_process()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run", type=Path)
    parser.add_argument("--sizes", default="240x136,720x480")
    parser.add_argument("--counts", default="5000,20000,80000", help="Gaussians, without a run")
    parser.add_argument("--threads", default="1,2", help="of the kernels")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    device, rows = pick_device(args.device), []
    for size in args.sizes.split(","):
        width, height = map(int, size.split("x"))
        for field, tonemapper, camera in subjects(args, width, height):
            field.to(device)
            tonemapper.to(device)
            for threads in map(int, args.threads.split(",")):
                numba.set_num_threads(threads)
                where = replace(camera, K=camera.K.to(device), c2w=camera.c2w.to(device))
                for flow in (False, True):
                    about = {
                        "gaussians": len(field.static) + len(field.moving),
                        "width": width,
                        "height": height,
                    }
                    about |= {"threads": threads, "scene_flow": flow}
                    rows.append(about | measure(field, tonemapper, where, args.frames, flow))
                    print(json.dumps(rows[-1] | {"device": name_of(device)}), flush=True)
    if args.plot:
        plot(rows, args.plot)


def name_of(device: torch.device) -> str:
    return torch.cuda.get_device_name() if device.type == "cuda" else platform.machine()


def subjects(
    args: argparse.Namespace, width: int, height: int
) -> list[tuple[Any, ToneMapper, Camera]]:
    """Fields with their tone mapper and a camera of that size."""
    if args.run:
        run = Run.open(args.run, args.device)
        assert isinstance(run.field, Splat), "only fields of Gaussians are measured here"
        return [(run.field, run.tonemapper, run.scene.train[0].camera.resized(width, height))]
    camera = Camera(
        torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]),
        torch.eye(3, 4),
        width,
        height,
    )
    return [
        (
            made_up(int(count), camera),
            build_tone_mapper(ToneMapConfig(), Recordings((0,), (0,), (0.0,), 0, 1)),
            camera,
        )
        for count in args.counts.split(",")
    ]


@torch.no_grad()
def made_up(count: int, camera: Camera) -> Splat:
    """Static Gaussians on a wall at 3, moving ones around 2, spread over the picture,
    as wide as they are apart.
    """
    moving = round(MOVING * count)
    field = Splat(
        SplatConfig(static=count - moving, moving=moving),
        torch.arange(TIMES),
        1.0,
        6.0,
        camera.width * camera.height,
    )
    generator = torch.Generator().manual_seed(0)
    for gaussians, distance, share in ((field.static, 3.0, 1.0), (field.moving, 2.0, MOVING)):
        spread = torch.rand(len(gaussians), 3, generator=generator) - 0.5
        extent = (
            distance
            * torch.tensor([1.0, camera.height / camera.width, 0.1])
            * torch.tensor([share**0.5, share**0.5, 1])
        )
        gaussians.means.copy_(spread * extent + torch.tensor([0, 0, distance]))
        apart = (extent[0] * extent[1] / len(gaussians)).sqrt()
        gaussians.log_scales.copy_(
            apart.log() + 0.3 * torch.randn(len(gaussians), 3, generator=generator) - 0.5
        )
        gaussians.opacity_logits.fill_(1.0)
    return field


@torch.no_grad()
def measure(
    field: Splat, tonemapper: ToneMapper, camera: Camera, frames: int, flow: bool
) -> dict[str, float]:
    """Median milliseconds of a frame, and how many a second that are."""

    def frame(i: int) -> Tensor:
        limit_torch_threads(1)
        time = float(field.times[0]) + (i % 97) / 97 * float(field.times[-1] - field.times[0])
        render = field.render(camera, time, scene_flow=flow)
        rgb = tonemapper(render.radiance, 0, 0, None, leaky=False)
        if rgb.is_cuda:
            torch.cuda.synchronize()
        return rgb

    for i in range(5):
        frame(i)
    spent = []
    for i in range(frames):
        start = perf_counter()
        frame(7 * i)
        spent.append(perf_counter() - start)
    middle = statistics.median(spent)
    return {"ms": round(1e3 * middle, 2), "frames_per_second": round(1 / middle, 1)}


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Milliseconds against Gaussians without scene flow, a line for every size and
    number of threads.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [r for r in rows if not r["scene_flow"]]
    figure, axes = plt.subplots(figsize=(6, 4))
    for width, height, threads in sorted({(r["width"], r["height"], r["threads"]) for r in rows}):
        some = [
            r for r in rows if (r["width"], r["height"], r["threads"]) == (width, height, threads)
        ]
        axes.plot(
            [r["gaussians"] for r in some],
            [r["ms"] for r in some],
            marker="o",
            label=f"{width}x{height}, {threads} {'thread' if threads == 1 else 'threads'}",
        )
    axes.set(xlabel="Gaussians", ylabel="milliseconds a frame", xscale="log", yscale="log")
    counts = sorted({r["gaussians"] for r in rows})
    axes.set_xticks(counts, [f"{c:,}" for c in counts])
    axes.set_yticks([5, 10, 20, 50, 100], ["5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
