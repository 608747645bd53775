"""How well flow holds when the exposure changes: end-point error on rendered scenes,
whose flow is exact, for EV differences of one's choice.

    hdr-nsff synth SCENE
    python benchmarks/flow.py SCENE [SCENE ...] --flows prepared dis gmflow
    raft-finetuned --finetuned TUNED

The frames' exact radiance (SCENE/exact/clip_*.exr) is recorded again, as a clip whose
two exposures alternate: the same pairs of neighbors, with nothing changed between rows
but how many stops apart they are. `raw` matches what was recorded; `equalized` what
`prepare` makes of it. `prepared` is the flow of a scene that `prepare` made of those
frames, nothing else given: the default, with the masks that it found itself. Errors are
those of pixels that both frames show, in both directions, clipped or not; seconds are
CPU seconds per pair, both directions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import read_npy, write_json
from hdr_nsff.core.process import prepare_process
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


def main() -> None:
    prepare_process()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--flows", nargs="+", choices=FLOWS, default=["dis"])
    parser.add_argument(
        "--weights", type=Path, help="of gmflow or raft; default: where weights are kept"
    )
    parser.add_argument("--finetuned", type=Path, help="what `finetune-flow` wrote")
    parser.add_argument(
        "--ev", nargs="+", type=float, default=[0, 2, 4], help="stops between neighbors"
    )
    parser.add_argument(
        "--pairs", type=int, default=4, help="pairs of neighbors per scene, evenly over the clip"
    )
    parser.add_argument("--only", choices=("raw", "equalized"))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for scene in args.scenes:
        frames = [read_exr(path) for path in sorted((scene / "exact").glob("clip_*.exr"))]
        assert len(frames) > args.pairs, f"{scene}: {len(frames)} frames in exact/"
        pairs = neighbors(len(frames), args.pairs)
        height, width = frames[0]["Z"].shape
        print(f"\n{scene.name}, {len(pairs)} pairs of {width}x{height}\n\n{HEADER}")
        for name in args.flows:
            network = (
                None if name in ("dis", "prepared") else named(name, args.weights, args.finetuned)
            )
            both = (
                ("equalized",) if name in ("prepared", "semantic") else ("raw", "equalized")
            )  # these two equalize by themselves
            for treated in both if args.only is None else (args.only,):
                for stops in args.ev:
                    rows.append({"scene": scene.name, "flow": name, "frames": treated, "ev": stops})
                    rows[-1] |= measure(
                        frames,
                        pairs,
                        stops,
                        as_prepared if name == "prepared" else prior(network, treated),
                    )
                    print(line(rows[-1]), flush=True)
    if args.json:
        write_json(args.json, rows)


def named(name: str, weights: Path | None, finetuned: Path | None) -> object:
    """A loaded network, or the features of `--flow semantic` as they are: fitting them
    to a clip moved no median by 0.01 px.
    """
    if name == "semantic":
        return semantic_flow(SemanticConfig(steps=0), weights, (), ())
    return (
        load_network(None, finetuned) if name == "raft-finetuned" else load_network(name, weights)
    )  # type: ignore[arg-type]


def neighbors(frames: int, count: int) -> np.ndarray:
    """`count` pairs (count, 2) of neighbors, evenly over the clip."""
    first = np.unique(np.linspace(0, frames - 2, count).round().astype(int))
    return np.stack([first, first + 1], -1)


def prior(network, treated: str) -> Callable:
    """(recorded video, groups, pairs (P, 2)) -> flow and where it is believed."""

    def on_raw(
        video: np.ndarray, groups: list[int], pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        def match(i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
            if network is not None:
                assert not isinstance(network, SemanticFlow)
                return predict_both_directions(network, video[i], video[j])
            a, b = (np.rint(255 * (video[k] @ LUMA)).astype(np.uint8) for k in (i, j))
            return dense_inverse_search(a, b), dense_inverse_search(b, a)

        return match_pairs(match, np.zeros(video.shape[:3], bool), pairs, threads=1)

    def on_equalized(
        video: np.ndarray, groups: list[int], pairs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        frames = equalize(video, groups)
        if isinstance(network, SemanticFlow):
            network.features = None  # of another clip
            found, valid = network(*frames, pairs)
        else:
            found, valid = (
                dense_flow(*frames, pairs)
                if network is None
                else network_flow(network, *frames, pairs)
            )
        return completed(found, *frames, pairs), valid

    return on_raw if treated == "raw" else on_equalized


def as_prepared(
    video: np.ndarray, groups: list[int], pairs: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The flow that training sees of a clip, by all steps of `prepare` with their
    defaults, and where it is believed.
    """
    with TemporaryDirectory() as folder:
        clip, scene = Path(folder) / "clip", Path(folder) / "scene"
        clip.mkdir()
        for k, frame in enumerate(video):
            write_png(clip / f"{k:05d}.png", frame)
        prepare(PrepareConfig(clip, scene, hold_out=0))
        frames = Manifest.load(scene).frames
        files = [frames[i].flow[int(j)] for i, j in pairs]
        found = [read_npy(scene / one.flow).astype(np.float32) for one in files]
        return np.stack(found), np.stack([read_mask(scene / one.valid) for one in files])


