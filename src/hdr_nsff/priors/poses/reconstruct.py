"""Structure from motion on the views of a clip.

pycolmap maps the views (`sfm.py`) incrementally, from the focal length of a usual lens
and of a long one, then globally, with and without leveled contrast, until enough of
them register with a focal length that a lens can have. Where the first way fails, the
others are tried side by side. Where they register, but with one that no lens has, or
fit badly, as before a camera that flies straight ahead, every way is tried, and the one
that fits best is taken.
"""

from __future__ import annotations

import shutil
import tempfile
import zlib
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core.errors import InputError, NoSceneError
from hdr_nsff.core.images import encode
from hdr_nsff.core.process import usable_cores
from hdr_nsff.core.progress import say
from hdr_nsff.core.stack import ArrayStack, Stack, spread_frames
from hdr_nsff.core.tensors import CPU
from hdr_nsff.footage.colmap import ColmapModel, read_model, views_of_images
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.poses import ADVICE, MIN_REGISTERED_SHARE, RIG_ADVICE, format_ranges
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.lens import PINHOLE, LensTuning, Mapping
from hdr_nsff.priors.poses.lightglue import LightGlueTuning, Matcher, match_images, upsample
from hdr_nsff.priors.poses.matching import (
    MatchingTuning,
    keypoint_mask,
    sift_image,
    upsampling_factor,
)
from hdr_nsff.priors.poses.rolling_shutter import at_middle_rows
from hdr_nsff.priors.poses.rotation import (
    RotationTuning,
    default_focal,
    field_of_view,
    fit_video,
    focal_length,
)
from hdr_nsff.priors.poses.view_matches import (
    EarlierRounds,
    KeyframeTuning,
    ViewMatches,
    choose_keyframes,
    pairs_to_match,
)
from hdr_nsff.priors.poses.visit_matches import VisitImages, VisitTuning, match_visits


@dataclass(frozen=True)
class ReconstructionTuning:
    """When a reconstruction is good enough, and which of its points are kept.

    Hand-chosen on rendered clips if no other origin is given.
    """

    # across the longer side: what undistorted video cameras plausibly see
    min_fov_degrees: float = 10.0
    max_fov_degrees: float = 100.0
    # of a lens that was found to bend strongly, as wide ones do (a GoPro's: 104)
    max_fov_degrees_bent: float = 120.0
    strong_bend: float = 0.02  # of the longer side, at the corners (that clip: 0.1)
    # the other first guess of a focal length: from the usual one, 60 degrees, mapping
    # does not find a lens of 20 (from 30 it does)
    long_lens_fov_degrees: float = 24.0
    enough_registered: float = 0.9  # share of the views that ends the search for a model
    # median error of points, pixels of the images, beyond which a model is in doubt:
    # wrong focal lengths of a flight straight ahead have 0.62 to 0.67, a likely one
    # 0.41 (the first models of six other clips have 0.47 at most in the mean)
    max_good_error_px: float = 0.55
    max_attempts: int = 8  # mappings before the search ends
    min_registered: float = MIN_REGISTERED_SHARE  # share of the views below which poses have failed
    min_track_views: int = 3  # of a point that is kept
    min_points: int = 10
    # near and far: these percentiles of the points' depths, times these factors
    near_percentile: float = 1.0
    far_percentile: float = 99.0
    near_factor: float = 0.7
    far_factor: float = 1.3
    # frames, spread over the clip, that decide whether a camera stands still or has
    # parallax
    max_sampled_frames: int = 24
    matching: MatchingTuning = field(default_factory=MatchingTuning)
    rotation: RotationTuning = field(default_factory=RotationTuning)
    keyframes: KeyframeTuning = field(default_factory=KeyframeTuning)
    lightglue: LightGlueTuning = field(default_factory=LightGlueTuning)
    lens: LensTuning = field(default_factory=LensTuning)
    visits: VisitTuning = field(default_factory=VisitTuning)
    sfm: sfm.SfmTuning = field(default_factory=sfm.SfmTuning)


@dataclass(frozen=True)
class SfmViews:
    """The images to map: one per frame, but a single one for all frames of a camera
    that stands still.
    """

    images: ArrayStack  # (V, H, W, 3) equalized rgb in [0, 1]
    ignore: np.ndarray  # (V, H, W) bool
    groups: list[list[int]]  # views of each physical camera
    of_frame: np.ndarray  # (T,) the view of each frame
    visits: VisitImages | None = None  # of a rig: what is matched instead of the images
    readout: float = 0.0  # of a rolling shutter, from the first row to the last, in frames


