"""The verb `finetune-flow`: a flow network learns to match across exposures.

It is trained on pairs whose flow is known. Every step records them anew with random
exposures, clipping, noise and response curves, as the paper does for its ablation with
FlyingThings3D. The output folder then holds

- `weights.safetensors`: the adapted network, for `prepare --flow raft-finetuned
  --flow-weights`;
- `weights.json`: its settings and data, and its error on held-out pairs before and
  after;
- `config.json`, `before.json`, `checkpoints/`: what a restart needs after a kill.

Every step has a random generator, seeded by the step. A killed run that continues
therefore ends like an unbroken one.
"""

from __future__ import annotations

import re
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
from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import atomic, holds_nothing, read_json, write_json, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.core.tensors import pick_device
from hdr_nsff.flow_training.flow_exposures import Example, record_middle_pair, training_example
from hdr_nsff.flow_training.flow_sets import FlowPair, flow_pairs, read_sample
from hdr_nsff.priors.flow.networks import (
    FINETUNED,
    MULTIPLE,
    FlowNetwork,
    load_network,
    predict_both_directions,
)

# weight of each of a network's predictions relative to the next one; 0.9 in GMFlow (Xu
# et al. 2022), 0.8 in RAFT
PREDICTION_DECAY = 0.9
MAX_FLOW_PX = 400  # faster motion is left out of training, as RAFT (Teed & Deng 2020) does
MEASURED_EV = (0.0, 2.0, 4.0)  # EV differences of the held-out measurement
WARM_UP_SHARE = 0.05  # of the steps, as in RAFT's one-cycle schedule
FIRST_STEP_SHARE = 1e-3  # of the steps, added while warming up: the first rate is not 0
WEIGHT_DECAY = 1e-4  # of AdamW, as in RAFT and GMFlow
MAX_GRADIENT_NORM = 1.0  # as in RAFT and GMFlow
MIN_CROP_PX = 128  # shortest side of a crop: RAFT's correlation pyramid needs it
MAX_EV_RANGE = 12.0  # stops: the largest `--stops`, beyond what cameras record


