"""Exposures found from frames alone: cycles from brightness, steps from static points.

    python benchmarks/exposure_cycles.py CLIP [CLIP ...]
    python benchmarks/exposure_cycles.py --steps WORK --data DATA [--scenes SCENE ...]
    python benchmarks/exposure_cycles.py --drift SCENE TRUTH [--drift SCENE TRUTH ...]

CLIP is a video or a folder of frames. For every clip the file holds the cycle that
`prepare` detects, and the share of short pieces in which the same cycle is detected.

With --steps, five clips of one exposure are prepared into WORK once: three rendered
scenes, and `hand_books` and `nv_balloon1` of the folder DATA. Their frames are recorded
again with other exposures, with and without noise, and `estimate_response` has to find
the steps between them, with no exposure given. So it has to between the photographs of
the brackets in DATA (tripod, true exposures by EXIF), and in the prepared scenes
--scenes of clips named like `pan_3exp_2stop.mp4`. Every line of the file holds the true
exposures (EV), those found and those measured before they were moved to usual steps,
the 95 % interval of the largest one, and the largest error of a step in EV.

With --drift, the exposure of every training frame of a prepared scene is compared with
the truth of its clip (`reexpose --exposure auto`), as lossless frames and as others:
errors of the EV relative to the mean of all, and the same at the best common factor.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from record import Record, make_parser, name_of
from sensitivity import FRAMES, RENDERED, RecordedClip, open_rendered, prepared, record_again

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_image
from hdr_nsff.footage.exposure_lists import read_exif_ev
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.prepare.steps.response import response_view
from hdr_nsff.prepare.work import Work
from hdr_nsff.radiometry.estimate_response import estimate_response
from hdr_nsff.radiometry.exposure_cycle import detect_cycle
from hdr_nsff.radiometry.recording import record, response_curve
from hdr_nsff.radiometry.static_samples import ResponseView
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.truth import Truth
from hdr_nsff.synth.settings import sensor_noise

MAX_SIDE_PX = 640  # of the frames; brightness needs no more
PIECE_FRAMES = (7, 9, 12, 20)  # lengths of the pieces
PIECE_STRIDE = 3  # frames from the start of one piece to the next
GAMMA = 2.2  # by which recorded clips are linearized
RESPONSE = "film"  # of the camera that records again
# exposures of a cycle, EV relative to the middle one of the clip
CYCLES = [(-s, 0.0, s) for s in (1.3, 1.5, 1.7, 2.0, 2.4)] + [(-1.7, 0.0, 1.3)]
NOISES = (1.0, 0.0)  # 1: a sensor of 6000 electrons
RECORDED = {
    "hand_books": RecordedClip("hand_books/images", (-1, 1, 3), stride=3, reexposed=True),
    "nv_balloon1": RecordedClip("nv_balloon1/images", (-1, 1, 3), reexposed=True),
}
SPACINGS = (1, 2)  # of the photographs that are taken from a bracket
BRACKET_SIZE_PX = 500
MEAN_RANGE = (0.04, 0.93)  # of photographs that show something
NOMINAL = re.compile(r"(\d)exp_(\d)stop")


def main() -> None:
    parser = make_parser(__doc__, "exposure_cycles")
    parser.add_argument("clips", type=Path, nargs="*", metavar="CLIP")
    parser.add_argument("--steps", type=Path, metavar="WORK", help="folder for prepared clips")
    parser.add_argument("--data", type=Path, help="folder of recorded clips and brackets")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], metavar="SCENE")
    parser.add_argument(
        "--drift", type=Path, nargs=2, action="append", default=[], metavar=("SCENE", "TRUTH")
    )
    args = parser.parse_args()
    if (args.steps is None) != (args.data is None):
        parser.error("--steps and --data belong together")
    record_of_run = Record("exposure_cycles", args, seed=0)
    for clip in args.clips:
        record_of_run.add({"clip": name_of(clip)} | measure(clip))
    for scene in args.scenes:
        record_of_run.add(measure_scene(scene))
    for scene, truth in args.drift:
        for lossless in (True, False):
            record_of_run.add(measure_drift(scene, Truth.open(truth), lossless))
    if args.data is not None:
        for folder in sorted((args.data / "brackets").iterdir()):
            for result in measure_bracket(folder):
                record_of_run.add(result)
        for name in (*RENDERED, *RECORDED):
            for result in measure_recorded_again(name, args.steps, args.data):
                record_of_run.add(result)
    record_of_run.save()


def measure(clip: Path) -> dict[str, Any]:
    """The cycle of the whole clip, and how often its pieces agree."""
    frames = read_frames(open_footage(clip), 0, None, 1, MAX_SIDE_PX)
    video = np.stack([frame.rgb for frame in frames])  # (T, H, W, 3)
    cycle = detect_cycle(video)
    agreeing = []
    for length in PIECE_FRAMES:
        for start in range(0, len(video) - length + 1, PIECE_STRIDE):
            piece = detect_cycle(video[start : start + length])
            agreeing.append(piece.length == cycle.length)
    return {
        "frames": len(video),
        "cycle": cycle.length,
        "dark_to_bright": list(cycle.order),
        "ev_at_gamma_2.2": [round(float(cycle.ev[bracket]), 2) for bracket in cycle.order],
        "confidence": round(float(cycle.confidence), 3),
        "pieces": len(agreeing),
        "pieces_with_this_cycle": sum(agreeing),
    }


# Steps between exposures


def measure_steps(
    views: list[ResponseView], true_ev: list[float], middle: int, lossless: bool = False
) -> dict[str, Any]:
    """The exposures that `estimate_response` finds where none is given, and how far
    off they are.
    """
    unknown = [None] * len(true_ev)
    cameras = [0] * len(views)
    found = estimate_response(views, cameras, unknown, middle, 1, lossless=lossless)
    true = np.array(true_ev) - true_ev[middle]
    steps, true_steps = np.diff(np.sort(found.ev)), np.diff(np.sort(true))
    span = float(np.ptp(found.ev))
    return {
        "true_ev": true.round(3).tolist(),
        "found_ev": found.ev.round(3).tolist(),
        "measured_ev": (found.ev * found.measured_scale).round(3).tolist(),
        "moved_stops": round(found.moved_stops, 3),
        "widest_true": round(float(np.ptp(true)), 3),
        "widest_interval": [round(span * found.scale_low, 3), round(span * found.scale_high, 3)],
        "source": found.source,
        "max_step_error": round(float(np.abs(steps - true_steps).max()), 3),
    }


def measure_scene(scene: Path) -> dict[str, Any]:
    """A prepared scene of a clip whose steps are in its name."""
    m = Manifest.load(scene)
    clip = work_on(scene, m)
    nominal = NOMINAL.search(m.source)
    if nominal is None:
        raise InputError(f"{scene}: no steps in the name of its footage ({m.source})")
    views = [response_view(clip, f) for f in clip.train]
    brackets = range(len(m.bracket_ev))
    brightness = [np.mean([v.image.mean() for v in views if v.bracket == b]) for b in brackets]
    rank = np.argsort(np.argsort(brightness))
    true = [float(k) * int(nominal[2]) for k in rank]
    return {"clip": name_of(scene)} | measure_steps(views, true, m.reference_bracket)


def work_on(scene: Path, manifest: Manifest) -> Work:
    """A prepared scene, without its footage."""
    images = scene / "images"
    return Work(PrepareConfig(images, scene), open_footage(images), manifest)


def measure_drift(scene: Path, truth: Truth, lossless: bool) -> dict[str, Any]:
    """The exposures of the frames of a prepared scene, against those of `reexpose`."""
    m = Manifest.load(scene)
    clip = work_on(scene, m)
    views = [response_view(clip, f) for f in clip.train]
    cameras = [0] * len(views)
    found = estimate_response(views, cameras, m.known_ev, m.reference_bracket, 1, lossless=lossless)
    drift = np.zeros(len(views)) if found.drift is None else found.drift
    exposures = np.array([found.ev[v.bracket] for v in views]) + drift
    assert truth.clip_drift is not None
    cycle = [0.0 if ev is None else ev for ev in truth.bracket_ev]
    true = [cycle[f.index % len(cycle)] + truth.clip_drift[f.index] for f in clip.train]
    exposures, true_exposures = exposures - exposures.mean(), np.array(true) - np.mean(true)
    factor = float(exposures @ true_exposures / max(exposures @ exposures, 1e-9))
    error = np.abs(exposures - true_exposures)
    error_at_best = np.abs(factor * exposures - true_exposures)
    return {
        "clip": name_of(scene),
        "lossless": lossless,
        "frames": len(views),
        "drift_found": found.drift is not None,
        "range_ev": round(float(np.ptp(true_exposures)), 2),
        "median_error": round(float(np.median(error)), 3),
        "error_95": round(float(np.quantile(error, 0.95)), 3),
        "best_factor": round(factor, 3),
        "factor_interval": [round(found.scale_low, 3), round(found.scale_high, 3)],
        "median_error_at_best_factor": round(float(np.median(error_at_best)), 3),
        "error_95_at_best_factor": round(float(np.quantile(error_at_best, 0.95)), 3),
    }


def measure_bracket(folder: Path) -> Iterator[dict[str, Any]]:
    """Photographs from a tripod, two and three at a time."""
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() == ".jpg")
    by_ev = sorted((read_exif_ev(f) or 0.0, f) for f in files)
    images = [shrink(read_image(f)) for _, f in by_ev]
    useful = [k for k, image in enumerate(images) if MEAN_RANGE[0] < image.mean() < MEAN_RANGE[1]]
    K, c2w = np.diag([BRACKET_SIZE_PX, BRACKET_SIZE_PX, 1.0]), np.eye(4)[:3]
    for count in (2, 3):
        for spacing in SPACINGS:
            chosen = useful[len(useful) % 2 :: spacing][:count]
            if len(chosen) < count:
                continue
            views = []
            for bracket, k in enumerate(chosen):
                disparity = np.ones(images[k].shape[:2], np.float32)
                views.append(ResponseView(images[k], bracket, float(bracket), K, c2w, disparity))
            true = [by_ev[k][0] for k in chosen]
            yield {"clip": folder.name} | measure_steps(views, true, 0)


def shrink(image: np.ndarray) -> np.ndarray:
    """A photograph (H, W, 3) at most `BRACKET_SIZE_PX` wide."""
    scale = min(1.0, BRACKET_SIZE_PX / image.shape[1])
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def measure_recorded_again(name: str, work: Path, data: Path) -> Iterator[dict[str, Any]]:
    """A clip of one exposure, recorded with all `CYCLES`."""
    scene = work / f"{name}_scene"
    if name in RENDERED:
        clip = open_rendered(name, work / f"{name}_clip", scene)
        assert clip.exact is not None
        prepared_clip, middle = clip.work, 0.0
        radiance = [frame["RGB"].astype(np.float64) for frame in clip.exact]
    else:
        source = RECORDED[name]
        frames = slice(0, FRAMES * source.stride, source.stride)
        footage = data / source.path
        again = record_again(source, footage, work / f"{name}_clip", frames)
        prepared_clip = prepared(PrepareConfig(again, scene, exposures="auto", hold_out=0))
        middle = float(np.median(source.ev))
        stored = read_frames(open_footage(footage), 0, frames.stop, frames.step, source.max_size)
        radiance = [frame.rgb.astype(np.float64) ** GAMMA for frame in stored]
    views = [response_view(prepared_clip, f) for f in prepared_clip.train]
    curve = response_curve(RESPONSE)
    for noise in NOISES:
        for cycle in CYCLES:
            again_views = []
            for k, view in enumerate(views):
                bracket = k % len(cycle)
                ev, rng = middle + cycle[bracket], np.random.default_rng([0, k])
                image = record(radiance[k], ev, (1, 1, 1), curve, sensor_noise(noise), rng)
                again_views.append(replace(view, image=image, bracket=bracket))
            found = measure_steps(again_views, list(cycle), 1, lossless=True)
            yield {"clip": name, "noise": noise} | found


if __name__ == "__main__":
    main()
