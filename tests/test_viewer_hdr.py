"""The page on HDR screens, in headless Chromium: light above white, or the HDR clip.

Chromium pretends an HDR screen, and a WebGPU of software draws for it. What such a
screen shows cannot be photographed here: canvases are read back.
"""

from __future__ import annotations

import base64
import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Page, browser, find_browser
from test_export_gaussians import make_run
from toy_scene import ToyScene
from viewer_scenes import scene_file, trained
from viewer_tab import TO_BASE64, open_page, png_text, read_linear, read_png, state

from hdr_nsff.maths.hdr_signal import decode, rec709_to_rec2020
from hdr_nsff.rendering.export_page import export_page
from hdr_nsff.rendering.standard_set import render_all
from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.page_file import Link, PageSettings, make_page
from hdr_nsff.viewer.scene_file import to_bytes

SCREEN = ("--force-color-profile=scrgb-linear",)  # an HDR screen
WEBGPU = (
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
)
WHITE, KNEE, PEAK = 203.0, 500 / 203, 1000 / 203
NO_WEBGPU = "NO WEBGPU IN THIS CHROMIUM: LIGHT ABOVE WHITE IS NOT TESTED"

if find_browser() is None:
    pytest.skip("no Chromium", allow_module_level=True)


@pytest.fixture(scope="module")
def hdr_tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A tab on an HDR screen, in a browser with WebGPU."""
    with browser(tmp_path_factory.mktemp("profile"), *SCREEN, *WEBGPU) as page:
        (folder := tmp_path_factory.mktemp("empty")).joinpath("a.html").write_text(
            "<body data-ready=yes>"
        )
        page.goto((folder / "a.html").as_uri())
        if not page.run("navigator.gpu?.requestAdapter().then(Boolean)"):
            warnings.warn(NO_WEBGPU, stacklevel=1)
            pytest.skip(NO_WEBGPU)
        yield page


@pytest.fixture(scope="module")
def plain_tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A tab on an HDR screen, in a browser without WebGPU."""
    with browser(tmp_path_factory.mktemp("profile"), *SCREEN) as page:
        yield page


def expected_light(tab: Page, toy: Scene) -> np.ndarray:
    """The light (H, W, 3) that the page should show at its size, 1 is white."""
    _, tonemapper = trained(toy)
    view = tab.run("viewer.view(viewer.fullSize)")
    exposed = read_linear(tab, view)[..., :3].numpy() * tonemapper.neutral(0).numpy()
    level = np.maximum(exposed.max(-1, keepdims=True), 1e-9)
    excess = np.maximum(level - KNEE, 0) / (PEAK - KNEE)
    return exposed * (np.minimum(level, KNEE) + (PEAK - KNEE) * excess / (1 + excess)) / level


def srgb(light: np.ndarray) -> np.ndarray:
    """sRGB that continues above 1."""
    power = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, power)


def presented(tab: Page) -> np.ndarray:
    """What the canvas of light above white shows now (H, W, 3), sRGB beyond white."""
    values = tab.run(
        f"""(async () => {{
          const {{ canvas }} = viewer.hdr;
          await viewer.renderer.sort(viewer.view());
          viewer.sortedFor = JSON.stringify([viewer.state.time, viewer.camera().c2w]);
          viewer.touch();
          viewer.drawIfNeeded(performance.now());
          const copy = new OffscreenCanvas(canvas.width, canvas.height);
          const context = copy.getContext("2d", {{ colorType: "float16" }});
          context.drawImage(canvas, 0, 0);
          const whole = [0, 0, canvas.width, canvas.height];
          const {{ data }} = context.getImageData(...whole, {{ pixelFormat: "rgba-float16" }});
          return [canvas.width, canvas.height, ({TO_BASE64})(Float32Array.from(data))];
        }})()"""
    )
    width, height, text = values
    return np.frombuffer(base64.b64decode(text), np.float32).reshape(height, width, 4)[..., :3]


def test_an_hdr_screen_gets_light_above_white(hdr_tab: Page, toy: Scene, tmp_path: Path) -> None:
    open_page(hdr_tab, tmp_path / "scene.html", scene_file(toy))
    assert state(hdr_tab, "curve") == "extended"
    hdr_tab.run("viewer.set({ev: 2})")
    hdr_tab.wait("!document.getElementById('hdr').hidden")
    expected = srgb(expected_light(hdr_tab, toy))
    found = presented(hdr_tab)
    assert found.max() > 1.3
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert hdr_tab.problems() == []


