"""Errors of optical flow when the exposure changes, on scenes whose flow is exact.

    hdr-nsff synth lamp SCENE
    python benchmarks/flow.py SCENE [SCENE ...] --flows prepared dis gmflow

The exact radiance of the frames (SCENE/exact/clip_*.exr) is recorded again, as clips
whose two exposures alternate. The pairs of neighbors stay the same; only their
difference of exposure (--ev) varies. `raw` matches the recorded frames, `equalized` the
frames as `prepare` equalizes them. `prepared` is the flow that training reads after
`prepare` with its defaults, masks included. Errors count pixels that both frames show,
in both directions, clipped or not. Seconds are CPU seconds of a pair, both directions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from record import Record, make_parser, restart_prepared

from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import read_npy
from hdr_nsff.geometry.round_trip import valid_flow
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.priors.flow.dense import (
    average_with_reverse,
    dense_flow,
    dense_inverse_search,
    match_pairs,
)
from hdr_nsff.priors.flow.local_motion import fill_uncertain_flow
from hdr_nsff.priors.flow.networks import load_network, network_flow, predict_both_directions
from hdr_nsff.priors.flow.semantic import SemanticConfig, SemanticFlow, semantic_flow
from hdr_nsff.radiometry.common_range import LUMA, common_gray, recorded_range
from hdr_nsff.radiometry.exposure_cycle import equalize
from hdr_nsff.radiometry.recording import Noise, record, response_curve
from hdr_nsff.scene.manifest import Manifest

FLOWS = ("prepared", "dis", "semantic", "gmflow", "raft", "raft-finetuned")
SEED = 0  # of the recorded noise

Flows = tuple[np.ndarray, np.ndarray]  # flow (P, H, W, 2) px of pairs, valid (P, H, W)
# (recorded video (T, H, W, 3), bracket of each frame, pairs (P, 2)) -> flow
Matcher = Callable[[np.ndarray, list[int], np.ndarray], Flows]


def main() -> None:
    parser = make_parser(__doc__, "flow")
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="`synth` wrote it")
    parser.add_argument("--flows", nargs="+", choices=FLOWS, default=["dis"])
    parser.add_argument(
        "--weights", type=Path, help="of gmflow or raft; default: where weights are kept"
    )
    parser.add_argument("--finetuned", type=Path, help="the folder that `finetune-flow` wrote")
    parser.add_argument(
        "--ev", nargs="+", type=float, default=[0, 2, 4], help="stops between neighbors"
    )
    parser.add_argument(
        "--pairs", type=int, default=4, help="pairs of neighbors per scene, evenly over the clip"
    )
    parser.add_argument("--only", choices=("raw", "equalized"), help="match only these frames")
    args = parser.parse_args()
    restart_prepared()
    torch.set_num_threads(1)
    results = Record("flow", args, seed=SEED)
    for scene in args.scenes:
        frames = [read_exr(path) for path in sorted((scene / "exact").glob("clip_*.exr"))]
        if len(frames) < 2:
            parser.error(f"{scene}/exact holds {len(frames)} frames clip_*.exr; 2 are needed")
        pairs = neighbor_pairs(len(frames), args.pairs)
        height, width = frames[0]["Z"].shape
        print(f"\n{scene.name}, {len(pairs)} pairs of {width}x{height}\n\n{HEADER}")
        for name in args.flows:
            measure_flow(name, scene.name, frames, pairs, args, results)
    results.save()


def measure_flow(
    name: str,
    scene: str,
    frames: list[dict[str, np.ndarray]],
    pairs: np.ndarray,
    args: argparse.Namespace,
    results: Record,
) -> None:
    """One flow on one scene, for all inputs and differences of exposure."""
    network = load_flow(name, args.weights, args.finetuned)
    # `prepared` and `semantic` equalize the frames themselves.
    inputs = ("equalized",) if name in ("prepared", "semantic") else ("raw", "equalized")
    if args.only is not None:
        inputs = (args.only,)
    for kind in inputs:
        match = prepared_flow if name == "prepared" else matcher(network, kind)
        for stops in args.ev:
            row = {"scene": scene, "flow": name, "frames": kind, "ev": stops}
            row |= measure(frames, pairs, stops, match)
            results.add(row, show=False)
            print(table_line(row), flush=True)


def load_flow(name: str, weights: Path | None, finetuned: Path | None) -> Any:
    """The network of a flow; None where it needs none.

    `semantic` compares its features as they are: fitting them to a clip changed no
    median by 0.01 px.
    """
    match name:
        case "prepared" | "dis":
            return None
        case "semantic":
            return semantic_flow(SemanticConfig(steps=0), weights, (), ())
        case "raft-finetuned":
            return load_network(None, finetuned)
        case "gmflow" | "raft":
            return load_network(name, weights)
        case _:
            raise ValueError(name)


def neighbor_pairs(frames: int, count: int) -> np.ndarray:
    """At most `count` pairs (P, 2) of neighbors, evenly over the clip."""
    first = np.unique(np.linspace(0, frames - 2, count).round().astype(int))
    return np.stack([first, first + 1], -1)


def matcher(network: Any, kind: str) -> Matcher:
    """The flow of `network`, or of dense inverse search, on raw or equalized frames."""

    def on_raw(video: np.ndarray, brackets: list[int], pairs: np.ndarray) -> Flows:
        def match(i: int, j: int) -> Flows:
            if network is not None:
                assert not isinstance(network, SemanticFlow)
                return predict_both_directions(network, video[i], video[j])
            a, b = (np.rint(255 * (video[k] @ LUMA)).astype(np.uint8) for k in (i, j))
            return dense_inverse_search(a, b), dense_inverse_search(b, a)

        clipped = np.zeros(video.shape[:3], bool)
        return match_pairs(match, clipped, pairs, threads=1)

    def on_equalized(video: np.ndarray, brackets: list[int], pairs: np.ndarray) -> Flows:
        frames = equalize(video, brackets)
        if isinstance(network, SemanticFlow):
            network.features = None  # those of the last clip
            flow, valid = network(*frames, pairs)
        elif network is None:
            flow, valid = dense_flow(*frames, pairs)
        else:
            flow, valid = network_flow(network, *frames, pairs)
        return refine(flow, *frames, pairs), valid

    return on_raw if kind == "raw" else on_equalized


def prepared_flow(video: np.ndarray, brackets: list[int], pairs: np.ndarray) -> Flows:
    """The flow that training reads, by all steps of `prepare` with their defaults."""
    with TemporaryDirectory() as folder:
        clip, scene = Path(folder) / "clip", Path(folder) / "scene"
        clip.mkdir()
        for k, frame in enumerate(video):
            write_png(clip / f"{k:05d}.png", frame)
        prepare(PrepareConfig(clip, scene, hold_out=0))
        frames = Manifest.load(scene).frames
        files = [frames[i].flow[int(j)] for i, j in pairs]
        flow = [read_npy(scene / of_pair.flow).astype(np.float32) for of_pair in files]
        valid = [read_mask(scene / of_pair.valid) for of_pair in files]
        return np.stack(flow), np.stack(valid)


def refine(
    flow: np.ndarray, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """The flow (P, H, W, 2) px of pairs and their reverses, refined without masks.

    As the step `refined_flow` of `prepare` does it: uncertain pixels are filled from
    their neighborhood, and both directions are averaged.
    """
    ranges = [recorded_range(*frame) for frame in zip(video, clipped, strict=True)]
    by_pair = {(int(i), int(j)): one for (i, j), one in zip(pairs, flow, strict=True)}
    nothing_moves = np.zeros(clipped.shape[1:], bool)
    filled = {}
    for (i, j), one in by_pair.items():
        gray = common_gray(video, ranges, i, j)
        filled[i, j] = fill_uncertain_flow(
            one, by_pair[j, i], *gray, clipped[i], clipped[j], nothing_moves
        )
    return np.stack([average_with_reverse(one, filled[j, i]) for (i, j), one in filled.items()])


def measure(
    frames: list[dict[str, np.ndarray]], pairs: np.ndarray, stops: float, match: Matcher
) -> dict[str, Any]:
    """Errors of moving and of static pixels at a difference of `stops` EV."""
    brackets = [k % 2 if stops else 0 for k in range(len(frames))]
    video = record_clip(frames, brackets, stops)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    start = time.process_time()
    flow, valid = match(video, brackets, both)
    seconds = (time.process_time() - start) / len(pairs)
    nothing_clipped = np.zeros(video.shape[1:3], bool)
    errors, moving, seen = [], [], []
    for (i, j), of_pair in zip(both, flow, strict=True):
        forward, backward = exact_flow(frames[i], j - i), exact_flow(frames[j], i - j)
        errors.append(np.linalg.norm(of_pair - forward, axis=-1))
        moving.append(frames[i]["body"] > 0)
        seen.append(valid_flow(forward, backward, nothing_clipped, nothing_clipped))
    error, is_moving, is_seen = np.stack(errors), np.stack(moving), np.stack(seen)
    return {
        "moving": summarize(error[is_seen & is_moving]),
        "static": summarize(error[is_seen & ~is_moving]),
        "valid": {
            "share": float(valid[is_seen].mean()),
            "mean": float(error[is_seen & valid].mean()),
        },
        "seconds": seconds,
    }


def record_clip(
    frames: list[dict[str, np.ndarray]], brackets: list[int], stops: float
) -> np.ndarray:
    """The video (T, H, W, 3) that a camera with two alternating exposures records."""
    rng = np.random.default_rng(SEED)
    response = response_curve("film")
    video = []
    for frame, bracket in zip(frames, brackets, strict=True):
        ev = (bracket - 0.5) * stops
        video.append(record(frame["RGB"], ev, (1, 1, 1), response, Noise(), rng))
    return np.stack(video)


def exact_flow(frame: dict[str, np.ndarray], offset: int) -> np.ndarray:
    """The exact flow (H, W, 2) px to the next or previous frame."""
    direction = "forward" if offset > 0 else "backward"
    return np.stack([frame[f"{direction}.u"], frame[f"{direction}.v"]], -1)


def summarize(error: np.ndarray) -> dict[str, float]:
    """Mean and median in pixels, shares below 1 and 3 px."""
    return {
        "mean": float(error.mean()),
        "median": float(np.median(error)),
        "within1": float((error < 1).mean()),
        "within3": float((error < 3).mean()),
    }


COLUMNS = (
    "flow",
    "frames",
    "EV",
    "moving: mean, median px",
    "< 1, < 3 px",
    "static: mean, median px",
    "< 1, < 3 px",
    "valid: share, mean px",
    "s",
)
HEADER = f"| {' | '.join(COLUMNS)} |\n|{len(COLUMNS) * '---|'}"


def table_line(row: dict[str, Any]) -> str:
    """One line of the table."""
    cells = [row["flow"], row["frames"], f"{row['ev']:g}"]
    for part in (row["moving"], row["static"]):
        cells.append(f"{part['mean']:.2f}, {part['median']:.2f}")
        cells.append(f"{part['within1']:.0%}, {part['within3']:.0%}")
    valid = row["valid"]
    cells.append(f"{valid['share']:.0%}, {valid['mean']:.2f}")
    cells.append(f"{row['seconds']:.1f}")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
