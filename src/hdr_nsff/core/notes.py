"""Notes: JSON files of fixed shape that verbs leave beside their results.

A restart and the report read them. A note that was cut short or edited into another
shape counts as missing. The user reads a message about it, and the verb that needs it
makes it again. A JSON file of the same name that no verb has written belongs to the
user and stays as it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import read_json, write_json
from hdr_nsff.core.progress import say

Brightness = Annotated[float, Field(gt=0, lt=1e30)]
Count = Annotated[int, Field(ge=0)]


class Note(BaseModel):
    """What all notes have in common."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    # keys that distinguish a note of this kind from files of other programs
    marks: ClassVar[tuple[str, ...]] = ()


N = TypeVar("N", bound=Note)


class ShotShare(Note):
    """The part of a shot that fits into its time budget."""

    scale: float = Field(ge=0.05, le=1)
    views: list[Count] = Field(min_length=1)  # positions in the shot


class RenderPlan(Note):
    """`plan.json`: how the standard set spends its time budget."""

    marks = ("key", "shots")
    key: str
    seconds_at_a_time: float  # for one picture of the clip's size, at a training time
    seconds_between: float  # the same between training times
    refused: list[str]  # sentences about shots that the clip does not allow
    shots: dict[str, ShotShare]


class SequenceView(Note):
    """One view of a shot."""

    time: float  # in frames
    ev: float | None
    frame: int | None = None  # the training frame filmed there, by its index in the clip


class Sequence(Note):
    """`sequence.json` of a rendered shot."""

    marks = ("key", "views")
    key: str
    step: int
    fps: float
    display_exposure: Brightness
    views: list[SequenceView] = Field(min_length=1)
    seconds: float  # spent so far
    complete: bool = False
    of_set: bool = False  # of the standard set, which replaces its own shots only


class ExportedSequence(Note):
    """`FOLDER.sequence.json` beside a folder of exported Gaussians."""

    marks = ("key", "times")
    key: str
    step: int
    times: list[float]  # in frames, one per file
    display_exposure: Brightness


class TruthNote(Note):
    """`made_of.json`: a hash of the files that a truth folder was made from."""

    marks = ("key",)
    key: str


class LayoutNote(Note):
    """`hdr_nsff_export.json` of a scene exported in a public layout."""

    marks = ("layout",)
    layout: str = Field(min_length=1)
    scene: str
    files: list[str] = []  # that the export wrote, below its folder


class PictureRanges(Note):
    """`views.json`: the ranges of the colored pictures of the standard set."""

    marks = ("key", "depth_range")
    key: str
    depth_range: tuple[Brightness, Brightness]  # z-depth, scene units
    fastest: Brightness  # motion until the next frame, pixels
    moves: bool  # whether the field has scene flow
    exposures: list[float]  # EV


class ClipPart(Note):
    """A part of a clip between two cuts: frames of the footage, counted from 0."""

    start: Count
    end: Count  # the frame to stop before
    # which exposure a frame has, 0 the darkest, by its number modulo the cycle; empty
    # where exposures do not alternate
    cycle: list[Count] = []


class ClipParts(Note):
    """`parts.json`: where `prepare` cut a clip, and which frames it was to use."""

    marks = ("choice", "parts")
    choice: dict[str, int | None]
    parts: list[ClipPart] = Field(min_length=1)


class FlowError(Note):
    """End-point error, in pixels."""

    mean: float = Field(ge=0)
    median: float = Field(ge=0)


class FlowErrors(Note):
    """`before.json` of `finetune-flow`: errors of the network that it starts from.

    On the pairs kept out of training.
    """

    by_stops: dict[str, FlowError] = Field(min_length=1)  # EV between the two pictures -> error


class LogLine(Note):
    """One line of a run's `log.jsonl`."""

    step: Count
    seconds: float
    psnr: float
    rays_per_second: float
    losses: dict[str, float]


class Bench(Note):
    """`bench.json`: the settings that all runs of a benchmark share."""

    marks = ("settings", "scenes")
    settings: dict[str, str | int | float | bool | None]
    scenes: dict[str, str]  # name -> folder


class Machine(Note):
    """The machine and the program that a run was trained with."""

    cpu: str  # name
    cores: Count  # logical ones of the machine
    memory: Count | None  # bytes; None where the system does not say
    system: str  # such as Linux-6.1-x86_64
    python: str  # version
    torch: str  # version
    version: str  # of hdr-nsff
    commit: str | None  # of the checkout it was run from, "-dirty" with changes; None: installed


class Trained(Note):
    """The training of a benchmark's run: its cost, and where it ran."""

    steps: Count
    seconds: float  # of training
    # from reading the scene to the first step, and writing; in the process that
    # finished the training
    start_seconds: float
    memory: Count  # bytes, the peak of that process
    gpu_memory: Count | None = None  # bytes
    device: str  # "cpu", or the name of the GPU
    threads: Count
    frame_seconds: float  # to render a frame of the scene
    seed: int
    machine: Machine


