"""`hdr-nsff synth`: a path-traced room as alternating-exposure footage, with held-out truth that only `evaluate` reads.

Writes, below the output folder:
    clip.mp4, clip/*.png   what the camera recorded: the same frames as footage and without compression loss
    clip.csv, clip/exposures.csv   of a rig: the exposure of every frame, for `prepare`
    truth/                 views and times the clip does not show: linear radiance, moving masks, depth and motion (see truth.py)
    exact/*.exr            every rendered frame: radiance, z-depth `Z`, `body` (0 room, 1 box, 2 ball), exact optical flow
    oracle/                with `--oracle`: a scene folder made from the truth, for measuring a field without estimated priors
Every picture is cached in exact/: a run that was killed goes on where it was.

`--views mono` is one moving camera. `--views rig` is nine synchronized ones that stand still, and the clip goes around them:
frame i is what camera i modulo nine records at time i. They are of one make and share one response, so the clip is prepared
and trained on as that of one camera (`camera_id` 0), whose neighbour in time stands beside it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from hdr_nsff import io
from hdr_nsff.errors import InputError
from hdr_nsff.pathtracer import Tracer
from hdr_nsff.progress import say, track
from hdr_nsff.recording import Noise, record, response_curve
from hdr_nsff.synth_motion import exact_flow, view_geometry
from hdr_nsff.synth_oracle import OracleNoise, write_oracle
from hdr_nsff.synth_scene import POSES, RIG, build, camera_pose, intrinsics
from hdr_nsff.truth import Truth, TruthView

VIDEO_CRF = 4  # an error of 1.4 levels, below the recording's own noise
WHITE_BALANCE = (1.12, 1.0, 0.87)
OFF_PATH = ((0.06, -0.03, 0.03), (-0.05, 0.05, -0.02))  # metres in the camera's axes from the frame's pose


@dataclass(frozen=True)
class SynthConfig:
    """A path-traced room with a bright window, a lamp, a tumbling box and a swinging ball, filmed by a moving camera or a rig."""

    out: Annotated[Path, tyro.conf.Positional]  # folder to write
    views: Literal["mono", "rig"] = "mono"  # one moving camera, or nine synchronized ones that take the frames in turn
    size: str = "240x136"  # width x height in pixels
    frames: int = 36
    ev: str = "-4,-2,0"  # the exposures that alternate, in stops, in the order they are taken
    response: str = "film"  # the camera's response curve: film, gamma or srgb
    noise: float = 1.0  # times the noise of a small sensor; 0 is a perfect one
    spp: int = 256  # paths per pixel; above 64 rounded to a multiple of it
    truth_spp: int = 768  # paths per pixel of the held-out views
    seed: int = 0  # of textures, paths and noise
    variant: str = "auto"  # Mitsuba's variant: auto, llvm_ad_rgb, scalar_rgb, cuda_ad_rgb
    oracle: bool = False  # also write a scene folder with exact poses and masks, depth and flow with a little noise
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
    """Render, record and write everything; InputError where the settings or the output folder make no sense."""
    size, evs = parse_size(config.size), parse_ev(config.ev)
    check(config)
    clip = clip_shots(config.frames, config.spp, config.seed, config.views)
    views = truth_shots(config.frames, config.truth_spp, config.seed, config.views)
    K = intrinsics(*size)
    claim(config)
    render(clip + views, K, size, config)
    reference = int(np.argsort(evs)[len(evs) // 2])
    relative = [float(e - evs[reference]) for e in evs]
    video = record_clip(clip, relative, config)
    if config.views == "rig":
        list_exposures(evs, config)
    write_truth(clip, views, K, relative, reference, config)
    if config.oracle:
        noise = OracleNoise(config.depth_noise, config.depth_grain, config.flow_noise, config.seed)
        frames, poses = [exact(config.out, s) for s in clip], [s.c2w for s in clip]
        write_oracle(config.out, frames, video, K, poses, relative, reference, noise)
    say(
        f"{config.out}/clip.mp4: {len(clip)} frames of {size[0]}x{size[1]}, exposures {config.ev}; {len(views)} held-out views in truth/"
    )


def check(config: SynthConfig) -> None:
    """InputError for numbers out of range, before anything is rendered."""
    response_curve(config.response)
    if not 12 <= config.frames <= 400:
        raise InputError(
            f"--frames {config.frames}: 12 to 400 can be made; fewer leave no views far from the frames of their time"
        )
    if not 0 <= config.seed < 1000:
        raise InputError(f"--seed {config.seed}: must be from 0 to 999")
    if min(config.spp, config.truth_spp) < 1:
        raise InputError(f"--spp {config.spp} --truth-spp {config.truth_spp}: at least one path per pixel is needed")
    if not 0 <= config.noise < 1000:
        raise InputError(f"--noise {config.noise}: must be from 0 (a perfect sensor) to 1000")
    if not (0 <= config.depth_noise < 1 and 0 <= config.depth_grain < 1):
        raise InputError(f"--depth-noise {config.depth_noise} --depth-grain {config.depth_grain}: must be from 0 (exact) to 1")
    if not 0 <= config.flow_noise < 100:
        raise InputError(f"--flow-noise {config.flow_noise}: must be from 0 (exact) to 100 pixels")


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) of "WxH"."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) >= 16 and int(height) >= 16):
        raise InputError(f"--size {text!r}: write it as WIDTHxHEIGHT, such as 240x136, at least 16x16")
    return int(width), int(height)


def parse_ev(text: str) -> list[float]:
    """The exposures of a cycle, in stops."""
    try:
        evs = [float(e) for e in text.split(",")]
    except ValueError as error:
        raise InputError(f"--ev {text!r}: write stops with commas between them, such as -4,-2,0") from error
    if not np.isfinite(evs).all():
        raise InputError(f"--ev {text!r}: the stops must be finite numbers")
    return evs


def clip_shots(frames: int, spp: int, seed: int, views: str = "mono") -> list[Shot]:
    """The frames of the clip."""
    return [Shot(f"clip_{t:05d}", float(t), POSES[views](t), spp, seed * 1000 + t, t) for t in range(frames)]


def truth_shots(frames: int, spp: int, seed: int, views: str = "mono") -> list[Shot]:
    """Held-out views: eight at whole times from the pose of another frame (mono: far away in time; rig: of a camera three
    to six further around than the one that records then), six at half times, two off the path."""
    shots: list[Shot] = []

    def hold_out(kind: str, time: float, anchor: int, offset: tuple[float, float, float] | None = None) -> None:
        c2w = POSES[views](anchor)
        if offset is not None:
            c2w[:, 3] += c2w[:, :3] @ np.asarray(offset)
        name = f"{kind}_t{time:04.1f}_" + (f"pose{anchor:02d}" if views == "mono" else f"camera{anchor % len(RIG)}")
        shots.append(Shot(name, time, c2w, spp, seed * 1000 + 500 + len(shots), anchor, offset is not None))

    def other(time: int, rank: float) -> int:
        return far_anchor(time, frames, rank) if views == "mono" else rig_anchor(time, frames, 3 + len(shots) % 4)

    for time, rank in zip(np.linspace(1, frames - 2, 8).round().astype(int), np.linspace(0.3, 0.9, 8), strict=True):
        hold_out("view", float(time), other(time, rank))
    for time, rank in zip(np.linspace(2, frames - 4, 6).round().astype(int), np.linspace(0.8, 0.3, 6), strict=True):
        hold_out("time", time + 0.5, other(time, rank))
    for time, offset in zip((frames // 3, 2 * frames // 3), OFF_PATH, strict=True):
        hold_out("off", float(time), time, offset)
    return shots


def far_anchor(time: int, frames: int, rank: float) -> int:
    """A frame at least a quarter of the clip away from `time`: of all such, the one at `rank` in [0, 1] by distance."""
    others = [k for k in range(frames) if abs(k - time) >= frames // 4]
    others.sort(key=lambda k: float(np.linalg.norm(camera_pose(k)[:, 3] - camera_pose(time)[:, 3])))
    return others[round(rank * (len(others) - 1))]


def rig_anchor(time: int, frames: int, step: int) -> int:
    """The frame nearest to `time` of the rig's camera `step` further around than the one that records then."""
    recorded = range((time + step) % len(RIG), frames, len(RIG))
    return min(recorded, key=lambda k: abs(k - time))


