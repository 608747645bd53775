"""The verb `view`: a run in the browser. `train --view` starts it beside training."""

from __future__ import annotations

import subprocess
import sys
import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from hdr_nsff.core.progress import say
from hdr_nsff.rendering.served_run import ServedRun, newest_checkpoint
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.viewer.server import ViewerServer

WAIT_SECONDS = 0.5  # between two looks for a first checkpoint
CHECKPOINT_SECONDS = 15.0  # between checkpoints of a run that is watched, at most
FOLLOW_SECONDS = 5.0  # between two looks of the page for a newer version, as in main.js
END_SECONDS = 2 * FOLLOW_SECONDS  # after training, for the page to load its end
VIEWER = (  # the program of the viewer beside training
    "from hdr_nsff.core.process import die_with_parent; die_with_parent(); "
    "from hdr_nsff.cli import main; main()"
)


@dataclass(frozen=True)
class ViewConfig:
    """Look around in a run, in the browser of this machine. Ctrl-C ends it.

    A run that is still training is shown as it grows. Browsers without a GPU, and
    fields without Gaussians, get frames that this machine renders.
    """

    run: tyro.conf.Positional[Path]
    """Run folder."""
    browser: bool = True
    """Open the browser; else the address is printed."""
    port: int = 0
    """Port on 127.0.0.1; 0: a free one."""
    device: str = "auto"
    """auto, cpu or cuda: where frames are rendered."""
    wait: bool = False
    """Wait for the first checkpoint of a run that is about to be trained."""


def view(config: ViewConfig) -> None:
    """The verb: serve until Ctrl-C."""
    try:
        while config.wait and not newest_checkpoint(config.run):
            time.sleep(WAIT_SECONDS)
        source = ServedRun(config.run, config.device)
        with ViewerServer(source, config.port) as server:
            say(f"{source.title}: {server.address} (Ctrl-C ends it)")
            if config.browser:
                webbrowser.open(server.address)
            server.serve_forever()
    except KeyboardInterrupt:
        say("viewer closed")


@contextmanager
def viewer_beside(run: Path) -> Iterator[None]:
    """Show a run while it trains: a viewer in another process, which ends with it, even
    where that was killed.

    It renders on the CPU, as the GPU is at work. After training it stays until the page
    has had time to load what was learned.
    """
    arguments = ["view", str(run), "--wait", "--device", "cpu"]
    viewer = subprocess.Popen([sys.executable, "-P", "-c", VIEWER, *arguments])
    try:
        yield
        let_page_follow(viewer)
    finally:
        viewer.terminate()
        viewer.wait()
        again = f"; `hdr-nsff view {run}` opens it again" if newest_checkpoint(run) else ""
        say(f"the viewer has closed{again}")


def let_page_follow(viewer: subprocess.Popen[bytes]) -> None:
    """Wait until the page has had time to load the last checkpoint, or Ctrl-C."""
    say(f"training has ended; the viewer shows the result and closes in {END_SECONDS:.0f} s")
    with suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
        viewer.wait(END_SECONDS)


def watched(config: TrainConfig, options: Sequence[str]) -> TrainConfig:
    """The config with a checkpoint, which the page shows, every 15 seconds.

    Unless its checkpoints come faster, or `options` of the command line set their time.
    """
    names = {option.partition("=")[0].replace("_", "-") for option in options}
    seconds = min(config.checkpoint_seconds, CHECKPOINT_SECONDS)
    if "--checkpoint-seconds" in names:
        return config
    return replace(config, checkpoint_seconds=seconds)
