"""Structure from motion on the views of a clip: of a pinhole camera or a lens, of rows
that are read at once or one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.footage.colmap import ColmapModel, views_of_images
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.priors.poses.lens import (
    PINHOLE,
    LensChoice,
    Mapping,
    bent_cameras,
    fitted_lens,
    lens_fit,
    lens_of,
)
from hdr_nsff.priors.poses.lightglue import Matcher
from hdr_nsff.priors.poses.model_poses import poses_from_model
from hdr_nsff.priors.poses.reconstruct import (
    ReconstructionTuning,
    SfmViews,
    best_model,
    median_error,
)
from hdr_nsff.priors.poses.rolling_shutter import best_readout
from hdr_nsff.priors.poses.sfm import LENS_FILE
from hdr_nsff.priors.poses.view_matches import EarlierRounds

Readout = float | Literal["auto"]  # of a rolling shutter, in frames


@dataclass(frozen=True)
class Mapper:
    """Structure from motion on the views of a clip, with a lens or without."""

    views: SfmViews
    workdir: Path
    threads: int
    matcher: Matcher
    tuning: ReconstructionTuning
    device: torch.device
    earlier: EarlierRounds

    def model(self, mapping: Mapping, earlier: EarlierRounds) -> tuple[ColmapModel, int]:
        """The best reconstruction, and the scale of its images over the views."""
        return best_model(
            self.views, self.workdir, self.threads, self.matcher, self.tuning, self.device,
            earlier, mapping,
        )  # fmt: skip

    def poses(self, lens: LensChoice) -> Poses:
        """Poses of all frames, with the lens of each group of views where one is found
        or given. InputError where there is no good reconstruction.
        """
        if not isinstance(lens, str):
            return self.bent_poses(Mapping(distortion=lens))
        if lens == "none":
            return self.of_model(*self.model(PINHOLE, self.earlier))
        try:
            model, scale = self.model(Mapping(try_lens=True), self.earlier)
        except InputError:  # perhaps it bends too much for a pinhole camera
            poses = self.bent_poses(Mapping(distortion=(0.0, 0.0), refine=True, try_lens=True))
            if not poses.lenses:
                raise
            return poses
        fit = lens_fit(self.earlier)
        bent = [] if fit is None else bent_cameras(fit, model, scale, self.tuning.lens)
        if fit is not None and bent:
            limit = self.tuning.lens.max_model_error_share * median_error(model, self.tuning)
            try:
                poses = self.bent_poses(bent[0], limit)
            except InputError:  # the lens that fits the model of a pinhole has to do
                poses = self.of_model(model, scale)
                lenses = self.lenses(model, lambda camera: fitted_lens(fit, model, camera))
                poses = replace(poses, lenses=lenses)
            if poses.lenses:
                return poses
        return self.of_model(model, scale)

    def bent_poses(self, mapping: Mapping, max_error_px: float = np.inf) -> Poses:
        """Poses of a reconstruction with a lens, which starts from the earlier one's if
        there is one. Its lenses count unless they bend too little after all, or points
        miss by more than `max_error_px` (median, pixels of the images).
        """
        start = {name: c for name, c in self.earlier.model.items() if name != LENS_FILE}
        round_of_its_own = EarlierRounds(self.earlier.matches, start)
        model, scale = self.model(mapping, round_of_its_own)
        fit = lens_fit(round_of_its_own)
        tuning = self.tuning.lens
        poses = self.of_model(model, scale)
        lenses = self.lenses(model, lambda camera: lens_of(model, camera, fit, tuning))
        largest = max(lens.max_displacement_px() for lens in lenses.values())
        bends = largest >= tuning.min_displacement_px or not mapping.refine
        fits = median_error(model, self.tuning) <= max_error_px
        return replace(poses, lenses=lenses) if bends and fits else poses

    def with_readout(self, readout: float, model: dict[str, bytes]) -> Mapper:
        """The same for a rolling shutter that takes `readout` frames from the first row
        to the last, from the files of a `model`, if any.
        """
        earlier = EarlierRounds(self.earlier.matches, dict(model))
        return replace(self, views=replace(self.views, readout=readout), earlier=earlier)

    def with_measured_readout(self, poses: Poses) -> Poses:
        """Poses with the readout that fits best, which later rounds then know; the
        `poses` that were found without where that is 0, or nothing can be mapped with
        another.

        Views are mapped anew: the focal length of before suits rows read at once.
        """
        earlier, readout = self.earlier, 0.0
        try:
            readout = self.measured_readout()
            if readout:
                rolling = self.with_readout(readout, {})
                poses = rolling.poses("none")
                earlier.model = rolling.earlier.model
            rows = f"over {readout:.0%} of the time between frames" if readout else "at once"
            say(f"poses: rolling shutter: rows are read {rows}")
        except InputError as error:
            readout = 0.0
            say(f"poses: rolling shutter: not measured, taken for none: {error}")
        earlier.readout = readout
        return poses

    def measured_readout(self) -> float:
        """The readout in frames with which the views fit best, from the model that was
        found; 0 where they hardly fit better than without. InputError where nothing can
        be mapped with one.
        """
        if not self.earlier.model or self.views.visits is not None:
            return 0.0

        def error(readout: float) -> float:
            """The mean reprojection error of all observations, in pixels."""
            rolling = self.with_readout(readout, self.earlier.model)
            model, _ = rolling.model(PINHOLE, rolling.earlier)
            return float(np.average(model.errors, weights=model.track_lengths))

        return best_readout(error)

    def lenses(self, model: ColmapModel, of_camera: Callable[[int], Lens]) -> dict[int, Lens]:
        """The lens of each group of views, of the size of the frames; every group has a
        view in the model, as `of_model` makes sure.
        """
        height, width = self.views.images.shape[1:3]
        image_of = views_of_images(model)
        lenses = {}
        for k, group in enumerate(self.views.groups):
            camera_ids = [image_of[v].camera_id for v in group if v in image_of]
            lenses[k] = of_camera(camera_ids[0]).resized(width, height)
        return lenses

    def of_model(self, model: ColmapModel, scale: int) -> Poses:
        """The poses of a reconstruction."""
        height, width = self.views.images.shape[1:3]
        poses = poses_from_model(model, self.views, scale, (height, width), self.tuning)
        return replace(poses, readout=self.views.readout)
