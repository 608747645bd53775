"""`hdr-nsff synth`: a path-traced scene as alternating-exposure footage, with held-out
truth that only `evaluate` reads.

Writes, below the output folder:
    clip.mp4, clip/*.png   what the camera recorded: the same frames as footage and
    without compression loss
    clip.csv, clip/exposures.csv   of a rig: the exposure of every frame, for `prepare`
    truth/                 views and times the clip does not show: linear radiance,
    moving masks, depth and motion (see truth.py)
    exact/*.exr            every rendered frame: radiance, z-depth `Z`, `body` (0 stands
    still, k the scene's k-th mover), exact optical flow
    oracle/                with `--oracle`: a scene folder made from the truth, for
    measuring a field without estimated priors
Every picture is cached in exact/: a run that was killed goes on where it was.

`--views mono` is one moving camera. `--views rig` is nine synchronized ones that stand
still, and the clip goes around them: frame i is what camera i modulo nine records at
time i. They are of one make and share one response, so the clip is prepared and trained
on as that of one camera (`camera_id` 0), whose neighbor in time stands beside it.
"""

from __future__ import annotations

import hashlib
import json
import time as clock
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import SIDES, read_exr, write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_json, write_text
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.video import write_video
from hdr_nsff.radiometry.recording import Noise, record, response_curve, vignette
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.synth.motion import UV, exact_flow, view_geometry
from hdr_nsff.synth.oracle import OracleNoise, write_oracle
from hdr_nsff.synth.pathtracer import PASS, Surface, Tracer
from hdr_nsff.synth.scenes import SCENES
from hdr_nsff.synth.scenes.base import SynthScene, Views
from hdr_nsff.synth.scenes.geometry import intrinsics

VIDEO_CRF = 4  # an error of 1.4 levels, below the recording's own noise
OFF_PATH = (
    (0.06, -0.03, 0.03),
    (-0.05, 0.05, -0.02),
)  # meters in the camera's axes from the frame's pose


@dataclass(frozen=True)
class SynthConfig:
    """A path-traced scene filmed by a moving camera or a rig. `interior`: a room with a
    bright window, a tumbling box and a swinging ball. `lamp`: things that rush past a
    lamp. `night`: an alley at night, lights that move. `cloth`: cloth and a dancing
    tube in the wind.
    """

    name: Annotated[
        Literal["interior", "lamp", "night", "cloth"], tyro.conf.Positional
    ]  # which scene
    out: Annotated[Path, tyro.conf.Positional]  # folder to write
    # one moving camera, or nine synchronized ones that take the frames in turn
    views: Views = "mono"
    size: str = "240x136"  # width x height in pixels
    frames: int = 36
    ev: str | None = (
        # stops of the exposures that alternate, in the order they are taken, such as
        # -4,-2,0; by default the scene's
        None
    )
    response: str = "film"  # the camera's response curve: film, log, gamma or srgb
    white_balance: str = "1.12,1,0.87"  # gains of red, green and blue before the response
    # fall-off of light towards the corners: 1 is the cos^4 law of a simple lens
    vignetting: float = 0.0
    noise: float = 1.0  # times the noise of a small sensor; 0 is a perfect one
    spp: int | None = (
        # paths per pixel; above 64 rounded to a multiple of it; by default what suits
        # the scene
        None
    )
    truth_spp: int | None = None  # paths per pixel of the held-out views
    seed: int = 0  # of textures, paths and noise
    variant: str = "auto"  # Mitsuba's variant: auto, llvm_ad_rgb, scalar_rgb, cuda_ad_rgb
    # also write a scene folder with exact poses and masks, depth and flow with a little
    # noise
    oracle: bool = False
    depth_noise: float = 0.03  # of the oracle's depth: relative, smooth over an eighth of the frame
    depth_grain: float = 0.0  # of the oracle's depth: relative, every pixel for itself
    flow_noise: float = 0.3  # of the oracle's flow, in pixels


@dataclass(frozen=True)
class Shot:
    """A picture to render."""

    name: str
    time: float  # in frames
    c2w: np.ndarray  # (3, 4)
    spp: int
    seed: int
    anchor: int  # the clip's frame whose pose is the nearest
    off_path: bool = False  # the pose is not exactly the anchor's


