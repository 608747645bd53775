"""The settings of `bench`, and what they ask for: scenes x methods, each pair a run in
a folder of its own.

OUT/bench.json              what all runs have in common OUT/scenes/NAME/
footage, prepared once for all methods OUT/runs/SCENE/METHOD/      a run folder, with
its measurements OUT/logs/SCENE/METHOD.log   what its process said OUT/results.*,
index.html   the tables
"""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import tyro
from tyro.conf import Positional

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.evaluation.evaluate import views_of_clip
from hdr_nsff.evaluation.report import check_place
from hdr_nsff.footage.datasets import layout_of
from hdr_nsff.pipeline import RunConfig, held_out_every
from hdr_nsff.prepare.prepare import STEPS, PrepareConfig, held_out_truth
from hdr_nsff.scene.manifest import Manifest, Protocol
from hdr_nsff.synth.oracle import NOTE as ORACLE
from hdr_nsff.training.config import TrainConfig, check
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.train import open_folder


@dataclass(frozen=True)
class BenchConfig:
    """Train and measure methods on scenes, every pair a run of its own; tables, curves
    and pictures side by side.

    Killed, the same command goes on where it was; with more scenes or methods it adds
    theirs. A run that fails is shown with its reason, the others go on, and the exit
    code is 1.
    """

    out: Positional[Path]
    """Folder for everything; the results are OUT/index.html, results.md, results.csv,
    results.json.
    """
    scenes: str
    """Scenes with commas between them: scene folders, folders that `synth` or
    `reexpose` wrote, or public data sets. NAME=FOLDER gives one another name,
    FOLDER:TRUTH a truth folder; else truth/ in the scene folder or beside it is used,
    else its held-out frames.
    """
    methods: str
    """Presets with commas between them. NAME=PRESET OPTIONS changes settings as `train`
    does: "splat,no-flow=splat --loss.flow 0".
    """
    budget: str | None = None
    """Training time of each run: 5min, 90s, 0.5h. Default: the presets' own."""
    steps: int | None = None
    """Steps of each run, instead."""
    protocol: Protocol | None = None
    """How `prepare` splits footage, and which held-out views count, see `prepare
    --help`.
    """
    oracle: bool = False
    """Of `synth` folders take the oracle scene: exact poses and masks, given depth and
    flow. The results are named so.
    """
    jobs: int = 1
    """Runs at once on this machine, which share its threads."""
    devices: str | None = None
    """CUDA devices with commas between them: one run at once on each."""
    device: str = "auto"
    """auto, cpu or cuda."""
    lpips: str | None = None
    """LPIPS: a file with AlexNet weights, or `hub` to download them."""
    views: int = 4
    """Held-out views that are also measured after 1/8, 1/4 and 1/2 of the training, and
    of which pictures are shown; 0: none.
    """
    max_size: int = 640
    """Longest side in pixels of footage; larger frames are shrunk."""
    seed: int = 0
    only: str | None = None
    """Do one run, SCENE/METHOD, or prepare one SCENE, and write no tables."""
    list: bool = False
    """Print a command for every run, one a line, for job arrays; run nothing."""
    collect: bool = False
    """Run nothing; write the tables of what is there."""


OF_THE_WHOLE = ("jobs", "devices", "only", "list", "collect")  # settings that a single run has not
COMMON = (
    "budget",
    "steps",
    "protocol",
    "oracle",
    "views",
    "max_size",
    "seed",
)  # settings that all runs in a folder share


@dataclass(frozen=True)
class BenchScene:
    """A scene to be trained on."""

    name: str
    folder: Path  # the scene folder
    given_truth: Path | None
    footage: PrepareConfig | None  # how the scene folder is made, where it is not there yet
    oracle: bool  # made from the truth

    @property
    def ready(self) -> bool:
        """Whether the scene folder is whole."""
        if self.footage is None:
            return True
        if not (self.folder / "scene.json").is_file():
            return False
        found = Manifest.load(self.folder)
        done = all(name in found.steps and found.steps[name].done for name in STEPS)
        return done and (self.truth is not None or layout_of(self.footage.clip) is None)

    @property
    def truth(self) -> Path | None:
        """Its truth folder; None where it has none, or none yet."""
        return self.given_truth or (held_out_truth(self.footage) if self.footage else None)

    @property
    def key(self) -> str:
        """A hash of what is trained on."""
        return hashlib.sha256((self.folder / "scene.json").read_bytes()).hexdigest()[:16]


