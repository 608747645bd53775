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
# MyST does not see anchors such as <a id="eq-9">, which work: tests/test_docs.py
# checks all links instead
suppress_warnings = ["myst.xref_missing"]

html_theme = "furo"
html_title = f"HDR-NSFF {version}"
