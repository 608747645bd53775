"""The page in headless Chromium: it sees what `render` sees, and does what its controls
say. Skipped, in a loud line, where there is no Chromium.
"""

from __future__ import annotations

import base64
import json
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Page, browser, find_browser
from test_served_run import save_run
from viewer_scenes import render, scene_file, trained, trained_local, with_gap

from hdr_nsff.fields.splat.rasterize import rasterize
from hdr_nsff.geometry import paths
from hdr_nsff.maths.metrics import mu_law_psnr
from hdr_nsff.rendering.served_run import ServedRun
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.viewer.field_scene import scene_of
from hdr_nsff.viewer.page_file import PageSettings, make_page
from hdr_nsff.viewer.scene_file import SceneFile, to_bytes
from hdr_nsff.viewer.server import MAX_PIXELS, ViewerServer

SIZE = (160, 90)
TO_BASE64 = """a => {
  const bytes = new Uint8Array(a.buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192)
    text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}"""

if find_browser() is None:
    MISSING = "NO CHROMIUM: THE VIEWER'S PAGE IS NOT TESTED; install it, or set CHROMIUM"
    warnings.warn(MISSING, stacklevel=1)
    pytest.skip(MISSING, allow_module_level=True)


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def viewer(tab: Page, toy: Scene, tmp_path: Path) -> Iterator[Page]:
    """The tab with the toy scene's page, newly loaded; the console must stay empty."""
    open_page(tab, tmp_path / "scene.html", scene_file(toy))
    yield tab
    assert tab.problems() == []


def open_page(tab: Page, path: Path, scene: SceneFile, width: int = 500, height: int = 300) -> None:
    path.write_text(make_page(scene.title, to_bytes(scene), PageSettings()))
    tab.goto(path.as_uri(), width, height)


def view_of(scene: Scene, frame: int, time: float) -> dict[str, Any]:
    """A view for `readLinear`."""
    camera = scene.train[frame].camera.resized(*SIZE)
    pose = {"c2w": camera.c2w.tolist(), "K": camera.K.tolist()}
    return {"time": time, **pose, "width": SIZE[0], "height": SIZE[1]}


def read_linear(tab: Page, view: dict[str, Any]) -> torch.Tensor:
    """The page's exposed linear radiance and opacity (H, W, 4)."""
    text = tab.run(f"viewer.readLinear({json.dumps(view)}).then({TO_BASE64})")
    values = np.frombuffer(base64.b64decode(text), np.float32)
    return torch.from_numpy(values.copy()).view(view["height"], view["width"], 4)


def state(tab: Page, name: str) -> Any:
    return tab.run(f"viewer.state.{name}")


# Pictures


@pytest.mark.parametrize("preset", ["splat", "splat-sigmoid"])
def test_the_page_sees_what_render_sees(tab: Page, toy: Scene, tmp_path: Path, preset: str) -> None:
    field, _ = trained(toy, preset)
    open_page(tab, tmp_path / "scene.html", scene_file(toy, preset))
    tab.run("viewer.set({ev: 0})")
    for frame in (0, 2, len(toy.train) - 1):
        for time in (0.0, 1.37, 3.5):
            expected = render(field, toy, frame, time, SIZE)
            found = read_linear(tab, view_of(toy, frame, time))[..., :3]
            assert mu_law_psnr(found, expected, float(expected.max())) > 45


def test_the_page_moves_as_render_does_where_frames_are_missing(
    tab: Page, toy: Scene, tmp_path: Path
) -> None:
    scene = with_gap(toy)
    field, _ = trained(scene)
    open_page(tab, tmp_path / "scene.html", scene_file(scene))
    tab.run("viewer.set({ev: 0})")
    for time in (1.37, 5.0, 12.5):
        expected = render(field, scene, 2, time, SIZE)
        found = read_linear(tab, view_of(scene, 2, time))[..., :3]
        assert mu_law_psnr(found, expected, float(expected.max())) > 55


def test_the_page_draws_time_local_gaussians(tab: Page, toy: Scene, tmp_path: Path) -> None:
    field, tonemapper = trained_local(toy)
    open_page(tab, tmp_path / "scene.html", scene_of(field, tonemapper, toy, "Toy", 1.0))
    tab.run("viewer.set({ev: 0})")
    for time in (0.0, 1.7, 4.0):
        expected = render(field, toy, 1, time, SIZE)
        found = read_linear(tab, view_of(toy, 1, time))[..., :3]
        assert mu_law_psnr(found, expected, float(expected.max())) > 45


