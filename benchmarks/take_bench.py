"""Keeps a finished `hdr-nsff bench` as benchmarks/results/bench-NAME.json.

    hdr-nsff bench OUT --scenes ... --methods ...
    python benchmarks/take_bench.py NAME OUT [OUT ...]

The file holds one object per run: scene, method, status and every number of the run,
and its settings where these differ between several benchmarks.
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
    parser.add_argument(
        "bench", type=Path, nargs="+", help="the folders that `hdr-nsff bench` wrote"
    )
    args = parser.parse_args()
    found = [json.loads((folder / "results.json").read_text()) for folder in args.bench]
    settings = [{key: each["settings"].get(key) for key in SETTINGS} for each in found]
    common = {key: value for key, value in settings[0].items() if all_equal(settings, key)}
    out = RESULTS / f"bench-{args.name}.json"
    record = Record(
        f"bench-{args.name}", argparse.Namespace(out=out, **common), seed=found[0]["seed"]
    )
    for each, own in zip(found, settings, strict=True):
        differing = {key: value for key, value in own.items() if key not in common}
        for run in each["runs"]:
            record.add(one_run(run) | differing, show=False)
    record.save()


def all_equal(settings: list[dict[str, Any]], key: str) -> bool:
    """Whether all benchmarks have one value of a setting."""
    return all(each[key] == settings[0][key] for each in settings)


def one_run(run: dict[str, Any]) -> dict[str, Any]:
    """A run without its folder, with the commit that trained it."""
    machine = run["machine"] or {}
    return {key: run[key] for key in RUN} | {"commit": machine.get("commit")}


if __name__ == "__main__":
    main()
