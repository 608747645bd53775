"""Plots of a report: response curves, gains, radiance, and training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup
from scipy.ndimage import uniform_filter1d

from hdr_nsff.core import notes
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.page import CHANNEL_COLORS, GRAY, legend, plot, svg
from hdr_nsff.training.run_folder import Run

MAX_CAMERAS = 9  # whose responses are plotted
CHANNEL_OFFSET = 0.2  # frames between the points of the three channels of one gain
MAX_EXRS = 12  # of a sequence that enter the histogram
MIN_RADIANCE = 1e-7  # black pixels count as this on the log axis
NUM_BINS = 119
LOW_PERCENTILE = 0.05  # the left end of the histogram
RANGE_PERCENTILES = (0.1, 99.9)  # of the pixels, between which stops are counted
DARKEST_RECORDED = 3 / 255  # recorded value below which radiance is lost in the noise
SMOOTHING_SHARE = 40  # the moving average is this part of a log's length
PSNR_COLOR = CHANNEL_COLORS["blue"]
NUM_COLORS = 10  # of matplotlib's cycle; further lines are dashed


@dataclass(frozen=True)
class Plots:
    """Drawings and the sentence below them."""

    plots: list[Markup]
    note: str


def plot_responses(run: Run, metrics: dict[str, Any] | None) -> list[Markup]:
    """The response curve of every camera, dotted the true one where it is known."""
    camera_metrics = (metrics or {}).get("camera") or {}
    true = camera_metrics.get("true_response")
    drawings = []
    for camera in range(min(run.tonemapper.num_cameras, MAX_CAMERAS)):
        drawing, axes = plot(4.2, 3.2)
        x, y = (values.cpu().numpy() for values in run.tonemapper.curve(camera))
        axes.plot(x, x ** (1 / 2.2), "--", color=GRAY, linewidth=1, label="gamma 2.2")
        for channel, (name, color) in enumerate(CHANNEL_COLORS.items()):
            axes.plot(x, y[channel], color=color, linewidth=1.4, label=name)
            if true is not None:
                axes.plot(true["x"], true["y"][channel], ":", color=color, linewidth=1.6)
        if true is not None:
            axes.plot([], [], ":", color=GRAY, label="true")
        axes.set(
            xlabel="exposure (1 saturates)",
            ylabel="recorded value",
            title=f"response of camera {camera}",
        )
        legend(axes)
        drawings.append(svg(drawing))
    return drawings


def plot_gains(run: Run) -> Markup:
    """The gain of every frame and channel, with the given exposures as lines."""
    drawing, axes = plot(5.6, 3.2)
    gains = run.tonemapper.gains().cpu().numpy()  # (T, 3) EV
    times = np.array([frame.time for frame in run.scene.train])
    for channel, color in enumerate(CHANNEL_COLORS.values()):
        shifted = times + CHANNEL_OFFSET * (channel - 1)
        axes.plot(shifted, gains[:, channel], ".", color=color, markersize=4)
    for ev in run.scene.manifest.bracket_ev:
        if ev is not None:
            axes.axhline(ev, color=GRAY, linewidth=0.7, linestyle="--")
    given = "dashed: given" if run.scene.manifest.exposure_given else "none given"
    axes.set(
        xlabel="time (frames)",
        ylabel="gain (EV)",
        title=f"gain of every frame and channel ({given})",
    )
    return svg(drawing)


def plot_radiance(run: Run, renders: Path) -> Plots | None:
    """Histogram of rendered radiance, with the range that each exposure records.

    None without an EXR sequence in `renders`.
    """
    files = sorted((renders / "training").glob("*.exr"))
    if not files:
        return None
    chosen = files[:: max(1, len(files) // MAX_EXRS)]
    pixels = np.concatenate([read_exr(file)["RGB"].reshape(-1, 3) for file in chosen])
    log = np.log10(pixels.clip(MIN_RADIANCE))
    low, high = np.percentile(log, [LOW_PERCENTILE, 100]).tolist()
    edges = 10 ** np.linspace(low, high, NUM_BINS + 1)
    drawing, axes = plot(9.6, 3.2)
    for channel, (name, color) in enumerate(CHANNEL_COLORS.items()):
        values = 10 ** log[:, channel]
        axes.hist(values, bins=edges, histtype="step", color=color, linewidth=1.2, label=name)
    draw_recorded_ranges(axes, run, 10**low)
    axes.set(
        xscale="log",
        xlabel="linear radiance (1 saturates at the reference exposure)",
        ylabel="pixels",
    )
    legend(axes)
    dark, bright = np.percentile(pixels.max(-1), RANGE_PERCENTILES).tolist()
    stops = math.log2(max(bright, MIN_RADIANCE) / max(dark, MIN_RADIANCE))
    note = (
        f"{len(chosen)} views of the training path; 0.1 to 99.9 percentile: {stops:.1f} stops; "
        f"brightest pixel {pixels.max():.3g}."
    )
    return Plots([svg(drawing)], note)


def draw_recorded_ranges(axes: Any, run: Run, left: float) -> None:
    """A bar per exposure above the histogram: the radiance that it records.

    `left` is the left end of the histogram.
    """
    dark = darkest_exposure(run)
    exposures = sorted(run.tonemapper.exposures().tolist())
    axes.set_xlim(left=min(left, dark / 2 ** exposures[-1]) / 20)  # room for the words
    top = axes.get_ylim()[1]
    for i, ev in enumerate(exposures):
        start, end = dark / 2**ev, 1 / 2**ev
        height = top * (1.04 + 0.06 * i)
        axes.plot([start, end], [height] * 2, color=GRAY, linewidth=3, solid_capstyle="butt")
        words = f"EV {ev:+.1f} records  "
        axes.text(start, height, words, fontsize=7, va="center", ha="right", color=GRAY)


def darkest_exposure(run: Run) -> float:
    """The exposure at which the first camera records `DARKEST_RECORDED`."""
    x, y = (values.cpu() for values in run.tonemapper.curve(0))
    recorded = y.mean(0).contiguous()
    index = int(torch.searchsorted(recorded, torch.tensor(DARKEST_RECORDED)))
    return float(x[min(max(index, 1), len(x) - 1)])


def plot_training(log: Sequence[notes.LogLine], steps: int) -> Plots | None:
    """PSNR on training pixels, and every loss term, over time; None without a log.

    `steps` of the run: its last ones may have no line in the log.
    """
    if len(log) < 2:
        return None
    note = f"{steps} steps, {log[-1].rays_per_second:,.0f} rays per second."
    return Plots([plot_psnr(log), plot_losses(log)], note)


def plot_psnr(log: Sequence[notes.LogLine]) -> Markup:
    """PSNR of training batches, and its moving average."""
    minutes = [line.seconds / 60 for line in log]
    psnr = [line.psnr for line in log]
    drawing, axes = plot(4.6, 3.2)
    axes.plot(minutes, psnr, color=PSNR_COLOR, linewidth=0.5, alpha=0.5)
    axes.plot(minutes, moving_average(psnr), color=PSNR_COLOR, linewidth=1.6)
    axes.set(xlabel="minutes", ylabel="dB", title="PSNR of training batches")
    return svg(drawing)


def plot_losses(log: Sequence[notes.LogLine]) -> Markup:
    """The moving average of every loss term that is above 0 somewhere."""
    drawing, axes = plot(6.4, 3.2)
    names = sorted({name for line in log for name in line.losses})
    for i, name in enumerate(names):
        minutes, values = [], []
        for line in log:
            value = line.losses.get(name, 0)
            if value > 0:
                minutes.append(line.seconds / 60)
                values.append(value)
        if values:
            axes.plot(
                minutes,
                moving_average(values),
                linewidth=1.2,
                label=name.replace("_", " "),
                color=f"C{i % NUM_COLORS}",
                linestyle="-" if i < NUM_COLORS else "--",
            )
    axes.set(xlabel="minutes", yscale="log", title="loss terms, unweighted")
    legend(axes, loc="center left", bbox_to_anchor=(1, 0.5))
    return svg(drawing)


def moving_average(values: Sequence[float]) -> np.ndarray:
    """Values (N,) averaged over a fortieth of them, as long as the input."""
    width = max(1, len(values) // SMOOTHING_SHARE)
    return uniform_filter1d(np.asarray(values, dtype=float), width, mode="nearest")
