"""How much half and double of the constants of `priors/` that decide most change the
error of their own step of `prepare`.

    python benchmarks/sensitivity.py WORK --data RECORDED [--only NAME]

Clips: the first frames of three scenes of `synth` (rendered into WORK, which takes some
minutes), and of two recorded clips in the folder RECORDED. Every clip is prepared into
WORK once, rendered ones with their exact poses. Then one step at a time runs again on
what the steps before it left, with one constant halved or doubled. `step_errors.py`
names the errors, and what recorded clips are compared with. Constants of `radiometry/`
and of the round trip of flow, which the priors build on, are among them.

A constant that changes no error of any clip by 1 % changes nothing here. Structure from
motion is not repeatable: its default is run several times, and only errors outside of
their range (in brackets) count as changes. Every
measurement is stored as soon as it is done: the same command continues where a killed
one was, and with everything done prints the table. `commit` is that of the last run.
"""

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from record import Record, make_parser
from step_errors import METRICS, STEPS, Clip, Errors

from hdr_nsff.core.io import read_json, write_npy
from hdr_nsff.core.process import prepare_process
from hdr_nsff.core.progress import progress_of, say
from hdr_nsff.footage.layouts.llff import llff_table
from hdr_nsff.prepare.engine import run_step
from hdr_nsff.prepare.prepare import STEPS as PREPARE_STEPS
from hdr_nsff.prepare.prepare import PrepareConfig, begin
from hdr_nsff.prepare.work import Work
from hdr_nsff.synth.reexpose import ReexposeConfig, reexpose
from hdr_nsff.synth.scenes import SCENES
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.settings import SynthConfig, parse_ev
from hdr_nsff.synth.synth import claim, exact, record_clip, render
from hdr_nsff.synth.views import clip_views

SEED = 0
FRAMES = 12
SIZE = (160, 90)  # of rendered frames
SPP = 64  # paths per pixel
RENDERED = ("lamp", "interior", "cloth")
FACTORS = {"half": 0.5, "default": 1.0, "double": 2.0}
LAST_STEP = "refined_flow"
MIN_CHANGE = 0.01  # of an error: less is no change
MIN_CHANGE_PERCENT = 1.0  # the same where the error of the default is 0 by definition


@dataclass(frozen=True)
class RecordedClip:
    """A recorded clip: where it is, and how it was exposed."""

    path: str  # in the folder of recorded clips
    ev: tuple[float, ...]  # of one cycle, stops
    stride: int = 1
    reexposed: bool = False  # it has one exposure, and is recorded again with these
    max_size: int = 256  # pixels


# A hand moves over books, a handheld camera around them (nonrigid_nerf); a camera that
# pans, and people (DeepHDRVideo-Dataset), recorded with two exposures in turn.
RECORDED = {
    "hand_books": RecordedClip("hand_books/images", (-2, 0, 2), stride=3, reexposed=True),
    "park_walkers": RecordedClip("alternating/park_walkers_2exp_3stop.mp4", (0, 3)),
}


@dataclass(frozen=True)
class Constant:
    """A tuning constant: a field of a step's tuning, and what it is judged by first."""

    step: str
    path: str  # attributes from the step's tuning
    metric: str

    @property
    def name(self) -> str:
        """The record that holds it, and its own name."""
        *parents, own = self.path.split(".")
        holder = STEPS[self.step].tuning
        for parent in parents:
            holder = getattr(holder, parent)
        return f"{type(holder).__name__}.{own}"


CONSTANTS = (
    Constant("exposure", "min_step_ev", "exposure"),
    Constant("response", "debevec.smoothness", "exposure"),
    Constant("flow", "semantic.reach", "flow"),
    Constant("flow", "dense.smoothness", "flow"),
    Constant("poses", "min_rotation_share", "pose"),
    Constant("poses", "reconstruction.sfm.max_free_focal_error_share", "pose"),
    Constant("poses", "reconstruction.sfm.trimming.drop_factor", "pose"),
    Constant("masks", "certain", "mask"),
    Constant("masks", "likely", "mask"),
    Constant("masks", "min_noise_px", "mask"),
    Constant("masks", "reach_frames", "mask"),
    Constant("static_depth", "plane_sweep.jump_penalty", "depth"),
    Constant("static_depth", "fuse.max_disparity_difference", "depth"),
    Constant("static_depth", "min_static_match", "still"),
    Constant("refined_flow", "local_motion.trusted_round_trip_px", "flow"),
    Constant("refined_flow", "local_motion.unlike_motion_px", "flow"),
    Constant("refined_flow", "least_squares.window_px", "flow"),
    Constant("refined_flow", "round_trip.max_error_px", "validity"),
    Constant("movers", "groups.max_residual_ratio", "mover depth"),
    Constant("movers", "bundle.flow_noise_px", "mover depth"),
    Constant("movers", "bundle.path_sigma", "mover depth"),
    Constant("movers", "segmentation.max_error", "mover depth"),
    Constant("movers", "distance.prior_sigma", "mover depth"),
)


