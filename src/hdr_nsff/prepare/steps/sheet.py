"""The step `sheet`: the contact sheet, for a person to see what `prepare` found."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np

from hdr_nsff.core.images import colorize, colorize_flow, contact_sheet, read_mask, write_png
from hdr_nsff.core.io import read_npy
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.scene.manifest import FrameEntry
from hdr_nsff.scene.movers import Mover, movers_in_picture, read_movers

NUM_COLUMNS = 6  # frames shown
STRIPE_PX = 3  # width of the stripes on movers that are not rigid
NO_FLOW = 0.25  # gray where there is none
SHEET = "contact_sheet.png"
NO_MOVER_COLOR = np.ones((1, 3))  # white


def draw_sheet(work: Work) -> StepResult:
    """A few training frames as recorded, equalized, with moving pixels red, movers in
    colors with their tracks, flow to the next frame (from the last to the one before),
    and disparity.
    """
    m = work.manifest
    assert m.movers is not None
    frames = [work.train[k] for k in places_shown([f.bracket for f in work.train])]
    movers = read_movers(work.folder / m.movers)
    rows = {
        "recorded": [work.video[f.index] for f in frames],
        "equalized": [work.equalized[0][f.index] for f in frames],
        "moving": [moving_cell(work, f) for f in frames],
        "movers in colors (striped: not rigid)": [mover_cell(work, f, movers) for f in frames],
        "flow (gray: not believed)": [flow_cell(work, f) for f in frames],
        "disparity": disparity_cells(work, frames),
    }
    if not movers:
        rows.pop("movers in colors (striped: not rigid)")
    if m.parallax != "full":
        rows.pop("disparity")  # the same everywhere
    cells = [[cell.astype(np.float32) for cell in row] for row in rows.values()]
    return StepResult(
        note=", ".join(rows),
        files={SHEET: lambda path: write_png(path, contact_sheet(cells))},
    )


def places_shown(brackets: Sequence[int]) -> list[int]:
    """The places of up to NUM_COLUMNS frames among those of these `brackets`, about
    evenly spread. Exposures take turns: even steps may meet one of a cycle only.
    """
    count = len(brackets)
    if count <= NUM_COLUMNS:
        return list(range(count))
    kinds = np.unique(brackets)
    chosen = set()
    for column, even in enumerate(np.linspace(0, count - 1, NUM_COLUMNS)):
        alike = np.flatnonzero(np.array(brackets) == kinds[column % len(kinds)])
        chosen.add(int(alike[np.abs(alike - even).argmin()]))
    return sorted(chosen)


def moving_cell(work: Work, f: FrameEntry) -> np.ndarray:
    """The equalized frame (H, W, 3) with moving pixels red."""
    shown = work.equalized[0][f.index]
    moving = read_mask(work.folder / str(f.mask))
    return np.where(moving[..., None], 0.5 * shown + [0.5, 0, 0], shown)


def mover_cell(work: Work, f: FrameEntry, movers: Sequence[Mover]) -> np.ndarray:
    """The frame in gray (H, W, 3), moving pixels in the color of their mover, tracks as
    bright dots. A mover without a shape is drawn pale, one that is not rigid striped;
    white stripes mark pixels that move, but belong to no mover.
    """
    gray = np.repeat(work.equalized[0][f.index].mean(-1, keepdims=True), 3, axis=-1)
    times = movers[0].frames.tolist() if movers else []
    if f.index not in times:
        return gray
    t = times.index(f.index)
    moving = read_mask(work.folder / str(f.mask))
    y, x = np.nonzero(moving)
    owner = movers_in_picture(
        movers, t, moving, work.camera(f), tracked=True, in_turn=work.manifest.rig > 1
    )[y, x]
    colors = np.concatenate([mover_colors(movers), NO_MOVER_COLOR])
    rigid = np.array([*(mover.rigid for mover in movers), False])  # the last is `NO_MOVER`
    colored = rigid[owner] | ((x + y) // STRIPE_PX % 2 == 0)
    y, x, owner = y[colored], x[colored], owner[colored]
    gray[y, x] = 0.4 * gray[y, x] + 0.6 * colors[owner]
    for mover, color in zip(movers, colors, strict=False):
        pixels = mover.pixels[:, t]
        column, row = pixels[np.isfinite(pixels[:, 0])].astype(int).T
        gray[row, column] = 0.5 + 0.5 * color
    return gray


def mover_colors(movers: Sequence[Mover]) -> np.ndarray:
    """A color (M, 3) in [0, 1] per mover: hues by the golden ratio, pale without a
    shape.
    """
    golden = 0.618034
    colors = [
        colorsys.hsv_to_rgb(k * golden % 1, 0.9 if mover.has_shape else 0.35, 1.0)
        for k, mover in enumerate(movers)
    ]
    return np.array(colors).reshape(-1, 3)


def flow_cell(work: Work, f: FrameEntry) -> np.ndarray:
    """Flow (H, W, 3) to the next frame, from the last one to the one before; gray where
    it is not believed, or where the frame has none.
    """
    if not f.flow:
        return np.full((work.manifest.height, work.manifest.width, 3), NO_FLOW)
    files = f.flow[max(f.flow)]
    flow = colorize_flow(read_npy(work.folder / files.flow).astype(np.float32))
    return np.where(read_mask(work.folder / files.valid)[..., None], flow, NO_FLOW)


def disparity_cells(work: Work, frames: Sequence[FrameEntry]) -> list[np.ndarray]:
    """Disparity of the frames (H, W, 3), all on one scale of colors."""
    maps = [read_npy(work.folder / str(f.disparity)).astype(np.float32) for f in frames]
    low, high = (float(v) for v in np.percentile(np.stack(maps), [1, 99]))
    return [colorize(disparity, low, high) for disparity in maps]
