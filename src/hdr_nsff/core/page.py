"""Pieces of one self-contained HTML page, readable on light and dark: the frame,
tables, embedded pictures and videos, plots.
"""

from __future__ import annotations

import base64
import io as memory
from collections.abc import Collection, Sequence
from html import escape
from typing import Any

import cv2
import numpy as np

GRAY = "#808891"  # reads on light and dark
COLORS = ("#d1495b", "#3c9d6b", "#3d7fc4")  # red, green, blue channel


def document(title: str, facts: str, body: str) -> str:
    """The whole document."""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)} – HDR-NSFF report</title><style>{STYLE}</style></head>
<body><header><h1>{escape(title)}</h1><p class="facts">{escape(facts)}</p></header>
<main>{body}</main></body></html>
"""


STYLE = """
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#5b6570;--line:#d8dde3;--card:#f6f7f9;--page:#fff;--mark:#2f6fb0}
@media(prefers-color-scheme:dark){:root{--ink:#e6e9ed;--soft:#98a2ad;--line:#333a42;--card:#1d2126;--page:#14171a;--mark:#7fb2e5}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
header,main{max-width:1180px;margin:0 auto;padding:0 24px}
header{padding-top:36px}h1{margin:0;font-size:26px}h2{font-size:18px;margin:40px 0 12px;padding-bottom:6px;border-bottom:1px solid var(--line)}
h3{font-size:14px;margin:18px 0 6px;color:var(--soft);font-weight:600}
.facts,.note,figcaption,td.note{color:var(--soft)}p{margin:8px 0}
.tiles{display:flex;flex-wrap:wrap;gap:12px}.tile{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:12px 18px;min-width:150px}
.tile b{display:block;font-size:24px;font-weight:600}.tile span{color:var(--soft);font-size:13px}
.grid{display:grid;gap:10px;margin-bottom:20px;grid-template-columns:repeat(auto-fill,minmax(260px,1fr))}.pairs{display:grid;gap:10px;grid-template-columns:repeat(auto-fill,minmax(520px,1fr))}
figure{margin:0;min-width:0}
figure img,figure video{width:100%;display:block;border-radius:4px;background:#000}
figcaption{font-size:12px;padding:3px 0 6px;overflow-wrap:anywhere}
.plots{display:flex;flex-wrap:wrap;gap:16px}.plots svg{max-width:100%;height:auto}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}td,th{padding:4px 14px 4px 0;border-bottom:1px solid var(--line);text-align:left;vertical-align:top}
th{color:var(--soft);font-weight:600;font-size:13px}td.n,th.n{text-align:right}.wide{overflow-x:auto}
.missing{background:var(--card);border-left:3px solid var(--mark);padding:8px 14px;border-radius:0 6px 6px 0}
code,pre{font:13px/1.45 ui-monospace,Menlo,Consolas,monospace}pre{overflow-x:auto;background:var(--card);padding:12px;border-radius:6px}
summary{cursor:pointer;color:var(--mark)}
"""


def missing(sentence: str) -> str:
    """A visible note that something is not there."""
    return f'<p class="missing">{escape(sentence)}</p>'


def details(summary: str, content: str) -> str:
    """Something to unfold."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: bool = True,
    words: int = 1,
    bold: Collection[tuple[int, int]] = (),
) -> str:
    """An HTML table of plain texts; all columns but the first `words` are numbers if
    `numeric`. `bold`: cells as (row, column).
    """

    def cell(text: str, tag: str, row: int, column: int) -> str:
        inner = f"<b>{escape(text)}</b>" if (row, column) in bold else escape(text)
        return f"<{tag}{' class=n' if numeric and column >= words else ''}>{inner}</{tag}>"

    def line(cells: Sequence[str], tag: str, row: int = -1) -> str:
        return f"<tr>{''.join(cell(c, tag, row, i) for i, c in enumerate(cells))}</tr>"

    top = line(header, "th") if any(header) else ""
    return f'<div class="wide"><table>{top}{"".join(line(r, "td", i) for i, r in enumerate(rows))}</table></div>'


def figure(rgb: np.ndarray, caption: str, widest: int = 640) -> str:
    """An embedded JPEG of rgb (H, W, 3) in [0, 1], no wider than `widest` pixels."""
    if rgb.shape[1] > widest:
        rgb = cv2.resize(
            rgb, (widest, round(rgb.shape[0] * widest / rgb.shape[1])), interpolation=cv2.INTER_AREA
        )
    data = np.rint(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    ok, buffer = cv2.imencode(".jpg", np.ascontiguousarray(data), [cv2.IMWRITE_JPEG_QUALITY, 92])
    assert ok
    source = "data:image/jpeg;base64," + base64.b64encode(buffer.tobytes()).decode()
    return f'<figure><img src="{source}" alt="{escape(caption)}"><figcaption>{escape(caption)}</figcaption></figure>'


def video(data: bytes, caption: str) -> str:
    """An embedded MP4 that plays in a loop."""
    source = "data:video/mp4;base64," + base64.b64encode(data).decode()
    player = f'<video src="{source}" controls loop muted autoplay playsinline></video>'
    return f"<figure>{player}<figcaption>{escape(caption)}</figcaption></figure>"


def number(value: Any, digits: int = 2, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}{unit}"


def plot(width: float, height: float) -> tuple[Any, Any]:
    """An empty matplotlib figure in inches, transparent, in grays that can be read on
    light and dark.
    """
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(width, height), layout="constrained")
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


def svg(drawing: Any) -> str:
    """A drawing as inline SVG."""
    import matplotlib

    for axes in drawing.axes:
        for item in (axes.xaxis.label, axes.yaxis.label, axes.title):
            item.set(color=GRAY, fontsize=9)
    text = memory.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "report"}):
        drawing.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]
