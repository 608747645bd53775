"""A server for the viewer's page on this machine alone: 127.0.0.1, standard library.

It has the page, its scene file, the version of both, videos of the run, and frames that
this machine renders for browsers without a GPU. What it serves is a `Source`.
"""

from __future__ import annotations

import json
import re
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.geometry.paths import MAX_EV, parse_intrinsics, parse_numbers, parse_pose
from hdr_nsff.viewer.page_file import MAX_PIXELS

HOST = "127.0.0.1"
MAX_REQUEST_BYTES = 10_000
NUM_PORTS = 2**16
# as a browser names this machine; the port is another one behind a tunnel
LOCAL = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
MAX_SIDE = 65_500  # pixels: longer ones fit into no JPEG file of libjpeg
CURVES = ("camera", "agx", "neutral", "reinhard", "clip")  # that develop radiance
VIEWS = ("radiance", "depth", "motion", "flow")
KINDS = {"jpeg": "image/jpeg", "png8": "image/png", "png16": "image/png"}  # of files
NOT_LOCAL = b"not from this machine: open the page at localhost or 127.0.0.1"
LENGTH = re.compile(r"\d{1,9}")  # of a request in bytes
RANGE = re.compile(r"bytes=(\d{1,18})-(\d{0,18})")  # of a file, as players ask for it


@dataclass(frozen=True)
class FrameRequest:
    """A frame that a page asks for."""

    time: float  # in frames
    c2w: np.ndarray  # (3, 4) OpenCV camera to world, scene units
    K: np.ndarray  # (3, 3) pixels of the frame
    width: int
    height: int
    ev: float  # relative to the reference exposure
    curve: str  # one of CURVES
    camera_id: int  # whose response develops the frame
    show: str  # one of VIEWS
    clipping: bool  # whether clipped pixels are marked
    false_color: bool  # whether radiance is shown as stops from mid gray
    kind: str  # one of KINDS


class Source(Protocol):
    """What a server shows. Methods are called by several threads."""

    def page(self) -> str:
        """The HTML of the page."""
        ...

    def scene(self) -> bytes:
        """The scene file."""
        ...

    def version(self) -> str:
        """A text that changes with the scene."""
        ...

    def videos(self) -> dict[str, Path]:
        """MP4 files by their addresses, which begin with a slash."""
        ...

    def frame(self, request: FrameRequest, awaited: Callable[[], bool]) -> bytes | None:
        """A rendered frame as a file. InputError where it cannot be rendered.

        None where the frame is not `awaited` any more.
        """
        ...


