"""`hdr-nsff finetune-flow`: a flow network learns to look across exposures, on pairs
whose flow is known, recorded anew for every step with random EV pairs, clipping, noise
and response curves (as the paper does for its ablation, with FlyingThings3D).

Writes into the output folder:
    weights.safetensors   the adapted network, for `prepare --flow raft-finetuned
    --flow-weights`
    weights.json          what it was made of, and its error on pairs kept out of
    training, before and after
    config.json, checkpoints/   to go on after a kill
Every step draws from a generator of its own, so a run that was killed ends as one that
was not.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor
from tyro.conf import Positional

from hdr_nsff.core import notes
from hdr_nsff.core.checkpoints import latest_checkpoint, pack, save_checkpoint, unpack
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic, read_json, write_json, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.flow_training.flow_exposures import Example, example, recorded_pair
from hdr_nsff.flow_training.flow_sets import FlowPair, flow_pairs, read_sample
from hdr_nsff.priors.flow.networks import FINETUNED, MULTIPLE, FlowNetwork, both_ways, load

DECAY = 0.9  # weight of each of a network's predictions against the next one
FASTEST = 400  # pixels: faster motion is left out of training, as flow networks do
MEASURED = (0.0, 2.0, 4.0)  # EV differences of the held-out measurement
WARM_UP = 0.05  # share of the steps


@dataclass(frozen=True)
class FinetuneConfig:
    """Adapt a flow network to pairs of different exposure, on pairs whose flow is
    known.

    Killed? The same command goes on where it was.
    """

    out: Positional[Path]
    """Folder to write."""
    data: tuple[Path, ...] = field(default=())
    """Folders of pairs with known flow: FlyingThings3D, MPI Sintel, or scenes of
    `synth`.
    """
    network: Literal["gmflow", "raft"] = "gmflow"
    """The network to start from."""
    weights: Path | None = None
    """Its weights. Default: where weights are kept, see `hdr-nsff weights`."""
    steps: int = 5000
    batch: int = 2
    """Pairs per step."""
    size: str = "320x224"
    """Width x height of the crops in pixels, as matched (frames whose longer side is
    below 640 pixels are enlarged up to three times).
    """
    stops: float = 5.0
    """The farthest that the exposures of a pair are apart, in EV."""
    lr: float = 5e-5
    keep: float = 0.5
    """Share of the network as it was in the result, which is the mean of the weights
    before and after (Wortsman et al. 2022): it keeps what the data do not show. 0 takes
    the trained network alone.
    """
    held_out: float = 0.1
    """Share of the scenes (of a single scene: of its last pairs) kept for measuring."""
    measure: int = 6
    """Pairs of the held-out ones that are measured, at 0, 2 and 4 EV."""
    checkpoint_steps: int = 100
    """Steps between two checkpoints."""
    seed: int = 0
    device: str = "auto"
    """auto, cpu or cuda."""


def finetune_flow(config: FinetuneConfig) -> Path:
    """Adapt, measure, save; the file of weights. InputError where the data or a setting
    is at fault.
    """
    size = check(config)
    device = pick_device(config.device)
    pairs = [pair for folder in config.data for pair in flow_pairs(folder)]
    training, held_out = split(pairs, config.held_out)
    held_out = [
        held_out[k]
        for k in np.unique(np.linspace(0, len(held_out) - 1, config.measure).astype(int))
    ]
    network = load(config.network, config.weights, device)
    start = {k: v.clone() for k, v in network.state_dict().items()}
    with writing_to(config.out), lock_output(config.out):
        claim(config)
        say(
            f"finetune-flow: {len(training)} pairs to train on, {len(held_out)} others to measure on"
        )
        before = measured(network, held_out, config.out / "before.json")
        seconds = train(network, training, size, config)
        network.load_state_dict(mean(start, network.state_dict(), config.keep))
        after = measured(network, held_out, None)
        weights = write_weights(
            network,
            config,
            {
                "training_pairs": len(training),
                "held_out_pairs": len(held_out),
                "seconds": seconds,
                "before": before,
                "after": after,
            },
        )
    for stops in before:
        say(
            f"  {stops} EV apart: {before[stops]['mean']:.3f} px mean error before, {after[stops]['mean']:.3f} px after"
        )
    return weights


def check(config: FinetuneConfig) -> tuple[int, int]:
    """The size (h, w) of crops; InputError for settings that make no sense."""
    if not config.data:
        raise InputError(
            "finetune-flow: no data; name folders of pairs with known flow with --data"
        )
    width, _, height = config.size.lower().partition("x")
    if not (
        width.isdecimal()
        and height.isdecimal()
        and all(int(s) >= 128 and int(s) % MULTIPLE == 0 for s in (width, height))
    ):
        raise InputError(
            f"--size {config.size!r}: write it as WIDTHxHEIGHT, both multiples of {MULTIPLE} and at least 128"
        )
    if min(config.steps, config.batch, config.measure, config.checkpoint_steps) < 1:
        raise InputError("--steps, --batch, --measure and --checkpoint-steps must be at least 1")
    if not (
        0 < config.held_out < 1
        and 0 <= config.keep < 1
        and 0 <= config.stops <= 12
        and 0 < config.lr < 1
    ):
        raise InputError(
            "--held-out, --keep and --lr must be between 0 and 1, --stops from 0 to 12"
        )
    return int(height), int(width)


def split(pairs: list[FlowPair], share: float) -> tuple[list[FlowPair], list[FlowPair]]:
    """Pairs to train on and pairs to measure on: whole scenes apart; of a single scene
    its end, and no frame in both.
    """
    scenes = list(dict.fromkeys(p.scene for p in pairs))
    if len(scenes) > 1:
        kept = set(scenes[-max(1, round(share * len(scenes))) :])
        return [p for p in pairs if p.scene not in kept], [p for p in pairs if p.scene in kept]
    count = max(1, round(share * len(pairs)))
    training, held_out = pairs[: -count - 1], pairs[-count:]
    if not training:
        raise InputError(
            f"{scenes[0]}: {len(pairs)} pairs are too few to train on some and measure on others; name more data"
        )
    return training, held_out


def claim(config: FinetuneConfig) -> None:
    """Note the settings; InputError where the folder holds a run with other ones, or
    something else.
    """
    path = config.out / "config.json"
    settings = {
        k: [str(p) for p in v] if k == "data" else str(v) if isinstance(v, Path) else v
        for k, v in asdict(config).items()
        if k not in ("out", "device")
    }
    if path.is_file() and settings_in(path) != settings:
        raise InputError(
            f"{config.out}: holds a run with other settings; choose a new folder, or repeat its command"
        )
    if not path.is_file() and config.out.exists() and any(config.out.iterdir()):
        raise InputError(f"{config.out}: holds other files; choose an empty or new folder")
    write_json(path, settings)


def settings_in(path: Path) -> Any:
    """What a run's config.json holds; InputError where it is damaged."""
    try:
        return read_json(path)
    except ValueError as error:
        raise InputError(
            f"{path}: not readable JSON ({error}); restore it, or choose a new folder"
        ) from error


