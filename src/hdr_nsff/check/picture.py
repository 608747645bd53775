"""The picture of a check: frames with what they clip, brightness, and the findings."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hdr_nsff.check.facts import ClipFacts
from hdr_nsff.check.findings import Finding
from hdr_nsff.core.io import atomic

COLORS = {"good": "#1a7f37", "note": "#444444", "warning": "#b35900", "problem": "#c21d1d"}
MARKS = {"good": "+", "note": "·", "warning": "!", "problem": "x"}
LINE = 116  # characters of a finding
MAX_PICTURES = 6
WHITE, BLACK = (1.0, 0.1, 0.1), (0.15, 0.3, 1.0)  # colors of clipped pixels
HIGH, LOW = 0.97, 0.012  # recorded values that are clipped


def draw(
    path: Path,
    facts: ClipFacts,
    video: np.ndarray,
    brackets: Sequence[int],
    works: Mapping[str, str],
    findings: Sequence[Finding],
) -> None:
    """Write the picture of frames `video` (T, H, W, 3) with their `brackets` (T,)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = text_lines(works, findings)
    shown = chosen_frames(brackets)
    text_height = 0.19 * len(lines) + 0.4  # inches
    figure = Figure(figsize=(12, 5.0 + text_height), dpi=100)
    FigureCanvasAgg(figure)
    height = 5.0 + text_height
    file = facts.file
    first, end = facts.measured
    title = f"{file.name}: {file.width} x {file.height}, frames {first} to {end - 1}"
    figure.text(0.02, 1 - 0.3 / height, title, fontsize=13, weight="bold")
    note = "red: saturated, blue: black"
    figure.text(0.98, 1 - 0.3 / height, note, fontsize=9, ha="right", color="#444444")
    for i, t in enumerate(shown):
        place = (0.02 + 0.96 * i / len(shown), 1 - 2.9 / height)
        axes = figure.add_axes((*place, 0.94 / len(shown), 2.3 / height))
        axes.imshow(mark_clipped(video[t]))
        axes.set_axis_off()
        axes.set_title(f"frame {first + t}, exposure {brackets[t]}", fontsize=9)
    axes = figure.add_axes((0.06, (text_height + 0.35) / height, 0.92, 1.25 / height))
    brightness = np.median(video.mean(-1).reshape(len(video), -1), 1)
    axes.plot(range(first, end), brightness, color="#bbbbbb", linewidth=0.8)
    axes.scatter(range(first, end), brightness, c=list(brackets), cmap="viridis", s=14, zorder=2)
    axes.set_ylabel("median", fontsize=8)
    axes.set_xlabel("frame; colors: exposures", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.set_xlim(first - 1, end)
    for i, (text, color, weight) in enumerate(lines):
        y = (text_height - 0.35 - 0.19 * i) / height
        figure.text(0.02, y, text, fontsize=9.5, color=color, weight=weight, family="monospace")
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="white")


def chosen_frames(brackets: Sequence[int]) -> list[int]:
    """Frames to show: the first of each exposure, or three of the clip."""
    firsts = [list(brackets).index(b) for b in sorted(set(brackets))]
    if len(firsts) > 1:
        count = min(len(firsts), MAX_PICTURES)
        return [firsts[round(k)] for k in np.linspace(0, len(firsts) - 1, count)]
    return sorted({0, len(brackets) // 2, len(brackets) - 1})


def mark_clipped(rgb: np.ndarray) -> np.ndarray:
    """A frame (H, W, 3) with saturated pixels red and black ones blue."""
    shown = rgb.copy()
    shown[(rgb > HIGH).any(-1)] = WHITE
    shown[(rgb < LOW).all(-1)] = BLACK
    return shown


def text_lines(works: Mapping[str, str], findings: Sequence[Finding]) -> list[tuple[str, str, str]]:
    """Text, color and weight of every line."""
    lines = [(f"{name}: {answer}", "#000000", "bold") for name, answer in works.items()]
    for finding in findings:
        text = finding.text + (f" -> {finding.advice}" if finding.advice else "")
        wrapped = textwrap.wrap(text, LINE - 14)
        head = f"{MARKS[finding.level]} {finding.subject:<11} "
        for i, part in enumerate(wrapped):
            start = head if i == 0 else " " * len(head)
            lines.append((start + part, COLORS[finding.level], "normal"))
    return lines
