"""Runs the demo from frames alone, as `make demo` does, and keeps its numbers.

    python benchmarks/demo.py                        # 5 minutes of training
    python benchmarks/demo.py --preset grid

Time and peak memory are of the whole command, in a process of its own; the scores are
those of `evaluate` against demo/truth.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from record import ROOT, Record, make_parser

CLIP, TRUTH = ROOT / "demo/clip.mp4", ROOT / "demo/truth"
COMMAND = "import sys; from hdr_nsff.cli import main; sys.exit(main())"
GIB = 1024**2  # kilobytes, the unit of ru_maxrss on Linux


def main() -> None:
    """Run the demo and write benchmarks/results/demo-PRESET.json."""
    parser = make_parser(__doc__, "demo-splat")
    parser.add_argument("--preset", default="splat", help="splat or grid")
    parser.add_argument("--minutes", type=float, default=5.0, help="of training")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    if args.out == parser.get_default("out"):
        args.out = args.out.with_name(f"demo-{args.preset}.json")
    record = Record(f"demo-{args.preset}", args, seed=args.seed)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        words = ["run", CLIP, out, "--truth", TRUTH, "--preset", args.preset]
        words += ["--minutes", args.minutes, "--seed", args.seed]
        start = time.monotonic()
        subprocess.run([sys.executable, "-c", COMMAND, *map(str, words)], check=True)
        seconds = time.monotonic() - start
        record.add(collect(out) | {"seconds": seconds, "memory_gib": peak_memory()})
    record.save()


def peak_memory() -> float:
    """The largest resident memory of a child process so far, in GiB."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / GIB


def collect(out: Path) -> dict[str, Any]:
    """The numbers of a finished `run`."""
    metrics = json.loads((out / "run/metrics.json").read_text())
    steps = json.loads((out / "scene/scene.json").read_text())["steps"]
    last = json.loads((out / "run/log.jsonl").read_text().splitlines()[-1])
    return {
        "steps": last["step"],
        "training_seconds": last["seconds"],
        "prepare_seconds": {name: step.get("seconds") for name, step in steps.items()},
        "headline": metrics["headline"],
        "groups": metrics["groups"],
        "camera": metrics.get("camera"),
        "poses": metrics.get("poses"),
    }


if __name__ == "__main__":
    main()