def train(
    network: FlowNetwork, pairs: list[FlowPair], size: tuple[int, int], config: FinetuneConfig
) -> float:
    """Train to the last step from where the folder's checkpoints are; the seconds it
    took.
    """
    network.requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), config.lr, weight_decay=1e-4)
    found = latest_checkpoint(config.out) if (config.out / "checkpoints").is_dir() else None
    first, before, started = 0, 0.0, time.monotonic()
    if found is not None:
        unpack(found.tensors, {"network": network}, {"adam": optimizer})
        first, before = found.step, found.seconds
    device = next(network.parameters()).device
    for step in track(range(first, config.steps), "finetune-flow"):
        examples = [drawn(pairs, size, config, step, k) for k in range(config.batch)]
        loss = sequence_loss(
            network.predictions(stacked(examples, "images").to(device)),
            *(stacked(examples, n).to(device) for n in ("flow", "known")),
        )
        if not torch.isfinite(loss):
            raise FloatingPointError(f"step {step}: the loss is {float(loss)}")
        for group in optimizer.param_groups:
            group["lr"] = config.lr * rate(step / config.steps)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        if (step + 1) % config.checkpoint_steps == 0 or step + 1 == config.steps:
            save_checkpoint(
                config.out,
                step + 1,
                before + time.monotonic() - started,
                pack({"network": network}, {"adam": optimizer}),
            )
    network.requires_grad_(False)
    return before + time.monotonic() - started


