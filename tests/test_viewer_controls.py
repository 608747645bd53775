"""The page's keys, pointer and buttons in headless Chromium. Skipped where there is
no Chromium.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Page, find_browser
from viewer_scenes import scene_file
from viewer_tab import open_page, state

from hdr_nsff.geometry import paths
from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer import display

if find_browser() is None:
    pytest.skip("no Chromium", allow_module_level=True)


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


def choose(viewer: Page, select: str, value: str) -> None:
    """Choose from a list, as people do by pointer or key."""
    place = f"document.getElementById('{select}')"
    chosen = f"{place}.value = '{value}', {place}.dispatchEvent(new Event('change'))"
    viewer.run(chosen)


def test_the_time_slider_stops_playback_where_it_is_put(viewer: Page) -> None:
    viewer.run("viewer.set({playing: true, speed: 0.01})")
    viewer.click("#time")
    first, last = viewer.run("[viewer.first, viewer.last]")
    assert state(viewer, "playing") is False
    assert state(viewer, "time") == pytest.approx((first + last) / 2, abs=0.02 * (last - first))


def test_time_goes_by_at_the_chosen_speed(viewer: Page) -> None:
    choose(viewer, "speed", "0.25")
    turn = "viewer.set({time: viewer.first, playing: true}), viewer.advance(0.2)"
    assert viewer.run(f"{turn}, viewer.state.time - viewer.first") == pytest.approx(
        0.2 * 0.25 * viewer.run("viewer.scene.fps")
    )


def test_curve_and_view_are_chosen_from_lists(viewer: Page) -> None:
    curves = viewer.run("[...document.getElementById('curve').options].map(o => o.value)")
    assert curves == ["camera 0", "agx 0", "neutral 0", "reinhard 0", "clip 0"]
    for value in curves:
        choose(viewer, "curve", value)
        assert f"{state(viewer, 'curve')} {state(viewer, 'camera')}" == value
    for value in ("depth", "motion", "flow", "radiance"):
        choose(viewer, "show", value)
        assert state(viewer, "show") == value


def test_boxes_mark_clipping_and_show_false_color_with_its_legend(viewer: Page) -> None:
    legend = "document.getElementById('legend')"
    assert viewer.run(f"{legend}.hidden") is True
    viewer.click("#clipping")
    viewer.click("#false-color")
    assert (state(viewer, "clipping"), state(viewer, "falseColor")) == (True, True)
    assert viewer.run(f"{legend}.hidden") is False
    colors = viewer.run(f"[...{legend}.children].map(band => band.style.backgroundColor)")
    expected = [[round(255 * c) for c in color] for color in display.BAND_COLORS]
    found = [[int(n) for n in color[4:-1].split(",")] for color in colors]
    assert np.abs(np.array(found) - expected).max() <= 1
    viewer.click("#false-color")
    assert state(viewer, "falseColor") is False


def test_the_divider_of_the_split_screen_is_dragged_and_moved_by_keys(viewer: Page) -> None:
    viewer.click("#split")
    left, top, width, height = viewer.run(
        "(r => [r.x, r.y, r.width, r.height])("
        "document.getElementById('picture').getBoundingClientRect())"
    )
    middle = top + height / 2
    viewer.drag((left + width / 2, middle), (left + width / 4, middle))
    assert state(viewer, "splitAt") == pytest.approx(0.25, abs=0.01)
    assert state(viewer, "mode") == "filmed"  # the picture was not dragged
    clip = viewer.run("document.getElementById('recorded').style.clipPath")
    assert float(clip.split()[1].rstrip("%")) == pytest.approx(75, abs=1)
    viewer.run("document.getElementById('divider').focus()")
    viewer.press("ArrowRight")
    assert state(viewer, "splitAt") == pytest.approx(0.3, abs=0.01)
    assert state(viewer, "time") == viewer.run("viewer.first")


def test_the_wheel_moves_closer(viewer: Page) -> None:
    before = np.array(viewer.run("viewer.camera().c2w"))
    place = {"x": 120, "y": 100, "deltaX": 0, "deltaY": -300}
    viewer.call("Input.dispatchMouseEvent", type="mouseWheel", **place)
    viewer.wait("viewer.state.mode === 'orbit'")
    step = np.array(viewer.run("viewer.camera().c2w"))[:, 3] - before[:, 3]
    near = viewer.run("viewer.scene.near")
    np.testing.assert_allclose(step, 0.0006 * 300 * near * before[:, 2], atol=1e-6)


def test_the_button_of_a_bracket_rounds_its_label_alone(
    tab: Page, toy: Scene, tmp_path: Path
) -> None:
    exposures = [2.04, -1.96, 0.0, 0.04]
    open_page(tab, tmp_path / "scene.html", replace(scene_file(toy), exposures=exposures))
    labels = tab.run("[...document.querySelectorAll('#brackets button')].map(b => b.textContent)")
    assert labels == ["−2", "0", "+2"]
    tab.click("#brackets button")
    assert (state(tab, "curve"), state(tab, "ev")) == ("camera", -1.96)


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
