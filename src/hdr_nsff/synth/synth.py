"""`hdr-nsff synth`: a path-traced scene as alternating-exposure footage, with held-out
truth that only `evaluate` reads.

Writes, below the output folder:

- `clip.mp4`, `clip/*.png`: what the camera recorded, the same frames as footage and
  without compression loss
- `clip.csv`, `clip/exposures.csv`: of a rig, the exposure of every frame, for `prepare`
- `truth/`: views and times that the clip does not show, with linear radiance, moving
  masks, depth and motion (see `scene/truth.py`)
- `exact/*.exr`: every rendered picture, with radiance, z-depth `Z`, `body` (0 for
  static, k for the scene's k-th mover) and exact optical flow
- `oracle/`: with `--oracle`, a scene folder made from the truth, to measure a field
  without estimated priors

Every picture is cached in `exact/`: a killed run continues with the next one.

`--views mono` is one moving camera. `--views rig` is nine synchronized static ones, and
the clip goes around them: frame i is what camera i modulo nine records at time i. They
are of one make and share one response, so the clip is prepared and trained on as that
of one camera (`camera_id` 0), whose neighbor in time stands beside it.
"""

from __future__ import annotations

import hashlib
import json
import time as clock
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS, REC709, read_exr, write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import holds_nothing, write_json, write_text, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.video import DEFAULT_FPS, write_video
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.lens import Lens, distorted_picture
from hdr_nsff.maths import color
from hdr_nsff.radiometry.hdr_references import (
    ReferenceKinds,
    check_references,
    write_references,
)
from hdr_nsff.radiometry.recording import light_share, record, response_curve
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.synth.motion import UV, exact_flow, view_geometry
from hdr_nsff.synth.oracle import OracleNoise, remove_stale, write_oracle
from hdr_nsff.synth.pathtracer import PASS_SPP, Surface, Tracer
from hdr_nsff.synth.scenes import SCENES
from hdr_nsff.synth.scenes.base import SynthScene, Views
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.settings import (
    LENS_FINENESS,
    LENS_MARGIN,
    SynthConfig,
    check,
    parse_ev,
    parse_lens,
    parse_size,
    parse_white_balance,
    sensor_noise,
)
from hdr_nsff.synth.shutter import BANDS, exposures, trace_exposure
from hdr_nsff.synth.views import TracedView, clip_views, held_out_views

__all__ = ["SynthConfig", "synth"]

NOT_OF_THE_SCENE = ("out", "variant", "hdr_video", "hdr_codec", "hdr_still")  # settings
VIDEO_FPS = DEFAULT_FPS  # of all videos
LENS_PREFIX = "lens"  # of their names
VIDEO_CRF = 4  # an error of 1.4 levels, below the recording's own noise
SEEN = ("seen.red", "seen.green", "seen.blue")  # radiance through the shutter
TRACED_HEADER = {"chromaticities": REC709}  # Mitsuba's rgb variants are linear Rec. 709


