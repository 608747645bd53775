"""The single file in browsers that draw slowly, or not at all: it names the videos.
Skipped where there is no Chromium.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import Page, find_browser
from viewer_scenes import scene_file

from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.page_file import Link, PageSettings, make_page
from hdr_nsff.viewer.scene_file import to_bytes

if find_browser() is None:
    pytest.skip("no Chromium", allow_module_level=True)

NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
HARDWARE = """(real => {
  WebGL2RenderingContext.prototype.getParameter = function (name) {
    const value = real.call(this, name);
    return typeof value === "string" ? "Old GPU" : value;
  };
})(WebGL2RenderingContext.prototype.getParameter);"""
SLOW = """viewer.renderer.composite = (draw => function (...view) {
  for (const end = performance.now() + 250; performance.now() < end;);
  return draw.apply(this, view);
})(viewer.renderer.composite)"""
NOTE = "document.getElementById('note').textContent"
ADVICE = "The videos below the settings play smoothly."


@pytest.fixture
def address(toy: Scene, tmp_path: Path) -> str:
    """Where the toy scene's page is, with a video beside it."""
    settings = PageSettings(videos=[Link("render/training.mp4", "Video")])
    page = tmp_path / "scene.html"
    page.write_text(make_page("Toy", to_bytes(scene_file(toy)), settings))
    return page.as_uri()


def test_a_browser_without_a_gpu_hears_of_the_videos(tab: Page, address: str) -> None:
    tab.goto(address, 500, 300)
    assert tab.run(NOTE) == f"This browser draws without a GPU, so playback is slow. {ADVICE}"
    assert tab.run("document.querySelector('#videos a').textContent") == "Video"


def test_a_gpu_that_draws_slowly_names_the_videos_once(tab: Page, address: str) -> None:
    with tab.prepared(HARDWARE):
        tab.goto(address, 500, 300)
    assert tab.run("viewer.driver") == "Old GPU" and tab.run(NOTE) == ""
    tab.run(SLOW)
    tab.press(" ")
    tab.wait(f"{NOTE} === 'This browser draws slowly here. {ADVICE}'")
    assert tab.run("viewer.canvas.width <= viewer.scene.width")  # fewer pixels were tried
    tab.run(f"{NOTE} = ''; globalThis.turn = viewer.frameTimes[0]")
    tab.wait("viewer.isSlow() && viewer.frameTimes[0] > turn")
    assert tab.run(NOTE) == ""
    assert tab.problems() == []


def test_a_browser_without_webgl_2_names_the_videos(tab: Page, address: str) -> None:
    with tab.prepared(NO_WEBGL), pytest.raises(RuntimeError, match="no WebGL 2") as failed:
        tab.goto(address, 500, 300)
    assert ADVICE in str(failed.value)
    assert tab.run("document.querySelector('#videos a').getAttribute('href')") == (
        "render/training.mp4"
    )