def synth(config: SynthConfig) -> None:
    """Render, record and write everything; InputError where the settings or the output
    folder make no sense.
    """
    scene = SCENES[config.name]
    ev = scene.ev if config.ev is None else config.ev
    spp, truth_spp = (
        d if c is None else c
        for c, d in ((config.spp, scene.spp), (config.truth_spp, scene.truth_spp))
    )
    config = replace(config, ev=ev, spp=spp, truth_spp=truth_spp)
    size, evs = parse_size(config.size), parse_ev(ev)
    check(config, min(spp, truth_spp))
    clip = clip_shots(scene, config.frames, spp, config.seed, config.views)
    views = truth_shots(scene, config.frames, truth_spp, config.seed, config.views)
    K = intrinsics(*size)
    claim(config)
    render(clip + views, K, size, config)
    reference = int(np.argsort(evs)[len(evs) // 2])
    relative = [float(e - evs[reference]) for e in evs]
    video = record_clip(clip, relative, K, config)
    if config.views == "rig":
        list_exposures(evs, config)
    write_truth(clip, views, K, relative, reference, config)
    if config.oracle:
        noise = OracleNoise(config.depth_noise, config.depth_grain, config.flow_noise, config.seed)
        frames, poses = [exact(config.out, s) for s in clip], [s.c2w for s in clip]
        write_oracle(config.out, scene, frames, video, K, poses, relative, reference, noise)
    say(
        f"{config.out}/clip.mp4: {len(clip)} frames of {size[0]}x{size[1]}, exposures {config.ev}; {len(views)} held-out views in truth/"
    )


def check(config: SynthConfig, fewest_paths: int) -> None:
    """InputError for numbers out of range, before anything is rendered."""
    response_curve(config.response)
    parse_white_balance(config.white_balance)
    if not 0 <= config.vignetting <= 1:
        raise InputError(
            f"--vignetting {config.vignetting}: must be from 0 (none) to 1 (the cos^4 law)"
        )
    if not 12 <= config.frames <= 400:
        raise InputError(
            f"--frames {config.frames}: 12 to 400 can be made; fewer leave no views far from the frames of their time"
        )
    if not 0 <= config.seed < 1000:
        raise InputError(f"--seed {config.seed}: must be from 0 to 999")
    if fewest_paths < 1:
        raise InputError(
            f"--spp {config.spp} --truth-spp {config.truth_spp}: at least one path per pixel is needed"
        )
    if not 0 <= config.noise < 1000:
        raise InputError(f"--noise {config.noise}: must be from 0 (a perfect sensor) to 1000")
    if not (0 <= config.depth_noise < 1 and 0 <= config.depth_grain < 1):
        raise InputError(
            f"--depth-noise {config.depth_noise} --depth-grain {config.depth_grain}: must be from 0 (exact) to 1"
        )
    if not 0 <= config.flow_noise < 100:
        raise InputError(f"--flow-noise {config.flow_noise}: must be from 0 (exact) to 100 pixels")


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) of "WxH"."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) >= 16 and int(height) >= 16):
        raise InputError(
            f"--size {text!r}: write it as WIDTHxHEIGHT, such as 240x136, at least 16x16"
        )
    return int(width), int(height)


def parse_ev(text: str) -> list[float]:
    """The exposures of a cycle, in stops."""
    try:
        evs = [float(e) for e in text.split(",")]
    except ValueError as error:
        raise InputError(
            f"--ev {text!r}: write stops with commas between them, such as -4,-2,0"
        ) from error
    if not np.isfinite(evs).all():
        raise InputError(f"--ev {text!r}: the stops must be finite numbers")
    return evs


def parse_white_balance(text: str) -> tuple[float, float, float]:
    """Gains of red, green and blue, of "R,G,B"."""
    try:
        red, green, blue = (float(g) for g in text.split(","))
    except ValueError as error:
        raise InputError(
            f"--white-balance {text!r}: write three gains with commas between them, such as 1.12,1,0.87"
        ) from error
    if not all(0.01 <= g <= 100 for g in (red, green, blue)):
        raise InputError(f"--white-balance {text!r}: the gains must be from 0.01 to 100")
    return red, green, blue


def clip_shots(
    scene: SynthScene, frames: int, spp: int, seed: int, views: Views = "mono"
) -> list[Shot]:
    """The frames of the clip."""
    return [
        Shot(f"clip_{t:05d}", float(t), scene.pose(views, t), spp, seed * 1000 + t, t)
        for t in range(frames)
    ]


def truth_shots(
    scene: SynthScene, frames: int, spp: int, seed: int, views: Views = "mono"
) -> list[Shot]:
    """Held-out views: eight at whole times from the pose of another frame (mono: far
    away in time; rig: of a camera three to six further around than the one that records
    then), six at half times, two off the path.
    """
    shots: list[Shot] = []

    def hold_out(
        kind: str, time: float, anchor: int, offset: tuple[float, float, float] | None = None
    ) -> None:
        c2w = scene.pose(views, anchor)
        if offset is not None:
            c2w[:, 3] += c2w[:, :3] @ np.asarray(offset)
        name = f"{kind}_t{time:04.1f}_" + (
            f"pose{anchor:02d}" if views == "mono" else f"camera{anchor % len(scene.rig)}"
        )
        shots.append(
            Shot(name, time, c2w, spp, seed * 1000 + 500 + len(shots), anchor, offset is not None)
        )

    def other(time: int, rank: float) -> int:
        if views == "mono":
            return far_anchor(scene, time, frames, rank)
        return rig_anchor(time, frames, len(scene.rig), 3 + len(shots) % 4)

    for time, rank in zip(
        np.linspace(1, frames - 2, 8).round().astype(int), np.linspace(0.3, 0.9, 8), strict=True
    ):
        hold_out("view", float(time), other(time, rank))
    for time, rank in zip(
        np.linspace(2, frames - 4, 6).round().astype(int), np.linspace(0.8, 0.3, 6), strict=True
    ):
        hold_out("time", time + 0.5, other(time, rank))
    for time, offset in zip((frames // 3, 2 * frames // 3), OFF_PATH, strict=True):
        hold_out("off", float(time), time, offset)
    return shots


def far_anchor(scene: SynthScene, time: int, frames: int, rank: float) -> int:
    """A frame at least a quarter of the clip away from `time`: of all such, the one at
    `rank` in [0, 1] by distance.
    """
    others = [k for k in range(frames) if abs(k - time) >= frames // 4]
    others.sort(
        key=lambda k: float(
            np.linalg.norm(scene.camera_pose(k)[:, 3] - scene.camera_pose(time)[:, 3])
        )
    )
    return others[round(rank * (len(others) - 1))]


def rig_anchor(time: int, frames: int, cameras: int, step: int) -> int:
    """The frame nearest to `time` of the rig's camera `step` further around than the
    one that records then.
    """
    recorded = range((time + step) % cameras, frames, cameras)
    return min(recorded, key=lambda k: abs(k - time))


def claim(config: SynthConfig) -> None:
    """Mark the output folder with what it is rendered from; refuse one that holds
    something else.
    """
    key = {
        k: v
        for k, v in asdict(config).items()
        if k in ("size", "frames", "spp", "truth_spp", "seed")
    }
    key |= {
        k: v
        for k, v in (("views", config.views), ("name", config.name))
        if v not in ("mono", "interior")
    }
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]
    path = config.out / "exact" / "key.json"
    if config.out.exists() and not config.out.is_dir():
        raise InputError(f"{config.out}: is a file; name a folder to write")
    if path.is_file() and digest not in path.read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            f"{config.out}: holds a scene rendered with other settings; choose another folder or remove it"
        )
    if not path.is_file() and config.out.exists() and any(config.out.iterdir()):
        raise InputError(f"{config.out}: holds something else; choose a new or an empty folder")
    write_json(path, {"digest": digest, **key})


def render(shots: list[Shot], K: np.ndarray, size: tuple[int, int], config: SynthConfig) -> None:
    """Path-trace what is not in exact/ yet; says beforehand how long it will take, and
    in the end how long a picture took.
    """
    missing = [s for s in shots if not (config.out / "exact" / f"{s.name}.exr").is_file()]
    if not missing:
        return
    scene = SCENES[config.name]
    tracer = Tracer(scene, config.seed, config.variant)
    seconds = estimate(tracer, missing, K, size)
    say(
        f"{config.name}: {len(missing)} pictures of {size[0]}x{size[1]} to trace, about {seconds / 60:.1f} minutes"
    )
    spent: dict[int, list[float]] = {}
    for shot in track(missing, "path tracing"):
        began = clock.monotonic()
        surface = tracer.surface(shot.time, K, shot.c2w, size)
        channels = geometry_channels(scene, surface, shot, K, config.views)
        channels["RGB"] = tracer.radiance(shot.time, K, shot.c2w, size, shot.spp, shot.seed)
        write_exr(config.out / "exact" / f"{shot.name}.exr", channels, half=False)
        spent.setdefault(shot.spp, []).append(clock.monotonic() - began)
    cost = ", ".join(
        f"{np.mean(s):.1f} s per picture at {spp} paths per pixel" for spp, s in spent.items()
    )
    say(f"{config.name}: traced in {sum(map(sum, spent.values())) / 60:.1f} minutes; {cost}")


def estimate(tracer: Tracer, shots: list[Shot], K: np.ndarray, size: tuple[int, int]) -> float:
    """How many seconds the pictures will take, from the first of them with one path per
    pixel and with as many as are traced at once.
    """
    shot = shots[0]
    few = min(PASS, shot.spp)
    taken = []
    for spp in (1, 1, few):  # the first one compiles
        began = clock.monotonic()
        tracer.radiance(shot.time, K, shot.c2w, size, spp, shot.seed)
        taken.append(clock.monotonic() - began)
    per_path = max(0.0, taken[2] - taken[1]) / max(1, few - 1)
    return sum(taken[1] + per_path * (s.spp - 1) for s in shots)


def geometry_channels(
    scene: SynthScene, surface: Surface, shot: Shot, K: np.ndarray, views: Views
) -> dict[str, np.ndarray]:
    """What a picture shows: depth, bodies, where something deforms the place on it, and
    of a clip's frame the flow to the ones beside.
    """
    channels = {"Z": surface.depth, "body": surface.bodies.astype(np.float32)}
    if scene.deforms:
        channels |= {name: surface.uv[..., k] * (surface.bodies > 0) for k, name in enumerate(UV)}
    if shot.name.startswith("clip"):
        for side, name in SIDES.items():
            there = scene.moved(
                surface.points, surface.bodies, surface.uv, shot.time, shot.time + side
            )
            flow = exact_flow(there, K, scene.pose(views, shot.time + side))
            channels |= {f"{name}.u": flow[..., 0], f"{name}.v": flow[..., 1]}
    return channels


def exact(out: Path, shot: Shot) -> dict[str, np.ndarray]:
    """The rendered channels of a shot."""
    return read_exr(out / "exact" / f"{shot.name}.exr")


def record_clip(
    clip: list[Shot], relative: list[float], K: np.ndarray, config: SynthConfig
) -> np.ndarray:
    """Record every frame at its bracket's exposure; write clip/ and clip.mp4; the
    frames (T, H, W, 3).
    """
    curve, gains = response_curve(config.response), parse_white_balance(config.white_balance)
    noise = Noise(1e-3 * config.noise, config.noise**2 / 6000) if config.noise > 0 else None
    video = []
    for t, shot in enumerate(clip):
        rng = np.random.default_rng([config.seed, t])
        radiance = exact(config.out, shot)["RGB"]
        passed = vignette(radiance.shape[0], radiance.shape[1], K, config.vignetting)
        video.append(
            record(radiance, relative[t % len(relative)], gains, curve, noise, rng, passed)
        )
        write_png(config.out / "clip" / f"{t:05d}.png", video[-1])
    write_video(config.out / "clip.mp4", video, crf=VIDEO_CRF, footage=True)
    return np.stack(video)


def list_exposures(evs: list[float], config: SynthConfig) -> None:
    """The exposure of every frame beside the footage: from camera to camera brightness
    changes for other reasons too.
    """
    rows = [f"{t},{evs[t % len(evs)]:g}" for t in range(config.frames)]
    for path in (config.out / "clip.csv", config.out / "clip" / "exposures.csv"):
        write_text(path, "\n".join(["frame,ev", *rows, ""]))


def write_truth(
    clip: list[Shot],
    views: list[Shot],
    K: np.ndarray,
    relative: list[float],
    reference: int,
    config: SynthConfig,
) -> None:
    """truth/: truth.json, radiance as half EXR, moving masks, depth and motion as float
    EXR.
    """
    folder, curve = config.out / "truth", response_curve(config.response)
    entries = []
    for k, shot in enumerate(views):
        channels = exact(config.out, shot)
        write_exr(folder / "radiance" / f"{shot.name}.exr", {"RGB": channels["RGB"]})
        write_png(folder / "masks" / f"{shot.name}.png", channels["body"] > 0)
        geometry = view_geometry(SCENES[config.name], channels, shot.time, K, shot.c2w)
        write_exr(folder / "geometry" / f"{shot.name}.exr", geometry, half=False)
        entries.append(
            TruthView(
                name=shot.name,
                time=shot.time,
                bracket=k % len(relative),
                anchor=shot.anchor,
                c2w=shot.c2w.tolist() if shot.off_path else None,
                radiance=f"radiance/{shot.name}.exr",
                mask=f"masks/{shot.name}.png",
                geometry=f"geometry/{shot.name}.exr",
            )
        )
    truth = Truth(
        bracket_ev=relative,
        reference_bracket=reference,
        response_x=curve.x.tolist(),
        response_y=curve.y.tolist(),
        white_balance=list(parse_white_balance(config.white_balance)),
        vignetting=config.vignetting,
        settings={k: v for k, v in asdict(config).items() if k not in ("out", "variant")},
        K=K.tolist(),
        clip_c2w=[s.c2w.tolist() for s in clip],
        views=entries,
    )
    write_json(folder / "truth.json", truth.model_dump())
