"""Readers of public data layouts, one file each, and `recognize`: which of them a
folder is.
"""

from __future__ import annotations

from pathlib import Path

from hdr_nsff.footage.datasets import blender, hdr_nerf, hdr_nerf_real, llff, nerfstudio
from hdr_nsff.footage.datasets.capture import Capture

LAYOUTS = {  # the first that fits counts
    "nerfstudio": nerfstudio,
    "hdr-nerf": hdr_nerf,
    "hdr-nerf-real": hdr_nerf_real,
    "blender": blender,
    "hdr-gopro": llff,
}


def layout_of(folder: Path) -> str | None:
    """The name of the layout of `folder`; None for footage."""
    if not folder.is_dir():
        return None
    return next((name for name, reader in LAYOUTS.items() if reader.recognized(folder)), None)


def recognize(folder: Path) -> Capture | None:
    """The training part of the public data set in `folder`; None where it is none.

    InputError where it is one and something is missing or short. Held-out pictures are
    not opened.
    """
    name = layout_of(folder)
    return None if name is None else LAYOUTS[name].read(folder)
