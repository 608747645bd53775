"""The page with a server behind it, in headless Chromium: it follows a run that trains,
and a browser without a GPU shows frames of the server. Skipped where there is no
Chromium.
"""

from __future__ import annotations

import base64
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue

import cv2
import numpy as np
import pytest
import torch
from browser import Page, find_browser
from test_served_run import save_run, save_step
from viewer_tab import png_text, state

from hdr_nsff.rendering.served_run import ServedRun
from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.server import MAX_PIXELS, FrameRequest, ViewerServer

NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
SENT = "Network.requestWillBeSent"

if find_browser() is None:
    pytest.skip("no Chromium", allow_module_level=True)


@pytest.fixture(params=["splat"])
def address(
    request: pytest.FixtureRequest, toy: Scene, toy_folder: Path, tmp_path: Path
) -> Iterator[str]:
    """Where a run of a preset is served."""
    save_run(toy, toy_folder, tmp_path / "run", request.param)
    with ViewerServer(ServedRun(tmp_path / "run", "cpu")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.address
        server.shutdown()


def asked_widths(tab: Page) -> list[int]:
    """The widths of the frames that the page has asked for."""
    asked = [e["params"]["request"] for e in tab.events if e["method"] == SENT]
    return [json.loads(r["postData"])["width"] for r in asked if r["url"].endswith("/frame")]


@pytest.mark.parametrize("address", ["splat", "grid"], indirect=True)
def test_a_browser_without_a_gpu_shows_frames_of_the_server(tab: Page, address: str) -> None:
    tab.goto(address, 500, 300)
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 0")
    first, *_, last = asked_widths(tab)
    assert first < last == tab.run("viewer.scene.width")
    tab.press("ArrowRight")
    tab.drag((120, 100), (160, 110))
    tab.press("v")
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 2")
    width = tab.run("document.getElementById('frame').naturalWidth")
    assert width == tab.run("viewer.scene.width")  # the finest, after coarse ones
    assert all(asked.startswith(address) for asked in tab.requests())
    assert tab.problems() == []


@pytest.mark.parametrize("address", ["grid"], indirect=True)
def test_every_look_is_one_of_the_frames_that_the_server_keeps(tab: Page, address: str) -> None:
    with tab.prepared(NO_WEBGL):
        tab.goto(address, 500, 300)
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 0")
    tab.events.clear()
    looks = [{"ev": 2}, {"clipping": True}, {"falseColor": True}, {"show": "depth"}]
    curves = [{"curve": curve} for curve in ("agx", "neutral", "clip", "camera", "reinhard")]
    for look in [*curves, *looks]:
        tab.run(f"globalThis.before = viewer.frames.shown; viewer.set({json.dumps(look)})")
        tab.wait("viewer.frames.shown > before && !viewer.frames.busy")
    width = tab.run("viewer.scene.width")
    assert asked_widths(tab) == [width] * 9  # none is coarse: nothing is rendered
    assert tab.run("document.querySelectorAll('#panel :disabled').length") == 0
    assert tab.problems() == []


@pytest.mark.parametrize("address", ["nerf-wt"], indirect=True)
def test_a_field_that_records_itself_begins_coarse_at_another_exposure(
    tab: Page, address: str
) -> None:
    tab.goto(address, 500, 300)
    tab.run("viewer.set({curve: 'camera'})")
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 1")
    tab.events.clear()
    tab.run("viewer.frames.rate = 0; globalThis.before = viewer.frames.shown")
    tab.run("viewer.set({ev: 1})")
    tab.wait("!viewer.frames.busy && viewer.frames.shown > before")
    first, *_, last = asked_widths(tab)
    assert first < last == tab.run("viewer.scene.width")


@pytest.mark.parametrize("address", ["grid"], indirect=True)
def test_frames_of_the_server_are_saved_with_8_or_16_bits(tab: Page, address: str) -> None:
    tab.goto(address, 500, 300)
    width, height = tab.run("[viewer.scene.width, viewer.scene.height]")
    for bits, kind in ((8, np.uint8), (16, np.uint16)):
        file = np.frombuffer(base64.b64decode(tab.run(png_text(bits))), np.uint8)
        picture = cv2.imdecode(file, cv2.IMREAD_UNCHANGED)
        assert picture.dtype == kind and picture.shape == (height, width, 3)


def test_frames_of_the_server_are_never_too_large(tab: Page, address: str) -> None:
    tab.goto(address, 500, 300)
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 0")
    tab.run(
        "(() => { const { frames } = viewer; frames.maxPixels = 700; frames.shown = 0;"
        "frames.request(viewer.view(), viewer.state); })()"
    )
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 0")
    width, height = tab.run(
        "(image => [image.naturalWidth, image.naturalHeight])(document.getElementById('frame'))"
    )
    assert 600 < width * height <= 700
    assert tab.run("JSON.parse(document.getElementById('settings').textContent).max_pixels") == (
        MAX_PIXELS
    )


class SlowRun(ServedRun):
    """A run whose finest frames take as long as they are awaited, once it is slow."""

    slow = False

    def __init__(self, folder: Path, device: str) -> None:
        super().__init__(folder, device)
        self.given_up: Queue[float] = Queue()  # the times of such frames

    def frame(self, request: FrameRequest, awaited: Callable[[], bool]) -> bytes | None:
        finest = request.width == self.run.scene.train[0].camera.width
        if not (self.slow and finest):
            return super().frame(request, awaited)
        while awaited():
            time.sleep(0.01)
        self.given_up.put(request.time)
        return None


def test_the_newest_view_waits_for_no_finer_frame_of_another(
    tab: Page, toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    save_run(toy, toy_folder, tmp_path / "run")
    source = SlowRun(tmp_path / "run", "cpu")
    with ViewerServer(source) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        tab.goto(server.address, 500, 300)
        tab.wait("!viewer.frames.busy && viewer.frames.shown > 0")
        tab.run("Object.defineProperty(viewer.frames, 'rate', {get: () => 0, set() {}})")
        source.slow = True
        for _ in range(3):
            tab.run("globalThis.before = viewer.frames.shown")
            tab.press("ArrowRight")
            tab.wait("viewer.frames.shown > before && viewer.frames.refining")
        assert [source.given_up.get(timeout=20) for _ in range(2)] == [1, 2]
        assert tab.problems() == []
        server.shutdown()


def test_a_browser_that_draws_too_slowly_asks_the_server(tab: Page, address: str) -> None:
    tab.goto(f"{address}#draw", 500, 300)
    tab.run(
        "viewer.renderer.composite = (draw => function (...view) {"
        "for (const end = performance.now() + 250; performance.now() < end;);"
        "return draw.apply(this, view); })(viewer.renderer.composite)"
    )
    tab.press(" ")
    tab.wait("viewer.frames?.shown > 0")
    assert tab.run("viewer.renderer") is None
    tab.press(" ")
    tab.wait("!viewer.frames.busy")
    assert tab.problems() == []


def test_a_served_page_can_draw_and_follows_the_run(
    tab: Page, address: str, tmp_path: Path
) -> None:
    tab.goto(f"{address}#draw", 500, 300)
    assert tab.run("viewer.renderer.visible") > 400
    tab.press("ArrowRight")
    (checkpoint,) = (tmp_path / "run" / "checkpoints").iterdir()
    checkpoint.rename(checkpoint.with_name("step_00000009.safetensors"))
    tab.run("globalThis.scene = viewer.scene")
    tab.wait("viewer.scene !== scene")
    assert state(tab, "time") == 1
    assert tab.problems() == []


def test_a_page_follows_the_run_after_a_look_that_failed(
    tab: Page, address: str, tmp_path: Path
) -> None:
    tab.goto(f"{address}#draw", 500, 300)
    tab.run(
        "(real => { globalThis.asked = []; globalThis.fetch = (...what) => asked.push(what[0]) < 3"
        " ? Promise.reject(new TypeError('unreachable')) : real(...what); })(fetch);"
        "(real => { globalThis.setTimeout = (call, ms) => real(call, ms / 20); })(setTimeout)"
    )
    (checkpoint,) = (tmp_path / "run" / "checkpoints").iterdir()
    checkpoint.rename(checkpoint.with_name("step_00000009.safetensors"))
    tab.run("globalThis.scene = viewer.scene")
    tab.wait("viewer.scene !== scene")
    asked = tab.run("asked")
    assert asked.count("scene.hdr4d") == 1
    assert asked.index("scene.hdr4d") >= 3  # after two looks that failed and one that did not


def test_a_checkpoint_that_is_newer_than_the_server_is_shown(
    tab: Page, toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    run = save_run(toy, toy_folder, tmp_path / "run")
    with ViewerServer(ServedRun(tmp_path / "run", "cpu")) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with torch.no_grad():
            run.field.get_parameter("background").fill_(-1.0)  # type: ignore[attr-defined]
        save_step(run, 9)
        tab.goto(f"{server.address}#draw", 500, 300)
        assert tab.run("viewer.scene.background") == pytest.approx([np.exp(-1)] * 3)
        server.shutdown()
