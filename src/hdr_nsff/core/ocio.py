"""Looks of OpenColorIO: from linear Rec. 709 light to a display, by a configuration.

The library brings the ACES configurations along; `studio-config-latest` and
`cg-config-latest` have the views of ACES 2.0.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError, shorten

# Names and aliases of linear light with Rec. 709 primaries in common configurations
LINEAR_REC709 = (
    "Linear Rec.709 (sRGB)",
    "lin_rec709",
    "lin_rec709_scene",
    "lin_srgb",
    "Linear Rec.709",
    "Linear BT.709",
    "Utility - Linear - sRGB",
)


class Look:
    """A view of a display in a configuration."""

    def __init__(self, config: str, view: str | None, display: str | None = None) -> None:
        """`config` is a file or the name of one that the library has.

        Without a `view` or `display`, the configuration's first one. InputError for
        what it does not have.
        """
        ocio = import_library()
        known = open_config(ocio, config)
        self.display = display or known.getDefaultDisplay()
        check_name(f"--display {display!r}", self.display, known.getDisplays())
        views = list(known.getViews(self.display))
        self.view = view or known.getDefaultView(self.display)
        check_name(f"--view {view!r}", self.view, views)
        source = next((name for name in LINEAR_REC709 if known.getColorSpace(name)), None)
        if source is None:
            problem = "has no color space for linear Rec. 709"
            raise InputError(f"--ocio {config}: {problem}; use studio-config-latest")
        transform = ocio.DisplayViewTransform(src=source, display=self.display, view=self.view)
        self.processor: Any = known.getProcessor(transform).getDefaultCPUProcessor()

    def develop(self, light: np.ndarray) -> np.ndarray:
        """The picture (H, W, 3) in [0, 1] of linear light (H, W, 3), mid gray 0.18."""
        pixels = np.array(light, np.float32, order="C")
        self.processor.applyRGB(pixels)
        return pixels.clip(0, 1)


def import_library() -> Any:
    """PyOpenColorIO; InputError where it is not installed."""
    try:
        import PyOpenColorIO
    except ImportError as error:
        advice = "install it with `pip install 'hdr-nsff[ocio]'`"
        raise InputError(f"--ocio: OpenColorIO is not installed; {advice}") from error
    return PyOpenColorIO


def open_config(ocio: Any, config: str) -> Any:
    """The configuration of a file, or of a name that the library knows."""
    try:
        if config.endswith((".ocio", ".ocioz")):
            return ocio.Config.CreateFromFile(config)
        return ocio.Config.CreateFromBuiltinConfig(config)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        known = "studio-config-latest, cg-config-latest or a file NAME.ocio"
        reason = shorten(error)
        raise InputError(f"--ocio {config}: no configuration ({reason}); use {known}") from error


def check_name(option: str, name: str, known: Iterable[str]) -> None:
    """InputError unless a configuration knows the name."""
    names = list(known)
    if name not in names:
        listed = ", ".join(repr(other) for other in names)
        raise InputError(f"{option}: not in this configuration; it has {listed}")
