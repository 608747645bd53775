"""Scenes and truths that the tests of public layouts export."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import miniatures as mini
import numpy as np

from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import read_npy, write_json, write_npy
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.radiometry.recording import response_curve
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.truth import Truth, TruthView

LAYOUTS = ("hdr-gopro", "nerfstudio")
EXPOSURES = [2.0, 0.0, -1.0]  # of the toy scene's brackets 0 to 2


def exported_scene(toy_folder: Path, folder: Path) -> Path:
    """A copy of the toy scene in `folder` with the detail of a real one.

    Its poses are no round numbers; it has static points, confidences, and a bracket
    whose exposure is unknown.
    """
    shutil.copytree(toy_folder, folder)
    m = Manifest.load(folder)
    rng = np.random.default_rng(0)
    size = (m.height, m.width)
    for f in m.frames:
        f.c2w = mini.pose(0.013 * f.index).tolist()
        f.disparity_confidence = f"disparity_confidence/{f.index:05d}.npy"
        write_npy(folder / f.disparity_confidence, rng.random(size).astype(np.float16))
        for files in f.flow.values():
            write_png(folder / files.valid, rng.random(size) > 0.3)
            noise = rng.normal(size=(*size, 2))
            flow = read_npy(folder / files.flow) + noise
            write_npy(folder / files.flow, flow.astype(np.float16))
    m.points, m.fps = "points.npy", 12.5
    m.bracket_ev, m.exposure_given = [2.0, 0.0, None], False
    for f in m.frames:
        f.ev = m.bracket_ev[f.bracket]
    points = rng.uniform(-1, 1, (50, 3)).astype(np.float32) + np.float32([0, 0, 4])
    write_npy(folder / "points.npy", points)
    m.save(folder)
    return folder


def round_trip(scene: Path, layout: str) -> Path:
    """The scene folder that `prepare` makes of the exported one."""
    place = scene.with_name(layout)
    out = export(ExportConfig(scene, place, layout=layout))  # type: ignore[arg-type]
    return prepare(PrepareConfig(out, scene.with_name(f"again_{layout}"), hold_out=0))


def files_of(folder: Path) -> dict[str, bytes]:
    """All files below `folder` with their contents."""
    files = [p for p in folder.rglob("*") if p.is_file()]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


# Name, time, anchor and bracket of the held-out views.
VIEWS = (
    ("a", 1, 4, 0),
    ("b", 2.5, 5, 1),
    ("c", 3, 0, 2),  # recorded in 16 bits instead of exact radiance
    ("off", 2, 2, 1),  # off the path of the clip
    ("odd", 2.25, 0, 0),  # at a time that is no half frame
)


def write_truth(scene: Path, folder: Path) -> Truth:
    """The views with masks, in a turned, shifted world five times as large."""
    m, rng = Manifest.load(scene), np.random.default_rng(5)
    turn, shift = mini.pose(4.0)[:, :3], np.array([1.0, -2.0, 0.5])

    def in_truth(c2w: Any) -> np.ndarray:
        pose = np.array(c2w)
        center = 5 * turn @ pose[:, 3] + shift
        return np.concatenate([turn @ pose[:, :3], center[:, None]], 1)

    views = []
    for name, time, anchor, bracket in VIEWS:
        mask = f"masks/{name}.png"
        view = TruthView(name=name, time=time, anchor=anchor, bracket=bracket, mask=mask)
        write_png(folder / mask, rng.random((m.height, m.width)) > 0.5)
        if name == "off":
            view.c2w = in_truth(mini.pose(0.4)).tolist()
        if name == "c":
            view.recorded = {2: "recorded/c.png"}
            write_png(folder / "recorded/c.png", rng.random((m.height, m.width, 3)), bits=16)
        else:
            view.radiance = f"radiance/{name}.exr"
            radiance = rng.random((m.height, m.width, 3), np.float32)
            write_exr(folder / view.radiance, {"RGB": radiance})
        views.append(view)
    curve = response_curve("film")
    truth = Truth(
        bracket_ev=EXPOSURES,
        reference_bracket=1,
        response_x=curve.x.tolist(),
        response_y=curve.y.tolist(),
        white_balance=[1.2, 1, 0.9],
        clip_c2w=[in_truth(f.c2w).tolist() for f in m.frames],
        views=views,
    )
    write_json(folder / "truth.json", truth.model_dump())
    return truth
