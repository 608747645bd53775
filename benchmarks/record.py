"""The JSON file that every benchmark writes: its numbers, and what they depend on.

    parser = make_parser(__doc__, "speed")
    args = parser.parse_args()
    restart_prepared()
    record = Record("speed", args)
    record.add({"preset": "grid", "steps_per_second": 7.5})
    record.save()

The file holds `benchmark`, `machine`, `commit`, `dirty` (whether the code differs from
that commit), `seed`, `date` (UTC), `settings` (the command's arguments) and `results`
(one object per measurement). Files and folders are recorded by name, never by their
path on the machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hdr_nsff.bench.machine import git, this_machine
from hdr_nsff.core.io import write_json
from hdr_nsff.core.process import prepare_process

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
# What the numbers of a benchmark depend on; its results are no part of it.
CODE = ("src", "benchmarks", ":(exclude)benchmarks/results")
ANY_GPU = torch.device("cuda")  # the current one
# Names that many folders share: their parent's name is recorded as well.
COMMON_NAMES = {"scene", "oracle", "truth", "clip", "run", "out", "images", ""}


def make_parser(docstring: str | None, benchmark: str) -> argparse.ArgumentParser:
    """A parser whose help is the module's docstring, with the option --out."""
    parser = argparse.ArgumentParser(
        description=docstring, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=RESULTS / f"{benchmark}.json",
        metavar="FILE",
        help=f"the JSON file with the results; default: benchmarks/results/{benchmark}.json",
    )
    return parser


def restart_prepared() -> None:
    """Set up threads and memory as the command line does.

    OpenMP reads its settings when torch is imported, before `main` can change them.
    Where they are not set, the program starts once more with them.
    """
    ready = "OMP_WAIT_POLICY" in os.environ
    prepare_process()
    if not ready:
        sys.stdout.flush()
        os.execv(sys.executable, sys.orig_argv)


class Record:
    """The results of one benchmark, and the file that they are written to."""

    def __init__(
        self,
        benchmark: str,
        args: argparse.Namespace,
        seed: int | None = None,
        device: torch.device = ANY_GPU,
    ) -> None:
        self.benchmark = benchmark
        self.device = device  # whose name is recorded
        self.seed = seed  # of the random numbers; None where none are drawn
        self.out: Path = args.out
        self.settings = {name: value for name, value in vars(args).items() if name != "out"}
        self.results: list[dict[str, Any]] = []

    def add(self, result: dict[str, Any], show: bool = True) -> None:
        """Keep one measurement; `show` prints it as a line of JSON."""
        self.results.append(as_data(result))
        if show:
            print(json.dumps(self.results[-1], ensure_ascii=False), flush=True)

    def save(self, show: bool = True) -> Path:
        """Write the file, atomically; `show` prints where it is."""
        machine = this_machine().model_dump(exclude={"commit"})
        machine["gpu"] = gpu_name(self.device)
        commit, dirty = code_version()
        document = {
            "benchmark": self.benchmark,
            "machine": machine,
            "commit": commit,
            "dirty": dirty,
            "seed": self.seed,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "settings": as_data(self.settings),
            "results": self.results,
        }
        write_json(self.out, document)
        if show:
            print(f"results: {self.out}")
        return self.out


def gpu_name(device: torch.device) -> str | None:
    """The name of a CUDA device; None for the CPU, and where there is no GPU."""
    if device.type != "cuda" or not torch.cuda.is_available():
        return None
    return torch.cuda.get_device_name(device)


def code_version() -> tuple[str | None, bool | None]:
    """The commit of this checkout and whether its code differs; None outside of git."""
    try:
        commit = git(ROOT, "rev-parse", "HEAD")
        changes = git(ROOT, "status", "--porcelain", "--", *CODE)
    except (OSError, subprocess.SubprocessError):
        return None, None
    return commit, bool(changes)


def name_of(path: Path) -> str:
    """A file or folder by name, with its parents' names where it is a common one.

    `demo/out/scene` stays `demo/out/scene`; `/data/lamp` becomes `lamp`.
    """
    parts = path.resolve().parts[1:]  # without the root
    first = len(parts) - 1
    while first > 0 and Path(parts[first]).stem in COMMON_NAMES:
        first -= 1
    return "/".join(parts[max(first, 0) :])


def as_data(value: Any) -> Any:
    """`value` as plain JSON data: paths by name, null for infinities and NaN."""
    match value:
        case dict():
            return {str(key): as_data(item) for key, item in value.items()}
        case list() | tuple():
            return [as_data(item) for item in value]
        case Path():
            return name_of(value)
        case np.generic():
            return as_data(value.item())
        case float() if not math.isfinite(value):
            return None
        case _:
            return value
