"""The viewer's server: what it answers, to whom, and what it refuses."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.viewer.display import png
from hdr_nsff.viewer.field_scene import jpeg
from hdr_nsff.viewer.server import MAX_SIDE, FrameRequest, ViewerServer, parse_request

REQUEST = {
    "time": 1.5,
    "c2w": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
    "K": [[40, 0, 24], [0, 40, 16], [0, 0, 1]],
    "width": 48,
    "height": 32,
    "ev": -1,
    "curve": "camera",
    "camera": 0,
    "show": "radiance",
    "clipping": False,
    "falseColor": False,
    "kind": "jpeg",
}
SLOW = 3.0  # the time of a frame that is rendered as long as it is awaited


class Fake:
    """A source that answers with short texts."""

    def __init__(self, folder: Path) -> None:
        self.video = folder / "b.mp4"
        self.given_up = threading.Event()  # a frame that was not awaited any more

    def page(self) -> str:
        return "<p>page</p>"

    def scene(self) -> bytes:
        return b"scene"

    def version(self) -> str:
        return "7"

    def videos(self) -> dict[str, Path]:
        return {"/video/a.mp4": self.video}

    def frame(self, request: FrameRequest, awaited: Callable[[], bool]) -> bytes | None:
        if request.time > 4:
            raise InputError("outside the clip")
        if request.time == SLOW:
            while awaited():
                time.sleep(0.01)
            self.given_up.set()
            return None
        return f"{request.width} x {request.height}".encode()


@pytest.fixture
def fake(tmp_path: Path) -> Fake:
    return Fake(tmp_path)


@pytest.fixture
def port(fake: Fake) -> Iterator[int]:
    with ViewerServer(fake) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port
        server.shutdown()


def ask(port: int, method: str, path: str, body: str = "", host: str = "") -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request(method, path, body or None, {"Host": host} if host else {})
    answer = connection.getresponse()
    result = answer.status, answer.read()
    connection.close()
    return result


def post(port: int, body: str, headers: dict[str, str]) -> int:
    """The status of the answer to a frame's request."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("POST", "/frame", body, headers)
    status = connection.getresponse().status
    connection.close()
    return status


def test_page_scene_version_and_frames_are_served(port: int) -> None:
    assert ask(port, "GET", "/") == (200, b"<p>page</p>")
    assert ask(port, "GET", "/scene.hdr4d") == (200, b"scene")
    assert ask(port, "GET", "/version") == (200, b"7")
    assert ask(port, "POST", "/frame", json.dumps(REQUEST)) == (200, b"48 x 32")
    assert ask(port, "GET", "/etc/passwd")[0] == 404


def test_a_frame_that_cannot_be_rendered_is_a_sentence(port: int) -> None:
    answer = ask(port, "POST", "/frame", json.dumps({**REQUEST, "time": 9}))
    assert answer == (400, b"outside the clip")


def test_a_frame_ends_with_its_connection(port: int, fake: Fake) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("POST", "/frame", json.dumps({**REQUEST, "time": SLOW}))
    assert not fake.given_up.wait(0.2)
    connection.close()
    assert fake.given_up.wait(20)


def test_other_names_for_this_machine_are_refused(port: int) -> None:
    assert ask(port, "GET", "/scene.hdr4d", host=f"evil.example:{port}")[0] == 403
    assert ask(port, "POST", "/frame", json.dumps(REQUEST), host="evil.example")[0] == 403
    assert ask(port, "GET", "/version", host="localhost.evil.example")[0] == 403


@pytest.mark.parametrize("host", ["localhost:9999", "127.0.0.1:9999", "[::1]:9999", "localhost"])
def test_a_tunnel_may_have_another_port(port: int, host: str) -> None:
    assert ask(port, "GET", "/", host=host)[0] == 200
    assert ask(port, "POST", "/frame", json.dumps(REQUEST), host=host)[0] == 200
    headers = {"Host": host, "Origin": f"http://{host}"}
    assert post(port, json.dumps(REQUEST), headers) == 200
    assert post(port, json.dumps(REQUEST), {"Host": host, "Origin": "http://evil.example"}) == 403


