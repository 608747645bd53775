"""Scene to run: the loop, on one screen. Draw, forward, losses, backward, step.

Everything random is drawn from the seed, the step and the batch's slot in it. So a run
that resumes after a kill, or one spread over several processes (`torchrun`), does what
an unbroken single one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch

from hdr_nsff.core import distributed
from hdr_nsff.core.checkpoints import checkpoint_files
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.process import limit_torch_threads
from hdr_nsff.core.tensors import computes_bf16_fast, to_device
from hdr_nsff.fields.base import FrameError
from hdr_nsff.fields.baselines.hexplane import HexPlane
from hdr_nsff.fields.build import build_field, check_scene, device_for
from hdr_nsff.fields.nsff.two_branches import TwoBranches
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training import run_folder
from hdr_nsff.training.budget import Clock, Stopwatch
from hdr_nsff.training.config import TrainConfig, check_config
from hdr_nsff.training.measure import Monitor, averaged, frame_error, spread_frames
from hdr_nsff.training.objective import Objective
from hdr_nsff.training.optimizers import Optimizers
from hdr_nsff.training.pose_corrections import poses_for
from hdr_nsff.training.read_ahead import ReadAhead
from hdr_nsff.training.run_writer import RunWriter
from hdr_nsff.training.sampling import draw_batch, draw_frame, rays_per_step
from hdr_nsff.training.start import start_run
from hdr_nsff.training.weighted_terms import backward, merge_weights

CHECK_SAME_EVERY = 1000  # steps after which several processes compare their parameters
REARRANGE_UNTIL = 0.8  # share of the run after which the field rearranges nothing (hand-chosen)


def train(config: TrainConfig, keep_at: Sequence[float] = (), previews: bool = True) -> Path:
    """Train (or continue training) until the budget is spent; the run folder.

    What was learned by the shares `keep_at` of the run, in (0, 1), stays in
    `snapshots/`; this has no influence on training. `previews`: a picture with every
    checkpoint.
    """
    config = check_config(config)
    with writing_to(config.out), lock_output(config.out), distributed.group(config.device) as ranks:
        if ranks.world > config.batches:
            raise InputError(
                f"{ranks.world} processes share {config.batches} batches per step; "
                "start fewer, or raise --batches"
            )
        device = device_for(config.field, config.device)
        scene = Scene.open(config.scene)
        check_scene(config.field, scene)
        camera = scene.train[0].camera
        config = run_folder.with_own_budget(config)
        budget = config.budget.for_clip(camera.width * camera.height, len(scene.train))
        config = replace(config, budget=budget)
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
        self.config = config
        self.ranks = ranks
        self.clock = Clock(config.budget, config.schedule, len(scene.train))
        self.field = build_field(config.field, scene)
        self.tonemapper = tone_mapper_for(config.tonemap, scene)
        self.poses = poses_for(scene, config.refine_poses)
        self.monitor = Monitor(self.tonemapper, device)
        self.objective = Objective(
            weights=merge_weights(
                config.loss,
                self.field.loss_weights(),
                asdict(config.tonemap.loss),
                {"pose": config.pose_prior},
            ),
            depth_kind=scene.manifest.depth_kind,
            near=scene.near,
            squared=config.squared,
            saturation=config.saturation,
            fade=config.schedule.prior_fade,
            published=config.published,
        )
        modules = {"field": self.field, "tonemapper": self.tonemapper, "poses": self.poses}
        note = None
        if not checkpoint_files(config.out):
            with_flow = config.loss.flow > 0
            note = start_run(self.field, self.tonemapper, scene, config.from_priors, with_flow)
        # before there are optimizers: a move replaces the marks that these hold
        for module in modules.values():
            module.to(device)
        groups = self.field.param_groups()
        groups += self.tonemapper.param_groups(config.tonemap_lr)
        groups += self.poses.param_groups(config.pose_lr)
        self.optimizers = Optimizers(groups)
        num_rays = rays_per_step(config, scene)
        self.writer = RunWriter(config, modules, self.optimizers, num_rays, ranks.main)
        self.writer.say(note)
        self.bf16 = config.bf16 and computes_bf16_fast(device)
        if config.bf16 and not self.bf16:
            self.writer.say("layers in float32: this device would take longer in bfloat16")
        if isinstance(self.field, TwoBranches | HexPlane):  # the others have no layers
            self.field.bf16 = self.bf16
        self.clock = self.writer.resume(self.clock) or self.clock
        # frames on the CPU stay where they are: read when they are drawn
        self.scene = scene if device.type == "cpu" else to_device(scene, device)
        self.read_ahead = ReadAhead(self.scene.train)

    def loop(self, keep_at: Sequence[float] = (), previews: bool = True) -> None:
        """Train until the clock runs out; it counts neither compiling nor writing."""
        if self.clock.progress >= 1:
            self.writer.say(f"training was finished already, at step {self.clock.step}")
            return
        shares = sorted(share for share in keep_at if share > self.clock.progress)
        self.writer.announce(self.clock, self.scene)
        watch = Stopwatch(self.clock.seconds)
        if self.clock.step == 0:
            self.save()
        with self.writer.progress_bar():
            while self.clock.progress < 1:
                values = self.step()
                seconds = self.ranks.agree(watch.read())
                self.clock = replace(self.clock, step=self.clock.step + 1, seconds=seconds)
                with watch.paused():
                    self.writer.log(self.clock, values)
                    while shares and self.clock.progress >= shares[0]:
                        self.writer.save_snapshot(self.clock, shares.pop(0))
                    if self.writer.checkpoint_due():
                        self.save(previews)
                        self.writer.finish_checkpoint(self.clock)
        self.save(previews)
        self.writer.say(self.poses.describe())
        self.writer.say(f"run: {self.config.out}  ({self.clock.step:,} steps)")

    def step(self) -> dict[str, float]:
        """One optimizer step over this process's share of the batches.

        The terms' values, and the PSNR where a line of the log is due.
        """
        clock, config = self.clock, self.config
        self.field.train()
        limit_torch_threads(config.torch_threads)
        if clock.progress >= config.anchor_at and not self.tonemapper.is_anchored():
            self.tonemapper.anchor()
        slots = range(self.ranks.rank, config.batches, self.ranks.world)
        measured = []
        for slot in slots:
            batch = self.poses(self.draw(slot))
            self.read_ahead(draw_frame(config, self.scene, clock.step + 1, slot)[0])
            render, field_terms = self.field(batch)
            terms = self.objective.terms(render, batch, self.tonemapper, clock.phase)
            terms |= self.objective.reduce(field_terms) | self.tonemapper.regularizers()
            terms |= self.poses.regularizers(batch.frame)
            measured.append(self.monitor.measure(clock.step, terms, render, batch))
            backward(terms, self.objective.weights, config.batches)
        self.ranks.sum_gradients(self.optimizers.parameters())
        self.ranks.max_buffers(self.optimizers.row_marks)
        self.optimizers.step(clock.lr_share, clock.progress)
        self.poses.fix_gauge()
        self.ranks.max_buffers(self.field.shared_maxima())
        rearranging = clock.progress < REARRANGE_UNTIL
        if self.field.after_step(clock.step + 1, self.frame_errors if rearranging else None):
            self.ranks.follow_first([*self.field.parameters(), *self.field.buffers()])
        if (clock.step + 1) % CHECK_SAME_EVERY == 0:
            self.ranks.check_same(self.optimizers.parameters())
        return averaged(measured)

    def draw(self, slot: int) -> PixelBatch:
        """The batch of a slot of this step, with its recorder."""
        chained = self.clock.phase >= 2 and self.objective.weights.get("chain", 0.0) > 0
        batch = draw_batch(self.config, self.scene, self.clock, slot, chained)
        which = batch.bracket, batch.camera_id, batch.frame
        return replace(batch, recorder=self.tonemapper.recorder(*which, leaky=True))

    def frame_errors(self, count: int) -> list[FrameError]:
        """How wrong pictures of `count` training frames are; others every step."""
        chosen = spread_frames(count, len(self.scene.train), self.clock.step)
        return [frame_error(self.tonemapper, self.poses.frame(self.scene, i), i) for i in chosen]

    def save(self, preview: bool = False) -> None:
        """Save a checkpoint, and a `preview` of the frame in the middle."""
        self.monitor.check_latest(self.clock.step)
        self.writer.save_checkpoint(self.clock)
        if preview:
            middle = len(self.scene.train) // 2
            frame = self.poses.frame(self.scene, middle)
            self.writer.save_preview(self.clock.step, self.field, self.tonemapper, frame, middle)