def sfm_views(
    video: ArrayStack,
    ignore: np.ndarray,
    groups: list[list[int]],
    tuning: ReconstructionTuning = ReconstructionTuning(),
    readout: float = 0.0,
) -> SfmViews:
    """One view per frame; of a rig's cameras that stand still, one view per camera.

    That view is the median of the camera's frames, free of most movers. `video` (T, H,
    W, 3) in [0, 1], `ignore` (T, H, W) bool; `groups`: frames of each camera;
    `readout` of the rolling shutter, in frames.
    """
    if len(groups) == 1:
        return SfmViews(video, ignore, groups, np.arange(len(video)), readout=readout)
    medians: dict[int, np.ndarray] = {}
    frame_of: list[int] = []
    hidden: list[np.ndarray] = []
    view_groups: list[list[int]] = []
    of_frame = np.zeros(len(video), int)
    for group in groups:
        first = len(frame_of)
        sampled = [group[k] for k in spread_frames(len(group), tuning.max_sampled_frames)]
        if stands_still(video[sampled], ignore[sampled], tuning):
            medians[first] = median_image(np.asarray(video[sampled]), ignore[sampled])
            frame_of.append(group[0])
            hidden.append(np.all(ignore[sampled], axis=0))
            of_frame[group] = first
        else:
            frame_of += group
            hidden += [ignore[t] for t in group]
            of_frame[group] = first + np.arange(len(group))
        view_groups.append(list(range(first, len(frame_of))))

    def image(view: int) -> np.ndarray:
        return medians[view] if view in medians else video[frame_of[view]]

    images = Stack(image, (len(frame_of), *video.shape[1:]))
    return SfmViews(images, np.stack(hidden), view_groups, of_frame, readout=readout)


def stands_still(video: ArrayStack, ignore: np.ndarray, tuning: ReconstructionTuning) -> bool:
    """Whether the frames (T, H, W, 3) of a camera are those of a tripod; `ignore` (T,
    H, W) bool.
    """
    if len(video) < 2:
        return False
    panorama = fit_video(video, ignore, tuning.matching, tuning.rotation)
    if panorama is None or panorama.explained <= tuning.rotation.min_explained:
        return False
    return panorama.max_displacement < tuning.rotation.max_tripod_motion_px


def median_image(video: np.ndarray, ignore: np.ndarray) -> np.ndarray:
    """The median (H, W, 3) of the frames (T, H, W, 3) at every pixel over the times
    that `ignore` (T, H, W) leaves free, or over all times where it leaves none.
    """
    never_free = ignore.all(0)
    left_out = ignore & ~never_free
    return np.nanmedian(np.where(left_out[..., None], np.nan, video), 0)


def best_model(
    views: SfmViews,
    workdir: Path,
    threads: int,
    matcher: Matcher,
    tuning: ReconstructionTuning = ReconstructionTuning(),
    device: torch.device = CPU,
    earlier: EarlierRounds | None = None,
    mapping: Mapping = PINHOLE,
) -> tuple[ColmapModel, int]:
    """The best reconstruction of the views, and how many times larger than the views
    its images were. A learned `matcher` runs on `device`. NoSceneError where no
    reconstruction is good enough, InputError where the memory did not suffice.
    `mapping` is the lens to map with.

    Matches and poses of `earlier` rounds, on the same views with other pixels ignored,
    are used again; this round's are added in place.
    """
    search = Search(len(views.images), tuning)
    scale = upsampling_factor(views.images.shape[1:3], tuning.matching)
    tries_left = tuning.max_attempts
    longer_side = scale * max(views.images.shape[1:3])
    long_focal = focal_length(tuning.long_lens_fov_degrees, longer_side)
    at_once = threads or usable_cores()
    for leftover in workdir.glob(".sfm-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    workdir.mkdir(parents=True, exist_ok=True)
    earlier = earlier or EarlierRounds()
    # learned keypoints work in color, and leveling the contrast gains nothing for them
    contrasts = {"leveled": True, "plain": False} if matcher == "sift" else {"plain": False}
    for contrast, level_contrast in contrasts.items():
        if not tries_left:
            break
        with ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix=".sfm-", dir=workdir))
            try:
                job = write_job(
                    Path(folder), views, scale, level_contrast, threads, matcher, earlier,
                    tuning, device,
                )  # fmt: skip
                job = mapping.apply_to(job)
            except sfm.SfmError as error:
                search.failures.append(str(error))
                continue
            tries = attempts(job, earlier, long_focal)[:tries_left]
            results = stack.enter_context(closing(sfm.run_in_turn(tries, at_once)))
            for attempt, folders in zip(tries, results, strict=True):
                tries_left -= 1
                search.add(folders)
                if search.is_over:
                    break
                say(
                    f"poses: {attempt.task} mapping ({contrast} contrast): "
                    f"{search.num_registered} of {search.count} views registered at best so far"
                )
            if search.good:
                model, files = search.chosen()
                earlier.model = {p.name: p.read_bytes() for p in files.iterdir()}
                return model, scale
    best = search.best
    least = tuning.min_registered * search.count
    if best is None or len(best.images) < least or not has_plausible_lens(best, tuning):
        killed = best is None and sfm.KILLED in search.failures  # the machine's fault
        kind = InputError if killed else NoSceneError
        raise kind(failure_message(best, views, search.failures, tuning))
    return best, scale