@dataclass(frozen=True)
class BenchRun:
    """One run: a method on a scene."""

    scene: BenchScene
    method: str
    config: TrainConfig
    out: Path

    @property
    def name(self) -> str:
        """SCENE/METHOD."""
        return f"{self.scene.name}/{self.method}"

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.config.out

    @property
    def log(self) -> Path:
        """Where its process writes what it says."""
        return self.out / "logs" / self.scene.name / f"{self.method}.log"


@dataclass(frozen=True)
class Plan:
    """All that is asked for."""

    config: BenchConfig
    scenes: tuple[BenchScene, ...]
    methods: dict[str, TrainConfig]

    @cached_property
    def cells(self) -> tuple[BenchRun, ...]:
        """The runs, scene by scene."""
        out = self.config.out
        return tuple(
            BenchRun(s, name, replace(m, scene=s.folder, out=out / "runs" / s.name / name), out)
            for s in self.scenes
            for name, m in self.methods.items()
        )


def make_plan(config: BenchConfig) -> Plan:
    """What is asked for; InputError where it makes no sense or is not there. Writes
    nothing.
    """
    if config.jobs < 1 or config.views < 0:
        raise InputError(
            f"--jobs {config.jobs} --views {config.views}: choose at least one job, and no fewer than 0 views"
        )
    if config.devices is not None and (
        config.jobs != 1 or not all(d.strip() for d in config.devices.split(","))
    ):
        raise InputError(
            f"--devices {config.devices}: name devices such as 0,1; each takes one run at once, so leave --jobs out"
        )
    if config.budget is not None and config.steps is not None:
        raise InputError(
            "--budget and --steps both given, and each says how long to train; leave one out"
        )
    methods = distinct([method(text, config) for text in config.methods.split(",")], "--methods")
    scenes = distinct(
        [(s.name, s) for s in (scene(text, config) for text in config.scenes.split(","))],
        "--scenes",
    )
    return Plan(config, tuple(scenes.values()), methods)


def distinct(named: list[tuple[str, Any]], option: str) -> dict[str, Any]:
    """{name: value}; InputError where two have one name."""
    names = [name for name, _ in named]
    if twice := next((n for n in names if names.count(n) > 1), None):
        raise InputError(
            f"{option}: two are called {twice!r}; give one another name, {twice}-2=..."
        )
    return dict(named)


def minutes_of(budget: str) -> float:
    """Minutes of "5min", "90s" or "0.5h"."""
    units = {"s": 1 / 60, "sec": 1 / 60, "m": 1.0, "min": 1.0, "h": 60.0}
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*([a-z]+)", budget.strip().lower())
    if found is None or found[2] not in units or not 0 < float(found[1]) * units[found[2]] <= 1e6:
        raise InputError(f"--budget {budget!r:.40}: write a time such as 5min, 90s or 0.5h")
    return float(found[1]) * units[found[2]]


def safe_name(text: str, what: str) -> str:
    """`text` as the name of a folder: letters, digits, `_`, `-` and dots inside; others
    become `_`.
    """
    name = re.sub(r"[^\w.\-]", "_", text).strip("._")[:60]
    if not name:
        raise InputError(
            f"{what} {text!r:.60}: cannot be a name; give it one of letters and digits, NAME=..."
        )
    return name


# Methods

OURS = (
    "scene",
    "out",
    "steps",
    "minutes",
    "seed",
    "device",
)  # settings of `train` that are the same for all methods


