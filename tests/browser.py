"""Chromium without a window, driven through the DevTools protocol over a pipe.

The pipe needs no library: JSON messages that end in a zero byte, on the descriptors 3
and 4 of the browser.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
OPTIONS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--no-sandbox",  # tests run as root in containers
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--hide-scrollbars",
)
TIMEOUT_SECONDS = 120.0  # of one answer: software GL on a busy machine is slow


def find_browser() -> str | None:
    """The path of Chromium; `CHROMIUM` names another one."""
    named = os.environ.get("CHROMIUM")
    return named or next((path for name in NAMES if (path := shutil.which(name))), None)


class Page:
    """One tab: commands, and the events that came meanwhile."""

    def __init__(self, to_browser: int, from_browser: int) -> None:
        self.to_browser, self.from_browser = to_browser, from_browser
        self.received = b""
        self.last_id = 0
        self.session: str | None = None
        self.events: list[dict[str, Any]] = []

    def open_tab(self) -> None:
        """A new tab, whose console, errors and network are watched."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """The answer to a command."""
        self.last_id += 1
        message = {"id": self.last_id, "method": method, "params": params}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to_browser, json.dumps(message).encode() + b"\0")
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while time.monotonic() < deadline:
            answer = self.next_message(deadline, method)
            if answer.get("id") != self.last_id:
                self.events.append(answer)
            elif "error" in answer:
                raise RuntimeError(f"{method}: {answer['error']}")
            else:
                return answer["result"]
        raise TimeoutError(method)

    def next_message(self, deadline: float, method: str) -> dict[str, Any]:
        """The next message; TimeoutError where none is complete by the `deadline` of
        the command `method`, on the monotonic clock.
        """
        while b"\0" not in self.received:
            left = max(0.0, deadline - time.monotonic())
            if not select.select([self.from_browser], [], [], left)[0]:
                raise TimeoutError(method)
            chunk = os.read(self.from_browser, 1 << 20)
            if not chunk:
                raise RuntimeError("the browser has ended")
            self.received += chunk
        message, _, self.received = self.received.partition(b"\0")
        return json.loads(message)

    def goto(
        self, address: str, width: int = 1280, height: int = 800, mobile: bool = False
    ) -> None:
        """Load a page at a window size in CSS pixels, and wait until it is ready."""
        self.resize(width, height, mobile)
        self.events.clear()
        self.call("Page.navigate", url=address)
        self.wait("document.body?.dataset.ready")
        if self.run("document.body.dataset.ready") != "yes":
            raise RuntimeError(self.run("document.getElementById('loading').textContent"))

    @contextmanager
    def prepared(self, script: str) -> Iterator[None]:
        """Pages that are loaded meanwhile run a script before their own."""
        added = self.call("Page.addScriptToEvaluateOnNewDocument", source=script)
        try:
            yield
        finally:
            self.call("Page.removeScriptToEvaluateOnNewDocument", **added)

    def resize(self, width: int, height: int, mobile: bool = False) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def move_to_screen(self, width: int, height: int, density: int) -> None:
        """Move the window to a screen of `density` pixels per CSS pixel."""
        size = {"width": width, "height": height, "deviceScaleFactor": density, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        # a density alone is noticed only when another emulated medium is looked at
        for features in ([{"name": "prefers-color-scheme", "value": "dark"}], []):
            self.call("Emulation.setEmulatedMedia", features=features)

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression, awaited."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise RuntimeError(details.get("exception", details).get("description", details))
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        deadline = time.monotonic() + TIMEOUT_SECONDS
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"{condition}; {self.problems()}")
            time.sleep(0.05)

    def press(self, key: str, shift: bool = False) -> None:
        """Press and release a key."""
        text = {"text": key} if len(key) == 1 else {}
        code = {"windowsVirtualKeyCode": 27} if key == "Escape" else {}  # closes dialogs
        for kind in ("keyDown", "keyUp"):
            modifiers = 8 if shift else 0
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers, **code, **text
            )
            text = {}

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Drag the mouse between two points in CSS pixels."""
        button = {"button": "left", "buttons": 1, "clickCount": 1}
        for kind, (x, y) in (
            ("mousePressed", start),
            ("mouseMoved", end),
            ("mouseReleased", end),
        ):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **button)

    def click(self, selector: str) -> None:
        """Click the middle of the element that a selector finds."""
        element = f"document.querySelector({json.dumps(selector)})"
        frame = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.run(f"{element}.scrollIntoView({{block: 'nearest'}}), {frame}")
        box = self.run(
            f"(r => [r.x + r.width / 2, r.y + r.height / 2])({element}.getBoundingClientRect())"
        )
        self.drag((box[0], box[1]), (box[0], box[1]))

    def screenshot(self, path: Path) -> None:
        """Save what the tab shows as a PNG."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    def problems(self) -> list[str]:
        """Errors and warnings of the console, and exceptions, since the last `goto`.

        Chromium's own warnings about software WebGL and missing WebGPU are left out.
        """
        found = []
        for event in self.events:
            params = event.get("params", {})
            match event.get("method"):
                case "Runtime.exceptionThrown":
                    found.append(str(params["exceptionDetails"]))
                case "Runtime.consoleAPICalled" if params["type"] in ("error", "warning"):
                    found.append(str(params["args"]))
                case "Log.entryAdded" if params["entry"]["level"] in ("error", "warning"):
                    found.append(params["entry"]["text"])
        software = ("swiftshader", "gpu stall due to readpixels", "no available adapters")
        return [text for text in found if not any(word in text.lower() for word in software)]

    def requests(self) -> list[str]:
        """Addresses asked for since the last `goto`, without those in memory."""
        asked = [e for e in self.events if e.get("method") == "Network.requestWillBeSent"]
        addresses = [e["params"]["request"]["url"] for e in asked]
        return [a for a in addresses if not a.startswith(("data:", "blob:"))]


@contextmanager
def browser(profile: Path, *more: str) -> Iterator[Page]:
    """A tab of a new browser whose profile is the folder `profile`; `more` options. It
    ends with all of its processes, also where it hangs.
    """
    found = find_browser()
    assert found is not None
    browser_reads, to_browser = os.pipe()
    from_browser, browser_writes = os.pipe()

    def connect() -> None:
        """In the child: the pipe's ends as descriptors 3 and 4."""
        reads, writes = os.dup(browser_reads), os.dup(browser_writes)
        os.dup2(reads, 3)
        os.dup2(writes, 4)

    process = subprocess.Popen(
        [found, *OPTIONS, *more, f"--user-data-dir={profile}", "about:blank"],
        preexec_fn=connect,
        close_fds=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    os.close(browser_reads)
    os.close(browser_writes)
    page = Page(to_browser, from_browser)
    try:
        page.open_tab()
        yield page
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(30)
        os.close(to_browser)
        os.close(from_browser)
