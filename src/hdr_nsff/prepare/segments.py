"""A long clip as segments: scene folders that overlap in time and share poses,
exposures and one response.

The folder `clip` holds what is found once, of the whole clip: frames, exposures, flow
as matched, poses. A segment takes its part of them, and finds masks and depth of its
own. Static points of all segments give the one response. Then each segment refines its
flow and finds its movers and its depth. Pictures and flow that segments take are second
names of the same files where the disk allows it, so they need no space. Times are those
of the whole clip.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import SCENE_FILE, is_leftover, read_npy, write_npy
from hdr_nsff.core.progress import say
from hdr_nsff.prepare.engine import Step, found_manifest
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.steps.flow import flow_files
from hdr_nsff.prepare.steps.footage import identity
from hdr_nsff.prepare.steps.poses import SIGHTINGS
from hdr_nsff.prepare.steps.response import StoredView, find_response
from hdr_nsff.prepare.table import STEPS, run_steps
from hdr_nsff.prepare.work import PrepareConfig, Segment, StepName, Work
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest

CLIP_FOLDER = "clip"  # of what is found once
MAX_SECONDS = 1e6  # of a segment: eleven days
MIN_OVERLAP = 3  # frames; more where the exposure cycle is longer (hand-chosen)
# of a segment or a part between cuts: fewer show little motion (hand-chosen)
MIN_FRAMES = 12
OF_CLIP: tuple[StepName, ...] = ("frames", "exposure", "flow", "poses")
BEFORE_RESPONSE: tuple[StepName, ...] = ("masks", "static_depth")
AFTER_RESPONSE: tuple[StepName, ...] = ("refined_flow", "movers", "depth", "sheet")
# of the manifest, that the step `frames` sets
FRAME_VALUES = ("width", "height", "fps", "stride", "frame_seconds")
Take = Callable[[Work, Work], StepResult]  # of the whole clip, for a segment


def check_segments(config: PrepareConfig) -> None:
    """InputError for settings that segments cannot have."""
    seconds = config.segment
    if seconds is None:
        return
    if not 0 < seconds < MAX_SECONDS:
        raise InputError(f"--segment {seconds:g}: give the seconds of a segment, such as 4")
    if config.mask_points is not None:
        raise InputError(
            "--segment and --mask-points both given: points name frames of one scene; leave one out"
        )
    check_rig(seconds, config.rig or 1)
    check_place(config.out)


def check_rig(seconds: float, rig: int) -> None:
    """InputError for several cameras that take the frames in turn."""
    if rig > 1:
        raise InputError(
            f"--segment {seconds:g}: {rig} cameras take the frames in turn, and each is needed "
            "from its first visit to its last; leave the option out"
        )


def check_place(out: Path) -> None:
    """InputError where segments cannot go into the folder `out`."""
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(f"{out}: is a file; choose a folder to write the scenes to")
    if (out / SCENE_FILE).exists():
        raise InputError(
            f"{out}: holds the scene of a whole clip; choose another folder for segments"
        )
    begun = (out / CLIP_FOLDER / SCENE_FILE).exists()
    others = [path for path in out.iterdir() if path.name != CLIP_FOLDER and not is_leftover(path)]
    if others and not begun:
        raise InputError(f"{out}: holds other files and no scene; choose an empty or new folder")


def bring_back_clip(out: Path) -> None:
    """Make what was found of a clip that could not be cut the scene in `out`, for a
    command without `--segment`. InputError where it was cut.
    """
    clip = out / CLIP_FOLDER
    if not (clip / SCENE_FILE).is_file() or (out / SCENE_FILE).exists():
        return
    if any(out.glob(f"segment_*/{SCENE_FILE}")):
        raise InputError(
            f"{out}: holds the segments of a long clip; give --segment too, or choose another "
            "folder for one scene"
        )
    if any(path != clip and not is_leftover(path) for path in out.iterdir()):
        return
    (clip / SCENE_FILE).rename(out / SCENE_FILE)  # first: then a kill loses steps at most
    for path in clip.iterdir():
        path.rename(out / path.name)
    clip.rmdir()


def prepare_segments(clip: Work) -> list[Path]:
    """Run every step that is not done, of the whole clip and of its segments; the scene
    folders. InputError where the clip cannot be cut.
    """
    steps = {name: STEPS[name] for name in OF_CLIP}
    run_steps(clip, steps | {"flow": replace(STEPS["flow"], check=check_flow_and_cut)})
    clip.forget(("equalized", "raw_flows", "visits"))
    segments = cut_clip(clip)
    for segment in segments:
        times = [clip.manifest.frames[row].time for row in segment.rows]
        place = f"{segment.name} of {len(segments)}"
        say(f"{place}: {len(times)} frames, {min(times):g} to {max(times):g} of the clip")
        taken = {name: take_step(clip, segment, name, take) for name, take in TAKEN.items()}
        run_steps(open_segment(clip, segment), taken | {n: STEPS[n] for n in BEFORE_RESPONSE})
    run_steps(clip, {"response": response_step(clip, segments)})
    folders = []
    for segment in segments:
        say(f"{segment.name}: flow of movers, movers and depth")
        taken = {"response": take_step(clip, segment, "response", take_response)}
        work = open_segment(clip, segment)
        run_steps(work, taken | {name: STEPS[name] for name in AFTER_RESPONSE})
        folders.append(work.folder)
    report(clip, folders)
    return folders


def report(clip: Work, folders: list[Path]) -> None:
    """Print where the scenes are, and which folders are of an earlier cut."""
    out = clip.folder.parent
    say(f"scenes: {len(folders)} in {out}, {folders[0].name} to {folders[-1].name}")
    others = sorted(path.name for path in out.glob("segment_*") if path not in folders)
    if others:
        say(f"{out}: {', '.join(others)} of an earlier cut are left as they are; delete them")


# Where the clip is cut


def check_flow_and_cut(clip: Work) -> None:
    """InputError for bad input of flow or later steps, and where frames and exposures
    tell that the clip cannot be cut.
    """
    STEPS["flow"].check(clip)
    cut_clip(clip)


def cut_clip(clip: Work) -> list[Segment]:
    """The segments of a clip: of equal length, at most `--segment`, overlapping by an
    exposure cycle. Their first and last frames are training frames, so that they know
    all that the frames between show.
    """
    m, seconds = clip.manifest, clip.config.segment
    assert seconds is not None
    check_rig(seconds, m.rig)
    overlap = max(m.cycle, MIN_OVERLAP)
    longest = round(seconds * m.fps)
    least = max(MIN_FRAMES, 2 * overlap)
    if longest < least:
        raise InputError(
            f"--segment {seconds:g}: {longest} frames at {m.fps:.4g} a second; segments need "
            f"{least} or more, so give at least {least / m.fps:.1f} seconds"
        )
    times = sorted({f.time for f in m.frames})
    held_out = {f.time for f in m.frames if f.split == "test"}
    count = max(1, -(-(len(times) - overlap) // (longest - overlap)))
    bounds = np.linspace(0, len(times) - overlap, count + 1).round().astype(int)
    segments = []
    for k in range(count):
        first, last = int(bounds[k]), int(bounds[k + 1]) + overlap - 1
        while times[first] in held_out:
            first -= 1
        while times[last] in held_out:
            last += 1
        rows = tuple(f.index for f in m.frames if times[first] <= f.time <= times[last])
        segments.append(Segment(f"segment_{k:02d}", rows, len(m.frames)))
    return segments


def open_segment(clip: Work, segment: Segment) -> Work:
    """The scene folder of a segment, as far as it is done."""
    m, config = clip.manifest, replace(clip.config, out=clip.folder.parent / segment.name)
    found = found_manifest(config)
    if found is None:
        found = Manifest(source=m.source, width=m.width, height=m.height)
    for name in ("source", "inputs", "lens"):
        setattr(found, name, getattr(m, name))
    return Work(config, clip.footage, found, segment=segment)


# What a segment takes of the whole clip


def take_step(clip: Work, segment: Segment, name: StepName, take: Take) -> Step:
    """The step `name` of a segment: it takes its part of that step of the clip."""
    record = clip.manifest.steps[name]
    run = partial(run_take, clip, name, take)
    depends = (record.key, record.details.get("attempt"), list(segment.rows))
    return replace(STEPS[name], run=run, settings=(), depends=depends, quiet=True)


def run_take(clip: Work, name: StepName, take: Take, work: Work) -> StepResult:
    """What `take` takes, with the record of the clip's step."""
    record = clip.manifest.steps[name]
    details = {key: value for key, value in record.details.items() if key != "attempt"}
    result = take(clip, work)
    return replace(
        result,
        note=f"{record.note} (of the whole clip)",
        provenance=record.provenance,
        details=details | result.details,
    )