def claim(config: SynthConfig) -> None:
    """Mark the output folder with what it is rendered from; refuse one that holds something else."""
    key = {k: v for k, v in asdict(config).items() if k in ("size", "frames", "spp", "truth_spp", "seed")}
    key |= {"views": config.views} if config.views != "mono" else {}
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]
    path = config.out / "exact" / "key.json"
    if config.out.exists() and not config.out.is_dir():
        raise InputError(f"{config.out}: is a file; name a folder to write")
    if path.is_file() and digest not in path.read_text(encoding="utf-8", errors="replace"):
        raise InputError(f"{config.out}: holds a room rendered with other settings; choose another folder or remove it")
    if not path.is_file() and config.out.exists() and any(config.out.iterdir()):
        raise InputError(f"{config.out}: holds something else; choose a new or an empty folder")
    io.write_json(path, {"digest": digest, **key})


def render(shots: list[Shot], K: np.ndarray, size: tuple[int, int], config: SynthConfig) -> None:
    """Path-trace what is not in exact/ yet."""
    missing = [s for s in shots if not (config.out / "exact" / f"{s.name}.exr").is_file()]
    if not missing:
        return
    tracer = Tracer(build(config.seed), config.variant)
    for shot in track(missing, "path tracing"):
        surface = tracer.surface(shot.time, K, shot.c2w, size)
        channels = {"Z": surface.depth, "body": surface.bodies.astype(np.float32)}
        if shot.name.startswith("clip"):
            for side, name in io.SIDES.items():
                there = POSES[config.views](shot.time + side)
                flow = exact_flow(surface.points, surface.bodies, shot.time, shot.time + side, K, there)
                channels |= {f"{name}.u": flow[..., 0], f"{name}.v": flow[..., 1]}
        channels["RGB"] = tracer.radiance(shot.time, K, shot.c2w, size, shot.spp, shot.seed)
        io.write_exr(config.out / "exact" / f"{shot.name}.exr", channels, half=False)


