"""The step `response`: response curves, exposures and white balance of the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import fields
from typing import Self

import numpy as np

from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_npy
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.prepare.exposures import GOPRO
from hdr_nsff.prepare.given_white_balance import given_white_balance
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry.estimate_response import estimate_response
from hdr_nsff.radiometry.frame_colors import FrameColorsTuning, frame_white_balance
from hdr_nsff.radiometry.moving_samples import FlowLinks
from hdr_nsff.radiometry.response_words import describe
from hdr_nsff.radiometry.static_samples import ResponseView
from hdr_nsff.scene.manifest import FrameEntry
from hdr_nsff.scene.response import write_response

UNLIMITED_PX = 2**31  # as the longest side of a frame: none is shrunk


def find_response(work: Work, views: Sequence[ResponseView] | None = None) -> StepResult:
    """What static points that several exposures of the training frames recorded tell of
    the cameras. `views`: these frames, where their maps lie in other folders.
    """
    m = work.manifest
    if views is None:
        views = [StoredView(work, f) for f in work.train]
    cameras = [f.camera_id for f in work.train]
    response = estimate_response(
        views,
        cameras,
        m.known_ev,
        m.reference_bracket,
        m.num_cameras,
        lossless=shows_noise(work),
        drift=given_drift(work),
        may_drift=may_drift(work),
        links=flow_links(work),
    )
    colors = given = None
    if m.rig == m.num_cameras == 1:
        colors = frame_white_balance(views, response.x, response.y[0])
        given = given_white_balance(work)
    balance = white_balance_of_frames(work, colors)
    words = describe_colors(colors)
    if given is not None:
        balance = {f.index: given[f.index].round(5).tolist() for f in m.frames}
        words = describe_given_colors(given, colors, [f.index for f in work.train])
    return StepResult(
        note=describe(response, m.known_ev) + words,
        details={
            "misfit": response.misfit,
            "ev": response.ev.round(4).tolist(),
            "measured_scale": round(response.measured_scale, 4),
            "scale_interval": [round(response.scale_low, 4), round(response.scale_high, 4)],
        },
        manifest={"response": "response.json"},
        frames={
            "drift": drift_of_frames(work, response.drift),
            "white_balance": balance,
        },
        files={"response.json": lambda path: write_response(path, response)},
    )


def flow_links(work: Work) -> FlowLinks:
    """The flow between training frames."""
    place = {f.index: k for k, f in enumerate(work.train)}
    targets = [[place[j] for j in f.raw_flow if j in place] for f in work.train]

    def read(source: int, target: int) -> tuple[np.ndarray, np.ndarray]:
        files = work.train[source].raw_flow[work.train[target].index]
        flow = read_npy(work.folder / files.flow).astype(np.float32)
        return flow, read_mask(work.folder / files.valid)

    return FlowLinks(targets, read)


def shows_noise(work: Work) -> bool:
    """Whether the frames hold the noise of the sensor: compressed without loss, and of
    the size and shape in which they were recorded, since interpolation averages noise.
    """
    if not work.footage.lossless or work.manifest.lens:
        return False
    start = work.config.start
    recorded = next(read_frames(work.footage, start, start + 1, 1, UNLIMITED_PX))
    return recorded.rgb.shape[:2] == (work.manifest.height, work.manifest.width)


def describe_colors(colors: np.ndarray | None) -> str:
    """What a note says of the white balance (V, 3) of frames."""
    if colors is None:
        return ""
    low, high = colors.min(0), colors.max(0)
    red, blue = high[0] - low[0], high[2] - low[2]
    return f"; white balance drifts: red by {red:.2f}, blue by {blue:.2f} stops"


def describe_given_colors(given: np.ndarray, seen: np.ndarray | None, train: list[int]) -> str:
    """What a note says of the `given` white balance (T, 3) of all frames, and of what
    static points show of that of the `train` frames: `seen` (V, 3).
    """
    words = describe_colors(given) + f" by {GOPRO}"
    if seen is None:
        return words + ", which static points do not show"
    off = float(np.abs(seen - given[train] + given[train].mean(0)).max())
    if off >= FrameColorsTuning().min_drift:
        words += f", with which the pixels disagree by up to {off:.2f} stops"
    return words


def may_drift(work: Work) -> bool:
    """Whether frames may differ from their brackets by exposures that nobody gave.

    Not where the exposure of every frame is given. Between the cameras of a rig that
    take turns, brightness differs for other reasons.
    """
    exposure = work.manifest.steps.get("exposure")
    every_frame = exposure is not None and exposure.details.get("every_frame_given", False)
    return not every_frame and work.manifest.rig == 1


def given_drift(work: Work) -> np.ndarray | None:
    """The drift (V,) of the training frames where the step `exposure` had it given."""
    exposure = work.manifest.steps.get("exposure")
    if exposure is None or not exposure.details.get("drift_given", False):
        return None
    return np.array([f.drift or 0.0 for f in work.train])


def drift_of_frames(work: Work, drift: np.ndarray | None) -> dict[int, float]:
    """The drift of every frame by its index, from that of the training frames (V,).

    Given drift stays, whatever was estimated. Frames that are held out lie between
    their neighbors of the same bracket.
    """
    if given_drift(work) is not None:
        return {f.index: f.drift for f in work.manifest.frames if f.drift is not None}
    if drift is None:
        return {}
    brackets = np.array([f.bracket for f in work.train])
    times = np.array([f.time for f in work.train])
    of_bracket = {b: np.flatnonzero(brackets == b) for b in np.unique(brackets).tolist()}
    found = {}
    for f in work.manifest.frames:
        if f.bracket not in of_bracket:
            continue  # nothing was learned of its exposure
        same = of_bracket[f.bracket]
        found[f.index] = round(float(np.interp(f.time, times[same], drift[same])), 5)
    return found


def white_balance_of_frames(work: Work, colors: np.ndarray | None) -> dict[int, list[float]]:
    """The white balance (3,) of every frame by its index, from that of the training
    frames (V, 3) in stops.
    """
    if colors is None:
        return {}
    order = np.argsort([f.time for f in work.train])
    times = np.array([f.time for f in work.train])[order]
    found = {}
    for f in work.manifest.frames:
        balance = [float(np.interp(f.time, times, colors[order, c])) for c in range(3)]
        found[f.index] = [round(value, 5) for value in balance]
    return found


def response_view(work: Work, frame: FrameEntry) -> ResponseView:
    """A training frame as the response is estimated from it, in memory."""
    stored = StoredView(work, frame)
    return ResponseView(**{f.name: getattr(stored, f.name) for f in fields(ResponseView)})


class StoredView(ResponseView):
    """A training frame as the response is estimated from it, its maps read from the
    scene folder when asked for.

    Depth that is known up to scale and shift does not lead from frame to frame: it
    counts as unknown.
    """

    work: Work
    frame: FrameEntry

    def __init__(self, work: Work, frame: FrameEntry) -> None:
        K, c2w = work.camera(frame)
        own = {
            "work": work,
            "frame": frame,
            "bracket": frame.bracket,
            "time": frame.time,
            "K": K,
            "c2w": c2w,
        }
        for name, value in own.items():
            object.__setattr__(self, name, value)

    @property
    def image(self) -> np.ndarray:
        """(H, W, 3) recorded, in [0, 1]."""
        return self.work.video[self.frame.index]

    @property
    def disparity(self) -> np.ndarray:
        """(H, W) 1 / z-depth, scene units."""
        disparity = self.map(self.frame.static_disparity)
        return 0 * disparity if self.work.manifest.depth_kind == "relative" else disparity

    @property
    def confidence(self) -> np.ndarray:
        """(H, W) in [0, 1]."""
        return self.map(self.frame.static_confidence)

    @property
    def moving(self) -> np.ndarray:
        """(H, W) bool."""
        return read_mask(self.work.folder / str(self.frame.mask))

    def in_bracket(self, bracket: int) -> Self:
        """The same frame, counted as one of another bracket."""
        view = copy(self)
        object.__setattr__(view, "bracket", bracket)
        return view

    def map(self, name: str | None) -> np.ndarray:
        """A map (H, W) of the scene folder."""
        return read_npy(self.work.folder / str(name)).astype("f4")
