"""Scene to run: the loop, on one screen. Draw, forward, losses, backward, step.

Everything random is drawn from the seed, the step and the batch's place in it, so a
killed run that resumes, or one spread over several processes (`torchrun`), does what an
unbroken single one does.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from hdr_nsff.core import distributed
from hdr_nsff.core.checkpoints import latest_checkpoint, pack, save_checkpoint, unpack
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_png, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.process import hold_threads
from hdr_nsff.core.progress import bar, say
from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields import build_field, device_for, start_field
from hdr_nsff.fields.base import FrameError, Render, recorded
from hdr_nsff.fields.nsff.encodings import TouchedAdam
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, draw_pixels, whole_frame
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.initialize import initialize
from hdr_nsff.tonemap.tonemapper import ToneMapper, informative
from hdr_nsff.training.config import TrainConfig, check
from hdr_nsff.training.objective import LossWeights, Objective
from hdr_nsff.training.pose_corrections import PoseCorrections
from hdr_nsff.training.run_folder import keep_snapshot, read_config, write_config

LOG_EVERY = 25  # steps
SETTLED = 0.8  # of the run: after that nothing is rearranged any more


@dataclass(frozen=True)
class Clock:
    """How far a run is."""

    config: TrainConfig
    num_frames: int
    step: int
    seconds: float

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0 to 1."""
        if self.config.steps is not None:
            return self.step / self.config.steps
        assert self.config.minutes is not None
        return min(self.seconds / (60 * self.config.minutes), 1.0)

    @property
    def phase(self) -> float:
        """Time in units of the schedules' period K."""
        if self.config.period:
            return self.progress / self.config.period
        return self.step / (1000 * min(max(30, self.num_frames), 250))

    @property
    def lr_share(self) -> float:
        """Learning rates relative to their start."""
        return (
            self.config.lr_final**self.progress
            if self.config.lr_final
            else 0.1 ** (self.step / 300_000)
        )


def train(config: TrainConfig, keep_at: Sequence[float] = (), previews: bool = True) -> Path:
    """Train (or go on training) until the steps or minutes are spent; the run folder.
    What was learned by the shares `keep_at` of the run, in (0, 1), stays in
    `snapshots/`; it changes nothing of what is learned. `previews`: a picture with
    every checkpoint.
    """
    if config.steps is None and config.minutes is None:
        raise InputError("neither --steps nor --minutes: say how long to train")
    check(config)
    config = replace(
        config, scene=config.scene.resolve()
    )  # the run can then be opened from anywhere
    with writing_to(config.out), lock_output(config.out), distributed.group() as ranks:
        if ranks.world > config.batches:
            raise InputError(
                f"{ranks.world} processes share {config.batches} batches a step; start fewer, or raise --batches"
            )
        device, scene = device_for(config.field, config.device), Scene.open(config.scene)
        if ranks.main:
            open_folder(config)
        Trainer(config, scene, device, ranks).loop(keep_at, previews)
    return config.out


def open_folder(config: TrainConfig) -> None:
    """Start a run folder, or make sure an existing one was started with the same
    settings.
    """
    if (config.out / "config.json").exists():
        before = read_config(config.out)
        if replace(before, scene=config.scene, out=config.out, device=config.device) != config:
            raise InputError(
                f"{config.out}: holds a run with other settings; choose another --out, or delete it to start over"
            )
        return
    if any((config.out / "checkpoints").glob("step_*.safetensors")):
        raise InputError(
            f"{config.out}: holds checkpoints but no config.json; choose another --out, or delete it to start over"
        )
    write_config(config.out, config)


def heeded(scene: Scene, weights: LossWeights) -> Scene:
    """What of the scene the start may look at: not the flow of an objective that gives
    it no weight.
    """
    return (
        scene
        if weights.flow
        else replace(scene, train=[replace(f, flow={}, flow_valid={}) for f in scene.train])
    )