class ViewerServer(ThreadingHTTPServer):
    """Serves a source at a port; 0 takes a free one."""

    daemon_threads = True

    def __init__(self, source: Source, port: int = 0) -> None:
        try:
            super().__init__((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            problem = "this port is not free"
            if not 0 <= port < NUM_PORTS:
                problem = f"ports are from 0 to {NUM_PORTS - 1}"
            raise InputError(f"--port {port}: {problem}; leave the option out") from error
        self.source = source

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/"


class Handler(BaseHTTPRequestHandler):
    """One request."""

    server: ViewerServer

    def do_GET(self) -> None:
        source = self.server.source
        match self.path.partition("?")[0]:
            case _ if not self.is_local():
                self.answer(HTTPStatus.FORBIDDEN, "text/plain", NOT_LOCAL)
            case "/":
                self.answer(HTTPStatus.OK, "text/html; charset=utf-8", source.page().encode())
            case "/scene.hdr4d":
                self.answer(HTTPStatus.OK, "application/octet-stream", source.scene())
            case "/version":
                self.answer(HTTPStatus.OK, "text/plain", source.version().encode())
            case address if (video := source.videos().get(address)) and video.is_file():
                self.answer_video(video)
            case _:
                self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"nothing here")

    def do_POST(self) -> None:
        if not (self.is_local() and self.is_own_page()) or self.path != "/frame":
            self.answer(HTTPStatus.FORBIDDEN, "text/plain", NOT_LOCAL)
            return
        try:
            request = parse_request(self.read_body())
            frame = self.server.source.frame(request, self.is_awaited)
        except InputError as error:
            self.answer(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error).encode())
            return
        if frame is not None:
            self.answer(HTTPStatus.OK, KINDS[request.kind], frame)

    def read_body(self) -> bytes:
        """What was sent. InputError where its length is not given, or too large."""
        length = self.headers.get("Content-Length", "")
        if not (LENGTH.fullmatch(length) and int(length) <= MAX_REQUEST_BYTES):
            raise InputError(f"frame: Content-Length must be from 0 to {MAX_REQUEST_BYTES}")
        return self.rfile.read(int(length))

    def is_awaited(self) -> bool:
        """Whether the browser still waits: else it has closed the connection."""
        if not select.select([self.connection], [], [], 0)[0]:
            return True
        try:
            return self.connection.recv(1, socket.MSG_PEEK) != b""
        except ConnectionError:
            return False

    def answer_video(self, path: Path) -> None:
        """Send an MP4 file, or the part of it that a player asks for."""
        data = path.read_bytes()
        asked = parse_range(self.headers.get("Range", ""), len(data))
        if asked is None:
            self.answer(HTTPStatus.OK, "video/mp4", data, {"Accept-Ranges": "bytes"})
            return
        first, last = asked
        if first >= len(data):
            whole = {"Content-Range": f"bytes */{len(data)}"}
            self.answer(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, "text/plain", b"", whole)
            return
        part = {"Content-Range": f"bytes {first}-{last}/{len(data)}", "Accept-Ranges": "bytes"}
        self.answer(HTTPStatus.PARTIAL_CONTENT, "video/mp4", data[first : last + 1], part)

    def is_local(self) -> bool:
        """Whether the address was this machine's, at any port.

        Pages of other sites that let their name point to 127.0.0.1 have another name.
        """
        return LOCAL.fullmatch(self.headers.get("Host", "")) is not None

    def is_own_page(self) -> bool:
        """Whether our page asks, or no page at all; those of other sites may not."""
        origin = self.headers.get("Origin")
        return origin is None or origin == f"http://{self.headers.get('Host')}"

    def answer(
        self, status: HTTPStatus, kind: str, body: bytes, more: dict[str, str] | None = None
    ) -> None:
        """Send an answer; a browser that has gone away is no fault."""
        try:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            for name, value in (more or {}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except ConnectionError:
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are not of interest at the terminal."""


def parse_range(text: str, length: int) -> tuple[int, int] | None:
    """The first and the last byte that a `Range` asks for in a file of `length` bytes.

    None where it asks for no part that is understood here: the whole file.
    """
    asked = RANGE.fullmatch(text)
    if asked is None:
        return None
    first = int(asked[1])
    last = int(asked[2]) if asked[2] else max(first, length - 1)
    return None if last < first else (first, min(last, length - 1))


def parse_request(data: bytes) -> FrameRequest:
    """The request in a JSON text. InputError for anything else."""
    try:
        entries = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError("frame: not JSON") from error
    if not isinstance(entries, dict):
        raise InputError("frame: not a JSON object")
    width, height = (round(number(entries, name)) for name in ("width", "height"))
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise InputError(f"frame: {width} x {height} pixels; at most {MAX_PIXELS:,} are rendered")
    if max(width, height) > MAX_SIDE:
        raise InputError(f"frame: {width} x {height} pixels; at most {MAX_SIDE:,} a side")
    ev = number(entries, "ev")
    if abs(ev) > MAX_EV:
        raise InputError(f"frame: ev {ev:g} is beyond {MAX_EV:g} stops")
    for name, known in (("curve", CURVES), ("show", VIEWS), ("kind", tuple(KINDS))):
        if entries.get(name) not in known:
            raise InputError(f"frame: {name} must be one of {', '.join(known)}")
    for name in ("clipping", "falseColor"):
        if not isinstance(entries.get(name), bool):
            raise InputError(f"frame: {name} must be true or false")
    return FrameRequest(
        time=number(entries, "time"),
        c2w=parse_pose(entries.get("c2w"), "frame"),
        K=parse_intrinsics(entries.get("K"), "frame"),
        width=width,
        height=height,
        ev=ev,
        curve=entries["curve"],
        camera_id=round(number(entries, "camera")),
        show=entries["show"],
        clipping=entries["clipping"],
        false_color=entries["falseColor"],
        kind=entries["kind"],
    )


def number(entries: dict[str, Any], name: str) -> float:
    """A number of a request."""
    return float(parse_numbers(entries.get(name), (), f"frame: {name}"))
