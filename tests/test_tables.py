"""The tables of a benchmark: means, best and worst, failed runs, machines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hdr_nsff.bench import tables
from hdr_nsff.bench.config import BenchRun, BenchScene
from hdr_nsff.bench.tables import Row, best_numbers, describe_machines, means
from hdr_nsff.core.notes import Machine, RunRecord, Trained
from hdr_nsff.training.presets import PRESETS

MACHINE = Machine(
    cpu="Some CPU",
    cores=4,
    memory=None,
    system="Linux",
    python="3.11",
    torch="2.6",
    version="1.0",
    commit="abc",
)
TRAINED = Trained(
    steps=1234,
    seconds=10.0,
    start_seconds=1.0,
    memory=10**9,
    device="cpu",
    threads=1,
    frame_seconds=0.5,
    seed=0,
    machine=MACHINE,
)


def row(
    scene: str, method: str, psnr: float | None, oracle: bool = False, trained: Trained = TRAINED
) -> Row:
    """A made-up run; without `psnr` it failed."""
    folder = Path("out/runs") / scene / method
    where = BenchScene(scene, Path(scene), None, None, oracle)
    run = BenchRun(where, method, replace(PRESETS["tiny"], out=folder), Path("out"))
    if psnr is None:
        return Row(run, "failed", "no | luck", None, None)
    metrics = {"headline": {"views": 3, "psnr": psnr}, "kind": "views", "notes": []}
    return Row(run, "done", "", metrics, RunRecord(scene_key="k", trained=trained))


ROWS = [
    row("a", "x", 30.0),
    row("a", "y", 20.0),
    row("b", "x", 10.0),
    row("b", "y", None),
    row("c", "x", 20.0),
    row("c", "y", 30.0),
]


def test_means_are_over_the_scenes_that_all_methods_have_finished() -> None:
    x, y = means([*ROWS, row("a", "z", None)], oracle=False)
    assert x.scenes == y.scenes == ("a", "c")
    assert (x.values["psnr"], y.values["psnr"]) == (25.0, 25.0)
    assert (x.best, x.worst) == ("a", "b") and (y.best, y.worst) == ("c", "a")


def test_means_of_oracle_runs_are_apart() -> None:
    rows = [*ROWS, row("o", "x", 99.0, oracle=True)]
    assert [mean.scenes for mean in means(rows, oracle=False)] == [("a", "c")] * 2
    (oracle,) = means(rows, oracle=True)
    assert (oracle.scenes, oracle.values["psnr"]) == (("o",), 99.0)


def test_the_best_of_each_scene_is_marked_and_a_tie_is_two() -> None:
    rows = [
        row("a", "x", 30.001),
        row("a", "y", 30.002),
        row("b", "x", 10.0),
        row("b", "y", 10.1),
        row("c", "x", 5.0),
    ]
    assert best_numbers(rows, tables.SCORES[:1]) == {(0, 0), (1, 0), (3, 0)}


def test_a_failed_run_stays_in_the_markdown_and_breaks_no_column() -> None:
    rows = [row("a", "x", 30.0), row("a", "y", None)]
    lines = tables.markdown_table(rows, tables.SCORES).splitlines()
    assert lines[2:] == ["| a | x | 30.00 |", "| a | y | failed |"]
    costs = tables.markdown_table(rows, tables.COSTS).splitlines()[2]
    assert costs == "| a | x | 10.0 | 1,234 | 1.0 | 0.0 | 1.00 | 0.500 |"
    assert tables.grid(["a"], [["no | luck\nat all"]]).splitlines()[-1] == "| no \\| luck at all |"


def test_the_machines_of_all_runs_are_named_once() -> None:
    other = TRAINED.model_copy(
        update={"device": "Some GPU", "machine": MACHINE.model_copy(update={"cores": 8})}
    )
    rows = [row("a", "x", 30.0), row("a", "y", 20.0), row("a", "z", 10.0, trained=other)]
    assert describe_machines(rows) == (
        "hdr-nsff 1.0 (commit abc), torch 2.6; 4 cores of Some CPU, 8 cores of Some CPU; "
        "runs on cpu, Some GPU, threads of each: 1"
    )