@dataclass
class Search:
    """What the ways to map `count` views have come to so far."""

    count: int
    tuning: ReconstructionTuning
    best: ColmapModel | None = None
    good: list[tuple[ColmapModel, Path]] = field(default_factory=list)  # with their files
    in_doubt: bool = False  # enough views register, but no camera is like that
    failures: list[str] = field(default_factory=list)

    @property
    def is_over(self) -> bool:
        """Whether no other way needs to be tried."""
        return bool(self.good) and not self.in_doubt

    @property
    def num_registered(self) -> int:
        """The number of views in the best model."""
        return 0 if self.best is None else len(self.best.images)

    def add(self, folders: list[Path] | sfm.SfmError) -> None:
        """The models in the `folders` of one way, or why it failed."""
        if isinstance(folders, sfm.SfmError):
            self.failures.append(str(folders))
            return
        for folder in folders:
            model = read_model(folder)
            rank = self.rank(model)
            if self.best is None or rank > self.rank(self.best):
                self.best = model
            plausible, enough = rank[:2]
            if plausible and enough:
                self.good.append((model, folder))
            fits = median_error(model, self.tuning) <= self.tuning.max_good_error_px
            self.in_doubt |= enough and not (plausible and fits)

    def rank(self, model: ColmapModel) -> tuple[bool, bool, int, int]:
        """The order of models."""
        return model_rank(model, self.count, self.tuning)

    def chosen(self) -> tuple[ColmapModel, Path]:
        """The good model whose points fit best."""
        return min(self.good, key=lambda found: median_error(found[0], self.tuning))


def attempts(job: sfm.Job, earlier: EarlierRounds, long_focal: float) -> list[sfm.Job]:
    """The ways to map the views of a job, in the order in which they are tried: from
    the poses of earlier rounds, from keyframes, all at once, from the focal length of a
    long lens (pixels of the images), with it held, and globally.
    """
    tasks = []
    if earlier.model:
        start = Path(job.folder) / "start"
        start.mkdir(exist_ok=True)
        for name, content in earlier.model.items():
            (start / name).write_bytes(content)
        tasks.append(replace(job, task="adjust", start=str(start), keyframes=[]))
    if job.keyframes:
        tasks.append(replace(job, task="incremental"))
    tasks.append(replace(job, task="incremental", keyframes=[]))
    if not job.distortion:  # long lenses do not bend
        long = replace(job, task="incremental", focal=long_focal)
        tasks += [long, replace(long, refine_focal=False)]
    return [*tasks, replace(job, task="global", keyframes=[])]


def write_job(
    folder: Path,
    views: SfmViews,
    scale: int,
    level_contrast: bool,
    threads: int,
    matcher: Matcher,
    earlier: EarlierRounds,
    tuning: ReconstructionTuning = ReconstructionTuning(),
    device: torch.device = CPU,
) -> sfm.Job:
    """Write the images of the views and their matches outside the masks into a
    `folder`; the job that maps them. Matches of `earlier` rounds are not found again.
    """
    names = [f"{v:05d}.png" for v in range(len(views.images))]
    grays = []
    for name, image in zip(names, views.images, strict=True):
        gray = sift_image(image, scale, level_contrast, tuning.matching)
        encode(folder / "images" / name, gray)
        grays.append(zlib.crc32(gray.tobytes()))
    keyframes = choose_keyframes(views.groups, tuning.keyframes)
    pairs = pairs_to_match(views.groups, keyframes, tuning.matching, tuning.keyframes)
    named_pairs = [(names[a], names[b]) for a, b in pairs]
    job = sfm.Job(
        folder=str(folder),
        groups=[[names[v] for v in group] for group in views.groups],
        pairs=named_pairs,
        focal=default_focal(max(views.images.shape[1:3]), tuning.rotation) * scale,
        task="match",
        threads=threads,
        keyframes=[names[v] for v in keyframes],
        tuning=tuning.sfm,
    )
    if views.visits is not None:
        tunings = tuning.matching, tuning.lightglue, tuning.visits
        merged = match_visits(job, views.visits, level_contrast, matcher, device, *tunings)
        named_pairs = [(names[a], names[b]) for a, b in merged.pairs]
        sfm.write_matches(folder, names, merged.keypoints, named_pairs, merged.matches)
        return replace(job, pairs=named_pairs)
    key = (f"{matcher} {level_contrast}", tuple(grays))
    found = earlier.matches.get(key)
    if found is None:
        if matcher == "sift":
            sfm.run_worker(job)
            keypoints, matches = sfm.read_matches(folder, names, named_pairs)
        else:
            images = [upsample(image, scale) for image in views.images]
            everywhere = [np.ones(image.shape[:2], np.uint8) for image in images]
            keypoints, matches = match_images(
                images, everywhere, pairs, matcher, tuning.lightglue, device
            )
        found = earlier.matches[key] = ViewMatches(keypoints, pairs, matches)
    masks = [keypoint_mask(i, scale, tuning.matching.mask_margin_px) for i in views.ignore]
    static = found.outside(masks)
    if views.readout:
        height = scale * views.images.shape[1]
        static = at_middle_rows(static, views.groups, views.readout, height)
    sfm.write_matches(folder, names, static.keypoints, named_pairs, static.matches)
    return job


