"""A run -> stills, EXR sequences, videos, contact sheets: which views, and the standard
set that every run ends with.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from hdr_nsff.core import io, notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import to_device
from hdr_nsff.geometry import paths
from hdr_nsff.geometry.paths import View
from hdr_nsff.rendering.interpolate import LayeredField
from hdr_nsff.rendering.shots import (
    Output,
    Shot,
    device_of,
    fingerprint,
    picture_of,
    render_shot,
    take,
)
from hdr_nsff.scene.scene import Frame
from hdr_nsff.training.run_folder import Run

SHOTS = ("training", "fixed", "bullet", "slowmo")


@dataclass(frozen=True)
class RenderConfig:
    """Pictures, EXR sequences and videos from a run."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    path: str = "all"
    """training, fixed, bullet, slowmo, or a JSON file with a camera path; all: the set
    that `run` makes (no frame, scale, factor, views, fps).
    """
    out: Path | None = None
    """Where to; default: RUN/render."""
    frame: int | None = None
    """Frame whose camera (fixed, bullet) and time (bullet) are used; default: the
    middle one.
    """
    scale: float = 1.0
    """Size of the pictures relative to the clip's."""
    factor: int = 4
    """Slow motion: views per recorded frame."""
    views: int = 48
    """Bullet time: number of views."""
    fps: float | None = None
    """Frames per second of videos; default: the clip's."""
    budget: float = 90.0
    """For path `all`: seconds it may take; videos become smaller and shorter to fit."""
    device: str = "auto"
    """auto, cpu or cuda."""
    output: Annotated[Output, tyro.conf.arg(name="")] = field(default_factory=Output)


def render(config: RenderConfig) -> dict[str, Path]:
    """The verb: what was asked for, by name."""
    check_settings(config)
    run = Run.open(config.run, config.device)
    if config.output.between == "splat" and not isinstance(run.field, LayeredField):
        raise InputError("--between splat: this field has no layers to splat; use --between direct")
    out = config.out or Path(config.run) / "render"
    with io.writing_to(out), lock_output(out):
        if config.path == "all":
            return render_all(run, out, config.budget, config.output)
        shot = plan_shot(run, config.path, config.frame, config.factor, config.views)
        shot = Shot(
            shot.name, [v.resized(config.scale) for v in shot.views], config.fps or shot.fps
        )
        return {shot.name: render_shot(run, shot, out, config.output)}


def check_settings(config: RenderConfig) -> None:
    """InputError for settings that make no sense whatever the run is."""
    positive = {
        "scale": config.scale,
        "factor": config.factor,
        "views": config.views,
        "budget": config.budget,
    }
    for name, value in positive.items() | (
        {"fps": config.fps}.items() if config.fps is not None else set()
    ):
        if not (value > 0 and math.isfinite(value)):
            raise InputError(f"--{name} {value:g}: must be a number above 0")
    if config.fps is not None and config.fps > 1000:
        raise InputError(f"--fps {config.fps:g}: no player shows that many; use 1000 at most")
    o = config.output
    if o.ev is not None and not abs(o.ev) < 60:
        raise InputError(
            f"--ev {o.ev:g}: an exposure in stops relative to the reference, like -2 or 1.5"
        )
    if o.exr == "none" and not o.png and not o.video:
        raise InputError(
            "--exr none --no-png --no-video: nothing left to write; leave one of them out"
        )


def plan_shot(
    run: Run, path: str, frame: int | None = None, factor: int = 2, num_views: int = 24
) -> Shot:
    """The views of a named path or of a JSON file; InputError where the footage cannot
    show them.
    """
    frames = sorted(run.scene.train, key=lambda f: f.time)
    times = run.scene.times.tolist()
    start = find_frame(run, frame)
    fps = run.scene.manifest.fps
    match path:
        case "training":
            return Shot(
                path, paths.training_path([f.camera for f in frames], [f.time for f in frames]), fps
            )
        case "fixed":
            return Shot(path, paths.fixed(start.camera, times), fps)
        case "bullet":
            return Shot(path, bullet_views(run, start, num_views), min(fps, 12.0))
        case "slowmo" if (
            len({f.camera_id for f in frames}) > 1
        ):  # several cameras: gliding from one to the next would be a ride
            return Shot(path, paths.slow_motion([start.camera] * len(times), times, factor), fps)
        case "slowmo":
            return Shot(path, paths.slow_motion([f.camera for f in frames], times, factor), fps)
        case _:
            if not path.endswith(".json"):
                raise InputError(
                    f"path {path!r}: not known; use training, fixed, bullet, slowmo, all or a .json file"
                )
            views = paths.from_json(path, start.camera)
            check_views(run, path, views)
            return Shot(Path(path).stem, views, fps)


