"""The steps of `prepare`, in order: what each builds on, and what it leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from hdr_nsff.prepare.engine import Step, all_have, run_step
from hdr_nsff.prepare.given_maps import check_given_maps
from hdr_nsff.prepare.lens import DistortedFramesError
from hdr_nsff.prepare.steps import footage as on_footage
from hdr_nsff.prepare.steps.depth import find_depth
from hdr_nsff.prepare.steps.flow import find_flow, has_flow, has_refined_flow
from hdr_nsff.prepare.steps.masks import find_masks
from hdr_nsff.prepare.steps.movers import find_movers
from hdr_nsff.prepare.steps.poses import find_poses
from hdr_nsff.prepare.steps.refined_flow import refine_flow
from hdr_nsff.prepare.steps.response import find_response
from hdr_nsff.prepare.steps.sheet import draw_sheet
from hdr_nsff.prepare.steps.static_depth import find_static_depth
from hdr_nsff.prepare.undistort import UNDISTORTED_FLOW, start_over
from hdr_nsff.prepare.work import StepName, Work


def run_steps(work: Work, steps: Mapping[StepName, Step]) -> None:
    """Run every step that is not done; once more from the frames where these turn out
    to be distorted.
    """
    try:
        for name, step in steps.items():
            run_step(work, name, step)
    except DistortedFramesError as distorted:
        start_over(work, steps, distorted.lenses)
        work.config = replace(work.config, redo=())  # all is redone, but for the flow
        for name, step in steps.items():
            run_step(work, name, step)


STEPS: dict[StepName, Step] = {
    "frames": Step(
        on_footage.frames_step,
        settings=("start", "end", "stride", "max_size", "same_camera"),
        outputs=("images",),
        complete=all_have("image"),
        forgets=("codes", "equalized"),
    ),
    "exposure": Step(
        on_footage.exposure_step,
        needs=("frames",),
        settings=("exposures", "ev", "hold_out", "protocol", "rig"),
        forgets=("equalized", "visits"),
    ),
    "flow": Step(
        find_flow,
        needs=("exposure",),
        settings=("flow", "flow_weights", "semantic"),
        check=check_given_maps,
        outputs=("raw_flow", UNDISTORTED_FLOW),
        complete=has_flow,
        forgets=("raw_flows", "refined_flows"),
    ),
    "poses": Step(
        find_poses,
        needs=("flow",),
        settings=("poses", "masks", "matcher", "tripod", "readout"),
        check=check_given_maps,
        outputs=("poses", "points.npy"),
        complete=all_have("c2w"),
    ),
    "masks": Step(
        find_masks,
        needs=("poses",),
        settings=("masks", "mask_weights", "mask_points"),
        outputs=("masks",),
        complete=all_have("mask"),
        forgets=("masks",),
    ),
    "static_depth": Step(
        find_static_depth,
        needs=("masks",),
        settings=("depth", "depth_weights", "depth_kind"),
        check=check_given_maps,
        outputs=("static_disparity", "static_confidence", "still"),
        complete=all_have("static_disparity", "train"),
        forgets=("raw_flows",),
    ),
    "response": Step(
        find_response,
        needs=("static_depth",),
        outputs=("response.json",),
        complete=lambda m: m.response is not None,
    ),
    "refined_flow": Step(
        refine_flow,
        needs=("response",),
        outputs=("refined_flow",),
        complete=has_refined_flow,
        forgets=("refined_flows",),
    ),
    "movers": Step(
        find_movers,
        needs=("refined_flow",),
        outputs=("movers.npz", "mover_disparity", "mover_confidence"),
        complete=lambda m: m.movers is not None,
        forgets=("refined_flows",),
    ),
    "depth": Step(
        find_depth,
        needs=("movers",),
        outputs=("disparity", "disparity_confidence"),
        complete=all_have("disparity", "train"),
    ),
    "sheet": Step(draw_sheet, needs=("depth",), outputs=("contact_sheet.png",)),
}