@pytest.mark.parametrize(
    ("origin", "status"),
    [("http://127.0.0.1:{}", 200), ("http://evil.example", 403), ("null", 403)],
)
def test_pages_of_other_sites_get_no_frames(port: int, origin: str, status: int) -> None:
    headers = {"Origin": origin.format(port)}
    assert post(port, json.dumps(REQUEST), headers) == status


@pytest.mark.parametrize("length", ["abc", "-1", "10001", "9" * 5000, "1.5", ""])
def test_a_request_of_no_sensible_length_is_refused(port: int, length: str) -> None:
    assert post(port, "", {"Content-Length": length}) == 400
    assert ask(port, "GET", "/version") == (200, b"7")


def test_a_port_that_is_taken_is_one_sentence(port: int, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not free"):
        ViewerServer(Fake(tmp_path), port)


@pytest.mark.parametrize(
    ("asked", "status", "body", "part"),
    [
        ("", 200, b"0123456789", None),
        ("bytes=0-", 206, b"0123456789", "bytes 0-9/10"),
        ("bytes=4-6", 206, b"456", "bytes 4-6/10"),
        ("bytes=8-99", 206, b"89", "bytes 8-9/10"),
        ("bytes=-5", 200, b"0123456789", None),
        ("bytes=5-3", 200, b"0123456789", None),
        ("bytes=10-", 416, b"", "bytes */10"),
        ("bytes=15-20", 416, b"", "bytes */10"),
    ],
)
def test_videos_are_served_whole_or_in_part(
    port: int, tmp_path: Path, asked: str, status: int, body: bytes, part: str | None
) -> None:
    assert ask(port, "GET", "/video/a.mp4")[0] == 404
    (tmp_path / "b.mp4").write_bytes(b"0123456789")
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.request("GET", "/video/a.mp4", headers={"Range": asked} if asked else {})
    answer = connection.getresponse()
    assert (answer.status, answer.read()) == (status, body)
    assert answer.getheader("Content-Range") == part
    assert (answer.getheader("Content-Type") == "video/mp4") == (status != 416)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"time": "now"}, "time must be one finite number"),
        ({"width": 100_000, "height": 100_000}, "at most 4,000,000"),
        ({"height": 0}, "48 x 0 pixels"),
        ({"width": 4_000_000, "height": 1}, "at most 65,500 a side"),
        ({"width": 1, "height": 65_501}, "at most 65,500 a side"),
        ({"ev": 1000}, "beyond 60 stops"),
        ({"curve": "round"}, "curve must be one of"),
        ({"show": None}, "show must be one of"),
        ({"kind": "gif"}, "kind must be one of jpeg, png8, png16"),
        ({"clipping": 1}, "clipping must be true or false"),
        ({"falseColor": "no"}, "falseColor must be true or false"),
        ({"c2w": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "not a rotation"),
        ({"K": [[0, 0, 0], [0, 1, 0], [0, 0, 1]]}, "K must be"),
    ],
)
def test_requests_that_make_no_sense_are_refused(change: dict, word: str) -> None:
    with pytest.raises(InputError, match=word):
        parse_request(json.dumps({**REQUEST, **change}).encode())


def test_the_largest_sides_fit_into_every_kind_of_file() -> None:
    for rgb in (np.zeros((1, MAX_SIDE, 3)), np.zeros((MAX_SIDE, 1, 3))):
        assert jpeg(rgb) and png(rgb, 8) and png(rgb, 16)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"\xff", 9000 * b"["])
def test_requests_that_are_no_objects_are_refused(data: bytes) -> None:
    with pytest.raises(InputError, match="not"):
        parse_request(data)