def own_frames(clip: Work, work: Work) -> list[FrameEntry]:
    """The entries of a segment's frames in the manifest of the clip."""
    assert work.segment is not None
    return [clip.manifest.frames[row] for row in work.segment.rows]


def take_frames(clip: Work, work: Work) -> StepResult:
    """The frames of a segment, as they were decoded."""
    m = work.manifest
    entries, files = [], {}
    for index, f in enumerate(own_frames(clip, work)):
        image = f"images/{index:05d}.png"
        files[image] = partial(link, clip.folder / f.image)
        entry = FrameEntry(index=index, image=image, source=f.source, time=f.time, bracket=0)
        entries.append(entry.model_copy(update={"camera_id": f.camera_id, "track": f.track}))
    if [identity(f, False) for f in m.frames] != [identity(f, False) for f in entries]:
        m.frames = entries  # else the results of later steps for these frames stay
    sizes = {name: getattr(clip.manifest, name) for name in FRAME_VALUES}
    return StepResult(note="", manifest=sizes, files=files)


def take_exposure(clip: Work, work: Work) -> StepResult:
    """Exposures, times, and which frames are held out."""
    names = ("cycle", "rig", "reference_bracket", "bracket_ev", "exposure_given", "protocol")
    own = own_frames(clip, work)
    frames: dict[str, dict[int, Any]] = {
        name: {index: getattr(f, name) for index, f in enumerate(own)}
        for name in ("time", "bracket", "ev", "split", "exposure_time")
    }
    given = clip.manifest.steps["exposure"].details.get("drift_given", False)
    frames["drift"] = {index: f.drift for index, f in enumerate(own)} if given else {}
    values = {name: getattr(clip.manifest, name) for name in names}
    return StepResult(note="", manifest=values, frames=frames)


