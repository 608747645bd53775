"""Self-contained HTML pages.

Files are embedded as data URIs, plots as inline SVG, and the Jinja templates here are
those that all pages share. A page is one file that opens offline and reads on light and
dark, at desktop and phone width. Templates escape every value (autoescape); SVG is the
only markup that Python makes, and matplotlib escapes its text.
"""

from __future__ import annotations

import base64
import functools
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup

GRAY = "#808891"  # reads on light and dark
CHANNEL_COLORS = {"red": "#d1495b", "green": "#3c9d6b", "blue": "#3d7fc4"}
FIGURE_WIDTH = 640  # pixels: wider pictures are shrunk
JPEG_QUALITY = 92


@dataclass(frozen=True)
class Figure:
    """A picture or video with its caption."""

    source: str  # data URI
    caption: str


@dataclass(frozen=True)
class Table:
    """A table of plain texts. All columns but the first `num_labels` are numbers."""

    header: Sequence[str]  # empty texts: no header
    rows: Sequence[Sequence[str]]
    num_labels: int = 1
    bold: frozenset[tuple[int, int]] = frozenset()  # (row, column) of the best numbers


@functools.cache
def environment() -> jinja2.Environment:
    """The templates of this package, named by their paths in it."""
    package = Path(__file__).parents[1]
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(package),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def render_page(template: str, **values: Any) -> str:
    """The page of a template, such as `bench/gallery.html`."""
    return environment().get_template(template).render(values)


def figure(rgb: np.ndarray, caption: str, width: int = FIGURE_WIDTH) -> Figure:
    """An embedded JPEG of rgb (H, W, 3) in [0, 1], at most `width` pixels wide."""
    if rgb.shape[1] > width:
        height = round(rgb.shape[0] * width / rgb.shape[1])
        rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    bgr = np.rint(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    ok, buffer = cv2.imencode(".jpg", np.ascontiguousarray(bgr), options)
    assert ok
    return Figure(data_uri("image/jpeg", buffer.tobytes()), caption)


def video(path: Path, caption: str) -> Figure:
    """An embedded MP4."""
    return Figure(data_uri("video/mp4", path.read_bytes()), caption)


def data_uri(kind: str, data: bytes) -> str:
    """A file of a MIME `kind` as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def number(value: float | None, digits: int = 2, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}{unit}"


def plural(count: int, noun: str) -> str:
    """A count with its noun: "1 scene", "2 scenes"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def plot(width: float, height: float) -> tuple[Any, Any]:
    """An empty matplotlib figure of `width` x `height` inches, and its axes.

    Transparent, in grays that read on light and dark.
    """
    from matplotlib.figure import Figure as Drawing

    drawing = Drawing(figsize=(width, height), layout="constrained")
    drawing.patch.set_alpha(0)
    axes = drawing.add_subplot()
    axes.patch.set_alpha(0)
    axes.tick_params(which="both", colors=GRAY, labelsize=8)
    for spine in axes.spines.values():
        spine.set_color(GRAY)
    axes.grid(alpha=0.25, linewidth=0.5, color=GRAY)
    return drawing, axes


def legend(axes: Any, **place: Any) -> None:
    """The legend, in the same gray."""
    axes.legend(fontsize=8, frameon=False, labelcolor=GRAY, **place)


def svg(drawing: Any) -> Markup:
    """A drawing as inline SVG that knows its own width, for the style sheet."""
    import matplotlib

    for axes in drawing.axes:
        for item in (axes.xaxis.label, axes.yaxis.label, axes.title):
            item.set(color=GRAY, fontsize=9)
    text = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "report"}):
        drawing.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    _, opening, rest = text.getvalue().partition("<svg ")
    return Markup(f'{opening}style="--width: {drawing.get_figwidth():g}in" {rest}')
