"""The plan of a benchmark, and its folder.

Settings are checked before anything runs, and a folder holds one benchmark.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from hdr_nsff.bench.config import SHARED, BenchConfig, BenchPlan, BenchRun
from hdr_nsff.bench.methods import parse_method
from hdr_nsff.bench.scenes import parse_scene
from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import SCENE_FILE, holds_nothing
from hdr_nsff.core.progress import say
from hdr_nsff.evaluation.report import check_place
from hdr_nsff.footage.frame_choice import check_max_size
from hdr_nsff.training.run_folder import open_folder

T = TypeVar("T")


def make_plan(config: BenchConfig) -> BenchPlan:
    """The scenes and methods of the settings. Writes nothing.

    InputError where they make no sense or are not there.
    """
    check_settings(config)
    methods = [parse_method(text, config) for text in config.methods.split(",")]
    scenes = [parse_scene(text, config) for text in config.scenes.split(",")]
    by_name = distinct(((scene.name, scene) for scene in scenes), "--scenes")
    plan = BenchPlan(config, tuple(by_name.values()), distinct(methods, "--methods"))
    check_only(plan)
    return plan


def check_settings(config: BenchConfig) -> None:
    """InputError for counts, sizes and budgets that make no sense."""
    check_max_size(config.max_size)
    if config.jobs < 1 or config.views < 0:
        advice = "choose at least one job, and no fewer than 0 views"
        raise InputError(f"--jobs {config.jobs} --views {config.views}: {advice}")
    if config.devices is not None:
        named = all(device.strip() for device in config.devices.split(","))
        if not named or config.jobs != 1:
            advice = "name devices such as 0,1; each takes one run at a time, so leave --jobs out"
            raise InputError(f"--devices {config.devices}: {advice}")
    if config.budget is not None and config.steps is not None:
        problem = "both given, and each sets how long to train"
        raise InputError(f"--budget and --steps {problem}; leave one out")


def check_only(plan: BenchPlan) -> None:
    """InputError where `--only` names neither a run nor a scene."""
    only = plan.config.only
    names = [run.name for run in plan.runs] + [scene.name for scene in plan.scenes]
    if only is not None and only not in names:
        raise InputError(f"--only {only!r:.100}: no such run; there are {', '.join(names)}")


def distinct(named: Iterable[tuple[str, T]], option: str) -> dict[str, T]:
    """{name: value}; InputError where two have one name."""
    found: dict[str, T] = {}
    for name, value in named:
        if name in found:
            advice = f"give one another name, {name}-2=..."
            raise InputError(f"{option}: two are called {name!r}; {advice}")
        found[name] = value
    return found


# The folder


def claim(plan: BenchPlan) -> None:
    """Make the folder this benchmark's.

    InputError where it holds other files, or runs with other settings.
    """
    out = plan.config.out
    path = out / "bench.json"
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; choose a folder")
    if not path.is_file() and out.is_dir() and not holds_nothing(out):
        raise InputError(
            f"{out}: holds other files and no benchmark; choose an empty or new folder"
        )
    check_place(out / "index.html")
    settings = {name: getattr(plan.config, name) for name in SHARED}
    sources = {scene.name: str(scene.source.resolve()) for scene in plan.scenes}
    before = notes.read(path, notes.Bench)
    if before is not None and is_begun(out):
        check_same(plan, before, settings, sources)
        sources = before.scenes | sources
    for run in plan.runs:
        check_run(run)
    notes.write(path, notes.Bench(settings=settings, scenes=sources))


def is_begun(out: Path) -> bool:
    """Whether anything in the folder was made with the settings that it notes."""
    made = ("runs/*/*/config.json", f"scenes/*/{SCENE_FILE}")
    return any(next(out.glob(pattern), None) is not None for pattern in made)


def check_same(
    plan: BenchPlan, before: notes.Bench, settings: dict[str, object], sources: dict[str, str]
) -> None:
    """InputError where the folder holds runs with other settings or of other scenes."""
    out = plan.config.out
    for name, value in settings.items():
        earlier = before.settings.get(name)
        if earlier != value:
            problem = f"holds runs {difference(name, earlier, value)}"
            raise InputError(f"{out}: {problem}; choose another folder, or delete it")
    for name, source in sources.items():
        earlier_source = before.scenes.get(name, source)
        if earlier_source != source:
            problem = f"there {name} is the scene {earlier_source}"
            raise InputError(f"{out}: {problem}; give this one another name, NAME=FOLDER")


def difference(name: str, earlier: object, value: object) -> str:
    """How a setting was given before, and how not: "with --steps 5, not 7"."""
    option = f"--{name.replace('_', '-')}"
    if isinstance(value, bool):
        return f"with {option}, not without it" if earlier else f"without {option}, not with it"
    if value is None:
        return f"with {option} {earlier}, not without it"
    if earlier is None:
        return f"without {option}, not with {option} {value}"
    return f"with {option} {earlier}, not {value}"


def check_run(run: BenchRun) -> None:
    """InputError where the folder of a run holds another one.

    That is a run with other settings, or of another state of the scene.
    """
    if (run.folder / "config.json").is_file():
        open_folder(run.config)
    record = notes.read(run.record, notes.RunRecord)
    if record is not None and run.scene.ready and record.scene_key != run.scene.key:
        problem = f"was trained before {run.scene.folder} changed"
        raise InputError(f"{run.folder}: {problem}; choose another folder, or delete this run")


def describe_scenes(plan: BenchPlan) -> None:
    """Print every scene and the truth that its runs are measured on."""
    for scene in plan.scenes:
        truth = scene.truth or "the views that its data set or `prepare` holds out"
        oracle = ", an oracle run" if scene.oracle else ""
        say(f"{scene.name}: {scene.source}, measured on {truth}{oracle}")
