"""The settings of `bench`, and the records they become.

Every pair of a scene and a method is a run in a folder of its own:

    OUT/bench.json               settings that all runs share
    OUT/scenes/NAME/             footage, prepared once for all methods
    OUT/runs/SCENE/METHOD/       a run folder, with its measurements
    OUT/logs/SCENE/METHOD.log    the output of its process
    OUT/results.*, index.html    the tables
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

from tyro.conf import Positional

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.datasets import recognize
from hdr_nsff.prepare.prepare import STEPS, PrepareConfig, held_out_truth
from hdr_nsff.scene.manifest import Manifest, Protocol
from hdr_nsff.training.config import TrainConfig

MAX_NAME_LENGTH = 60  # letters of a folder's name


@dataclass(frozen=True)
class BenchConfig:
    """Train and measure methods on scenes; tables, curves and pictures side by side.

    Every pair is a run of its own. Killed, the same command continues where it was;
    with more scenes or methods it adds theirs. A run that fails is shown with its
    reason, the others go on, and the exit code is 1.
    """

    out: Positional[Path]
    """Folder for everything; the results are OUT/index.html, results.md, results.csv,
    results.json.
    """
    scenes: str
    """Scenes with commas between them: scene folders, folders that `synth` or
    `reexpose` wrote, public data sets, videos or folders of frames. NAME=PLACE gives
    one another name, PLACE:TRUTH a truth folder; else truth/ in the scene folder or
    beside it is used, else the frames that `prepare` holds out.
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
    """Number of parallel runs on this machine, which share its threads."""
    devices: str | None = None
    """CUDA devices with commas between them: one run at a time on each."""
    device: str = "auto"
    """auto, cpu or cuda."""
    lpips: str | None = None
    """LPIPS: a file with AlexNet weights, or `hub` to download them."""
    views: int = 4
    """Held-out views that are also measured after 1/8, 1/4, 1/2 and 4/5 of training,
    and of which pictures are shown; 0: none.
    """
    max_size: int = 640
    """Longest side in pixels of footage; larger frames are shrunk."""
    seed: int = 0
    only: str | None = None
    """Do one run, SCENE/METHOD, or prepare one SCENE, and write no tables."""
    list: bool = False
    """Print a command for every run, one a line, for job arrays; run nothing."""
    collect: bool = False
    """Run nothing; write the tables of the runs that are done."""


# Settings of the whole benchmark, not of a single run.
WHOLE_ONLY = ("jobs", "devices", "only", "list", "collect")
# Settings that all runs in a folder share.
SHARED = ("budget", "steps", "protocol", "oracle", "views", "max_size", "seed")


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
        """Whether the scene folder is complete."""
        if self.footage is None:
            return True
        if not (self.folder / "scene.json").is_file():
            return False
        steps = Manifest.load(self.folder).steps
        done = all(name in steps and steps[name].done for name in STEPS)
        return done and (self.truth is not None or not holds_views_out(self.footage.clip))

    @property
    def truth(self) -> Path | None:
        """Its truth folder; None where it has none, or none yet."""
        if self.given_truth is not None:
            return self.given_truth
        return None if self.footage is None else held_out_truth(self.footage)

    @property
    def source(self) -> Path:
        """The folder or file that it was given as."""
        return self.folder if self.footage is None else self.footage.clip

    @property
    def key(self) -> str:
        """A hash of the scene that is trained on."""
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
        """The output of its process."""
        return self.out / "logs" / self.scene.name / f"{self.method}.log"

    @property
    def record(self) -> Path:
        """The note of its state."""
        return self.folder / "run_record.json"

    @property
    def failure(self) -> Path:
        """The note of why it has no result."""
        return self.folder / "failure.json"


@dataclass(frozen=True)
class BenchPlan:
    """All scenes and methods of a benchmark."""

    config: BenchConfig
    scenes: tuple[BenchScene, ...]
    methods: dict[str, TrainConfig]

    @cached_property
    def runs(self) -> tuple[BenchRun, ...]:
        """The runs, scene by scene."""
        out = self.config.out
        runs = []
        for scene in self.scenes:
            for name, method in self.methods.items():
                folder = out / "runs" / scene.name / name
                config = replace(method, scene=scene.folder, out=folder)
                runs.append(BenchRun(scene, name, config, out))
        return tuple(runs)


def holds_views_out(clip: Path) -> bool:
    """Whether a clip is a public data set with held-out views, which become a truth."""
    capture = recognize(clip)
    return capture is not None and capture.has_held_out


def safe_name(text: str, option: str) -> str:
    """`text` as the name of a folder: letters, digits, `_`, `-` and dots inside.

    Other characters become `_`. InputError, which names the `option`, where nothing
    is left.
    """
    name = re.sub(r"[^\w.\-]", "_", text).strip("._")[:MAX_NAME_LENGTH]
    if not name:
        advice = "give it one of letters and digits, NAME=..."
        raise InputError(f"{option} {text!r:.60}: cannot be a name; {advice}")
    return name


def arguments(config: BenchConfig, only: str) -> list[str]:
    """The words after `hdr-nsff` of the command for one run.

    `only`: its name, or that of a scene to be prepared.
    """
    return [*bench_words(config, WHOLE_ONLY), "--only", only]


def bench_words(config: BenchConfig, without: tuple[str, ...]) -> list[str]:
    """The words after `hdr-nsff` of a command with these settings.

    Defaults and the settings `without` are left out.
    """
    words = ["bench", str(config.out)]
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name in ("out", *without) or value == field.default:
            continue
        option = f"--{field.name.replace('_', '-')}"
        words.append(option if value is True else f"{option}={value}")
    return words