def method(text: str, config: BenchConfig) -> tuple[str, TrainConfig]:
    """The name and the settings of "PRESET" or "NAME=PRESET OPTIONS"."""
    found = re.fullmatch(r"\s*(?:([^\s=]+)=)?(.*)", text, re.DOTALL)
    assert found is not None
    try:
        words = shlex.split(found[2])
    except ValueError as error:
        raise InputError(f"--methods {text!r:.60}: {error}; mend the quotes") from error
    if not words or words[0] not in PRESETS:
        raise InputError(
            f"--methods: no preset {' '.join(words[:1])!r:.60}; there are {', '.join(PRESETS)}"
        )
    if len(words) > 1 and found[1] is None:
        raise InputError(
            f"--methods {text!r:.60}: a method with options needs a name of its own, NAME={text.strip()[:60]}"
        )
    if taken := [o for o in OURS if any(w.split("=")[0] == f"--{o}" for w in words)]:
        raise InputError(
            f"--methods {text!r:.60}: --{taken[0]} is the same for all runs of a bench; leave it out there"
        )
    settings = tyro.extras.overridable_config_cli(
        {k: ("", v) for k, v in PRESETS.items()}, prog="--methods", args=words
    )
    settings = replace(settings, seed=config.seed, device=config.device)
    if config.budget is not None:
        settings = replace(settings, minutes=minutes_of(config.budget), steps=None)
    if config.steps is not None:
        settings = replace(settings, minutes=None, steps=config.steps)
    check(settings)
    return safe_name(found[1] or words[0], "--methods"), settings


# Scenes


def scene(text: str, config: BenchConfig) -> BenchScene:
    """The scene of "[NAME=]FOLDER[:TRUTH]"; InputError where there is none."""
    label, folder, given = split_scene(text.strip())
    name = safe_name(label or Path(os.path.abspath(folder)).name, "--scenes")
    if given is not None and not (given / "truth.json").is_file():
        raise InputError(
            f"--scenes {text.strip()!r:.200}: no truth.json in {given}; mend the path, or leave it out"
        )
    if (folder / "scene.json").is_file():
        return prepared(name, folder, given, config)
    footage = next((p for p in (folder / "clip.mp4", folder / "clip") if p.exists()), None)
    if footage is not None and (given or (folder / "truth" / "truth.json").is_file()):
        truth_folder = given or folder / "truth"
        return (
            of_oracle(name, folder, truth_folder)
            if config.oracle
            else of_footage(name, footage, truth_folder, config)
        )
    if layout_of(folder) is not None and not config.oracle:
        return of_footage(name, folder, given, config)
    raise InputError(
        f"--scenes {text.strip()!r:.200}: holds no scene.json, no clip with its truth/ as `synth` and `reexpose` write them, and no public data "
        "set; make a scene of other footage with `hdr-nsff prepare`"
    )


def split_scene(text: str) -> tuple[str | None, Path, Path | None]:
    """Name, folder and truth folder of "[NAME=]FOLDER[:TRUTH]". What is a folder as it
    stands is taken for one.
    """
    label, equals, rest = text.partition("=")
    for name, place in ((None, text), (label if equals else None, rest if equals else text)):
        folder, colon, truth = place.rpartition(":")
        if place and Path(place).is_dir():
            return name, Path(place), None
        if colon and folder and Path(folder).is_dir():
            return name, Path(folder), Path(truth)
    raise InputError(
        f"--scenes {text!r:.200}: no such folder; mend the path (one with a comma in it cannot be given)"
    )


def prepared(name: str, folder: Path, given: Path | None, config: BenchConfig) -> BenchScene:
    """A scene folder that is there already."""
    manifest = Manifest.load(folder)
    oracle = any(ORACLE in step.note for step in manifest.steps.values())
    if config.oracle and not oracle:
        raise InputError(
            f"--oracle: {folder} is a scene made from footage; give a folder that `hdr-nsff synth --oracle` wrote"
        )
    if config.protocol is not None and manifest.protocol != config.protocol:
        raise InputError(
            f"--protocol {config.protocol}: {folder} is prepared already, for {manifest.protocol or 'none'}; give its footage, or leave the option out"
        )
    beside = (
        folder / "truth",
        folder.absolute().parent / "truth",
        folder.absolute().with_name(f"{folder.absolute().name}_truth"),
    )
    truth = given or next((p for p in beside if (p / "truth.json").is_file()), None)
    if truth is not None:
        views_of_clip(truth)  # refuses what is no truth
    return BenchScene(oracle_name(name) if oracle else name, folder, truth, None, oracle)