def find_frame(run: Run, index: int | None) -> Frame:
    """The frame of that index, or the training frame in the middle of the clip."""
    if index is None:
        frames = sorted(run.scene.train, key=lambda f: f.time)
        return frames[len(frames) // 2]
    known = {f.index: f for f in run.scene.train + run.scene.test}
    if index not in known:
        raise InputError(
            f"frame {index}: the scene has no such frame; it has {min(known)} to {max(known)}"
        )
    return known[index]


def bullet_views(run: Run, start: Frame, num_views: int) -> list[View]:
    """The spiral around a frame, as wide as the cameras of the clip reach; InputError
    where the footage has no parallax.
    """
    if (parallax := run.scene.manifest.parallax) != "full":
        camera = "only turned" if parallax == "rotation" else "stood still"
        raise InputError(
            f"{run.folder}: no bullet time from this clip, its camera {camera}, so there is no parallax and no depth; "
            "use --path fixed or --path slowmo"
        )
    depth = focus_depth(run, start)
    radius = paths.reach([f.camera for f in run.scene.train], start.camera).clamp(max=0.2 * depth)
    widest = radius.max()
    radius = radius.maximum(
        widest * torch.tensor([0.5, 0.25, 0.0]).to(radius)
    )  # a spiral even where the clip moved along a line
    return paths.bullet_time(start.camera, start.time, depth, radius, num_views)


def focus_depth(run: Run, frame: Frame) -> float:
    """Median z-depth of what the frame's camera sees, from a small picture."""
    small = View(frame.camera, frame.time).resized(0.25)
    seen = run.field.render(to_device(small.camera, device_of(run)), small.time)
    solid = seen.opacity > 0.5
    return (
        float(seen.depth[solid].median())
        if solid.any()
        else 2 / (1 / run.scene.near + 1 / run.scene.far)
    )


def check_views(run: Run, path: str, views: Sequence[View]) -> None:
    """InputError where a path file leaves the clip's time, or its viewpoint where the
    clip has no parallax.
    """
    times = run.scene.times
    first, last = float(times[0]), float(times[-1])
    centers = torch.stack([f.camera.c2w[:, 3] for f in run.scene.train])
    for i, view in enumerate(views):
        if not first <= view.time <= last:
            raise InputError(
                f"{path}: view {i} is at time {view.time:g}, outside the clip ({first:g} to {last:g} frames)"
            )
        distance = (centers - view.camera.c2w[:, 3]).norm(dim=-1).min()
        if run.scene.manifest.parallax != "full" and distance > 1e-3 * run.scene.near:
            raise InputError(
                f"{path}: view {i} leaves the clip's viewpoint, but the clip has no parallax and so no depth"
            )


# The standard set


@dataclass(frozen=True)
class Speed:
    """Measured seconds for one picture of the clip's size."""

    at: float  # at a training time
    between: float  # between training times


def render_all(
    run: Run, out: Path, budget: float = 90.0, output: Output | None = None
) -> dict[str, Path]:
    """The standard set within about `budget` seconds; what there is to look at, by
    name.

    Training path (EXR sequence, LDR views at three exposures, depth and motion
    pictures) and three videos: fixed camera, bullet time where the clip has parallax,
    slow motion. Under a tight budget the training path skips frames, and videos shrink
    first and then keep to the middle of the clip. The plan is kept in `plan.json`, so
    that a restart goes on with the same one.
    """
    output = output or Output()
    if output.exr == "none":
        raise InputError(
            "--exr none: the standard set is made from its EXR sequence; choose --exr half or float"
        )
    if not any((out / name).is_file() for name in ("plan.json", "views.json")):
        foreign = next(
            (
                out / name
                for name in ("overview.png", "ldr", "depth", "scene_flow")
                if (out / name).exists()
            ),
            None,
        )
        if foreign is not None:
            raise InputError(
                f"{foreign}: is there already and was not made by render; choose another --out"
            )
    refused: list[str] = []
    shots = standard_shots(run, out, budget, refused)
    for sentence in refused:
        say(sentence)
    results: dict[str, Path] = {}
    for shot in shots:
        video = render_shot(
            run, shot, out, output if shot.name == "training" else replace(output, exr="none")
        )
        if shot.name == "training":
            results |= {"EXR sequence": out / "training"} | write_views(run, out, shot)
        results[
            {"fixed": "fixed camera", "bullet": "bullet time", "slowmo": "slow motion"}.get(
                shot.name, "as filmed"
            )
        ] = video
    return results


def standard_shots(run: Run, out: Path, budget: float, refused: list[str]) -> list[Shot]:
    """The four shots cut to the budget; sentences about what the clip does not allow
    are appended to `refused`.
    """
    wanted = {}
    for name in SHOTS:
        try:
            wanted[name] = plan_shot(run, name, factor=2, num_views=24)
        except InputError as error:
            refused.append(str(error))
    plan = read_plan(run, out, budget, list(wanted.values()), refused)
    shots = []
    for name, shot in wanted.items():
        scale, chosen = plan[name].scale, plan[name].views
        if scale < 1 or len(chosen) < len(shot.views):
            say(
                f"{name}: {len(chosen)} of {len(shot.views)} views at {scale:.0%} size, to keep to {budget:.0f} s; "
                f"`hdr-nsff render {run.folder} --path {name}` makes them all"
            )
        fps = (
            shot.fps * len(chosen) / len(shot.views) if name in THINNED else shot.fps
        )  # skipped views do not make it faster
        shots.append(Shot(name, [shot.views[i].resized(scale) for i in chosen], fps))
    return shots


SHARE = {"training": 0.3, "fixed": 0.2, "bullet": 0.15, "slowmo": 0.35}  # of the budget
THINNED = (
    "training",
    "bullet",
)  # cut to the budget by leaving out views all over; the others keep to the middle of the clip
SCALES = (1.0, 0.75, 0.67, 0.5, 0.35, 0.25)
NARROWEST = 160  # pixels: videos do not shrink below this width


def read_plan(
    run: Run, out: Path, budget: float, shots: Sequence[Shot], refused: Sequence[str]
) -> dict[str, notes.Share]:
    """Per shot the scale and the positions of the views to make: what `plan.json` says
    for this checkpoint, else measured anew.
    """
    file, key = out / "plan.json", fingerprint(run, budget)
    found, sizes = notes.read(file, notes.Plan), {s.name: len(s.views) for s in shots}
    if found is not None and found.key == key:
        if found.shots.keys() == sizes.keys() and all(
            max(s.views) < sizes[name] for name, s in found.shots.items()
        ):
            return found.shots
        say(f"{file}: does not fit these shots, measuring the speed again")
    speed = measure(run)
    times = run.scene.times.tolist()
    plan = {}
    for shot in shots:
        costs = [
            speed.at if min(abs(v.time - t) for t in times) < 1e-3 else speed.between
            for v in shot.views
        ]
        smallest = (
            1.0 if shot.name == "training" else min(1.0, NARROWEST / shot.views[0].camera.width)
        )
        scale, chosen = cut(costs, SHARE[shot.name] * budget, smallest, thin=shot.name in THINNED)
        plan[shot.name] = notes.Share(scale=scale, views=chosen)
    seconds = {"seconds_at_a_time": speed.at, "seconds_between": speed.between}
    notes.write(file, notes.Plan(key=key, **seconds, refused=list(refused), shots=plan))
    return plan


def measure(run: Run) -> Speed:
    """Time one picture at, and one between, training times (small ones first, so that
    compiling is not counted).
    """
    frame = find_frame(run, None)
    times = run.scene.times.tolist()
    middle = (
        (times[len(times) // 2 - 1] + times[len(times) // 2]) / 2 if len(times) > 1 else times[0]
    )
    seconds = []
    for moment in (frame.time, middle):
        take(run, View(frame.camera, moment).resized(0.1))
        start = time.monotonic()
        take(run, View(frame.camera, moment).resized(0.5))
        seconds.append(4 * (time.monotonic() - start))
    return Speed(*seconds)


def cut(
    costs: Sequence[float], seconds: float, smallest: float, thin: bool
) -> tuple[float, list[int]]:
    """Scale and positions of the views that fit into `seconds`, given what each view
    costs at full size.

    Smaller pictures first, down to the scale `smallest`; then fewer views: evenly
    chosen ones if `thin`, else those in the middle.
    """
    total, n = max(sum(costs), 1e-9), len(costs)
    scales = [s for s in SCALES if s >= smallest]
    scale = next((s for s in scales if total * s**2 <= seconds), scales[-1])
    count = min(n, max(8, int(n * seconds / (total * scale**2) + 1e-9)))
    if thin:
        return scale, sorted({round(i) for i in np.linspace(0, n - 1, count).tolist()})
    first = (n - count) // 2
    return scale, list(range(first, first + count))


def three_exposures(ev: Sequence[float]) -> list[float]:
    """Darkest, middle and brightest exposure of the clip; two stops apart where it has
    one, the mean between where it has two.
    """
    values = sorted(ev)
    if values[-1] - values[0] < 0.5:
        return [values[0] - 2.0, values[0], values[0] + 2.0]
    middle = values[len(values) // 2] if len(values) > 2 else (values[0] + values[-1]) / 2
    return [values[0], middle, values[-1]]


def write_views(run: Run, out: Path, shot: Shot) -> dict[str, Path]:
    """From the EXR sequence of the training path: LDR views at three exposures, depth,
    motion, and an overview; by name.
    """
    sources = [out / "training" / f"{i:05d}.exr" for i in range(len(shot.views))]
    note = out / "views.json"
    evs = three_exposures(run.tonemapper.exposures().tolist())
    key = fingerprint(run, shot.views, evs)
    results = {f"LDR at EV {ev:+.1f}": out / "ldr" / f"ev{ev:+.1f}" for ev in evs} | {
        "depth": out / "depth"
    }
    done = notes.read(note, notes.Colored)
    if done is None or done.key != key:
        near, far, fastest, moves = ranges(sources)
        for i, source in enumerate(track(sources, "LDR, depth and motion pictures")):
            seen = io.read_exr(source)
            for ev in evs:
                picture = picture_of(run, shot.views[i], seen["RGB"], ev, 0, 1.0)
                io.write_png(out / "ldr" / f"ev{ev:+.1f}" / f"{i:05d}.png", picture)
            io.write_png(
                out / "depth" / f"{i:05d}.png",
                io.colorize(1 / seen["Z"].clip(1e-6), 1 / far, 1 / near),
            )
            if moves:
                flow = np.stack([seen["forward.u"], seen["forward.v"]], -1)
                io.write_png(out / "scene_flow" / f"{i:05d}.png", io.colorize_flow(flow, fastest))
        write_overview(run, out, shot, evs, moves)
        done = notes.Colored(
            key=key, depth_range=(near, far), fastest=fastest, moves=moves, exposures=evs
        )
        notes.write(note, done)
    if done.moves:
        results["scene flow"] = out / "scene_flow"
    else:
        say("scene flow: this field tells none, no pictures of it")
    return results | {"overview": out / "overview.png"}


def ranges(sources: Sequence[Path]) -> tuple[float, float, float, bool]:
    """One range for a sequence's pictures: 2nd and 98th percentile of depth, 99th of
    the motion's length in pixels; whether there is motion.
    """
    depths, lengths, moves = [], [], True
    for source in sources:
        seen = io.read_exr(source)
        depths.append(seen["Z"][::4, ::4].ravel())
        moves = moves and "forward.u" in seen
        if moves:
            lengths.append(np.hypot(seen["forward.u"], seen["forward.v"])[::2, ::2].ravel())
    near, far = np.percentile(np.concatenate(depths), [2, 98]).tolist()
    fastest = float(np.percentile(np.concatenate(lengths), 99)) if moves else 0.0
    return max(near, 1e-6), max(far, 1e-6), max(fastest, 1e-3), moves


def write_overview(run: Run, out: Path, shot: Shot, evs: Sequence[float], moves: bool) -> None:
    """`overview.png`: rows of recorded frame, tone-mapped HDR, three exposures, depth
    and motion.
    """
    folders = [
        "training",
        *(f"ldr/ev{ev:+.1f}" for ev in evs),
        "depth",
        *(["scene_flow"] if moves else []),
    ]
    rows = []
    for i in sorted({round(x) for x in np.linspace(0, len(shot.views) - 1, 4).tolist()}):
        view = shot.views[i]
        frame = next(
            f
            for f in run.scene.train
            if f.time == view.time and torch.equal(f.camera.c2w, view.camera.c2w)
        )
        rows.append(
            [frame.image.cpu().numpy(), *(io.read_image(out / f / f"{i:05d}.png") for f in folders)]
        )
    io.write_png(out / "overview.png", io.contact_sheet(rows))