class Trainer:
    """Field, tone mapper, optimizers and clock of one run."""

    def __init__(
        self, config: TrainConfig, scene: Scene, device: torch.device, ranks: distributed.Ranks
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.scene, self.ranks = config, scene, ranks
        self.field = build_field(config.field, scene)
        self.tonemapper = ToneMapper.for_scene(config.tonemap, scene)
        self.objective = Objective(
            config.loss,
            scene.manifest.depth_kind,
            scene.near,
            config.squared,
            config.saturation,
            config.prior_fade,
        )
        groups = self.field.param_groups()
        dense = [g for g in groups if not g.get("touched")] + self.tonemapper.param_groups(
            config.tonemap_lr
        )
        self.poses = PoseCorrections(scene) if config.refine_poses else None
        dense += self.poses.param_groups(config.pose_lr) if self.poses else []
        touched = [g for g in groups if g.get("touched")]
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        if dense:  # grids without a tone mapper have nothing dense
            self.optimizers["dense"] = torch.optim.Adam(dense, fused=True)
        if touched:
            self.optimizers["touched"] = TouchedAdam(touched)
        self.marks = [
            marks for g in touched for marks in g["touched"]
        ]  # rows with a gradient, of any process
        self.base_lr = {
            name: [g["lr"] for g in o.param_groups] for name, o in self.optimizers.items()
        }
        self.clock = Clock(config, len(scene.train), 0, 0.0)
        self.resume_or_initialize()
        self.scene = to_device(scene, device)
        self.field.to(device)
        self.tonemapper.to(device)
        if self.poses:
            self.poses.to(device)
        for optimizer in self.optimizers.values():
            optimizer.load_state_dict(optimizer.state_dict())  # moments follow their parameters

    @property
    def modules(self) -> dict[str, torch.nn.Module]:
        """What a checkpoint holds besides the optimizers."""
        learned: dict[str, torch.nn.Module] = {"field": self.field, "tonemapper": self.tonemapper}
        return {**learned, "poses": self.poses} if self.poses else learned

    def resume_or_initialize(self) -> None:
        """Continue from the newest checkpoint, or start response and brightness from
        the recordings.
        """
        found = latest_checkpoint(self.config.out)
        if found is not None:
            unpack(found.tensors, self.modules, self.optimizers)
            self.clock = replace(self.clock, step=found.step, seconds=found.seconds)
            self.report(f"going on at step {found.step}, {found.seconds:.0f} s into the training")
            return
        initialize(self.tonemapper, self.scene.response)
        told = start_field(
            self.field,
            heeded(self.scene, self.config.loss),
            self.recorded_radiance,
            self.typical_log_radiance(),
            self.config.from_priors,
        )
        if told:
            self.report(told)

    def report(self, message: str) -> None:
        """A line for the person at the terminal, once however many processes there are."""
        if self.ranks.main:
            say(message)

    def camera(self, frame: int) -> Camera:
        """The camera of training frame `frame`, as far as it has been refined."""
        camera = self.scene.train[frame].camera
        return self.poses.camera(camera, *self.poses.frames[frame]) if self.poses else camera

    def recorded_radiance(self, rgb: Tensor, frame: int) -> Tensor:
        """Radiance (N, 3) that training frame `frame` recorded as `rgb` (N, 3)."""
        f = self.scene.train[frame]
        return self.tonemapper.inverse(rgb, f.bracket, f.camera_id, frame)

    @torch.no_grad()
    def typical_log_radiance(self) -> float:
        """Median log radiance of what the frames recorded without clipping."""
        logs = []
        for i, f in enumerate(self.scene.train):
            rgb = f.image[::4, ::4].reshape(-1, 3)
            rgb = rgb[informative(rgb)]
            logs.append(self.recorded_radiance(rgb, i).clamp_min(1e-6).log().flatten())
        values = torch.cat(logs)
        return float(values.median()) if len(values) else 0.0

    def loop(self, keep_at: Sequence[float] = (), previews: bool = True) -> None:
        """Train until the clock runs out. It stands still while something is written,
        and starts after this process's first step, in which kernels are compiled.
        """
        if self.clock.progress >= 1:
            self.report(f"training was finished already, at step {self.clock.step}")
            return
        due = sorted(share for share in keep_at if share > self.clock.progress)
        started, before = time.monotonic(), self.clock.seconds
        saved, note, compiled = started, "", False
        if self.clock.step == 0 and self.ranks.main:
            self.save()
        with bar() as progress:
            task = progress.add_task("train", total=1000, note="")
            while self.clock.progress < 1:
                values = self.step()
                if not compiled:
                    started, compiled = time.monotonic(), True
                elapsed = self.ranks.agree(before + time.monotonic() - started)
                self.clock = replace(self.clock, step=self.clock.step + 1, seconds=elapsed)
                paused = time.monotonic()
                if self.clock.step % LOG_EVERY == 0 and self.ranks.main:
                    self.log(values)
                    note = f"{values['psnr']:.1f} dB"
                    progress.update(task, completed=round(1000 * self.clock.progress), note=note)
                while due and self.clock.progress >= due[0]:
                    self.keep(due.pop(0))
                if time.monotonic() - saved > self.config.checkpoint_seconds and self.ranks.main:
                    self.save()
                    if previews:
                        self.preview()
                    if not progress.live.is_started:
                        say(f"train: {self.clock.progress:.0%}, step {self.clock.step}, {note}")
                    saved = time.monotonic()
                started += time.monotonic() - paused
        if self.ranks.main:
            self.save()
            if previews:
                self.preview()
        if self.poses:
            self.report(self.poses.told())

    def step(self) -> dict[str, float]:
        """One optimizer step over this process's share of the batches; the terms'
        values, and the PSNR where a line of the log is due.
        """
        clock, config = self.clock, self.config
        self.field.train()
        hold_threads(config.torch_threads)
        if clock.progress >= config.anchor_at and not bool(self.tonemapper.anchored):
            self.tonemapper.anchor()
        slots = range(self.ranks.rank, config.batches, self.ranks.world)
        totals: dict[str, float] = {}
        for slot in slots:
            batch = self.draw(slot)
            batch = self.poses(batch) if self.poses else batch
            with torch.autocast(batch.rgb.device.type, torch.bfloat16, enabled=config.bf16):
                render, own = self.field(batch)
            terms = (
                self.objective.terms(render, batch, self.tonemapper, clock.phase)
                | own
                | self.tonemapper.regularizers()
            )
            terms |= self.poses.regularizers(batch.frame) if self.poses else {}
            values = dict(zip(terms, torch.stack(list(terms.values())).tolist(), strict=True))
            self.check(values, batch, render.radiance)
            (self.objective.total(terms) / config.batches).backward()
            for name, value in values.items():
                totals[name] = totals.get(name, 0.0) + value / len(slots)
            if (clock.step + 1) % LOG_EVERY == 0:
                totals["mse"] = totals.get("mse", 0.0) + self.squared_error(render, batch) / len(
                    slots
                )
        self.ranks.sum_gradients(
            p for o in self.optimizers.values() for g in o.param_groups for p in g["params"]
        )
        self.ranks.max_buffers(self.marks)
        for name, optimizer in self.optimizers.items():
            for group, lr in zip(optimizer.param_groups, self.base_lr[name], strict=True):
                group["lr"] = lr * clock.lr_share * (clock.progress >= group.get("start", 0.0))
            optimizer.step()
            if name == "dense":  # the touched one clears what it used
                optimizer.zero_grad()
        if self.poses:
            self.poses.fix_gauge()
        self.ranks.max_buffers(self.field.shared_maxima())
        self.field.after_step(
            clock.step + 1, self.frame_errors if clock.progress < SETTLED else None
        )
        if "mse" in totals:
            totals["psnr"] = -10 * math.log10(max(totals.pop("mse"), 1e-10))
        return totals

    def frame_errors(self, count: int) -> list[FrameError]:
        """How wrong pictures of `count` training frames are, evenly spread; others
        every step.
        """
        num = len(self.scene.train)
        chosen = sorted(
            {
                int((i + self.clock.step % 97 / 97) * num / count) % num
                for i in range(min(count, num))
            }
        )
        return [
            FrameError(self.camera(i), self.scene.train[i].time, partial(self.frame_error, i))
            for i in chosen
        ]

    @torch.no_grad()
    def frame_error(self, frame: int, radiance: Tensor) -> Tensor:
        """Mean absolute difference (S,) of what training frame `frame` recorded and
        would record of `radiance` (S, 3).
        """
        f = self.scene.train[frame]
        return (
            (
                self.tonemapper(radiance, f.bracket, f.camera_id, frame, leaky=False)
                - f.image.flatten(0, 1)
            )
            .abs()
            .mean(-1)
        )

    @torch.no_grad()
    def squared_error(self, render: Render, batch: PixelBatch) -> float:
        """Mean square difference of the recorded and the rendered rgb at the uniformly
        drawn pixels.
        """
        if render.rgb is not None:
            rgb = render.rgb.clamp(0, 1)
        else:
            rgb = self.tonemapper(
                render.radiance, batch.bracket, batch.camera_id, batch.frame, leaky=False
            )
        return float((rgb - batch.rgb)[batch.uniform].square().mean())

    def draw(self, slot: int) -> PixelBatch:
        """The batch of a slot of this step."""
        config, clock = self.config, self.clock
        generator = torch.Generator().manual_seed(
            hash((config.seed, clock.step, slot)) & 0x7FFFFFFF
        )
        frame = int(torch.randint(len(self.scene.train), (1,), generator=generator))
        when = clock.progress if config.period else clock.phase
        moving = config.moving_rays if when < config.moving_until else 0
        batch = (
            draw_pixels(self.scene, frame, config.rays, moving, generator)
            if config.rays
            else whole_frame(self.scene, frame)
        )
        chain = (1 if clock.step % 2 else -1) if clock.phase >= 2 and config.loss.chain else 0
        recorder = self.tonemapper.recorder(batch.bracket, batch.camera_id, frame, leaky=True)
        return replace(
            batch,
            seed=int(torch.randint(2**31, (1,), generator=generator)),
            recorder=recorder,
            chain=chain,
        )

    def check(self, values: dict[str, float], batch: PixelBatch, radiance: Tensor) -> None:
        """NaN and Inf are errors with the step, the term and the ray."""
        bad = [name for name, value in values.items() if not math.isfinite(value)]
        if not bad:
            return
        rays = (~torch.isfinite(radiance).all(-1)).nonzero()[:, 0]
        where = (
            f"pixel {batch.pixels[rays[0]].tolist()} of frame {batch.frame}"
            if len(rays)
            else f"frame {batch.frame}, all radiance finite"
        )
        raise FloatingPointError(f"step {self.clock.step}: the terms {bad} are not finite; {where}")

    def log(self, values: dict[str, float]) -> None:
        """Append one line to log.jsonl."""
        losses = {k: v for k, v in values.items() if k != "psnr"}
        c, drawn = (
            self.clock,
            self.config.rays + self.config.moving_rays or self.scene.train[0].image[..., 0].numel(),
        )
        rays = drawn * self.config.batches
        line = {
            "step": c.step,
            "seconds": round(c.seconds, 3),
            "psnr": values["psnr"],
            "rays_per_second": rays * c.step / c.seconds,
            "losses": losses,
        }
        with open(self.config.out / "log.jsonl", "ab+") as file:
            end = file.seek(0, 2)
            file.seek(max(end - 1, 0))
            whole = file.read() in (b"", b"\n")  # a kill may have cut the line before short
            file.write((b"" if whole else b"\n") + json.dumps(line).encode() + b"\n")

    def save(self) -> None:
        """A checkpoint of everything that counts."""
        save_checkpoint(
            self.config.out,
            self.clock.step,
            self.clock.seconds,
            pack(self.modules, self.optimizers),
        )

    def keep(self, share: float) -> None:
        """What was learned by now, to stay."""
        if self.ranks.main:
            keep_snapshot(
                self.config.out, share, self.clock.step, self.clock.seconds, pack(self.modules, {})
            )

    @torch.no_grad()
    def preview(self) -> None:
        """The middle frame as recorded and as rendered, side by side."""
        i = len(self.scene.train) // 2
        f = self.scene.train[i]
        rgb = recorded(
            self.field,
            self.camera(i),
            f.time,
            [self.tonemapper.recorder(f.bracket, f.camera_id, i)],
        )[0].view_as(f.image)
        pair = torch.cat([f.image, rgb], 1).cpu().numpy()
        write_png(self.config.out / "previews" / f"step_{self.clock.step:08d}.png", pair)
