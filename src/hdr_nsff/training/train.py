"""Scene to run: the loop, on one screen. Draw, forward, losses, backward, step.

Everything random is drawn from the seed, the step and the batch's place in it, so a
killed run that resumes, or one spread over several processes (`torchrun`), does what an
unbroken single one does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core import distributed
from hdr_nsff.core.checkpoints import latest_checkpoint, pack, save_checkpoint, unpack
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.process import limit_torch_threads
from hdr_nsff.core.progress import bar, say
from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.base import FrameError
from hdr_nsff.fields.build import build_field, device_for
from hdr_nsff.scene.batch import PixelBatch, draw_pixels, whole_frame
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training import run_folder
from hdr_nsff.training.budget import Clock
from hdr_nsff.training.config import TrainConfig, check_config
from hdr_nsff.training.measure import check_finite, frame_error, spread_frames, squared_error
from hdr_nsff.training.objective import Objective, merge_weights
from hdr_nsff.training.optimizers import Optimizers
from hdr_nsff.training.pose_corrections import PoseCorrections
from hdr_nsff.training.start import start_field

LOG_EVERY = 25  # steps
REARRANGE_UNTIL = 0.8  # share of the run: after that the field rearranges nothing


def train(config: TrainConfig, keep_at: Sequence[float] = (), previews: bool = True) -> Path:
    """Train (or continue training) until the budget is spent; the run folder.

    What was learned by the shares `keep_at` of the run, in (0, 1), stays in
    `snapshots/`; this has no influence on training. `previews`: a picture with every
    checkpoint.
    """
    config = check_config(config)
    with writing_to(config.out), lock_output(config.out), distributed.group() as ranks:
        if ranks.world > config.batches:
            raise InputError(
                f"{ranks.world} processes share {config.batches} batches a step; "
                "start fewer, or raise --batches"
            )
        device, scene = device_for(config.field, config.device), Scene.open(config.scene)
        if ranks.main:
            run_folder.open_folder(config)
        Trainer(config, scene, device, ranks).loop(keep_at, previews)
    return config.out


class Trainer:
    """Field, tone mapper, optimizers and clock of one run."""

    def __init__(
        self, config: TrainConfig, scene: Scene, device: torch.device, ranks: distributed.Ranks
    ) -> None:
        torch.manual_seed(config.seed)
        self.config, self.ranks = config, ranks
        self.clock = Clock(config.budget, config.schedule, len(scene.train))
        self.field = build_field(config.field, scene)
        self.tonemapper = tone_mapper_for(config.tonemap, scene)
        self.poses = PoseCorrections(scene) if config.refine_poses else None
        own = [self.field.loss_weights(), asdict(config.tonemap.loss)]
        weights = merge_weights(config.loss, *own, {"pose": config.pose_prior})
        fade, kind = config.schedule.prior_fade, scene.manifest.depth_kind
        self.objective = Objective(
            weights, kind, scene.near, config.squared, config.saturation, fade
        )
        groups = self.field.param_groups() + self.tonemapper.param_groups(config.tonemap_lr)
        groups += self.poses.param_groups(config.pose_lr) if self.poses else []
        self.optimizers = Optimizers(groups)
        self.resume_or_start(scene)
        self.scene = to_device(scene, device)
        for module in self.modules.values():
            module.to(device)
        self.optimizers.follow_parameters()

    @property
    def modules(self) -> dict[str, torch.nn.Module]:
        """What a checkpoint holds besides the optimizers."""
        learned: dict[str, torch.nn.Module] = {"field": self.field, "tonemapper": self.tonemapper}
        return {**learned, "poses": self.poses} if self.poses else learned

    def resume_or_start(self, scene: Scene) -> None:
        """Continue from the newest checkpoint, or start at what `prepare` found."""
        found = latest_checkpoint(self.config.out)
        if found is not None:
            unpack(found.tensors, self.modules, self.optimizers.by_name)
            self.clock = replace(self.clock, step=found.step, seconds=found.seconds)
            self.report(f"continuing at step {found.step}, {found.seconds:.0f} s into the training")
            return
        self.tonemapper.start(scene.response)
        weights, from_priors = self.objective.weights, self.config.from_priors
        self.report(
            start_field(self.field, self.tonemapper, scene, from_priors, bool(weights["flow"]))
        )

    def report(self, message: str | None) -> None:
        """A line for the person at the terminal, from the main process only."""
        if message and self.ranks.main:
            say(message)

    def frame(self, position: int) -> Frame:
        """A training frame, its camera as far as it has been refined."""
        frame = self.scene.train[position]
        if self.poses is None:
            return frame
        camera = self.poses.camera(frame.camera, *self.poses.frames[position])
        return replace(frame, camera=camera)

    def loop(self, keep_at: Sequence[float] = (), previews: bool = True) -> None:
        """Train until the clock runs out. The clock stands still while something is
        written, and starts after this process's first step, in which kernels compile.
        """
        if self.clock.progress >= 1:
            self.report(f"training was finished already, at step {self.clock.step}")
            return
        due = sorted(share for share in keep_at if share > self.clock.progress)
        before, started, compiled = self.clock.seconds, time.monotonic(), False
        saved, psnr = started, ""
        if self.clock.step == 0:
            self.save()
        with bar() as progress:
            task = progress.add_task("train", total=1000, note="")
            while self.clock.progress < 1:
                values = self.step()
                if not compiled:
                    started, compiled = time.monotonic(), True
                seconds = self.ranks.agree(before + time.monotonic() - started)
                self.clock = replace(self.clock, step=self.clock.step + 1, seconds=seconds)
                paused, done = time.monotonic(), self.clock.progress
                if self.clock.step % LOG_EVERY == 0 and self.ranks.main:
                    run_folder.append_log(self.config.out, self.clock, self.num_rays, values)
                    psnr = f"{values['psnr']:.1f} dB"
                    progress.update(task, completed=round(1000 * done), note=psnr)
                while due and done >= due[0]:
                    self.keep(due.pop(0))
                if paused - saved > self.config.checkpoint_seconds:
                    self.save(previews)
                    if not progress.live.is_started:
                        self.report(f"train: {done:.0%}, step {self.clock.step}, {psnr}")
                    saved = time.monotonic()
                started += time.monotonic() - paused
        self.save(previews)
        self.report(self.poses.describe() if self.poses else None)

    def step(self) -> dict[str, float]:
        """One optimizer step over this process's share of the batches.

        The terms' values, and the PSNR where a line of the log is due.
        """
        clock, config = self.clock, self.config
        self.field.train()
        limit_torch_threads(config.torch_threads)
        if clock.progress >= config.anchor_at and not bool(self.tonemapper.anchored):
            self.tonemapper.anchor()
        slots = range(self.ranks.rank, config.batches, self.ranks.world)
        totals: dict[str, float] = {}
        for slot in slots:
            batch = self.draw(slot)
            batch = self.poses(batch) if self.poses else batch
            with torch.autocast(batch.rgb.device.type, torch.bfloat16, enabled=config.bf16):
                render, own = self.field(batch)
            terms = self.objective.terms(render, batch, self.tonemapper, clock.phase)
            terms |= own | self.tonemapper.regularizers()
            terms |= self.poses.regularizers(batch.frame) if self.poses else {}
            values = dict(zip(terms, torch.stack(list(terms.values())).tolist(), strict=True))
            check_finite(values, clock.step, batch, render.radiance)
            (self.objective.total(terms) / config.batches).backward()
            if (clock.step + 1) % LOG_EVERY == 0:
                values["mse"] = squared_error(render, batch, self.tonemapper)
            for name, value in values.items():
                totals[name] = totals.get(name, 0.0) + value / len(slots)
        self.ranks.sum_gradients(self.optimizers.parameters())
        self.ranks.max_buffers(self.optimizers.row_marks)
        self.optimizers.step(clock.lr_share, clock.progress)
        if self.poses:
            self.poses.fix_gauge()
        self.ranks.max_buffers(self.field.shared_maxima())
        rearranging = clock.progress < REARRANGE_UNTIL
        self.field.after_step(clock.step + 1, self.frame_errors if rearranging else None)
        if "mse" in totals:
            totals["psnr"] = -10 * math.log10(max(totals.pop("mse"), 1e-10))
        return totals

    def draw(self, slot: int) -> PixelBatch:
        """The batch of a slot of this step."""
        config, clock = self.config, self.clock
        seed = np.random.SeedSequence([config.seed, clock.step, slot]).generate_state(1)
        generator = torch.Generator().manual_seed(int(seed[0]))
        frame = int(torch.randint(len(self.scene.train), (1,), generator=generator))
        when = clock.progress if config.schedule.period else clock.phase
        moving = config.moving_rays if when < config.moving_until else 0
        batch = whole_frame(self.scene, frame)
        if config.rays:
            batch = draw_pixels(self.scene, frame, config.rays, moving, generator)
        chained = clock.phase >= 2 and self.objective.weights.get("chain", 0.0) > 0
        direction = 1 if clock.step % 2 else -1
        return replace(
            batch,
            seed=int(torch.randint(2**31, (1,), generator=generator)),
            recorder=self.tonemapper.recorder(batch.bracket, batch.camera_id, frame, leaky=True),
            chain=direction if chained else 0,
        )

    def frame_errors(self, count: int) -> list[FrameError]:
        """How wrong pictures of `count` training frames are; others every step."""
        chosen = spread_frames(count, len(self.scene.train), self.clock.step)
        return [frame_error(self.tonemapper, self.frame(i), i) for i in chosen]

    @property
    def num_rays(self) -> int:
        """Pixels that one step compares."""
        drawn = self.config.rays + self.config.moving_rays
        return (drawn or self.scene.train[0].image[..., 0].numel()) * self.config.batches

    def save(self, preview: bool = False) -> None:
        """Save a checkpoint, and a `preview` picture."""
        if not self.ranks.main:
            return
        out, clock = self.config.out, self.clock
        tensors = pack(self.modules, self.optimizers.by_name)
        save_checkpoint(out, clock.step, clock.seconds, tensors)
        if preview:
            i = len(self.scene.train) // 2
            run_folder.write_preview(out, clock.step, self.field, self.tonemapper, self.frame(i), i)

    def keep(self, share: float) -> None:
        """A snapshot of what was learned by a share of the run."""
        if self.ranks.main:
            tensors = pack(self.modules, {})
            clock = self.clock
            run_folder.keep_snapshot(self.config.out, share, clock.step, clock.seconds, tensors)