@dataclass(frozen=True)
class FinetuneConfig:
    """Adapt a flow network to pairs of different exposure whose flow is known.

    After a kill, the same command continues.
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
    """Steps of training."""
    batch: int = 2
    """Pairs per step."""
    size: str = "320x224"
    """Width x height of the crops in pixels, at the scale of matching (frames whose
    longer side is below 640 pixels are enlarged up to three times).
    """
    stops: float = 5.0
    """The largest exposure difference of a pair, in EV."""
    lr: float = 5e-5
    """Learning rate at its peak."""
    keep: float = 0.5
    """Share of the original weights in the result, which is a weighted mean of the
    weights before and after (Wortsman et al. 2022): it preserves what the data do not
    contain. 0 takes the trained network alone.
    """
    held_out: float = 0.1
    """Share of the scenes (of a single scene: of its last pairs) kept for measuring."""
    measure: int = 6
    """Number of held-out pairs that are measured, at 0, 2 and 4 EV."""
    checkpoint_steps: int = 100
    """Steps between two checkpoints."""
    seed: int = 0
    """Seed of all random choices."""
    device: str = "auto"
    """auto, cpu or cuda."""


def finetune_flow(config: FinetuneConfig) -> Path:
    """Adapt, measure and save a network; the file of its weights.

    InputError where the data or a setting is at fault.
    """
    size = check_settings(config)
    device = pick_device(config.device)
    pairs = [pair for folder in config.data for pair in flow_pairs(folder)]
    training, held_out = split_pairs(pairs, config.held_out)
    chosen = np.unique(np.linspace(0, len(held_out) - 1, config.measure).astype(int))
    held_out = [held_out[k] for k in chosen]
    network = load_network(config.network, config.weights, device)
    start = {k: v.clone() for k, v in network.state_dict().items()}
    with writing_to(config.out), lock_output(config.out):
        claim_folder(config)
        say(
            f"finetune-flow: {len(training)} pairs to train on, "
            f"{len(held_out)} others to measure on"
        )
        before = measure_or_read(network, held_out, config.out / "before.json")
        seconds = train(network, training, size, config)
        network.load_state_dict(mean_weights(start, network.state_dict(), config.keep))
        after = measure_errors(network, held_out)
        record = {
            "training_pairs": len(training),
            "held_out_pairs": len(held_out),
            "seconds": seconds,
            "before": before,
            "after": after,
        }
        weights = write_weights(network, config, record)
    for stops in before:
        say(
            f"  {stops} EV apart: {before[stops]['mean']:.3f} px mean error before, "
            f"{after[stops]['mean']:.3f} px after"
        )
    return weights


# Settings, folder and data


def check_settings(config: FinetuneConfig) -> tuple[int, int]:
    """The size (h, w) of crops; InputError for settings that make no sense."""
    if not config.data:
        raise InputError(
            "finetune-flow: no data; name folders of pairs with known flow with --data"
        )
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", config.size.lower())
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(width, height) < MIN_CROP_PX or width % MULTIPLE or height % MULTIPLE:
        raise InputError(
            f"--size {shorten(config.size)!r}: write it as WIDTHxHEIGHT, both multiples of "
            f"{MULTIPLE} and at least {MIN_CROP_PX}"
        )
    if min(config.steps, config.batch, config.measure, config.checkpoint_steps) < 1:
        raise InputError("--steps, --batch, --measure and --checkpoint-steps must be at least 1")
    if config.seed < 0:
        raise InputError(f"--seed {shorten(config.seed)}: it must be 0 or more")
    shares_fit = 0 < config.held_out < 1 and 0 <= config.keep < 1 and 0 < config.lr < 1
    if not (shares_fit and 0 <= config.stops <= MAX_EV_RANGE):
        raise InputError(
            "--held-out, --keep and --lr must be between 0 and 1, "
            f"--stops from 0 to {MAX_EV_RANGE:g}"
        )
    return height, width


def split_pairs(pairs: list[FlowPair], share: float) -> tuple[list[FlowPair], list[FlowPair]]:
    """Pairs to train on, and a `share` to measure on.

    Scenes stay together. A single scene is measured on at its end, and no frame is in
    both.
    """
    scenes = list(dict.fromkeys(pair.scene for pair in pairs))
    if len(scenes) > 1:
        kept = set(scenes[-max(1, round(share * len(scenes))) :])
        training = [pair for pair in pairs if pair.scene not in kept]
        return training, [pair for pair in pairs if pair.scene in kept]
    count = max(1, round(share * len(pairs)))
    training = pairs[: -count - 1]
    if not training:
        raise InputError(
            f"{scenes[0]}: {len(pairs)} pairs are too few to train on some and measure on "
            "others; name more data"
        )
    return training, pairs[-count:]


def claim_folder(config: FinetuneConfig) -> None:
    """Note the settings in the output folder.

    InputError where it holds a run with other settings, or something else.
    """
    path = config.out / "config.json"
    settings: dict[str, Any] = {}
    for name, value in asdict(config).items():
        if name == "data":
            settings[name] = [str(folder) for folder in value]
        elif name not in ("out", "device"):
            settings[name] = str(value) if isinstance(value, Path) else value
    if path.is_file():
        if read_settings(path) != settings:
            raise InputError(
                f"{config.out}: holds a run with other settings; choose a new folder, "
                "or repeat its command"
            )
    elif config.out.exists() and not holds_nothing(config.out):
        raise InputError(f"{config.out}: holds other files; choose an empty or new folder")
    write_json(path, settings)


def read_settings(path: Path) -> Any:
    """The content of a run's config.json; InputError where it is damaged."""
    try:
        return read_json(path)
    except ValueError as error:
        raise InputError(
            f"{path}: not readable JSON ({shorten(error)}); restore it, or choose a new folder"
        ) from error


# Training


def train(
    network: FlowNetwork, pairs: list[FlowPair], size: tuple[int, int], config: FinetuneConfig
) -> float:
    """Train to the last step from the folder's checkpoints on; the seconds it took.

    Steps before a kill count. Crops are of `size` (h, w).
    """
    network.requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), config.lr, weight_decay=WEIGHT_DECAY)
    started = time.monotonic()
    first_step = 0
    seconds_before = 0.0
    has_checkpoints = (config.out / "checkpoints").is_dir()
    found = latest_checkpoint(config.out) if has_checkpoints else None
    if found is not None:
        unpack(found.tensors, {"network": network}, {"adam": optimizer})
        first_step = found.step
        seconds_before = found.seconds
    for step in track(range(first_step, config.steps), "finetune-flow"):
        examples = [draw_example(pairs, size, config, step, k) for k in range(config.batch)]
        train_step(network, optimizer, examples, step, config)
        is_last = step + 1 == config.steps
        if (step + 1) % config.checkpoint_steps == 0 or is_last:
            seconds = seconds_before + time.monotonic() - started
            tensors = pack({"network": network}, {"adam": optimizer})
            save_checkpoint(config.out, step + 1, seconds, tensors)
    network.requires_grad_(False)
    return seconds_before + time.monotonic() - started