def synth(config: SynthConfig) -> None:
    """Render, record and write everything; InputError where the settings or the output
    folder make no sense.
    """
    scene = SCENES[config.name]
    ev = scene.ev if config.ev is None else config.ev
    spp = scene.spp if config.spp is None else config.spp
    truth_spp = scene.truth_spp if config.truth_spp is None else config.truth_spp
    config = replace(config, ev=ev, spp=spp, truth_spp=truth_spp)
    size = parse_size(config.size)
    evs = parse_ev(ev)
    check(config, min(spp, truth_spp), scene.max_frames)
    check_references(config.out, size, VIDEO_FPS, reference_kinds(config))
    clip = clip_views(scene, config.frames, spp, config.seed, config.views)
    held_out = held_out_views(scene, config.frames, truth_spp, config.seed, config.views)
    K = intrinsics(*size)
    reference = int(np.argsort(evs)[len(evs) // 2])
    relative = [float(e - evs[reference]) for e in evs]
    with writing_to(config.out), lock_output(config.out):
        claim(config)
        render(clip + held_out, K, size, config)
        lens = parse_lens(config.lens, K, size)
        if lens is not None:
            wide_K, wide_size = lens_canvas(K, size)
            render([lens_view(view) for view in clip], wide_K, wide_size, config)
        video = record_clip(clip, relative, K, config)
        if config.views == "rig":
            list_exposures(evs, config)
        write_truth(clip, held_out, K, relative, reference, config)
        write_traced(clip, config)
        if config.oracle:
            noise = OracleNoise(
                config.depth_noise, config.depth_grain, config.flow_noise, config.seed
            )
            frames = [exact(config.out, view) for view in clip]
            poses = [view.c2w for view in clip]
            rig = len(scene.rig) if config.views == "rig" else 1
            write_oracle(
                config.out, scene, frames, video, K, poses, relative, reference, noise, rig
            )
        else:
            remove_stale(config.out)
    say(
        f"{config.out}/clip.mp4: {len(clip)} frames of {size[0]}x{size[1]}, "
        f"exposures {config.ev}; {len(held_out)} held-out views in truth/"
    )


def claim(config: SynthConfig) -> None:
    """Mark the output folder with what it is rendered from. InputError where it holds
    something else.
    """
    key = {name: getattr(config, name) for name in ("size", "frames", "spp", "truth_spp", "seed")}
    if config.readout or config.shutter:
        key |= {"readout": config.readout, "shutter": config.shutter, "ev": config.ev}
    if config.views != "mono":
        key["views"] = config.views
    if config.name != "interior":
        key["name"] = config.name
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]
    path = config.out / "exact" / "key.json"
    if config.out.exists() and not config.out.is_dir():
        raise InputError(f"{config.out}: is a file; name a folder to write")
    if path.is_file() and digest not in path.read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            f"{config.out}: holds a scene rendered with other settings; "
            "choose another folder or remove it"
        )
    if not path.is_file() and config.out.exists() and not holds_nothing(config.out):
        raise InputError(f"{config.out}: holds other files; choose a new or an empty folder")
    write_json(path, {"digest": digest, **key})


def render(
    views: list[TracedView], K: np.ndarray, size: tuple[int, int], config: SynthConfig
) -> None:
    """Path-trace what is not in exact/ yet. Reports how long it will take before, and
    how long a picture took after.
    """
    missing = [v for v in views if not exact_path(config.out, v).is_file()]
    if not missing:
        return
    scene = SCENES[config.name]
    tracer = Tracer(scene, config.seed, config.variant)
    renders = BANDS if config.readout else 1
    seconds = estimate_seconds(tracer, missing, K, size, renders)
    say(
        f"{config.name}: {len(missing)} pictures of {size[0]}x{size[1]} to trace, "
        f"about {seconds / 60:.1f} minutes"
    )
    shutters = exposures(config.readout, config.shutter, parse_ev(str(config.ev)), VIDEO_FPS)
    spent: dict[int, list[float]] = defaultdict(list)  # seconds per picture, by its spp
    for view in track(missing, "path tracing"):
        start = clock.monotonic()
        surface = tracer.surface(view.time, K, view.c2w, size)
        channels = geometry_channels(scene, surface, view, K, config.views)
        channels["RGB"] = tracer.radiance(view.time, K, view.c2w, size, view.spp, view.seed)
        if shutters is not None and view.name.startswith("clip"):
            shutter = shutters[view.anchor % len(shutters)]
            seen = trace_exposure(tracer, scene, view, K, size, config.views, shutter)
            channels |= {name: seen[..., k] for k, name in enumerate(SEEN)}
        write_exr(exact_path(config.out, view), channels, TRACED_HEADER, half=False)
        spent[view.spp].append(clock.monotonic() - start)
    costs = [
        f"{np.mean(seconds):.1f} s per picture at {spp} paths per pixel"
        for spp, seconds in spent.items()
    ]
    total = sum(sum(seconds) for seconds in spent.values())
    say(f"{config.name}: traced in {total / 60:.1f} minutes; {', '.join(costs)}")


