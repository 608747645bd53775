"""The verb `view`: a run in the browser. `train --view` starts it beside training."""

from __future__ import annotations

import subprocess
import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import tyro

from hdr_nsff.core.progress import say
from hdr_nsff.rendering.served_run import ServedRun, newest_checkpoint
from hdr_nsff.viewer.server import ViewerServer

WAIT_SECONDS = 0.5  # between two looks for a first checkpoint
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

    It renders on the CPU, as the GPU is at work.
    """
    arguments = ["view", str(run), "--wait", "--device", "cpu"]
    viewer = subprocess.Popen([sys.executable, "-P", "-c", VIEWER, *arguments])
    try:
        yield
    finally:
        viewer.terminate()
        viewer.wait()
        again = f"; `hdr-nsff view {run}` opens it again" if newest_checkpoint(run) else ""
        say(f"the viewer has closed{again}")
