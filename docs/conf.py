"""Sphinx settings: `make docs`."""

from hdr_nsff import __version__

project = "HDR-NSFF"
author = "The HDR-NSFF authors"
copyright = f"2026, {author}"
version = release = __version__

extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"HDR-NSFF {version}"
