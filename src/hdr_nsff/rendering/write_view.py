"""One view of a shot as files: its picture, and the EXR file beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.images import write_png
from hdr_nsff.core.ocio import Look
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.develop import develop, develop_view
from hdr_nsff.rendering.exr_header import balance, radiance_header
from hdr_nsff.rendering.lens import LensView, original_lens
from hdr_nsff.rendering.mattes import ObjectMattes
from hdr_nsff.rendering.output import Output, Shot, ev_of
from hdr_nsff.rendering.stills import render_still, write_still
from hdr_nsff.training.run_folder import Run


def write_view(
    run: Run,
    shot: Shot,
    index: int,
    picture: Path,
    output: Output,
    exposure: float,
    mattes: ObjectMattes | None,
    look: Look | None,
) -> None:
    """Write `picture` and the EXR beside it where one of them is missing.

    `exposure` is that of the display.
    """
    view = shot.views[index]
    exr = picture.with_suffix(".exr")
    with_vectors = output.exr != "none"
    with_exr = with_vectors or bool(output.hdr_video or output.hdr_still)  # made from EXR
    if picture.exists() and (exr.exists() or not with_exr):
        return
    steps = neighbor_views(shot.views, index) if with_vectors else {}
    lens_view = view_through_lens(run, view, output)
    if lens_view is None:
        still = render_still(run, view, output.between, with_vectors, steps)
    else:
        lenses = {side: view_through_lens(run, v, output) for side, v in steps.items()}
        steps = {side: each.view for side, each in lenses.items() if each is not None}
        rendered = render_still(run, lens_view.view, output.between, with_vectors, steps)
        still = lens_view.distort_still(rendered)
    ev = ev_of(view, output)
    if with_exr:
        header = radiance_header(run, output.white_balance, output.camera_id)
        if ev is None:
            header["displayExposure"] = exposure
        else:
            header["developedEV"] = float(ev)
        stored = balance(run, still.radiance, output.white_balance, output.camera_id)
        stored_still = replace(still, radiance=stored)
        objects = matte_pictures(mattes, view, lens_view)
        half = output.exr != "float"
        write_still(exr, stored_still, view, half, header, output.exr_vectors, objects)
    if look is None and lens_view is not None:
        rgb = develop(run, still.radiance, ev, output.camera_id, exposure)
    elif look is None:
        rgb = develop_view(run, view, still.radiance, ev, output.camera_id, exposure)
    else:
        white = exposure if ev is None else 2.0**ev
        rgb = look.develop(white * balance(run, still.radiance, "neutral", output.camera_id))
    write_png(picture, rgb)


def view_through_lens(run: Run, view: PathView, output: Output) -> LensView | None:
    """The view through the clip's lens; None for a pinhole camera."""
    if output.lens == "pinhole":
        return None
    return LensView.of(view, original_lens(run.scene.manifest, output.camera_id))


def matte_pictures(
    mattes: ObjectMattes | None, view: PathView, lens_view: LensView | None
) -> dict[str, np.ndarray]:
    """The mattes of a view by name, through the lens if there is one."""
    if mattes is None:
        return {}
    if lens_view is None:
        return mattes.coverage(view)
    return lens_view.distort_mattes(mattes.coverage(lens_view.view))


def open_look(output: Output) -> Look | None:
    """The look that develops pictures, where one is asked for."""
    if output.ocio is None:
        return None
    return Look(output.ocio, output.view, output.display)


def neighbor_views(views: Sequence[PathView], index: int) -> dict[int, PathView]:
    """The next (1) and the previous (-1) view of a shot, where there is one."""
    return {side: views[index + side] for side in (1, -1) if 0 <= index + side < len(views)}
