"""Measures a clip in seconds, on small frames, with the estimators that `prepare` uses:
the cycle by brightness, SIFT matches on equalized frames, rotations that explain them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from hdr_nsff.check.cameras import measure_cameras
from hdr_nsff.check.drift import drift_contradictions, measure_drift
from hdr_nsff.check.facts import CameraFacts, CameraMotion, ClipFacts, ExposureFacts
from hdr_nsff.check.file import describe_file
from hdr_nsff.check.given import GivenExposures, given_exposures
from hdr_nsff.check.lens import measure_lens
from hdr_nsff.check.picture_motion import affine_motions, measure_shake
from hdr_nsff.check.shutter import measure_readout
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import track
from hdr_nsff.core.stack import spread_frames
from hdr_nsff.footage.bars import with_bars
from hdr_nsff.footage.cuts import find_cuts
from hdr_nsff.footage.footage import Footage
from hdr_nsff.footage.frame_choice import check_frame_size
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.prepare.steps.footage import empty_frames
from hdr_nsff.priors.poses.estimate import PosesTuning, believed_share, shaken_poses
from hdr_nsff.priors.poses.matching import (
    Keypoints,
    PairMatches,
    detect_keypoints,
    match_pairs,
    view_pairs,
)
from hdr_nsff.priors.poses.rotation import fit_panorama, rotation_share
from hdr_nsff.priors.poses.still_camera import nearly_still_shifts, still_camera_shifts
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.dropped_frames import find_cycle

MIN_FRAMES = 3


@dataclass(frozen=True)
class CheckTuning:
    """Hand-chosen on the real clips that docs/shooting.md was tried on."""

    max_frames: int = 96  # looked at, from the start on
    max_size: int = 480  # pixels of the longest side
    low: float = 0.012  # recorded values beyond these are black and white, as for cycles
    high: float = 0.97
    min_points: int = 12  # of a pair, to look for bands
    # pixels between frames compared for bands: more motion looks like bands
    max_band_shift: float = 1.0
    edge_blur_px: float = 1.2  # keeps noise out of edges
    edge_share: float = 0.1  # of pixels: the strongest edges are compared
    min_band_cycles: int = 2  # of bands in a picture's height
    max_band_cycles: int = 24
    # share of the power of row changes in one frequency, above which they are bands
    min_band_power: float = 0.3


def measure_clip(
    footage: Footage, tuning: CheckTuning = CheckTuning()
) -> tuple[ClipFacts, np.ndarray, list[int]]:
    """The facts of a clip, its small frames (T, H, W, 3), and their brackets (T,).

    Of several cameras or tracks, the first is looked at, and the exposures of all.
    Where the picture cuts, the longest part between two cuts is measured.
    InputError for footage that cannot be read, and where all is black or white.
    """
    clip, footage = footage.path, with_bars(footage)
    frames = read_frames(footage, 0, tuning.max_frames, 1, tuning.max_size)
    total = min(footage.count or tuning.max_frames, tuning.max_frames)
    pictures = []
    for frame in track(frames, "frames", total):
        if frame.camera_id or frame.track:
            break
        pictures.append(frame.rgb)
    if len(pictures) < MIN_FRAMES:
        count = f"{len(pictures)} frame{'s' * (len(pictures) != 1)}"
        raise InputError(f"{clip}: {count} to look at; at least {MIN_FRAMES} are needed")
    video = np.stack(pictures)
    check_frame_size(clip, video.shape[2], video.shape[1])
    nothing = exposure.all_clipped([exposure.extent(picture) for picture in video])
    if nothing is not None:
        raise InputError(f"{clip}: all frames are {nothing}; check that it plays")
    file = describe_file(footage)
    given = given_exposures(footage, len(video))[0]
    empty, looked_at = empty_frames([exposure.extent(picture) for picture in video]), len(video)
    cycle, gaps = cycle_of(given, video)
    cuts = find_cuts(exposure.equalize(video, cycle.brackets)[0])
    first, end = max(pairwise([0, *cuts, looked_at]), key=lambda part: part[1] - part[0])
    if cuts:
        video = video[first:end]
        given = None if given is None else replace(given, ev=given.ev[first:end])
        cycle, gaps = cycle_of(given, video)
    equalized, clipped = exposure.equalize(video, cycle.brackets)
    keypoints = detect_keypoints(equalized, clipped)
    following = match_pairs(keypoints, [(t, t + 1) for t in range(len(video) - 1)])
    scale = max(file.width, file.height) / max(video.shape[1:3])
    facts = ClipFacts(
        file=file,
        looked_at=looked_at,
        measured=(first, end),
        exposure=replace(
            measure_exposure(given, video, cycle, keypoints, tuning),
            missing_before=tuple(first + gap for gap in gaps),
            empty=empty,
        ),
        camera=replace(
            measure_camera(equalized, clipped, cycle, keypoints, following, scale, tuning),
            cuts=tuple(cuts),
        ),
        each_camera=measure_cameras(footage, tuning.max_size, tuning.low, tuning.high),
    )
    return facts, video, cycle.brackets


# Exposure


def cycle_of(
    given: GivenExposures | None, video: np.ndarray
) -> tuple[exposure.Cycle, tuple[int, ...]]:
    """The cycle of `given` exposures, else of brightness, and the frames before which
    it skips some.
    """
    if given is not None:
        return given.cycle()
    gapped = find_cycle(exposure.brightness_steps(video), np.ones(len(video) - 1, int))
    return gapped.cycle, gapped.gaps


def measure_exposure(
    given: GivenExposures | None,
    video: np.ndarray,
    cycle: exposure.Cycle,
    keypoints: list[Keypoints],
    tuning: CheckTuning,
) -> ExposureFacts:
    """Exposures of the recorded `video` (T, H, W, 3), and what they clip."""
    brackets = np.array(cycle.brackets)
    white = (video > tuning.high).any(-1).mean((1, 2))  # (T,)
    black = (video < tuning.low).all(-1).mean((1, 2))
    steps = exposure.brightness_steps(video)
    count = len(cycle.ev)

    drift = measure_drift(video, cycle, keypoints)
    contradictions = []
    if given is not None:
        contradictions = exposure.contradictions(video, given.ev)
        contradictions += drift_contradictions(drift, given.ev)

    def per_bracket(shares: np.ndarray) -> tuple[float, ...]:
        return tuple(round(float(shares[brackets == b].mean()), 4) for b in range(count))

    return ExposureFacts(
        cycle=cycle.length,
        ev=tuple(round(value, 2) for value in cycle.ev),
        explained=round(cycle.confidence, 3),
        given=None if given is None else given.source,
        given_drift_ev=0.0 if given is None else round(given.drift(), 2),
        contradictions=tuple(contradictions),
        change_ev=round(float(np.abs(steps).mean()), 3),
        drift_ev=round(drift.exposure_ev, 2),
        color_drift_ev=round(drift.color_ev, 2),
        white_share=per_bracket(white),
        black_share=per_bracket(black),
        banding_ev=round(measure_banding(video, keypoints, cycle.length, tuning), 3),
    )


def measure_banding(
    video: np.ndarray, keypoints: list[Keypoints], cycle: int, tuning: CheckTuning
) -> float:
    """The amplitude in EV of bands across the picture that change from frame to frame.

    Lamps on mains flicker, and a rolling shutter draws that as bands. Frames of equal
    exposure are compared row by row.
    """
    amplitudes = []
    pairs = [(t, t + cycle) for t in range(len(video) - cycle)]
    for pair in match_pairs(keypoints, pairs):
        shift = np.linalg.norm(pair.q - pair.p, axis=1)
        if len(shift) < tuning.min_points or np.median(shift) > tuning.max_band_shift:
            continue
        before, after = (np.maximum(video[k].mean(-1), 1e-4) for k in (pair.i, pair.j))
        low, high = np.minimum(before, after), np.maximum(before, after)
        use = (low > 4 * tuning.low) & (high < tuning.high)
        ratio = np.where(use, exposure.GAMMA * np.log2(after / before), np.nan)
        rows = use.mean(1) > 0.2
        if rows.mean() < 0.7:
            continue
        profile = np.zeros(len(ratio))
        profile[rows] = np.nanmedian(ratio[rows], axis=1)
        position = np.arange(len(profile))
        profile = np.interp(position, position[rows], profile[rows])
        profile -= np.polyval(np.polyfit(position, profile, 3), position)
        power = np.abs(np.fft.rfft(profile * np.hanning(len(profile)))) ** 2
        peak = int(power[: tuning.max_band_cycles + 1].argmax())
        near = power[max(peak - 1, 0) : peak + 2].sum() / max(power.sum(), 1e-12)
        periodic = peak >= tuning.min_band_cycles and near > tuning.min_band_power
        amplitudes.append(np.sqrt(2) * float(profile.std()) if periodic else 0.0)
    return float(np.median(amplitudes)) if amplitudes else 0.0


# Camera


def measure_camera(
    equalized: np.ndarray,
    clipped: np.ndarray,
    cycle: exposure.Cycle,
    keypoints: list[Keypoints],
    following: list[PairMatches],
    scale: float,
    tuning: CheckTuning,
) -> CameraFacts:
    """What the camera does, from frames at one brightness (T, H, W, 3).

    `scale` is the pixels of the clip per pixel of these.
    """
    motion, share = find_motion(equalized, clipped, keypoints)
    shifts = [np.linalg.norm(pair.q - pair.p, axis=1) for pair in following if len(pair.p)]
    per_frame = float(np.median(np.concatenate(shifts))) if shifts else 0.0
    lens = None
    # with so little parallax `prepare` looks for no lens either: mapping would take
    # minutes and fail
    enough = share is None or share < PosesTuning().no_lens_share
    if motion == "parallax" and enough:
        lens = measure_lens(equalized, clipped, scale)
    height, width = equalized.shape[1:3]
    shake = measure_shake(affine_motions(following, (height, width)))
    readout = None
    if motion != "tripod":
        readout = measure_readout(following, (height, width), portrait=height > width)
    return CameraFacts(
        motion=motion,
        rotation_share=None if share is None else round(share, 3),
        pixels_per_frame=round(scale * per_frame, 2),
        long_sharpness=compare_sharpness(equalized, clipped, cycle, tuning),
        lens=lens,
        readout=None if readout is None else (round(readout[0], 3), round(readout[1], 3)),
        shake=None if shake is None else (round(scale * shake[0], 3), round(scale * shake[1], 3)),
    )


def find_motion(
    equalized: np.ndarray, clipped: np.ndarray, keypoints: list[Keypoints]
) -> tuple[CameraMotion, float | None]:
    """What the camera does, and the share of static matches that rotations explain.

    As `prepare` decides it, on frames spread over the clip; the share is None where
    matches did not decide it.
    """
    tuning = PosesTuning()
    if still_camera_shifts(equalized, clipped, tuning.still) is not None:
        return "tripod", None
    matching, rotation = tuning.reconstruction.matching, tuning.reconstruction.rotation
    chosen = spread_frames(len(equalized), tuning.reconstruction.max_sampled_frames)
    pairs = view_pairs([list(range(len(chosen)))], matching)
    matches = match_pairs([keypoints[t] for t in chosen], pairs, matching)
    height, width = equalized.shape[1:3]
    panorama = fit_panorama(matches, len(chosen), width, height, rotation)
    share = believed = None
    if panorama is not None:
        share = rotation_share(matches, panorama, width, height, rotation)
        believed = believed_share(panorama, share, tuning)
    enough = believed is not None and believed >= tuning.min_rotation_share
    if panorama is not None and enough:
        still = panorama.max_displacement < rotation.max_tripod_motion_px
        return ("tripod" if still else "rotation"), share
    shaken = shaken_poses(equalized, clipped, clipped, tuning)
    if shaken is not None:
        return ("tripod" if shaken.parallax == "none" else "rotation"), None
    if share is not None:
        return "parallax", share
    hardly_shifts = nearly_still_shifts(equalized, clipped, tuning.still) is not None
    return ("tripod" if hardly_shifts else "unknown"), None


def compare_sharpness(
    equalized: np.ndarray, clipped: np.ndarray, cycle: exposure.Cycle, tuning: CheckTuning
) -> float | None:
    """Edges of the brightest bracket relative to those of the darkest beside it, in the
    direction that lost most.

    None without alternation, or where the two share too little of the picture.
    """
    if cycle.length == 1:
        return None
    darkest, brightest = cycle.order[0], cycle.order[-1]
    brackets = cycle.brackets
    edges = [edge_strengths(picture, tuning) for picture in equalized]
    ratios = []
    for t, bracket in enumerate(brackets):
        if bracket != brightest:
            continue
        for s in range(max(t - cycle.length + 1, 0), min(t + cycle.length, len(brackets))):
            if brackets[s] != darkest:
                continue
            use = ~(grow(clipped[t]) | grow(clipped[s]))
            if use.mean() >= tuning.edge_share:
                ratios.append(
                    [edge_ratio(edges[t][k][use], edges[s][k][use], tuning) for k in (0, 1)]
                )
    return round(float(np.median(ratios, axis=0).min()), 3) if ratios else None


def edge_ratio(long: np.ndarray, short: np.ndarray, tuning: CheckTuning) -> float:
    """Strength of edges (P,) relative to those of another picture."""
    mean = long + short
    strong = mean > np.quantile(mean, 1 - tuning.edge_share)
    return float(long[strong].sum() / max(short[strong].sum(), 1e-9))


def grow(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) grown by the reach of edges."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0


def edge_strengths(picture: np.ndarray, tuning: CheckTuning) -> tuple[np.ndarray, np.ndarray]:
    """Strength (H, W) of upright and of level edges of a smoothed picture.

    Motion along a row blurs the upright ones alone.
    """
    gray = cv2.GaussianBlur(picture.mean(-1), (0, 0), tuning.edge_blur_px)
    upright = np.abs(cv2.Sobel(gray, cv2.CV_32F, 1, 0))
    return upright, np.abs(cv2.Sobel(gray, cv2.CV_32F, 0, 1))
