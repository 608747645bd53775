"""The standard set that every run ends with, within a budget of seconds.

Training path (EXR sequence, LDR views at three exposures, depth and motion pictures)
and three videos: fixed camera, bullet time where the clip has parallax, slow motion.
Under a tight budget the training path skips frames; videos shrink first, and then
bullet time skips views and the others keep to the middle of the clip. The plan stays in
`plan.json`, which a restart follows.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import can_encode, check_encoder
from hdr_nsff.core.progress import say
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.radiometry.hdr_footage import hdr_path
from hdr_nsff.rendering.fingerprint import fingerprint
from hdr_nsff.rendering.hdr_shots import TRANSFERS, write_hdr_videos
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.set_pictures import write_pictures
from hdr_nsff.rendering.shot_views import SHOTS, find_frame, plan_shot
from hdr_nsff.rendering.shots import is_made_by_path, name_results, render_shot
from hdr_nsff.rendering.stills import render_still
from hdr_nsff.training.run_folder import Run

LABELS = {
    "training": "as filmed",
    "fixed": "fixed camera",
    "bullet": "bullet time",
    "slowmo": "slow motion",
}
# Share of the budget per shot (hand-chosen: slow motion has the most views, and views
# between training times cost twice as much).
BUDGET_SHARE = {"training": 0.3, "fixed": 0.2, "bullet": 0.15, "slowmo": 0.35}
# Shots that leave out views evenly to fit; the others keep to the middle of the clip.
THINNED = ("training", "bullet")
SCALES = (1.0, 0.75, 0.67, 0.5, 0.35, 0.25)  # of the picture's sides, tried in this order
MIN_WIDTH_PX = 160  # videos do not shrink below this width (hand-chosen)
MIN_VIEWS = 8  # of a shot, whatever the budget (hand-chosen: fewer are no video)
SLOW_MOTION_FACTOR = 2
BULLET_VIEWS = 24
TIME_TOLERANCE = 1e-3  # frames: a view closer to a training time is at that time
MEASURE_SCALE = 0.5  # of the picture that is timed: a quarter of its pixels
WARM_UP_SCALE = 0.1  # of the picture before it, so that compiling is not timed


@dataclass(frozen=True)
class RenderSpeed:
    """Measured seconds for one picture of the clip's size."""

    at_training_time: float
    between_times: float


def render_all(
    run: Run, out: Path, budget: float = 90.0, output: Output | None = None
) -> dict[str, Path]:
    """Render the standard set within about `budget` seconds; its files by name."""
    output = output or Output()
    if not output.png:
        problem = "the overview and the report are made from the standard set's pictures"
        raise InputError(f"--no-png: {problem}; leave it out, or choose one --path")
    if output.exr == "none":
        problem = "the standard set is made from its EXR sequence"
        raise InputError(f"--exr none: {problem}; choose --exr half or float")
    check_folder(out)
    shots, refused = plan_standard_shots(run)
    for sentence in refused:
        say(sentence)
    results: dict[str, Path] = {}
    for shot in fit_to_budget(run, out, budget, shots, refused):
        filmed = shot.name == "training"
        others = replace(output, exr="none", hdr_still=())
        own = with_hdr_clip(output, shot) if filmed else others
        if is_made_by_path(run, shot, out, own):
            say(
                f"{shot.name}: made with --path and other options, it stays; for the standard "
                f"set's with its pictures, choose another --out, or delete {out / shot.name}"
            )
            results[LABELS[shot.name]] = out / shot.name
            continue
        video = render_shot(run, shot, out, own, of_set=True)
        if filmed:
            results["EXR sequence"] = out / "training"
            results |= write_pictures(run, out, shot, own)
        results |= name_results(out, shot, LABELS[shot.name], own, video)
        if filmed:
            results |= add_av1_clip(run, shot, out, own)
    return results


def with_hdr_clip(output: Output, shot: Shot) -> Output:
    """The output with the HDR video for the viewer's page, if it can be encoded."""
    camera = shot.views[0].camera
    width, height = camera.width // 2 * 2, camera.height // 2 * 2
    if output.hdr_video or not can_encode(output.hdr_codec, width, height, shot.fps):
        return output
    return replace(output, hdr_video=("hlg",))


