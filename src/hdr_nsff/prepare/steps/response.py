"""The step `response`: response curves, exposures and white balance of the cameras."""

from __future__ import annotations

from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_npy
from hdr_nsff.prepare.result import StepResult
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry.response import describe, estimate_response
from hdr_nsff.radiometry.static_samples import ResponseView
from hdr_nsff.scene.manifest import FrameEntry
from hdr_nsff.scene.response import write_response


def find_response(work: Work) -> StepResult:
    """What static points that several exposures of the training frames recorded tell of
    the cameras.
    """
    m = work.manifest
    views = [response_view(work, f) for f in work.train]
    cameras = [f.camera_id for f in work.train]
    response = estimate_response(
        views,
        cameras,
        m.known_ev,
        m.reference_bracket,
        m.num_cameras,
        lossless=work.footage.lossless,
    )
    return StepResult(
        note=describe(response, m.known_ev),
        details={
            "misfit": response.misfit,
            "ev": response.ev.round(4).tolist(),
            "measured_scale": round(response.measured_scale, 4),
            "scale_interval": [round(response.scale_low, 4), round(response.scale_high, 4)],
        },
        manifest={"response": "response.json"},
        files={"response.json": lambda path: write_response(path, response)},
    )


def response_view(work: Work, f: FrameEntry) -> ResponseView:
    """A training frame as the response is estimated from it. Depth that is known up to
    scale and shift does not lead from frame to frame: it counts as unknown.
    """
    K, c2w = work.camera(f)
    disparity = read_npy(work.folder / str(f.static_disparity)).astype("f4")
    if work.manifest.depth_kind == "relative":
        disparity = 0 * disparity
    return ResponseView(
        image=work.video[f.index],
        bracket=f.bracket,
        time=f.time,
        K=K,
        c2w=c2w,
        disparity=disparity,
        confidence=read_npy(work.folder / str(f.static_confidence)).astype("f4"),
        moving=read_mask(work.folder / str(f.mask)),
    )
