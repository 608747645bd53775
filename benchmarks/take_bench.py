"""Keeps a finished `hdr-nsff bench` as benchmarks/results/bench-NAME.json.

    hdr-nsff bench OUT --scenes ... --methods ...
    python benchmarks/take_bench.py NAME OUT

The file holds one object per run: scene, method, status and every number of the run.
Scenes are kept by name; no path of the machine is.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from record import RESULTS, Record

SETTINGS = ("methods", "budget", "steps", "oracle", "jobs", "max_size", "protocol")
RUN = (
    "scene", "method", "oracle", "status", "measured_on", "seed", "device", "threads", "values",
    "curve",
)  # fmt: skip


def main() -> None:
    """Write the JSON file of one finished benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", help="what the benchmark compares: camera, rig, real, ablations")
    parser.add_argument("bench", type=Path, help="the folder that `hdr-nsff bench` wrote")
    args = parser.parse_args()
    found = json.loads((args.bench / "results.json").read_text())
    settings = {key: found["settings"].get(key) for key in SETTINGS}
    out = RESULTS / f"bench-{args.name}.json"
    options = argparse.Namespace(out=out, **settings)
    record = Record(f"bench-{args.name}", options, seed=found["seed"])
    for run in found["runs"]:
        record.add(one_run(run), show=False)
    record.save()


def one_run(run: dict[str, Any]) -> dict[str, Any]:
    """A run without its folder, with the commit that trained it."""
    machine = run["machine"] or {}
    return {key: run[key] for key in RUN} | {"commit": machine.get("commit")}


if __name__ == "__main__":
    main()