def mean(one: dict[str, Tensor], other: dict[str, Tensor], share: float) -> dict[str, Tensor]:
    """Weights that are `share` of `one` and the rest of the `other`; numbers that are
    no weights are the other's.
    """
    return {
        k: torch.lerp(v, one[k], share) if v.is_floating_point() else v for k, v in other.items()
    }


def rate(progress: float) -> float:
    """The learning rate's share at a share of the steps: up in a line, then down in a
    line.
    """
    return min((progress + 1e-3) / WARM_UP, (1 - progress) / (1 - WARM_UP))


def drawn(
    pairs: list[FlowPair], size: tuple[int, int], config: FinetuneConfig, step: int, slot: int
) -> Example:
    """The example of a slot of a step."""
    rng = np.random.default_rng([config.seed, step, slot])
    return example(read_sample(pairs[rng.integers(len(pairs))]), config.stops, size, rng)


def stacked(examples: list[Example], name: str) -> Tensor:
    """One part of some examples as a pair batch (2B, ...): first all firsts, then all
    seconds.
    """
    parts = torch.stack([getattr(e, name) for e in examples], 1)  # (2, B, ...)
    return parts.flatten(0, 1)


def sequence_loss(predictions: list[Tensor], flow: Tensor, known: Tensor) -> Tensor:
    """The mean absolute error (pixels, per axis) of every prediction (2B, 2, H, W)
    where flow is `known` (2B, H, W), later ones weighing more.
    """
    counted = known & (flow.norm(dim=1) < FASTEST)
    weights = [DECAY ** (len(predictions) - 1 - k) for k in range(len(predictions))]
    errors = [
        ((p - flow).abs().mean(1) * counted).sum() / counted.sum().clamp_min(1) for p in predictions
    ]
    return torch.stack([w * e for w, e in zip(weights, errors, strict=True)]).sum()


def measured(
    network: FlowNetwork, pairs: list[FlowPair], kept: Path | None
) -> dict[str, dict[str, float]]:
    """End-point error of `pairs` per EV difference, mean and median in pixels of the
    frames, as `prepare` matches them.

    `kept`: a file with the answer, if it is there; where it is not, it is written.
    """
    if kept is not None and (found := notes.read(kept, notes.FlowErrors)) is not None:
        return {k: e.model_dump() for k, e in found.by_stops.items()}
    errors: dict[str, list[np.ndarray]] = {f"{stops:g}": [] for stops in MEASURED}
    for pair in track(pairs, "measure"):
        sample = read_sample(pair)
        for stops in MEASURED:
            flow = np.stack(both_ways(network, *recorded_pair(sample.radiance, stops, equal=True)))
            errors[f"{stops:g}"].append(np.linalg.norm(flow - sample.flow, axis=-1)[sample.known])
    result = {
        k: {"mean": float(np.concatenate(e).mean()), "median": float(np.median(np.concatenate(e)))}
        for k, e in errors.items()
    }
    if kept is not None:
        notes.write(kept, notes.FlowErrors.model_validate({"by_stops": result}))
    return result


def write_weights(network: FlowNetwork, config: FinetuneConfig, record: dict) -> Path:
    """Save the network and what is to be said of it; the file of weights."""
    path = config.out / FINETUNED
    tensors = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()}
    with atomic(path) as partial:
        partial.write_bytes(save(tensors, {"network": config.network}))
    write_json(
        path.with_suffix(".json"), {"network": config.network, "steps": config.steps, **record}
    )
    say(f"finetune-flow: {path}; use it with `prepare --flow raft-finetuned --flow-weights {path}`")
    return path
