"""A lens that structure from motion finds late: `prepare` starts over with undistorted
frames, but their flow is that of the recorded ones, as a pinhole camera would have seen
it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_npy
from hdr_nsff.core.progress import say, track
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.prepare.engine import Step, next_attempt, remove, step_key
from hdr_nsff.prepare.lens import describe, flow_undistorter
from hdr_nsff.prepare.steps.flow import flow_files, write_flow
from hdr_nsff.prepare.work import StepName, Work
from hdr_nsff.scene.manifest import FlowFiles, LensEntry

UNDISTORTED_FLOW = "undistorted_flow"  # a folder of the scene


def start_over(work: Work, steps: Mapping[StepName, Step], lenses: dict[int, Lens]) -> None:
    """Make the scene folder that of undistorted frames, of which only flow is done.

    The manifest is saved last: a command that is stopped before finds the `lenses`
    {camera_id: lens} again.
    """
    m = work.manifest
    given = work.config.lens_distortion != "auto"
    entries = {c: LensEntry.of(lens, given) for c, lens in lenses.items()}
    say(f"poses: the lens distorts ({describe(entries)}); frames are undistorted, once")
    remove(work.folder / UNDISTORTED_FLOW)
    flow = undistort_flow(work, lenses)
    remove(work.folder / "images")
    m.lens = entries
    first_steps: tuple[StepName, ...] = ("frames", "exposure", "flow")
    for name in first_steps:
        key = step_key(work, name, steps[name])
        record = m.steps[name]
        done = record.model_copy(update={"key": key})
        m.steps[name] = done if name == "flow" else next_attempt(record, key)
    for f in m.frames:
        f.raw_flow = f.flow = flow.get(f.index, {})
    work.save()
    remove(work.folder / "raw_flow")
    work.forget(("codes", "equalized", "raw_flows", "refined_flows"))


def undistort_flow(work: Work, lenses: dict[int, Lens]) -> dict[int, dict[int, FlowFiles]]:
    """Write the flow of all pairs as undistorted frames have it; the new files."""
    frames, folder = work.manifest.frames, work.folder
    undistorted = flow_undistorter(lenses, work.manifest.width, work.manifest.height)
    found: dict[int, dict[int, FlowFiles]] = {}
    pairs = [(f, j, files) for f in frames for j, files in f.raw_flow.items()]
    for f, j, files in track(pairs, "flow: undistorted"):
        flow = read_npy(folder / files.flow).astype(np.float32)
        valid = read_mask(folder / files.valid)
        names = flow_files(UNDISTORTED_FLOW, (f.index, j))
        write_flow(work, names, *undistorted(f.camera_id, flow, valid))
        found.setdefault(f.index, {})[j] = names
    return found