def oracle_name(name: str) -> str:
    """A name that says it."""
    return name if "oracle" in name else f"{name}-oracle"


def of_oracle(name: str, folder: Path, truth: Path) -> BenchScene:
    """The oracle scene that `synth --oracle` wrote."""
    if not (folder / "oracle" / "scene.json").is_file():
        raise InputError(
            f"--oracle: {folder} holds no oracle/; run `hdr-nsff synth` with `--oracle` on it again"
        )
    views_of_clip(truth)
    return BenchScene(oracle_name(name), folder / "oracle", truth, None, True)


def of_footage(name: str, clip: Path, truth: Path | None, config: BenchConfig) -> BenchScene:
    """A scene that `prepare` makes of a clip, with poses where they were given for it."""
    out = config.out / "scenes" / name
    every = held_out_every(RunConfig(clip, out, truth=truth, protocol=config.protocol))
    poses = clip.parent / "poses_bounds.npy"
    known = poses if truth is not None and poses.is_file() else None
    footage = PrepareConfig(
        clip, out, max_size=config.max_size, hold_out=every, protocol=config.protocol, poses=known
    )
    return BenchScene(name, out, truth, footage, False)


# The folder


def claim(plan: Plan) -> None:
    """Make the folder this benchmark's; InputError where it holds something else, or
    runs with other settings.
    """
    config = plan.config
    path, out = config.out / "bench.json", config.out
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; choose a folder")
    settings = {name: getattr(config, name) for name in COMMON}
    places = {
        s.name: str((s.footage.clip if s.footage else s.folder).resolve()) for s in plan.scenes
    }
    if not path.is_file() and out.is_dir() and any(out.iterdir()):
        raise InputError(f"{out}: holds other files and no bench; choose an empty or new folder")
    check_place(out / "index.html")
    before = notes.read(path, notes.Bench)
    if before is not None:
        for name, value in settings.items():
            if before.settings.get(name) != value:
                option = f"--{name.replace('_', '-')}"
                was = before.settings.get(name)
                raise InputError(
                    f"{out}: holds runs with {option} {was}, not {value}; choose another folder, or delete it"
                )
        if moved := next(
            (n for n, place in places.items() if before.scenes.get(n, place) != place), None
        ):
            raise InputError(
                f"{out}: there {moved} is the scene {before.scenes[moved]}; give this one another name, NAME=FOLDER"
            )
        places = before.scenes | places
    for cell in plan.cells:
        check_cell(cell)
    notes.write(path, notes.Bench(settings=settings, scenes=places))


def check_cell(cell: BenchRun) -> None:
    """InputError where the folder of a run holds one with other settings, or of another
    state of the scene.
    """
    if (cell.folder / "config.json").is_file():
        open_folder(cell.config)
    trial = notes.read(cell.folder / "trial.json", notes.RunRecord)
    if trial is not None and cell.scene.ready and trial.scene_key != cell.scene.key:
        raise InputError(
            f"{cell.folder}: was trained before {cell.scene.folder} changed; choose another folder, or delete this run"
        )


def introduce(plan: Plan) -> None:
    """Say what will be measured on what."""
    for s in plan.scenes:
        against = (
            f"measured on {s.truth}"
            if s.truth
            else "measured on what its data set or `prepare` holds out"
        )
        say(
            f"{s.name}: {s.footage.clip if s.footage else s.folder}, {against}{', an oracle run' if s.oracle else ''}"
        )


def arguments(config: BenchConfig, only: str) -> list[str]:
    """What follows `hdr-nsff` in the command that does one run, or prepares one scene,
    of a benchmark.
    """
    words = ["bench", str(config.out)]
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name in ("out", *OF_THE_WHOLE) or value == field.default:
            continue
        option = f"--{field.name.replace('_', '-')}"
        words += [option] if value is True else [f"{option}={value}"]
    return [*words, "--only", only]
