"""The viewer's page as one HTML file: style, shaders, scripts and the scene inlined.

The sources in `page/` are ES modules that a browser could load one by one. A page that
is opened from a folder may load nothing, so they are joined here: modules in order of
their imports, without their `import` lines and `export` words. Names at the top level
of all modules must therefore differ.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

FOLDER = Path(__file__).parent / "page"
SHADERS = ("splat.vert", "splat.frag", "picture.vert", "develop.frag")
ENTRY, WORKER = "main.js", "sorter.js"
MAX_PIXELS = 4_000_000  # of a frame that the server renders
MARK = '<meta name="generator" content="hdr-nsff">'  # of a page that was made here
IMPORT = re.compile(r'^import\s*\{[^}]*\}\s*from\s*"\./([\w.]+)";\n', re.MULTILINE)
EXPORT = re.compile(r"^export\s+(?=(async\s+)?(function|class|const|let)\b)", re.MULTILINE)
# what the page may load: nothing, but what it holds itself
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; media-src blob:{media}; "
    "connect-src {server}"
)


@dataclass(frozen=True)
class Link:
    """A file beside the page, or one that the page holds under this name."""

    href: str  # relative to the page
    text: str


@dataclass(frozen=True)
class PageSettings:
    """What the scripts know besides the scene."""

    videos: Sequence[Link] = field(default_factory=list)
    hdr_clips: Sequence[Link] = field(default_factory=list)
    """An HDR video, for screens whose browser draws no light above white: in several
    codecs, of which a browser takes the first that it plays.
    """
    server: bool = False
    """The page comes from a server, which has the scene and renders frames."""
    records: bool = False
    """The field records by itself what the learned camera does: another exposure takes
    the server as long as another view.
    """
    max_pixels: int = MAX_PIXELS


def make_page(
    title: str,
    scene: bytes | None,
    settings: PageSettings,
    videos: Mapping[str, bytes] | None = None,
) -> str:
    """The HTML of the page; `scene` are the bytes of a scene file.

    Without them the page asks its server for `scene.hdr4d`. `videos` are files that the
    page holds, by the `href` of their links in `settings`.
    """
    server = "'self'" if settings.server else "'none'"
    media = " 'self'" if settings.server else ""
    parts = {
        "POLICY": POLICY.format(server=server, media=media),
        "TITLE": html.escape(title),
        "STYLE": read("page.css"),
        "SOURCES": "\n".join(sources(scene, settings, videos or {})),
    }
    page = read("page.html")
    for name, text in parts.items():
        page = page.replace(f"@@{name}@@", text)
    return page


def sources(scene: bytes | None, settings: PageSettings, videos: Mapping[str, bytes]) -> list[str]:
    """The script elements of the page, the one that runs last."""
    elements = [script("settings", "application/json", json.dumps(asdict(settings)))]
    elements += [script(name, "text/plain", read(name)) for name in SHADERS]
    elements.append(script(WORKER, "text/plain", join_modules(WORKER)))
    if scene is not None:
        packed = base64.b64encode(gzip.compress(scene, mtime=0)).decode()
        elements.append(script("scene", "text/plain", packed))
    for name, video in videos.items():
        elements.append(script(name, "text/plain", base64.b64encode(video).decode()))
    elements.append(f'<script type="module">\n{join_modules(ENTRY)}</script>')
    return elements


def script(name: str, kind: str, text: str) -> str:
    """A script element that holds a text for other scripts."""
    text = text.replace("</", "<\\/") if kind == "application/json" else text
    assert "</script" not in text, name
    return f'<script id="{name}" type="{kind}">{text}</script>'


def join_modules(entry: str) -> str:
    """A module and all that it imports as one script."""
    return "\n".join(EXPORT.sub("", IMPORT.sub("", read(name))) for name in modules_of(entry))


def modules_of(entry: str, found: tuple[str, ...] = ()) -> tuple[str, ...]:
    """The names of all modules that one imports, and its own, in order of use."""
    for name in IMPORT.findall(read(entry)):
        if name not in found:
            found = modules_of(name, found)
    return (*found, entry)


def read(name: str) -> str:
    """A source file of the page."""
    return (FOLDER / name).read_text(encoding="utf-8")