def exact(out: Path, shot: Shot) -> dict[str, np.ndarray]:
    """The rendered channels of a shot."""
    return io.read_exr(out / "exact" / f"{shot.name}.exr")


def record_clip(clip: list[Shot], relative: list[float], config: SynthConfig) -> np.ndarray:
    """Record every frame at its bracket's exposure; write clip/ and clip.mp4; the frames (T, H, W, 3)."""
    curve = response_curve(config.response)
    noise = Noise(1e-3 * config.noise, config.noise**2 / 6000) if config.noise > 0 else None
    video = []
    for t, shot in enumerate(clip):
        rng = np.random.default_rng([config.seed, t])
        radiance = exact(config.out, shot)["RGB"]
        video.append(record(radiance, relative[t % len(relative)], WHITE_BALANCE, curve, noise, rng))
        io.write_png(config.out / "clip" / f"{t:05d}.png", video[-1])
    io.write_video(config.out / "clip.mp4", video, crf=VIDEO_CRF, footage=True)
    return np.stack(video)


def list_exposures(evs: list[float], config: SynthConfig) -> None:
    """The exposure of every frame beside the footage: from camera to camera brightness changes for other reasons too."""
    rows = [f"{t},{evs[t % len(evs)]:g}" for t in range(config.frames)]
    for path in (config.out / "clip.csv", config.out / "clip" / "exposures.csv"):
        io.write_text(path, "\n".join(["frame,ev", *rows, ""]))


def write_truth(
    clip: list[Shot], views: list[Shot], K: np.ndarray, relative: list[float], reference: int, config: SynthConfig
) -> None:
    """truth/: truth.json, radiance as half EXR, moving masks, depth and motion as float EXR."""
    folder, curve = config.out / "truth", response_curve(config.response)
    entries = []
    for k, shot in enumerate(views):
        channels = exact(config.out, shot)
        io.write_exr(folder / "radiance" / f"{shot.name}.exr", {"RGB": channels["RGB"]})
        io.write_png(folder / "masks" / f"{shot.name}.png", channels["body"] > 0)
        geometry = view_geometry(channels["Z"], channels["body"].astype(int), shot.time, K, shot.c2w)
        io.write_exr(folder / "geometry" / f"{shot.name}.exr", geometry, half=False)
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
        white_balance=list(WHITE_BALANCE),
        K=K.tolist(),
        clip_c2w=[s.c2w.tolist() for s in clip],
        views=entries,
    )
    io.write_json(folder / "truth.json", truth.model_dump())
