"""The single file in browsers that draw slowly, or not at all: it names the videos.
Skipped where there is no Chromium.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from browser import Page, find_browser
from test_export_gaussians import make_run
from viewer_scenes import scene_file

from hdr_nsff.core.video import write_video
from hdr_nsff.rendering.export_page import export_page
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
ADVICE = "The videos below the settings play smoothly. They lie in render/ beside this page."
INSIDE = "“Video” below the settings plays smoothly. The others lie in render/ beside this page."


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


def test_a_page_that_was_sent_plays_the_video_inside_it(
    tab: Page, toy: Scene, tmp_path: Path
) -> None:
    run = make_run(toy, tmp_path / "run")
    (tmp_path / "render").mkdir()
    write_video(tmp_path / "render/training.mp4", [np.zeros((36, 64, 3))] * 12, 12)
    (tmp_path / "render/slowmo.mp4").write_bytes(b"")
    page = export_page(run, tmp_path / "scene.html")
    (tmp_path / "sent").mkdir()
    page = page.rename(tmp_path / "sent/scene.html")
    with tab.prepared(NO_WEBGL), pytest.raises(RuntimeError, match="no WebGL 2") as failed:
        tab.goto(page.as_uri(), 500, 300)
    assert INSIDE in str(failed.value)
    assert tab.run("document.querySelector('#videos > *').textContent") == "Video"
    assert tab.run("document.querySelector('#videos a').textContent") == "Slow motion"
    tab.click("#video-button")
    tab.wait("document.getElementById('clip-video').currentTime > 0.1")
    assert tab.run("document.getElementById('clip').ariaLabel") == "Video"
    assert all(asked.startswith(page.as_uri()) for asked in tab.requests())


def test_one_dialog_plays_the_video_of_the_button(tab: Page, toy: Scene, tmp_path: Path) -> None:
    files = {"toy_hlg.mp4": b"no video", "training.mp4": b""}
    for name, side in (("toy_hlg_av1.mp4", 72), ("training.mp4", 36)):
        write_video(tmp_path / name, [np.zeros((side, 64, 3))] * 12, 12)
        files[name] = (tmp_path / name).read_bytes()
    clips = [Link(f"toy_hlg{ending}.mp4", "HDR clip") for ending in ("", "_av1")]
    settings = PageSettings([Link("training.mp4", "Video")], clips)
    (tmp_path / "scene.html").write_text(
        make_page("Toy", to_bytes(scene_file(toy)), settings, files)
    )
    tab.goto((tmp_path / "scene.html").as_uri(), 500, 300)
    for button, height in (("clip", 72), ("video", 36), ("clip", 72), ("clip", 72)):
        tab.click(f"#{button}-button")
        tab.wait(f"document.getElementById('clip-video').videoHeight === {height}")
        tab.wait("document.getElementById('clip-video').currentTime > 0.1")
        tab.press("Escape")
        tab.wait("document.getElementById('clip-video').paused")