def add_av1_clip(run: Run, shot: Shot, out: Path, output: Output) -> dict[str, Path]:
    """Write the HDR video of the training path in AV1 too, if it is not there; by name.

    It is for the viewer's page in browsers without HEVC. Where it cannot be encoded,
    there is none; a sentence says so where the encoder is missing.
    """
    transfer = next((t for t in TRANSFERS if t in output.hdr_video), TRANSFERS[0])
    path = hdr_path(out, shot.name, transfer, "av1")
    camera = shot.views[0].camera
    try:
        check_encoder("av1")
    except InputError as error:
        say(f"no HDR clip in AV1, which more browsers play than HEVC: {error}")
        return {}
    if not can_encode("av1", camera.width // 2 * 2, camera.height // 2 * 2, shot.fps):
        return {}
    if not path.exists():
        note = notes.read(out / shot.name / "sequence.json", notes.Sequence)
        assert note is not None  # of the shot that was just rendered
        pictures = [out / shot.name / f"{i:05d}.png" for i in range(len(shot.views))]
        av1 = replace(output, hdr_video=(transfer,), hdr_codec="av1")
        write_hdr_videos(run, shot, pictures, out, av1, note.display_exposure)
    return {f"{LABELS[shot.name]}, {transfer}, AV1": path}


def check_folder(out: Path) -> None:
    """InputError where `out` holds files of the set's names that no `render` wrote."""
    if (out / "plan.json").is_file() or (out / "views.json").is_file():
        return
    for name in ("overview.png", "ldr", "depth", "scene_flow"):
        if (out / name).exists():
            problem = "already exists and was not made by render"
            raise InputError(f"{out / name}: {problem}; choose another --out")


def plan_standard_shots(run: Run) -> tuple[list[Shot], list[str]]:
    """The four shots in full, if the clip allows them; sentences about the others."""
    shots, refused = [], []
    for name in SHOTS:
        try:
            shot = plan_shot(run, name, factor=SLOW_MOTION_FACTOR, num_views=BULLET_VIEWS)
        except InputError as error:
            refused.append(str(error))
        else:
            shots.append(shot)
    return shots, refused


def fit_to_budget(
    run: Run, out: Path, budget: float, shots: Sequence[Shot], refused: Sequence[str]
) -> list[Shot]:
    """The shots, smaller or with fewer views where the budget (seconds) asks for it."""
    plan = read_plan(run, out, budget, shots, refused)
    fitted = []
    for shot in shots:
        scale, chosen = plan[shot.name].scale, plan[shot.name].views
        if scale < 1 or len(chosen) < len(shot.views):
            made = f"{len(chosen)} of {len(shot.views)} views at {scale:.0%} size"
            command = f"hdr-nsff render {run.folder} --path {shot.name} --out {out}"
            say(f"{shot.name}: {made}, to keep to {budget:.0f} s; `{command}` makes them all")
        fps = shot.fps
        if shot.name in THINNED:  # skipped views do not make it faster
            fps = shot.fps * len(chosen) / len(shot.views)
        views = [shot.views[i].resized(scale) for i in chosen]
        fitted.append(Shot(shot.name, views, fps))
    return fitted


def read_plan(
    run: Run, out: Path, budget: float, shots: Sequence[Shot], refused: Sequence[str]
) -> dict[str, notes.ShotShare]:
    """Per shot the scale and the positions of the views to render.

    From `plan.json` where that is of this checkpoint and of as many views, else planned
    and written.
    """
    path = out / "plan.json"
    key = fingerprint(run, budget, [len(shot.views) for shot in shots])
    found = notes.read(path, notes.RenderPlan)
    if found is not None and found.key == key:
        if plan_fits(found, shots):
            return found.shots
        say(f"{path}: does not fit these shots, measuring the speed again")
    speed = measure_speed(run)
    shares = {shot.name: share_of(run, shot, speed, budget) for shot in shots}
    plan = notes.RenderPlan(
        key=key,
        seconds_at_a_time=speed.at_training_time,
        seconds_between=speed.between_times,
        refused=list(refused),
        shots=shares,
    )
    notes.write(path, plan)
    return shares


def plan_fits(plan: notes.RenderPlan, shots: Sequence[Shot]) -> bool:
    """Whether a plan is of these shots and of views that they have."""
    sizes = {shot.name: len(shot.views) for shot in shots}
    if plan.shots.keys() != sizes.keys():
        return False
    return all(max(share.views) < sizes[name] for name, share in plan.shots.items())


def share_of(run: Run, shot: Shot, speed: RenderSpeed, budget: float) -> notes.ShotShare:
    """The part of a shot that fits into its share of the budget (seconds)."""
    times = run.scene.times.tolist()
    costs = []
    for view in shot.views:
        at_training_time = min(abs(view.time - t) for t in times) < TIME_TOLERANCE
        costs.append(speed.at_training_time if at_training_time else speed.between_times)
    smallest = 1.0
    if shot.name != "training":
        smallest = min(1.0, MIN_WIDTH_PX / shot.views[0].camera.width)
    seconds = BUDGET_SHARE[shot.name] * budget
    scale, chosen = cut(costs, seconds, smallest, thin=shot.name in THINNED)
    return notes.ShotShare(scale=scale, views=chosen)


def measure_speed(run: Run) -> RenderSpeed:
    """Time one picture at a training time and one between two of them.

    After a small one each, so that compiling is not counted.
    """
    frame = find_frame(run, None)
    times = run.scene.times.tolist()
    between = times[0]
    if len(times) > 1:
        middle = len(times) // 2
        between = (times[middle - 1] + times[middle]) / 2
    return RenderSpeed(
        time_render(run, frame.camera, frame.time), time_render(run, frame.camera, between)
    )


def time_render(run: Run, camera: Camera, moment: float) -> float:
    """Seconds for one picture of the clip's size at the time `moment` in frames."""
    view = PathView(camera, moment)
    render_still(run, view.resized(WARM_UP_SCALE))
    start = time.monotonic()
    render_still(run, view.resized(MEASURE_SCALE))
    return (time.monotonic() - start) / MEASURE_SCALE**2


def cut(
    costs: Sequence[float], seconds: float, smallest: float, thin: bool
) -> tuple[float, list[int]]:
    """Scale and positions of the views that fit into `seconds`.

    `costs`: seconds of each view at full size. Smaller pictures first, down to the
    scale `smallest`; then fewer views: evenly chosen ones if `thin`, else those in
    the middle.
    """
    total = max(sum(costs), 1e-9)
    num_views = len(costs)
    scales = [s for s in SCALES if s >= smallest]
    scale = next((s for s in scales if total * s**2 <= seconds), scales[-1])
    affordable = int(num_views * seconds / (total * scale**2) + 1e-9)
    count = min(num_views, max(MIN_VIEWS, affordable))
    if thin:
        positions = np.linspace(0, num_views - 1, count).tolist()
        return scale, sorted({round(position) for position in positions})
    first = (num_views - count) // 2
    return scale, list(range(first, first + count))
