"""The lens of a clip: whether structure from motion shows that it bends straight lines,
and by how much.

A reconstruction with a pinhole camera is adjusted once more with radial distortion k1,
k2 (COLMAP's RADIAL). Where that lowers the reprojection error clearly and moves the
corners visibly, its poses start another one with such a camera, whose lens is found; k2
only where k1 alone serves worse. Otherwise the clip is that of a pinhole camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from hdr_nsff.footage.colmap import ColmapModel
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.pinhole import intrinsics
from hdr_nsff.priors.poses.rotation import field_of_view
from hdr_nsff.priors.poses.sfm import LENS_FILE, Job, LensFit, parse_lens_fit
from hdr_nsff.priors.poses.view_matches import EarlierRounds

# auto: estimated where the clip shows it; none: a pinhole; (k1, k2): given
LensChoice = Literal["auto", "none"] | tuple[float, float]


@dataclass(frozen=True)
class LensTuning:
    """When a lens counts as found."""

    # by which a corner of a frame moves: below it, a pinhole serves as well
    min_displacement_px: float = 1.0
    # mean reprojection error with one more coefficient over that without it: 0.9998 and
    # more on seven rendered pinhole clips, 0.9968 on photographs of lenses that nobody
    # states; with 5 pixels 0.961, and 0.9945 where the camera walks forward
    max_error_share: float = 0.996
    # median error of the model that is mapped with the lens over that of the pinhole's
    # (with a false lens, before a flight straight ahead: 1.10)
    max_model_error_share: float = 1.02
    # a longer lens bends little, and behind it what bends and what is farther away look
    # alike
    min_fov_degrees: float = 25.0


@dataclass(frozen=True)
class Mapping:
    """Which lens the views are mapped with."""

    distortion: tuple[float, float] | None = None  # k1, k2 to start from; None: a pinhole
    focal: float | None = None  # to start from, pixels of the images; None: a common one
    refine: bool = False  # or held
    try_lens: bool = False  # fit one to the pinhole model afterwards

    def apply_to(self, job: Job) -> Job:
        """The job with its images mapped with this lens."""
        return replace(
            job,
            focal=self.focal or job.focal,
            distortion=list(self.distortion or ()),
            refine_distortion=self.refine,
            try_lens=self.try_lens,
        )


PINHOLE = Mapping()


def lens_fit(earlier: EarlierRounds) -> LensFit | None:
    """The lens fit to the model of the last round; None where none was tried."""
    content = earlier.model.get(LENS_FILE)
    return None if content is None else parse_lens_fit(content)


def shows_lens(fit: LensFit, tuning: LensTuning = LensTuning()) -> bool:
    """Whether a lens explains a reconstruction clearly better than a pinhole does."""
    return fit.error_px <= tuning.max_error_share * fit.model_error_px


def bent_cameras(
    fit: LensFit, model: ColmapModel, scale: int, tuning: LensTuning = LensTuning()
) -> list[Mapping]:
    """The lenses of cameras that bend their pictures, to map with, the strongest first;
    empty where the reconstruction shows none.

    `scale`: how many times larger the images of the reconstruction are than the frames.
    """
    if not shows_lens(fit, tuning):
        return []
    found = []
    for key, (focal, k1, k2) in fit.cameras.items():
        camera = model.cameras[key]
        K = intrinsics(focal, camera.width, camera.height)
        lens = Lens(K, (k1, k2, 0.0, 0.0), camera.width, camera.height)
        displacement = lens.max_displacement_px() / scale
        fov = field_of_view(camera.K[0, 0], camera.width, camera.height)
        bends = lens.is_one_to_one() and displacement >= tuning.min_displacement_px
        if bends and fov >= tuning.min_fov_degrees:
            found.append((displacement, Mapping((k1, k2), focal, refine=True, try_lens=True)))
    return [mapping for _, mapping in sorted(found, key=lambda item: -item[0])]


def lens_of(
    model: ColmapModel,
    camera_id: int,
    fit: LensFit | None,
    tuning: LensTuning = LensTuning(),
) -> Lens:
    """The lens of a camera of a reconstruction, for its images.

    Without its k2 where k1 alone, the `fit`, serves as well.
    """
    if fit is not None and tuning.max_error_share * fit.error_px < fit.model_error_px:
        return fitted_lens(fit, model, camera_id)
    camera = model.cameras[camera_id]
    k1, k2 = (float(k) for k in camera.distortion[:2])
    return Lens(camera.K, (k1, k2, 0.0, 0.0), camera.width, camera.height)


def fitted_lens(fit: LensFit, model: ColmapModel, camera_id: int) -> Lens:
    """The lens that was fit to a camera of a reconstruction, for its images."""
    camera = model.cameras[camera_id]
    focal, k1, k2 = fit.cameras[camera_id]
    K = intrinsics(focal, camera.width, camera.height)
    return Lens(K, (k1, k2, 0.0, 0.0), camera.width, camera.height)