@dataclass(frozen=True)
class Measurement:
    """One run of a step: the default of all its constants where `constant` is ""."""

    clip: str
    step: str
    constant: str
    factor: float


def main() -> None:
    prepare_process()
    parser = make_parser(__doc__, "sensitivity")
    parser.add_argument("work", type=Path, help="folder for clips and scenes")
    parser.add_argument("--data", type=Path, help="folder of recorded clips; default: none")
    parser.add_argument("--only", metavar="NAME", help="constants whose name contains this")
    names = [*RENDERED, *RECORDED]
    parser.add_argument("--clips", nargs="+", choices=names, default=names)
    args = parser.parse_args()
    record = Record("sensitivity", args, seed=SEED)
    record.settings |= {"frames": FRAMES, "size": SIZE, "spp": SPP}
    if args.out.is_file():
        record.results = read_json(args.out)["results"]
    constants = [c for c in CONSTANTS if args.only is None or args.only in c.name]
    clips = [clip for clip in args.clips if args.data or clip in RENDERED]
    wanted = [m for clip in clips for m in measurements(clip, constants)]
    stored = {measurement_of(row) for row in record.results}
    measure([m for m in wanted if m not in stored], constants, record, args.work, args.data)
    print(table(constants, record.results))
    idle = [c.name for c in constants if not changes_anything(c, record.results)]
    print(f"\nwithout effect: {', '.join(idle) or 'none'}")


def measurements(clip: str, constants: list[Constant]) -> list[Measurement]:
    """All measurements of a clip, the defaults of the steps first."""
    steps = dict.fromkeys(c.step for c in constants)
    defaults = [Measurement(clip, step, "", 1.0) for step in steps]
    changed = [
        Measurement(clip, c.step, c.name, FACTORS[key])
        for c in constants
        for key in ("half", "double")
    ]
    return defaults + changed


def measurement_of(row: dict[str, Any]) -> Measurement:
    """The measurement whose result a row holds."""
    return Measurement(row["clip"], row["step"], row["constant"], row["factor"])


def measure(
    missing: list[Measurement],
    constants: list[Constant],
    record: Record,
    work: Path,
    data: Path | None,
) -> None:
    """Do the measurements that are missing, and store each as it is done."""
    path_of = {c.name: c.path.split(".") for c in constants}
    start = time.monotonic()
    clip = None
    for done, m in enumerate(missing, 1):
        if clip is None or clip.name != m.clip:
            clip = open_clip(m.clip, work, data)
        step = STEPS[m.step]
        tuning, value = step.tuning, None
        if m.constant:
            tuning, value = scaled(step.tuning, path_of[m.constant], m.factor)
        repeats = 1 if m.constant else step.repeats
        runs = [step.errors(clip, tuning) for _ in range(repeats)]
        record.add(asdict(m) | {"value": value} | summary(runs), show=False)
        record.save(show=False)
        left = progress_of(done, len(missing), time.monotonic() - start)
        say(f"sensitivity: {done}{left}; {m.clip}, {m.constant or m.step} x{m.factor:g}")


def scaled(tuning: Any, path: list[str], factor: float) -> tuple[Any, float]:
    """The tuning with the constant at `path` multiplied by `factor`, and its new value.
    Whole numbers stay whole, and at least 1.
    """
    name, *rest = path
    value = getattr(tuning, name)
    if rest:
        inner, new = scaled(value, rest, factor)
        return replace(tuning, **{name: inner}), new
    new = max(1, round(value * factor)) if isinstance(value, int) else value * factor
    return replace(tuning, **{name: new}), new