def estimate_seconds(
    tracer: Tracer, views: list[TracedView], K: np.ndarray, size: tuple[int, int], renders: int = 1
) -> float:
    """How many seconds the pictures will take, from the first of them with one path per
    pixel and with as many as are traced at once. Frames of the clip are traced
    `renders` times more.
    """
    view = views[0]
    many = min(PASS_SPP, view.spp)
    taken = []
    for spp in (1, 1, many):  # the first one compiles
        start = clock.monotonic()
        tracer.radiance(view.time, K, view.c2w, size, spp, view.seed)
        taken.append(clock.monotonic() - start)
    _, one_path, many_paths = taken
    per_path = max(0.0, many_paths - one_path) / max(1, many - 1)
    times = [1 + (renders if renders > 1 and v.name.startswith("clip") else 0) for v in views]
    return sum(n * (one_path + per_path * (v.spp - 1)) for n, v in zip(times, views, strict=True))


def geometry_channels(
    scene: SynthScene, surface: Surface, view: TracedView, K: np.ndarray, views: Views
) -> dict[str, np.ndarray]:
    """The geometry of a picture: depth; bodies; texture coordinates where the scene has
    deforming bodies; for a frame of the clip, the flow to the frames beside it.
    """
    channels = {"Z": surface.depth, "body": surface.bodies.astype(np.float32)}
    if scene.deforms:
        for k, name in enumerate(UV):
            channels[name] = surface.uv[..., k] * (surface.bodies > 0)
    if view.name.startswith("clip"):
        for side, name in MOTION_DIRECTIONS.items():
            other = view.time + side
            there = scene.moved(surface.points, surface.bodies, surface.uv, view.time, other)
            flow = exact_flow(there, K, scene.pose(views, other))
            channels[f"{name}.u"] = flow[..., 0]
            channels[f"{name}.v"] = flow[..., 1]
    return channels


def exact_path(out: Path, view: TracedView) -> Path:
    """The file of a rendered picture."""
    return out / "exact" / f"{view.name}.exr"


def exact(out: Path, view: TracedView) -> dict[str, np.ndarray]:
    """The rendered channels of a picture."""
    return read_exr(exact_path(out, view))


def record_clip(
    clip: list[TracedView], relative: list[float], K: np.ndarray, config: SynthConfig
) -> np.ndarray:
    """Record every frame at its bracket's exposure, and write clip/ and clip.mp4. The
    frames as recorded, (T, H, W, 3).
    """
    curve = response_curve(config.response)
    gains = parse_white_balance(config.white_balance)
    noise = sensor_noise(config.noise)
    width, height = parse_size(config.size)
    lens = parse_lens(config.lens, K, (width, height))
    seen = pinhole.pixel_centers(height, width)  # by a pinhole camera in place of the lens
    if lens is not None:
        seen = lens.undistort(seen, K)
    transmission = light_share(seen, K, config.vignetting)
    video = []
    for t, view in enumerate(clip):
        rng = np.random.default_rng([config.seed, t])
        radiance = lens_radiance(view, lens, config.out)
        ev = relative[t % len(relative)]
        frame = record(radiance, ev, gains, curve, noise, rng, transmission)
        write_png(config.out / "clip" / f"{t:05d}.png", frame)
        video.append(frame)
    write_video(config.out / "clip.mp4", video, crf=VIDEO_CRF, footage=True)
    return np.stack(video)


def lens_canvas(K: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, tuple[int, int]]:
    """K (3, 3), and width and height, of the pictures that a lens distorts.

    They do not depend on the lens, so that clips of several lenses share them.
    """
    wide = np.rint(np.array(size) * LENS_MARGIN * LENS_FINENESS).astype(int)
    width, height = (int(side) for side in wide)
    return pinhole.intrinsics(K[0, 0] * LENS_FINENESS, width, height), (width, height)


def lens_view(view: TracedView) -> TracedView:
    """The wide picture of a frame; its finer pixels need fewer paths each."""
    spp = max(1, round(view.spp / LENS_FINENESS**2))
    return replace(view, name=view.name.replace("clip", LENS_PREFIX), spp=spp)