def test_depth_and_motion_are_those_of_render(viewer: Page, toy: Scene) -> None:
    field, _ = trained(toy)
    maps = read_linear(viewer, {**view_of(toy, 1, 1.37), "show": "depth"})
    camera = toy.train[1].camera.resized(*SIZE)
    expected = field.render(camera, 1.37, scene_flow=False)
    opacity = expected.opacity.view(SIZE[1], SIZE[0])
    solid = opacity > 0.5
    depth = (maps[..., 0] / maps[..., 3]).clamp(field.near, field.far)
    torch.testing.assert_close(
        depth[solid], expected.depth.view(SIZE[1], SIZE[0])[solid], rtol=0.02, atol=0.02
    )
    motion = expected.motion.view(SIZE[1], SIZE[0])
    torch.testing.assert_close(maps[..., 1], motion, rtol=0, atol=0.02)


def test_scene_flow_is_the_motion_until_the_next_frame(viewer: Page, toy: Scene) -> None:
    field, _ = trained(toy)
    camera, time = toy.train[1].camera.resized(*SIZE), 1.37
    cloud = field.cloud(field.knot(time))
    with torch.no_grad():
        moved = field.positions(field.knot(time) + 1)
        flow = camera.project(moved)[0] - camera.project(cloud.means)[0]
        gaussians = cloud.means, cloud.quaternions, cloud.scales, cloud.opacities
        expected = rasterize(*gaussians, flow.clamp(-320, 320), camera).features
    found = read_linear(viewer, {**view_of(toy, 1, time), "show": "flow"})[..., :2]
    largest = float(expected.abs().max())
    torch.testing.assert_close(found, expected, rtol=0.02, atol=0.01 * largest)


def test_one_stop_on_the_slider_doubles_the_read_back(viewer: Page, toy: Scene) -> None:
    view = view_of(toy, 0, 1.0)
    viewer.run("viewer.set({ev: 0})")
    before = read_linear(viewer, view)
    slide = "(() => { const e = document.getElementById('ev'); e.value = 1; "
    viewer.run(slide + "e.dispatchEvent(new Event('input')); })()")
    assert state(viewer, "ev") == 1
    torch.testing.assert_close(read_linear(viewer, view)[..., :3], 2 * before[..., :3])


def test_the_camera_curve_records_as_the_tone_mapper_does(viewer: Page, toy: Scene) -> None:
    _, tonemapper = trained(toy)
    viewer.run("viewer.set({curve: 'camera', ev: 0.5})")
    found = read_png(base64.b64decode(viewer.run(png_text(16))))
    text = viewer.run(f"viewer.readLinear(viewer.view(viewer.fullSize)).then({TO_BASE64})")
    exposed = np.frombuffer(base64.b64decode(text), np.float32).reshape(*found.shape[:2], 4)
    radiance = torch.from_numpy(exposed[..., :3] * 2**-0.5)
    expected = tonemapper.develop(radiance, 0.5).numpy()
    np.testing.assert_allclose(found, expected, atol=0.004)


def test_a_response_that_rises_beyond_1_is_shown_whole(
    tab: Page, toy: Scene, tmp_path: Path
) -> None:
    field, _ = trained(toy)
    tonemapper = tone_mapper_for(ToneMapConfig(kind="sigmoid"), toy)
    open_page(tab, tmp_path / "scene.html", scene_of(field, tonemapper, toy, "Toy", 1.0))
    tab.run("viewer.set({curve: 'camera', ev: 3})")
    found = read_png(base64.b64decode(tab.run(png_text(16))))
    exposed = read_linear(tab, tab.run("viewer.view(viewer.fullSize)"))[..., :3].numpy()
    assert found.max() > 0.8
    np.testing.assert_allclose(found, exposed / (1 + exposed), atol=0.004)


def png_text(bits: int) -> str:
    """An expression: the base64 text of the picture's PNG."""
    return (
        f"viewer.png({bits}).then(blob => blob.arrayBuffer())"
        f".then(data => new Uint8Array(data)).then({TO_BASE64})"
    )


