"""What a run writes while it trains: checkpoints, snapshots, log, previews, progress.

Only the main process writes. Checkpoints hold everything that resuming needs, so that a
killed run does what an unbroken one does.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

from torch import nn

from hdr_nsff.core.checkpoints import latest_checkpoint, pack, save_checkpoint, unpack
from hdr_nsff.core.progress import SHORT_SECONDS, bar, say, time_left
from hdr_nsff.fields.base import RadianceField
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.tonemap.base import ToneMapper
from hdr_nsff.training import run_folder
from hdr_nsff.training.budget import Clock
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.measure import LOG_EVERY
from hdr_nsff.training.optimizers import Optimizers


class RunWriter:
    """Reads the newest checkpoint of a run folder, and writes the next ones."""

    def __init__(
        self,
        config: TrainConfig,
        modules: Mapping[str, nn.Module],
        optimizers: Optimizers,
        num_rays: int,
        main: bool,
    ) -> None:
        self.config = config
        self.modules = modules
        self.optimizers = optimizers
        self.num_rays = num_rays  # pixels that one step compares
        self.main = main  # whether this process writes
        self.progress = bar()
        self.psnr = ""  # of the last line of the log
        self.last_checkpoint = time.monotonic()
        self.spoken = False  # whether a line has said how long training takes

    def say(self, message: str | None) -> None:
        """Print a line, if there is one, from the main process only."""
        if message and self.main:
            say(message)

    def announce(self, clock: Clock, scene: Scene) -> None:
        """Report how long this takes, where that is known."""
        minutes = clock.budget.minutes
        if clock.budget.steps is not None or minutes is None:
            return
        left = minutes * 60 - clock.seconds
        end = time.strftime("%H:%M", time.localtime(time.time() + left))
        camera = scene.train[0].camera
        self.say(
            f"train: {left / 60:.1f} minutes for {len(scene.train)} frames of "
            f"{camera.width}x{camera.height}, until about {end}"
        )

    def resume(self, clock: Clock) -> Clock | None:
        """Load the newest checkpoint; the clock then, or None where there is none."""
        found = latest_checkpoint(self.config.out)
        if found is None:
            return None
        unpack(found.tensors, self.modules, self.optimizers.by_name)
        self.say(f"continuing at step {found.step}, {found.seconds:.0f} s into the training")
        return replace(clock, step=found.step, seconds=found.seconds)

    @contextmanager
    def progress_bar(self) -> Iterator[None]:
        """Show how far the run is, on a terminal."""
        self.last_checkpoint = time.monotonic()
        with self.progress:
            self.task = self.progress.add_task("train", total=1000, note="", left=None)
            yield
            self.progress.update(self.task, completed=1000, left=0.0)

    def log(self, clock: Clock, values: dict[str, float]) -> None:
        """Every `LOG_EVERY` steps, append a line to the log and move the bar."""
        if not self.main or clock.step % LOG_EVERY != 0:
            return
        run_folder.append_log(self.config.out, clock, self.num_rays, values)
        self.psnr = f"{values['psnr']:.1f} dB"
        self.progress.update(
            self.task,
            completed=round(1000 * clock.progress),
            note=self.psnr,
            left=clock.seconds_left,
        )
        if not self.spoken and (clock.seconds_left or 0.0) > SHORT_SECONDS:
            self.report(clock)

    def checkpoint_due(self) -> bool:
        """Whether the last checkpoint is old enough to write another."""
        return time.monotonic() - self.last_checkpoint > self.config.checkpoint_seconds

    def save_checkpoint(self, clock: Clock) -> None:
        """Write everything that training needs to continue."""
        if self.main:
            tensors = pack(self.modules, self.optimizers.by_name)
            save_checkpoint(self.config.out, clock.step, clock.seconds, tensors)

    def finish_checkpoint(self, clock: Clock) -> None:
        """Start the time to the next checkpoint; report progress where no bar does."""
        self.last_checkpoint = time.monotonic()
        self.report(clock)

    def report(self, clock: Clock) -> None:
        """Print progress and the time left, where no bar shows them."""
        self.spoken = True
        if self.progress.live.is_started:
            return
        line = f"train: {clock.progress:.0%}, step {clock.step}"
        if self.psnr:
            line += f", {self.psnr}"
        if clock.seconds_left is not None:
            line += f", {time_left(clock.seconds_left)}"
        self.say(line)

    def save_snapshot(self, clock: Clock, share: float) -> None:
        """Keep what was learned by a `share` of the run, without optimizers."""
        if self.main:
            tensors = pack(self.modules, {})
            run_folder.keep_snapshot(self.config.out, share, clock.step, clock.seconds, tensors)

    def save_preview(
        self, step: int, field: RadianceField, tonemapper: ToneMapper, frame: Frame, position: int
    ) -> None:
        """Write a picture of training frame `frame`, at `position` in the scene."""
        if self.main:
            run_folder.write_preview(self.config.out, step, field, tonemapper, frame, position)
