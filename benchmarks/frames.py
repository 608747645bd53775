"""Frames per second of a field of Gaussians, as a viewer needs them.

    python benchmarks/frames.py --counts 5000 20000 80000 --plot docs/images/frames.png
    python benchmarks/frames.py --run RUN

Each frame moves the Gaussians to its time, draws radiance, depth and motion share, and
applies the tone mapper. It is measured with and without the scene flow to both sides;
every frame has another time. Without a run, the Gaussians lie on a wall behind a row of
movers, as many and as large as the pixels ask for in a trained field. With a run, its
Gaussians are drawn from a camera of its scene, at the given sizes.
"""

from __future__ import annotations

import argparse
import platform
import statistics
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numba
import torch
from record import Record, make_parser, restart_prepared
from torch import Tensor

from hdr_nsff.core.process import limit_torch_threads
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.build import build_tone_mapper
from hdr_nsff.training.run_folder import Run

# The generated field: values hand-chosen, near those of trained scenes.
SEED = 0
MOVING_SHARE = 0.2  # of all Gaussians
TRAINING_TIMES = 36
WALL_DEPTH, MOVER_DEPTH = 3.0, 2.0  # scene units
NEAR, FAR = 1.0, 6.0
WARM_UP_FRAMES = 5
DIFFERENT_TIMES = 97  # a prime: stepping by 7 visits all of them


def main() -> None:
    parser = make_parser(__doc__, "frames")
    parser.add_argument("--run", type=Path, help="a run of `splat`; default: generated fields")
    parser.add_argument(
        "--sizes", nargs="+", default=["240x136", "720x480"], metavar="WxH", help="of the pictures"
    )
    parser.add_argument(
        "--counts",
        nargs="+",
        type=int,
        default=[5_000, 20_000, 80_000],
        help="Gaussians of the generated fields",
    )
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2], help="of the kernels")
    parser.add_argument("--frames", type=int, default=60, help="frames that are timed")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N")
    parser.add_argument(
        "--plot", type=Path, metavar="FILE", help="draw milliseconds against Gaussians to this PNG"
    )
    args = parser.parse_args()
    restart_prepared()
    record = Record("frames", args, seed=None if args.run else SEED)
    for size in args.sizes:
        width, height = map(int, size.split("x"))
        for field, tonemapper, camera in subjects(args, width, height):
            measure_field(field, tonemapper, camera, args, record)
    record.save()
    if args.plot:
        plot(record.results, args.plot)


def subjects(
    args: argparse.Namespace, width: int, height: int
) -> list[tuple[Splat, ToneMapper, Camera]]:
    """Fields with their tone mapper and a camera of that size."""
    if args.run:
        run = Run.open(args.run, args.device)
        assert isinstance(run.field, Splat), "only fields of Gaussians are measured here"
        return [(run.field, run.tonemapper, run.scene.train[0].camera.resized(width, height))]
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    camera = Camera(K, torch.eye(3, 4), width, height)
    recordings = Recordings((0,), (0,), (0.0,), 0, 1)
    fields = [wall_and_movers(count, camera) for count in args.counts]
    return [(field, build_tone_mapper(ToneMapConfig(), recordings), camera) for field in fields]


@torch.no_grad()
def wall_and_movers(count: int, camera: Camera) -> Splat:
    """Static Gaussians on a wall, moving ones before it.

    They are spread over the picture, and as wide as they are apart.
    """
    moving = round(MOVING_SHARE * count)
    config = SplatConfig(static=count - moving, moving=moving)
    pixels = camera.width * camera.height
    field = Splat(config, torch.arange(TRAINING_TIMES), NEAR, FAR, pixels)
    generator = torch.Generator().manual_seed(SEED)
    shape = torch.tensor([1.0, camera.height / camera.width, 0.1])  # of the wall, in depths
    for gaussians, depth, share in (
        (field.static, WALL_DEPTH, 1.0),
        (field.moving, MOVER_DEPTH, MOVING_SHARE),
    ):
        spread = torch.rand(len(gaussians), 3, generator=generator) - 0.5
        extent = depth * shape * torch.tensor([share**0.5, share**0.5, 1])
        gaussians.means.copy_(spread * extent + torch.tensor([0, 0, depth]))
        spacing = (extent[0] * extent[1] / len(gaussians)).sqrt()
        variation = 0.3 * torch.randn(len(gaussians), 3, generator=generator)
        gaussians.log_scales.copy_(spacing.log() + variation - 0.5)
        gaussians.opacity_logits.fill_(1.0)
    return field


def measure_field(
    field: Splat, tonemapper: ToneMapper, camera: Camera, args: argparse.Namespace, record: Record
) -> None:
    """All thread counts, with and without scene flow."""
    device = pick_device(args.device)
    field.to(device)
    tonemapper.to(device)
    on_device = replace(camera, K=camera.K.to(device), c2w=camera.c2w.to(device))
    for threads in args.threads:
        numba.set_num_threads(threads)
        for scene_flow in (False, True):
            conditions: dict[str, Any] = {
                "gaussians": len(field.static) + len(field.moving),
                "width": camera.width,
                "height": camera.height,
                "threads": threads,
                "scene_flow": scene_flow,
                "device": device_name(device),
            }
            times = measure_times(field, tonemapper, on_device, args.frames, scene_flow)
            record.add(conditions | times)


@torch.no_grad()
def measure_times(
    field: Splat, tonemapper: ToneMapper, camera: Camera, frames: int, scene_flow: bool
) -> dict[str, float]:
    """Median milliseconds of a frame, and frames per second."""
    first, last = float(field.times[0]), float(field.times[-1])

    def draw(i: int) -> Tensor:
        limit_torch_threads(1)
        time = first + (i % DIFFERENT_TIMES) / DIFFERENT_TIMES * (last - first)
        render = field.render(camera, time, scene_flow=scene_flow)
        rgb = tonemapper(render.radiance, 0, 0, None, leaky=False)
        if rgb.is_cuda:
            torch.cuda.synchronize()
        return rgb

    for i in range(WARM_UP_FRAMES):
        draw(i)
    times = []
    for i in range(frames):
        start = perf_counter()
        draw(7 * i)
        times.append(perf_counter() - start)
    median = statistics.median(times)
    return {"ms": round(1e3 * median, 2), "frames_per_second": round(1 / median, 1)}


def device_name(device: torch.device) -> str:
    """The GPU's name, or the processor's architecture."""
    return torch.cuda.get_device_name() if device.type == "cuda" else platform.machine()


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Milliseconds against Gaussians without scene flow.

    There is a line for every size and number of threads.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    lines: dict[tuple[int, int, int], list[dict[str, Any]]] = {}
    for row in rows:
        if not row["scene_flow"]:
            lines.setdefault((row["width"], row["height"], row["threads"]), []).append(row)
    figure, axes = plt.subplots(figsize=(6, 4))
    for (width, height, threads), of_line in sorted(lines.items()):
        axes.plot(
            [row["gaussians"] for row in of_line],
            [row["ms"] for row in of_line],
            marker="o",
            label=f"{width}x{height}, {threads} thread{'s' if threads > 1 else ''}",
        )
    axes.set(xlabel="Gaussians", ylabel="milliseconds a frame", xscale="log", yscale="log")
    counts = sorted({row["gaussians"] for row in rows})
    ticks = [5, 10, 20, 50, 100]
    axes.set_xticks(counts, [f"{count:,}" for count in counts])
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