def train_step(
    network: FlowNetwork,
    optimizer: torch.optim.Optimizer,
    examples: list[Example],
    step: int,
    config: FinetuneConfig,
) -> None:
    """One step of gradient descent on a batch of `examples`."""
    device = next(network.parameters()).device
    predictions = network.predictions(stack_pairs(examples, "images").to(device))
    flow = stack_pairs(examples, "flow").to(device)
    known = stack_pairs(examples, "known").to(device)
    loss = sequence_loss(predictions, flow, known)
    if not torch.isfinite(loss):
        raise FloatingPointError(f"step {step}: the loss is {float(loss)}")
    for group in optimizer.param_groups:
        group["lr"] = config.lr * rate_share(step / config.steps)
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
    optimizer.step()


def rate_share(progress: float) -> float:
    """The learning rate's share of its peak, at a share of the steps.

    It rises linearly over `WARM_UP_SHARE`, then falls linearly to 0.
    """
    rising = (progress + FIRST_STEP_SHARE) / WARM_UP_SHARE
    falling = (1 - progress) / (1 - WARM_UP_SHARE)
    return min(rising, falling)


def draw_example(
    pairs: list[FlowPair], size: tuple[int, int], config: FinetuneConfig, step: int, slot: int
) -> Example:
    """The example in a slot of the batch of a step."""
    rng = np.random.default_rng([config.seed, step, slot])
    sample = read_sample(pairs[rng.integers(len(pairs))])
    return training_example(sample, config.stops, size, rng)


def stack_pairs(examples: list[Example], name: str) -> Tensor:
    """One part of the examples as a batch (2B, ...): first frames, then second ones."""
    parts = torch.stack([getattr(e, name) for e in examples], 1)  # (2, B, ...)
    return parts.flatten(0, 1)


def sequence_loss(predictions: list[Tensor], flow: Tensor, known: Tensor) -> Tensor:
    """The weighted sum of the mean absolute errors (px, per axis) of all predictions.

    `predictions` and `flow` are (2B, 2, H, W); only pixels count where flow is `known`
    (2B, H, W) and not too fast. Later predictions weigh more (RAFT, equation 7).
    """
    counted = known & (flow.norm(dim=1) < MAX_FLOW_PX)
    terms = []
    for k, prediction in enumerate(predictions):
        error = (prediction - flow).abs().mean(1)
        mean = (error * counted).sum() / counted.sum().clamp_min(1)
        terms.append(PREDICTION_DECAY ** (len(predictions) - 1 - k) * mean)
    return torch.stack(terms).sum()


def mean_weights(
    one: dict[str, Tensor], other: dict[str, Tensor], share: float
) -> dict[str, Tensor]:
    """The weighted mean of two networks' weights, with `share` of `one`.

    Counters, which are no weights, are those of the `other`.
    """
    mean = {}
    for name, value in other.items():
        if value.is_floating_point():
            value = torch.lerp(value, one[name], share)
        mean[name] = value
    return mean


# Measuring


def measure_or_read(
    network: FlowNetwork, pairs: list[FlowPair], kept: Path
) -> dict[str, dict[str, float]]:
    """The result of `measure_errors`, read from the note `kept` or written there."""
    found = notes.read(kept, notes.FlowErrors)
    if found is not None:
        return {stops: error.model_dump() for stops, error in found.by_stops.items()}
    errors = measure_errors(network, pairs)
    notes.write(kept, notes.FlowErrors.model_validate({"by_stops": errors}))
    return errors


def measure_errors(network: FlowNetwork, pairs: list[FlowPair]) -> dict[str, dict[str, float]]:
    """The end-point error of `pairs` per EV difference, as `prepare` matches frames.

    Mean and median over all pixels whose flow is known, in pixels of the frames.
    """
    errors: dict[str, list[np.ndarray]] = {f"{stops:g}": [] for stops in MEASURED_EV}
    for pair in track(pairs, "measure"):
        sample = read_sample(pair)
        for stops in MEASURED_EV:
            pictures = record_middle_pair(sample.radiance, stops, equal=True)
            flow = np.stack(predict_both_directions(network, *pictures))
            error = np.linalg.norm(flow - sample.flow, axis=-1)[sample.known]
            errors[f"{stops:g}"].append(error)
    result = {}
    for stops_name, parts in errors.items():
        every = np.concatenate(parts)
        result[stops_name] = {"mean": float(every.mean()), "median": float(np.median(every))}
    return result


def write_weights(network: FlowNetwork, config: FinetuneConfig, record: dict[str, Any]) -> Path:
    """Save the network and the `record` of how it was made; the file of weights."""
    path = config.out / FINETUNED
    tensors = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items()}
    with atomic(path) as temporary:
        temporary.write_bytes(save(tensors, {"network": config.network}))
    made_of = {"network": config.network, "steps": config.steps, **record}
    write_json(path.with_suffix(".json"), made_of)
    say(f"finetune-flow: {path}; use it with `prepare --flow raft-finetuned --flow-weights {path}`")
    return path