def tuning_for_lenses(
    lenses: Sequence[Lens], tuning: ReconstructionTuning = ReconstructionTuning()
) -> ReconstructionTuning:
    """The tuning for frames that were undistorted by `lenses`; none: a pinhole's."""
    bends = [lens.max_displacement_px() / max(lens.width, lens.height) for lens in lenses]
    if not bends or min(bends) < tuning.strong_bend:
        return tuning
    return replace(tuning, max_fov_degrees=tuning.max_fov_degrees_bent)


def has_plausible_lens(
    model: ColmapModel, tuning: ReconstructionTuning = ReconstructionTuning()
) -> bool:
    """Whether the focal lengths are those of real lenses, which see more where they
    bend strongly.
    """
    for camera in model.cameras.values():
        k1, k2 = np.append(camera.distortion, [0.0, 0.0])[:2].tolist()
        lens = Lens(camera.K, (k1, k2, 0.0, 0.0), camera.width, camera.height)
        own = tuning_for_lenses([lens], tuning) if lens.is_one_to_one() else tuning
        fov = field_of_view(camera.K[0, 0], camera.width, camera.height)
        if not own.min_fov_degrees <= fov <= own.max_fov_degrees:
            return False
    return True


def model_rank(
    model: ColmapModel, count: int, tuning: ReconstructionTuning = ReconstructionTuning()
) -> tuple[bool, bool, int, int]:
    """The order of reconstructions of `count` views, the best one highest: a plausible
    lens, enough images, then more images, then more long tracks.
    """
    num_images = len(model.images)
    num_tracks = int((model.track_lengths >= tuning.min_track_views).sum())
    enough = num_images >= tuning.enough_registered * count
    return has_plausible_lens(model, tuning), enough, num_images, num_tracks


def median_error(
    model: ColmapModel, tuning: ReconstructionTuning = ReconstructionTuning()
) -> float:
    """The median reprojection error of the points with long tracks, in pixels."""
    errors = model.errors[model.track_lengths >= tuning.min_track_views]
    return float(np.median(errors)) if len(errors) else np.inf


def failure_message(
    model: ColmapModel | None,
    views: SfmViews,
    failures: list[str],
    tuning: ReconstructionTuning = ReconstructionTuning(),
) -> str:
    """Why there are no poses, for which frames, and what to do."""
    count, (height, width) = len(views.of_frame), views.images.shape[1:3]
    advice = ADVICE if len(views.groups) == 1 else RIG_ADVICE
    if model is None:
        reason = "no two frames could be matched (no common texture seen from two places)"
        if sfm.KILLED in failures:
            reason, advice = sfm.KILLED, "give a smaller --max-size, or fewer frames (--stride)"
        elif failures:
            reason += f"; the last error was: {failures[-1]}"
        return f"poses failed: {reason}; {advice}"
    registered = views_of_images(model)
    missing = [t for t in range(count) if int(views.of_frame[t]) not in registered]
    if len(missing) <= (1 - tuning.min_registered) * count:
        scale = upsampling_factor((height, width), tuning.matching)
        focal = next(iter(model.cameras.values())).K[0, 0] / scale
        return (
            f"poses failed: the estimated focal length of {focal:.0f} px is impossible "
            f"for frames of {width}x{height}; {advice}"
        )
    return (
        f"poses failed: {len(missing)} of {count} frames could not be registered "
        f"(frames {format_ranges(missing)}); {advice}"
    )