def take_flow(clip: Work, work: Work) -> StepResult:
    """The flow between frames of the segment, as matched."""
    assert work.segment is not None
    place = {row: index for index, row in enumerate(work.segment.rows)}
    flow: dict[int, dict[int, FlowFiles]] = {}
    files = {}
    for index, f in enumerate(own_frames(clip, work)):
        flow[index] = {}
        for target, source in f.raw_flow.items():
            if target not in place:
                continue
            own = flow_files("raw_flow", (index, place[target]))
            files[own.flow] = partial(link, clip.folder / source.flow)
            files[own.valid] = partial(link, clip.folder / source.valid)
            flow[index][place[target]] = own
    return StepResult(note="", frames={"raw_flow": flow, "flow": flow}, files=files)


def take_poses(clip: Work, work: Work) -> StepResult:
    """Cameras, and the static points that the frames of the segment see."""
    assert work.segment is not None
    m, own = clip.manifest, own_frames(clip, work)
    registered = clip.manifest.steps["poses"].details["registered"]
    points = np.zeros((0, 3), np.float32)
    if m.points is not None:
        points = np.array(read_npy(clip.folder / m.points))
        sightings = clip.folder / SIGHTINGS
        frames, seen = np.array(read_npy(sightings)).T if sightings.is_file() else np.zeros((2, 0))
        if len(seen):  # without, points were given: all of them count
            points = points[np.unique(seen[np.isin(frames, work.segment.rows)])]
    files = {"points.npy": lambda path: write_npy(path, points)} if len(points) else {}
    values = {name: getattr(m, name) for name in ("parallax", "near", "far", "readout")}
    return StepResult(
        note="",
        details={"registered": [registered[f.index] for f in own]},
        manifest=values | {"points": "points.npy" if len(points) else None},
        frames={
            name: {index: getattr(f, name) for index, f in enumerate(own)} for name in ("K", "c2w")
        },
        files=files,
    )


def take_response(clip: Work, work: Work) -> StepResult:
    """The response, and exposure and white balance of every frame."""
    own = own_frames(clip, work)
    return StepResult(
        note="",
        manifest={"response": clip.manifest.response},
        frames={
            name: {index: getattr(f, name) for index, f in enumerate(own)}
            for name in ("drift", "white_balance")
        },
        files={"response.json": partial(shutil.copyfile, clip.folder / "response.json")},
    )


TAKEN: dict[StepName, Take] = {
    "frames": take_frames,
    "exposure": take_exposure,
    "flow": take_flow,
    "poses": take_poses,
}


def link(source: Path, place: Path) -> None:
    """The file `source` at `place` too: one file with two names, or a copy."""
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)
    try:
        os.link(source, place)
    except OSError:
        shutil.copyfile(source, place)


# The response of all segments


def response_step(clip: Work, segments: Sequence[Segment]) -> Step:
    """The step `response` of the clip, from the depth and masks of its segments."""
    works = [open_segment(clip, segment) for segment in segments]
    records = [work.manifest.steps["static_depth"] for work in works]
    depends = tuple((record.key, record.details.get("attempt")) for record in records)
    run = partial(find_shared_response, works)
    return replace(STEPS["response"], run=run, needs=("poses",), depends=depends)


def find_shared_response(works: Sequence[Work], clip: Work) -> StepResult:
    """The response from the training frames of all segments; frames of two segments
    count once.
    """
    views: dict[int, SegmentView] = {}
    for work in works:
        assert work.segment is not None
        for row, frame in zip(work.segment.rows, work.manifest.frames, strict=True):
            views.setdefault(row, SegmentView(work, frame, clip, row))
    return find_response(clip, [views[f.index] for f in clip.train])


class SegmentView(StoredView):
    """A training frame with the maps of a segment. Its picture is read through the
    whole clip, so that all segments together keep as many in memory as one scene.
    """

    clip: Work
    row: int

    def __init__(self, work: Work, frame: FrameEntry, clip: Work, row: int) -> None:
        """`row`: the index of the `frame` in the whole clip."""
        super().__init__(work, frame)
        object.__setattr__(self, "clip", clip)
        object.__setattr__(self, "row", row)

    @property
    def image(self) -> np.ndarray:
        """(H, W, 3) recorded, in [0, 1]."""
        return self.clip.video[self.row]
