"""The verb `view`: a run in the browser."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from pathlib import Path

import tyro

from hdr_nsff.core.progress import say
from hdr_nsff.rendering.served_run import ServedRun
from hdr_nsff.viewer.server import ViewerServer


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


def view(config: ViewConfig) -> None:
    """The verb: serve until Ctrl-C."""
    source = ServedRun(config.run, config.device)
    with ViewerServer(source, config.port) as server:
        try:
            say(f"{source.title}: {server.address} (Ctrl-C ends it)")
            if config.browser:
                webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            say("viewer closed")