class CurvePoint(Note):
    """Quality on a few held-out views, part of the way through the training."""

    share: float
    step: Count
    seconds: float  # of training
    scores: dict[str, float]


class ShownView(Note):
    """A held-out view of which pictures were kept, and its scores."""

    name: str = Field(pattern=r"^[^/\x00]+$", max_length=200)
    time: float  # in frames
    scores: dict[str, float]


class RunRecord(Note):
    """`run_record.json`: the state of a benchmark's run."""

    marks = ("scene_key", "trained")
    scene_key: str  # of the scene folder it was trained on
    trained: Trained | None = None
    measured: str | None = None  # hash of the truth and the settings it was measured with
    metrics: str | None = None  # hash of the metrics.json written then; None: unknown
    seconds: float = 0.0  # of measuring
    curve: list[CurvePoint] = []
    shown: list[ShownView] = []


class Failure(Note):
    """`failure.json`: why a run of a benchmark has no result."""

    marks = ("reason", "log")
    reason: str
    log: str | None


class Scores(BaseModel):
    """Means over some views; every further key is a score."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)
    __pydantic_extra__: dict[str, float | None]
    views: int


class ViewScores(BaseModel):
    """One view; every further key is a score."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)
    __pydantic_extra__: dict[str, float | None]
    name: str = Field(pattern=r"^[^/\x00]+$", max_length=200)
    group: str
    protocol: str | None = None
    time: float
    bracket: int
    psnr: float


class TrueResponse(Note):
    """The curve of the true camera."""

    x: list[float]
    y: list[list[float]] = Field(min_length=3, max_length=3)

    @model_validator(mode="after")
    def fits(self) -> Self:
        if any(len(channel) != len(self.x) for channel in self.y):
            raise ValueError("x and y differ in length")
        return self


class Pu21(Note):
    """The luminance that scores in PU21 assume."""

    white: float
    nits: float


Digits = Annotated[int, Field(ge=0, le=9)]
Labels = dict[str, tuple[str, Digits]]  # score -> its label, and the digits to show


class Metrics(Note):
    """`metrics.json`: the results of `evaluate`."""

    step: int | None = None  # of the run that was measured
    kind: str
    notes: list[str]
    headline: Scores
    protocol: str | None = None
    groups: dict[str, Scores]
    protocols: dict[str, Scores] = {}
    views: list[ViewScores]
    lpips: str
    seconds: float
    hdr_scores: Labels | None = None
    peak: float | None = None
    recordable_peak: float | None = None
    scale: float | None = None
    scale_per_channel: list[float] | None = None
    pu21: Pu21 | None = None
    geometry_scores: Labels | None = None
    depth_scale: float | None = None
    world_scale: float | None = None
    camera: dict[str, int | float | list[float] | TrueResponse] | None = None
    poses: dict[str, int | float] | None = None
    stability: dict[str, int | float] | None = None

    @model_validator(mode="after")
    def fits(self) -> Self:
        if empty := set(self.groups) - {v.group for v in self.views}:
            raise ValueError(f"no view is of the group {min(empty)}")
        gauge = (self.peak, self.recordable_peak, self.scale, self.scale_per_channel)
        if self.hdr_scores is not None and None in gauge:
            raise ValueError("hdr_scores without their scale")
        if self.geometry_scores is not None and self.depth_scale is None:
            raise ValueError("geometry_scores without their scale")
        if not isinstance((self.camera or {}).get("true_response"), TrueResponse | None):
            raise ValueError("true_response is no curve")
        return self


def read(path: Path, kind: type[N]) -> N | None:
    """The note at `path`; None where there is none.

    None, with a message, also where it is damaged. InputError where the file is not a
    note of this kind.
    """
    if not path.is_file():
        return None
    try:
        data = read_json(path)
        if kind.marks and not (isinstance(data, dict) and set(kind.marks) <= data.keys()):
            problem = "already exists and was not made by hdr-nsff"
            raise InputError(f"{path}: {problem}; move it away, or choose another place")
        return kind.model_validate(data)
    except InputError:
        raise
    except ValueError as error:
        say(f"{path}: cut short or edited, treated as missing ({first_problem(error)})")
        return None


def write(path: Path, note: Note) -> None:
    """Write a note, atomically."""
    write_json(path, note.model_dump())


def first_problem(error: Exception) -> str:
    """The first thing pydantic or json complained about, in a few words."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return f"{place or 'top level'}: {first['msg']}"
    return str(error)


def to_dict(note: Note) -> dict[str, Any]:
    """A note as plain data, without the fields that are None."""
    return note.model_dump(exclude_none=True)