def lens_radiance(view: TracedView, lens: Lens | None, out: Path) -> np.ndarray:
    """The radiance (H, W, 3) that falls on the sensor, through the lens if there is
    one: the mean of four points of every pixel.
    """
    if lens is None:
        channels = exact(out, view)
        if SEEN[0] in channels:
            return np.stack([channels[name] for name in SEEN], -1)
        return channels["RGB"]
    wide = exact(out, lens_view(view))["RGB"]
    wide_K, _ = lens_canvas(lens.K, (lens.width, lens.height))
    fine = distorted_picture(wide, wide_K, lens.resized(2 * lens.width, 2 * lens.height))
    return fine.reshape(lens.height, 2, lens.width, 2, 3).mean((1, 3))


def write_traced(clip: list[TracedView], config: SynthConfig) -> None:
    """Write the radiance of the clip as the HDR references that are asked for."""
    if not (config.hdr_video or config.hdr_still):
        return
    frames = [exact_path(config.out, view) for view in clip]
    probes = [frames[i] for i in sorted({0, len(frames) // 2, len(frames) - 1})]
    white = color.auto_exposure(np.concatenate([read_exr(p)["RGB"] for p in probes]))

    def radiance() -> Iterator[np.ndarray]:
        return (read_exr(path)["RGB"] for path in frames)

    write_references(config.out, radiance, len(frames), VIDEO_FPS, white, reference_kinds(config))


def reference_kinds(config: SynthConfig) -> ReferenceKinds:
    """The HDR references that are asked for."""
    return ReferenceKinds(config.hdr_video, config.hdr_codec, config.hdr_still)


def list_exposures(evs: list[float], config: SynthConfig) -> None:
    """Write the exposure of every frame beside the footage of a rig: from camera to
    camera brightness changes for other reasons too.
    """
    rows = [f"{t},{evs[t % len(evs)]:g}" for t in range(config.frames)]
    text = "\n".join(["frame,ev", *rows, ""])
    for path in (config.out / "clip.csv", config.out / "clip" / "exposures.csv"):
        write_text(path, text)


def write_truth(
    clip: list[TracedView],
    held_out: list[TracedView],
    K: np.ndarray,
    relative: list[float],
    reference: int,
    config: SynthConfig,
) -> None:
    """Write truth/: truth.json, radiance as half EXR, moving masks, depth and motion as
    float EXR.
    """
    folder = config.out / "truth"
    curve = response_curve(config.response)
    scene = SCENES[config.name]
    lens = parse_lens(config.lens, K, parse_size(config.size))
    entries = []
    for k, view in enumerate(held_out):
        channels = exact(config.out, view)
        geometry = view_geometry(scene, channels, view.time, K, view.c2w)
        radiance = {"RGB": channels["RGB"]}
        write_exr(folder / "radiance" / f"{view.name}.exr", radiance, TRACED_HEADER)
        write_png(folder / "masks" / f"{view.name}.png", channels["body"] > 0)
        write_exr(folder / "geometry" / f"{view.name}.exr", geometry, half=False)
        entry = TruthView(
            name=view.name,
            time=view.time,
            bracket=k % len(relative),
            anchor=view.anchor,
            c2w=view.c2w.tolist() if view.off_path else None,
            radiance=f"radiance/{view.name}.exr",
            mask=f"masks/{view.name}.png",
            geometry=f"geometry/{view.name}.exr",
        )
        entries.append(entry)
    truth = Truth(
        bracket_ev=relative,
        reference_bracket=reference,
        response_x=curve.x.tolist(),
        response_y=curve.y.tolist(),
        white_balance=list(parse_white_balance(config.white_balance)),
        vignetting=config.vignetting,
        lens=None if lens is None else list(lens.distortion[:2]),
        settings={k: v for k, v in asdict(config).items() if k not in NOT_OF_THE_SCENE},
        K=K.tolist(),
        clip_c2w=[view.c2w.tolist() for view in clip],
        views=entries,
    )
    write_json(folder / "truth.json", truth.model_dump())