def read_png(data: bytes, bits: int = 16) -> np.ndarray:
    """RGB (H, W, 3) in [0, 1] of a PNG without filters, by its own rules."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, body, header = 8, b"", b""
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        chunk = data[place + 8 : place + 8 + length]
        (crc,) = struct.unpack(">I", data[place + 8 + length : place + 12 + length])
        assert crc == zlib.crc32(kind + chunk)
        body += chunk if kind == b"IDAT" else b""
        header = chunk if kind == b"IHDR" else header
        place += 12 + length
    width, height, *depth_and_color = struct.unpack(">IIBB", header[:10])
    assert depth_and_color == [bits, 2]
    rows = np.frombuffer(zlib.decompress(body), np.uint8).reshape(height, -1)
    assert not rows[:, 0].any()  # no filter
    samples = rows[:, 1:].copy().view(">u2" if bits == 16 else "u1")
    return samples.reshape(height, width, 3) / (2**bits - 1)


def test_pictures_of_8_bits_are_those_of_16_bits(viewer: Page) -> None:
    fine = read_png(base64.b64decode(viewer.run(png_text(16))))
    coarse = read_png(base64.b64decode(viewer.run(png_text(8))), bits=8)
    np.testing.assert_allclose(coarse, fine, atol=0.51 / 255)
    assert fine.shape[1] == viewer.run("viewer.fullSize.width")


# Controls


def test_the_single_file_asks_the_network_for_nothing(viewer: Page) -> None:
    viewer.run("viewer.set({split: true, time: 2})")
    asked = viewer.requests()
    assert len(asked) == 1 and asked[0].startswith("file://")


def test_space_plays_and_pauses(viewer: Page) -> None:
    viewer.press(" ")
    assert state(viewer, "playing") is True
    viewer.wait("viewer.state.time > 0")
    viewer.press(" ")
    assert state(viewer, "playing") is False


def test_space_plays_after_a_click_on_another_button(viewer: Page) -> None:
    viewer.click("#loop")
    viewer.run("viewer.set({speed: 0.01})")  # or the clip is over before it is looked at
    viewer.press(" ")
    assert (state(viewer, "loop"), state(viewer, "playing")) == (False, True)
    viewer.run("document.getElementById('time').focus()")
    viewer.press(" ")
    viewer.run("viewer.set({time: 1})")
    viewer.press("ArrowRight")
    assert (state(viewer, "playing"), state(viewer, "time")) == (False, 2)


def test_arrows_step_through_time_and_exposure(viewer: Page) -> None:
    viewer.run("viewer.set({ev: 0, time: 1})")
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "ArrowUp", "ArrowUp", "ArrowDown"):
        viewer.press(key)
    assert (state(viewer, "time"), state(viewer, "ev")) == (2, 0.5)
    viewer.press("End")
    assert state(viewer, "time") == viewer.run("viewer.last")


def test_the_question_mark_opens_help_and_escape_closes_it(viewer: Page) -> None:
    viewer.press("?")
    assert viewer.run("document.getElementById('help').open") is True
    viewer.press(" ")
    assert state(viewer, "playing") is False
    viewer.press("Escape")
    viewer.wait("!document.getElementById('help').open")


def test_keys_choose_view_curve_camera_and_split(viewer: Page) -> None:
    viewer.press("v")
    viewer.press("c")
    assert (state(viewer, "show"), state(viewer, "curve")) == ("depth", "clip")
    viewer.press("3")
    assert state(viewer, "mode") == "orbit"
    viewer.press("x")  # compares from where it was filmed
    assert (state(viewer, "split"), state(viewer, "mode")) == (True, "filmed")
    viewer.press("2")
    assert state(viewer, "split") is False


def key(viewer: Page, kind: str, name: str, repeated: bool = False) -> None:
    text = {"text": name} if kind == "keyDown" and len(name) == 1 else {}
    viewer.call("Input.dispatchKeyEvent", type=kind, key=name, autoRepeat=repeated, **text)


def test_of_keys_that_are_held_down_arrows_alone_act_again(viewer: Page) -> None:
    viewer.run("viewer.set({speed: 0.01, time: 0})")
    for name in ("k", " ", "ArrowRight"):
        for repeated in (False, True):
            key(viewer, "keyDown", name, repeated)
        if name == " ":
            assert state(viewer, "playing") is True
        key(viewer, "keyUp", name)
    assert viewer.run("viewer.keys.length") == 1
    assert 2 <= state(viewer, "time") < 3


def test_the_camera_flies_while_a_key_is_held_and_in_that_mode_alone(viewer: Page) -> None:
    key(viewer, "keyDown", "w")
    assert state(viewer, "mode") == "fly"
    viewer.wait("viewer.camera().c2w.some((row, i) => row[3] !== viewer.scene.views[0].c2w[i][3])")
    viewer.press("1")
    viewer.run("viewer.tick(performance.now() + 50)")
    assert state(viewer, "mode") == "filmed"
    key(viewer, "keyUp", "w")
    key(viewer, "keyDown", "w")
    key(viewer, "keyDown", "Alt")
    key(viewer, "keyUp", "∑")  # of w, on a Mac
    assert viewer.run("viewer.held.size") == 0


def test_a_drag_orbits_and_keeps_a_rotation(viewer: Page) -> None:
    before = viewer.run("viewer.camera().c2w")
    viewer.drag((120, 100), (160, 110))
    assert state(viewer, "mode") == "orbit"
    c2w = np.array(viewer.run("viewer.camera().c2w"))
    assert not np.allclose(c2w, before)
    np.testing.assert_allclose(c2w[:, :3] @ c2w[:, :3].T, np.eye(3), atol=1e-9)
    viewer.press("r")
    assert state(viewer, "mode") == "filmed"


def test_one_finger_orbits_and_two_move_closer(viewer: Page) -> None:
    def touch(kind: str, *points: tuple[float, float]) -> None:
        touches = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        viewer.call("Input.dispatchTouchEvent", type=kind, touchPoints=touches)

    viewer.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    touch("touchStart", (100, 90))
    touch("touchMove", (140, 90))
    touch("touchEnd")
    assert state(viewer, "mode") == "orbit"
    before = np.array(viewer.run("viewer.camera().c2w"))
    touch("touchStart", (100, 90), (120, 90))
    touch("touchMove", (80, 90), (120, 90))
    touch("touchMove", (80, 90), (140, 90))
    touch("touchEnd")
    step = np.array(viewer.run("viewer.camera().c2w"))[:, 3] - before[:, 3]
    assert step @ before[:, 2] > 0.01
    viewer.call("Emulation.setTouchEmulationEnabled", enabled=False)


def test_the_path_is_copied_with_a_hint(viewer: Page) -> None:
    note = "document.getElementById('note').textContent"
    before = viewer.run(note)
    viewer.click("#copy-path")
    viewer.wait(f"{note}.includes('path.json')")
    assert "--path path.json" in viewer.run(note) and "path.json" not in before


def test_a_path_that_the_browser_does_not_copy_is_not_called_copied(viewer: Page) -> None:
    viewer.run("navigator.clipboard.writeText = () => Promise.reject(new Error('no')); 0")
    viewer.run("document.execCommand = () => false; 0")
    viewer.click("#copy-path")
    viewer.wait("document.getElementById('note').textContent.includes('did not let')")


def test_a_saved_picture_is_named_by_its_own_time(viewer: Page) -> None:
    save = "HTMLAnchorElement.prototype.click = function () { globalThis.saved = this.download; }"
    later = "viewer.png = () => { viewer.set({time: 3}); return new Blob(); }"
    viewer.run(f"{save}; {later}; viewer.set({{time: 1}})")
    viewer.press("p")
    viewer.wait("globalThis.saved")
    assert viewer.run("saved") == "Toy_1.00.png"


def test_buttons_work_by_pointer(viewer: Page) -> None:
    viewer.click("#play")
    assert state(viewer, "playing") is True
    viewer.click("#play")
    viewer.click("#brackets button")
    darkest = viewer.run("Math.min(...viewer.scene.exposures)")
    assert (state(viewer, "curve"), state(viewer, "ev")) == ("camera", darkest)
    viewer.click("[data-mode=fly]")
    assert state(viewer, "mode") == "fly"
    viewer.click("#stats-button")
    viewer.wait("document.getElementById('stats').textContent.includes('Gaussians')")


def test_the_copied_path_is_one_that_render_reads(viewer: Page, toy: Scene, tmp_path: Path) -> None:
    viewer.run("viewer.set({curve: 'camera', ev: -1})")
    viewer.press("k")
    viewer.press("End")
    viewer.drag((120, 100), (150, 100))
    viewer.press("k")
    file = tmp_path / "path.json"
    file.write_text(json.dumps(viewer.run("viewer.cameraPath()")))
    views = paths.read_path(file, toy.train[0].camera)
    assert [v.time for v in views] == list(range(len(views))) and len(views) > 2
    assert {v.ev for v in views} == {-1}
    torch.testing.assert_close(views[0].camera.c2w, toy.train[0].camera.c2w, atol=1e-5, rtol=0)


def test_the_path_of_a_clip_has_held_out_frames_too(viewer: Page, toy: Scene) -> None:
    viewer.run("viewer.scene.times = [0, 1, 2, 4, 5, 6, 7.5]")
    times = [view["time"] for view in viewer.run("viewer.cameraPath()")]
    assert times == [0, 1, 2, 3, 4, 5, 6, 7, 7.5]
    for clip in ([0, 1, 3, 4, 6], [1 / 3, 1 / 3 + 1, 1 / 3 + 1.6666666]):
        viewer.run(f"viewer.scene.times = {clip}")
        times = [view["time"] for view in viewer.run("viewer.cameraPath()")]
        expected = [view.time for view in paths.fixed_path(toy.train[0].camera, clip)]
        assert times == pytest.approx(expected, abs=1e-6)
        assert (times[0], times[-1]) == (clip[0], clip[-1])  # not outside of the clip
    viewer.run("viewer.scene.times = [3]")
    assert [view["time"] for view in viewer.run("viewer.cameraPath()")] == [3]


def test_the_path_of_another_camera_names_it(viewer: Page) -> None:
    for holder in ("viewer.scene", "viewer.renderer"):
        viewer.run(f"{holder}.responses.push({holder}.responses[0])")
    viewer.run("viewer.set({curve: 'camera', camera: 1})")
    viewer.click("#copy-path")
    text = "document.getElementById('note').textContent"
    viewer.wait(f"{text}.endsWith('--path path.json --camera-id 1')")


def test_a_right_click_drags_nothing(viewer: Page) -> None:
    mouse = {"x": 120, "y": 100, "clickCount": 1}
    right = {"button": "right", "buttons": 2}
    viewer.call("Input.dispatchMouseEvent", type="mousePressed", **mouse, **right)
    viewer.call("Input.dispatchMouseEvent", type="mouseMoved", x=160, y=110)
    assert state(viewer, "mode") == "filmed"
    left = {"button": "left", "buttons": 1}
    viewer.call("Input.dispatchMouseEvent", type="mousePressed", **mouse, **left)
    viewer.call("Input.dispatchMouseEvent", type="mouseMoved", x=160, y=110)  # released elsewhere
    assert state(viewer, "mode") == "filmed"


def test_a_drag_ends_with_the_left_button(viewer: Page) -> None:
    def mouse(kind: str, x: float, button: str, buttons: int) -> None:
        place = {"x": x, "y": 100, "clickCount": 1}
        viewer.call("Input.dispatchMouseEvent", type=kind, button=button, buttons=buttons, **place)

    mouse("mousePressed", 120, "left", 1)
    mouse("mousePressed", 120, "right", 3)
    mouse("mouseReleased", 120, "left", 2)
    before = viewer.run("viewer.camera().c2w")
    mouse("mouseMoved", 160, "right", 2)
    mouse("mouseReleased", 160, "right", 0)
    assert viewer.run("viewer.camera().c2w") == before


def test_recorded_frames_say_their_own_exposure(tab: Page, toy: Scene, tmp_path: Path) -> None:
    drifting = replace(toy, train=[replace(frame, drift=0.3) for frame in toy.train])
    open_page(tab, tmp_path / "scene.html", scene_file(drifting))
    tab.run("viewer.set({split: true, time: viewer.first})")
    ev = tab.run("viewer.scene.exposures[viewer.scene.views[0].bracket]") + 0.3
    label = tab.run("document.getElementById('recorded-label').textContent")
    assert label == f"Recorded, {ev:+.1f} EV".replace("-", "−")


def test_the_recorded_frame_is_of_the_camera_that_the_page_follows(
    tab: Page, toy: Scene, tmp_path: Path
) -> None:
    file = scene_file(toy)
    views = [replace(view, camera_id=i % 2) for i, view in enumerate(file.views)]
    two = replace(file, views=views, responses=2 * file.responses)
    open_page(tab, tmp_path / "scene.html", two)
    tab.run("viewer.set({split: true, time: viewer.scene.views[1].time})")
    shown = tab.run("viewer.scene.views.filter(view => view.address).map(view => view.camera_id)")
    assert shown == [0]


def test_without_parallax_the_camera_stays_where_it_filmed(
    tab: Page, toy: Scene, tmp_path: Path
) -> None:
    open_page(tab, tmp_path / "scene.html", replace(scene_file(toy), parallax="rotation"))
    before = tab.run("viewer.camera().c2w")
    tab.drag((120, 100), (160, 110))
    for key in ("3", "4", "w"):
        tab.press(key)
    assert tab.run("viewer.camera().c2w") == before
    assert tab.run("document.querySelector('[data-mode=orbit]').disabled") is True
    assert "only turned" in tab.run("document.getElementById('camera-note').textContent")


@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844), (844, 390)])
def test_the_picture_and_the_controls_fit_the_window(
    tab: Page, toy: Scene, tmp_path: Path, width: int, height: int
) -> None:
    open_page(tab, tmp_path / "scene.html", scene_file(toy), width, height)
    assert tab.run("document.documentElement.scrollWidth") <= width
    for name in ("picture", "timeline", "play", "help-button"):
        rect = f"document.getElementById('{name}').getBoundingClientRect()"
        left, top, right, bottom = tab.run(f"(r => [r.left, r.top, r.right, r.bottom])({rect})")
        assert left >= 0 and top >= 0 and right <= width + 1 and bottom <= height + 1
        assert right - left > 20 and bottom - top > 20


# Over time


def test_a_new_state_of_the_scene_is_sorted_again(viewer: Page) -> None:
    viewer.run("viewer.set({playing: true})")
    started = "const old = viewer.renderer, done = viewer.replace(viewer.scene);"
    left = "viewer.sortedFor = ''; viewer.sorting = false; viewer.drawIfNeeded(0);"
    slow = "old.sorter.worker.onmessage = () => {};"  # not answered when it ends
    viewer.run(f"(async () => {{ {started} {slow} {left} await done; }})()")
    assert viewer.run("viewer.sorting && viewer.renderer.sorter.pending.size === 0") is False
    viewer.run("globalThis.sorts = viewer.renderer.sorter.next")
    viewer.wait("viewer.renderer.sorter.next > sorts + 3")
    viewer.run("viewer.set({playing: false})")
    viewer.wait("!viewer.sorting")


def test_a_picture_is_saved_while_the_scene_is_replaced(viewer: Page) -> None:
    file = viewer.run(png_text(8))
    viewer.run("viewer.renderer.sorter.worker.onmessage = () => {}")  # not answered when it ends
    both = f"Promise.all([{png_text(8)}, viewer.replace(viewer.scene)])"
    assert viewer.run(f"{both}.then(answers => answers[0])") == file


def test_another_tab_says_nothing_about_the_speed(viewer: Page) -> None:
    viewer.run("globalThis.requestAnimationFrame = () => 0")  # the turns below are the only ones
    viewer.run("viewer.set({playing: true})")
    turns = "for (let i = 0; i < {}; i++) viewer.tick(now += {});"
    run = "(() => {{ globalThis.now ??= performance.now() + 1e5; {} return viewer.isSlow(); }})()"
    assert viewer.run(run.format(turns.format(20, 16))) is False
    assert viewer.run("viewer.framesPerSecond()") == pytest.approx(62.5)
    assert viewer.run(run.format(turns.format(1, 5000) + turns.format(4, 16))) is False
    assert viewer.run("viewer.frameTimes.length") == 5
    assert viewer.run(run.format(turns.format(8, 700))) is True  # a slow GPU always pauses


# With a server


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


@pytest.mark.parametrize("address", ["splat", "grid"], indirect=True)
def test_a_browser_without_a_gpu_shows_frames_of_the_server(tab: Page, address: str) -> None:
    tab.goto(address, 500, 300)
    tab.wait("!document.getElementById('frame').hidden")
    tab.press("ArrowRight")
    tab.drag((120, 100), (160, 110))
    tab.press("v")
    tab.wait("!viewer.frames.busy && viewer.frames.shown > 2")
    width = tab.run("document.getElementById('frame').naturalWidth")
    assert width == tab.run("viewer.scene.width")  # the finest, after coarse ones
    assert tab.run("document.querySelector('#curve [value^=agx]').disabled") is True
    assert all(asked.startswith(address) for asked in tab.requests())
    assert tab.problems() == []


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