def completed(
    found: np.ndarray, video: np.ndarray, clipped: np.ndarray, pairs: np.ndarray
) -> np.ndarray:
    """The flow (P, H, W, 2) px of pairs and their reverses, ended as the step
    `refined_flow` of `prepare` does, without its masks: where it is not sure told by
    what is around, and both ways met halfway.
    """
    ranges = [recorded_range(*frame) for frame in zip(video, clipped, strict=True)]
    one_way = {(int(i), int(j)): one for (i, j), one in zip(pairs, found, strict=True)}
    still = np.zeros(clipped.shape[1:], bool)
    ended = {
        (i, j): fill_uncertain_flow(
            one, one_way[j, i], *common_gray(video, ranges, i, j), clipped[i], clipped[j], still
        )
        for (i, j), one in one_way.items()
    }
    return np.stack([average_with_reverse(one, ended[j, i]) for (i, j), one in ended.items()])


def measure(
    frames: list[dict[str, np.ndarray]], pairs: np.ndarray, stops: float, match: Callable
) -> dict:
    """Errors at a difference of `stops` EV, moving and still pixels apart."""
    groups = [k % 2 if stops else 0 for k in range(len(frames))]
    rng, camera = np.random.default_rng(0), response_curve("film")
    video = np.stack(
        [
            record(f["RGB"], (g - 0.5) * stops, (1, 1, 1), camera, Noise(), rng)
            for f, g in zip(frames, groups, strict=True)
        ]
    )
    both = np.concatenate([pairs, pairs[:, ::-1]])
    start = time.process_time()
    found, valid = match(video, groups, both)
    seconds = (time.process_time() - start) / len(pairs)
    nothing = np.zeros(video.shape[1:3], bool)
    errors, moving, seen = [], [], []
    for (i, j), one in zip(both, found, strict=True):
        there, back = (exact(frames[a], b - a) for a, b in ((i, j), (j, i)))
        errors.append(np.linalg.norm(one - there, axis=-1))
        moving.append(frames[i]["body"] > 0)
        seen.append(valid_flow(there, back, nothing, nothing))
    error, moves, counts = np.stack(errors), np.stack(moving), np.stack(seen)
    return {
        "moving": summary(error[counts & moves]),
        "still": summary(error[counts & ~moves]),
        "believed": {
            "share": float(valid[counts].mean()),
            "mean": float(error[counts & valid].mean()),
        },
        "seconds": seconds,
    }


def exact(frame: dict[str, np.ndarray], side: int) -> np.ndarray:
    """The exact flow (H, W, 2) px to the next or previous frame."""
    name = "forward" if side > 0 else "backward"
    return np.stack([frame[f"{name}.u"], frame[f"{name}.v"]], -1)


def summary(error: np.ndarray) -> dict[str, float]:
    """Mean and median in pixels, shares within 1 and 3 px."""
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
    "still: mean, median px",
    "< 1, < 3 px",
    "believed: share, mean px",
    "s",
)
HEADER = f"| {' | '.join(COLUMNS)} |\n|{len(COLUMNS) * '---|'}"


def line(row: dict) -> str:
    """One line of the table."""
    m, s, b = row["moving"], row["still"], row["believed"]
    cells = [row["flow"], row["frames"], f"{row['ev']:g}"]
    for part in (m, s):
        cells += [
            f"{part['mean']:.2f}, {part['median']:.2f}",
            f"{part['within1']:.0%}, {part['within3']:.0%}",
        ]
    return (
        "| "
        + " | ".join([*cells, f"{b['share']:.0%}, {b['mean']:.2f}", f"{row['seconds']:.1f}"])
        + " |"
    )


if __name__ == "__main__":
    main()