def summary(runs: list[Errors]) -> dict[str, dict[str, Any]]:
    """The median errors of equal runs, and the range of each where there are several;
    infinite where the step failed (null in JSON).
    """
    values = {name: [float(f"{run[name]:.5g}") for run in runs] for name in runs[0]}
    summarized: dict[str, dict[str, Any]] = {}
    summarized["errors"] = {name: sorted(v)[len(v) // 2] for name, v in values.items()}
    if len(runs) > 1:
        summarized["range"] = {name: [min(v), max(v)] for name, v in values.items()}
    return summarized


# Clips


def open_clip(name: str, work: Path, data: Path | None) -> Clip:
    """A clip, rendered and prepared if that is not done yet."""
    scene = work / f"{name}_scene"
    if name in RENDERED:
        return open_rendered(name, work / f"{name}_clip", scene)
    assert data is not None
    recorded = RECORDED[name]
    frames = slice(0, FRAMES * recorded.stride, recorded.stride)
    clip = data / recorded.path
    if recorded.reexposed:
        clip = record_again(recorded, clip, work / f"{name}_clip", frames)
        frames = slice(0, FRAMES, 1)
    config = PrepareConfig(
        clip,
        scene,
        exposures="auto",
        hold_out=0,
        max_size=recorded.max_size,
        end=frames.stop,
        stride=frames.step,
    )
    return Clip(name, prepared(config), recorded.ev)


def record_again(recorded: RecordedClip, clip: Path, out: Path, frames: slice) -> Path:
    """The frames of a clip recorded with alternating exposures, as footage."""
    settings = ReexposeConfig(
        clip,
        out,
        ev=",".join(f"{ev:g}" for ev in recorded.ev),
        max_size=recorded.max_size,
        end=frames.stop,
        stride=frames.step,
        seed=SEED,
    )
    return reexpose(settings) / "clip"


def prepared(config: PrepareConfig) -> Work:
    """The scene folder of these settings with the steps up to the refined flow, which
    are those measured.
    """
    work = begin(config)
    for name, step in PREPARE_STEPS.items():
        run_step(work, name, step)
        if name == LAST_STEP:
            break
    return work


def open_rendered(name: str, folder: Path, scene: Path) -> Clip:
    """The first frames of a scene of `synth`, without its held-out views."""
    world = SCENES[name]
    config = SynthConfig(
        name,  # type: ignore[arg-type]
        folder,
        size=f"{SIZE[0]}x{SIZE[1]}",
        frames=FRAMES,
        ev=world.ev,
        spp=SPP,
        truth_spp=SPP,
        seed=SEED,
    )
    views = clip_views(world, FRAMES, SPP, SEED)
    K = intrinsics(*SIZE)
    ev = parse_ev(world.ev)
    claim(config)
    render(views, K, SIZE, config)
    frames = tuple(exact(folder, view) for view in views)
    c2w = np.stack([view.c2w for view in views])
    poses = folder / "poses_bounds.npy"
    if not poses.is_file():
        reference = sorted(ev)[len(ev) // 2]
        record_clip(views, [e - reference for e in ev], K, config)
        bounds = np.stack([np.percentile(frame["Z"], [0, 100]) for frame in frames])
        table_of_poses = llff_table(np.stack([K] * FRAMES), c2w, SIZE[::-1], bounds)
        write_npy(poses, table_of_poses)
    settings = PrepareConfig(folder / "clip", scene, poses=poses, hold_out=0)
    return Clip(name, prepared(settings), tuple(ev), frames, c2w, float(K[0, 0]))


# The table


def table(constants: list[Constant], rows: list[dict[str, Any]]) -> str:
    """Markdown: a line for each constant and clip."""
    lines = [
        "| constant | clip | error of | half | default | double | unit |",
        "|---|---|---|---|---|---|---|",
    ]
    for c in constants:
        for clip in dict.fromkeys(row["clip"] for row in rows):
            found = rows_of(c, clip, rows)
            if found is None or c.metric not in found["default"]["errors"]:
                continue  # not measured on this clip
            cells = [number(found[key]["errors"].get(c.metric)) for key in FACTORS]
            spread = found["default"].get("range", {}).get(c.metric)
            if spread is not None and spread[0] != spread[1]:
                cells[1] += f" ({number(spread[0])} to {number(spread[1])})"
            row = [c.name, clip, c.metric, *cells, unit(c, clip)]
            lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def unit(constant: Constant, clip: str) -> str:
    """The unit of the error of a constant's step."""
    metric = METRICS[constant.metric]
    return metric.recorded_unit if clip in RECORDED and metric.recorded_unit else metric.unit


def number(value: float | None) -> str:
    """An error in three digits."""
    return "fails" if value is None else f"{value:.3g}"


def rows_of(
    constant: Constant, clip: str, rows: list[dict[str, Any]]
) -> dict[str, dict[str, Any]] | None:
    """The results by the names of `FACTORS`; None where some are not measured."""
    by_measurement = {measurement_of(row): row for row in rows}
    found = {}
    for key, factor in FACTORS.items():
        name = "" if key == "default" else constant.name
        measurement = Measurement(clip, constant.step, name, factor)
        if measurement not in by_measurement:
            return None
        found[key] = by_measurement[measurement]
    return found


def changes_anything(constant: Constant, rows: list[dict[str, Any]]) -> bool:
    """Whether half or double changes any error of any clip by more than equal runs
    differ.
    """
    for clip in {row["clip"] for row in rows}:
        found = rows_of(constant, clip, rows)
        if found is None:
            continue
        default = found["default"]
        for metric, error in default["errors"].items():
            low, high = default.get("range", {}).get(metric, (error, error))
            for key in ("half", "double"):
                if differs(found[key]["errors"].get(metric), low, high):
                    return True
    return False


def differs(value: float | None, low: float | None, high: float | None) -> bool:
    """Whether an error lies outside the range of the default's; None stands for a
    failed step.
    """
    if value is None or low is None or high is None:
        return (value is None) != (low is None)
    below = MIN_CHANGE * low if low else MIN_CHANGE_PERCENT
    above = MIN_CHANGE * high if high else MIN_CHANGE_PERCENT
    return not low - below <= value <= high + above


if __name__ == "__main__":
    main()