def test_other_curves_and_views_stay_below_white(hdr_tab: Page, toy: Scene, tmp_path: Path) -> None:
    open_page(hdr_tab, tmp_path / "scene.html", scene_file(toy))
    hidden = "document.getElementById('hdr').hidden"
    hdr_tab.wait(f"!{hidden}")
    for change in ({"curve": "agx"}, {"show": "depth"}, {"falseColor": True}):
        hdr_tab.run(f"viewer.set({json.dumps(change)})")
        hdr_tab.wait(hidden)
        hdr_tab.run("viewer.set({curve: 'extended', show: 'radiance', falseColor: false})")
        hdr_tab.wait(f"!{hidden}")
    hdr_tab.press("c")
    assert state(hdr_tab, "curve") == "camera"


def test_a_picture_of_16_bits_keeps_light_above_white(
    hdr_tab: Page, toy: Scene, tmp_path: Path
) -> None:
    open_page(hdr_tab, tmp_path / "scene.html", scene_file(toy))
    hdr_tab.run("viewer.set({ev: 2})")
    file = base64.b64decode(hdr_tab.run(png_text(16)))
    assert b"cICP\x09\x10\x00\x01" in file and b"sRGB" not in file
    nits = decode(read_png(file), "pq")
    expected = WHITE * rec709_to_rec2020(expected_light(hdr_tab, toy))
    np.testing.assert_allclose(nits, expected, rtol=0.01, atol=0.5)


def test_a_window_on_another_screen_ends_at_white(
    hdr_tab: Page, toy: Scene, tmp_path: Path
) -> None:
    open_page(hdr_tab, tmp_path / "scene.html", scene_file(toy))
    option = "document.querySelector('#curve [value^=extended]').disabled"
    hdr_tab.run("viewer.hdr.device.destroy()")
    hdr_tab.wait(option)
    assert state(hdr_tab, "curve") == "reinhard"
    hdr_tab.wait("document.getElementById('hdr').hidden")


def test_without_webgpu_the_page_names_the_clip(
    plain_tab: Page, toy: Scene, tmp_path: Path
) -> None:
    note = "document.getElementById('range-note').textContent"
    open_page(plain_tab, tmp_path / "scene.html", scene_file(toy))
    assert state(plain_tab, "curve") == "reinhard"
    assert plain_tab.run("viewer.hdr") is None
    assert "--hdr-video hlg" in plain_tab.run(note)
    page = make_page("Toy", to_bytes(scene_file(toy)), with_clip())
    (tmp_path / "scene.html").write_text(page)
    plain_tab.goto((tmp_path / "scene.html").as_uri(), 500, 300)
    assert "The HDR clip shows it" in plain_tab.run(note)


def with_clip() -> PageSettings:
    return PageSettings(hdr_clips=[Link("toy_hlg.mp4", "HDR clip")])


def test_the_clips_of_the_standard_set_play_inside_the_page(
    plain_tab: Page, tmp_path: Path
) -> None:
    folder = ToyScene(width=128, height=72).write(tmp_path / "scene")
    run = make_run(Scene.open(folder), tmp_path / "run")
    render_all(run, tmp_path / "render", budget=1.0)
    page = export_page(run, tmp_path / "sent" / "scene.html")
    held = re.findall(r'id="(.*_hlg.*)" type="text/plain"', page.read_text())
    assert held == ["training_hlg.mp4", "training_hlg_av1.mp4"]
    plain_tab.goto(page.as_uri(), 500, 300)
    plain_tab.click("#clip-button")
    plain_tab.wait("document.getElementById('clip-video').currentTime > 0.1")
    assert plain_tab.run("document.getElementById('clip-video').videoWidth") == 128
    plain_tab.press("Escape")
    plain_tab.wait("document.getElementById('clip-video').paused")
    assert plain_tab.problems() == []
    assert all(asked.startswith("file://") for asked in plain_tab.requests())


def test_a_clip_that_the_browser_cannot_play_can_be_saved(
    plain_tab: Page, toy: Scene, tmp_path: Path
) -> None:
    page = make_page("Toy", to_bytes(scene_file(toy)), with_clip(), {"toy_hlg.mp4": b"no video"})
    (tmp_path / "scene.html").write_text(page)
    plain_tab.goto((tmp_path / "scene.html").as_uri(), 500, 300)
    plain_tab.click("#clip-button")
    plain_tab.wait("!document.getElementById('clip-problem').hidden")
    assert plain_tab.run("document.getElementById('clip-file').download") == "toy_hlg.mp4"
    plain_tab.press(" ")
    assert state(plain_tab, "playing") is False  # keys are the dialog's
