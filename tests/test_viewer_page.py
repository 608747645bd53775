"""The page in headless Chromium: it sees what `render` sees.
Skipped, in a loud line, where there is no Chromium.
"""

from __future__ import annotations

import base64
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Page, find_browser
from viewer_scenes import render, scene_file, trained, trained_local, with_gap
from viewer_tab import SIZE, TO_BASE64, open_page, png_text, read_linear, read_png, state, view_of

from hdr_nsff.fields.splat.rasterize import rasterize
from hdr_nsff.maths.metrics import mu_law_psnr
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.viewer.field_scene import scene_of

if find_browser() is None:
    MISSING = "NO CHROMIUM: THE VIEWER'S PAGE IS NOT TESTED; install it, or set CHROMIUM"
    warnings.warn(MISSING, stacklevel=1)
    pytest.skip(MISSING, allow_module_level=True)


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


def test_pictures_of_8_bits_are_those_of_16_bits(viewer: Page) -> None:
    fine = read_png(base64.b64decode(viewer.run(png_text(16))))
    coarse = read_png(base64.b64decode(viewer.run(png_text(8))), bits=8)
    np.testing.assert_allclose(coarse, fine, atol=0.51 / 255)
    assert fine.shape[1] == viewer.run("viewer.fullSize.width")


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


@pytest.mark.parametrize(
    ("width", "height"), [(1280, 800), (390, 844), (844, 390), (640, 360), (568, 320)]
)
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


def test_a_screen_of_another_density_gets_its_own_pixels(viewer: Page) -> None:
    viewer.run("viewer.easeOff = () => false")  # however slowly this machine draws
    width = viewer.run("viewer.canvas.width")
    for density in (2, 1, 2):
        viewer.move_to_screen(500, 300, density)
        viewer.wait(f"Math.abs(viewer.canvas.width - {density * width}) <= 1")


def wait_until_filled(viewer: Page, room: str) -> None:
    """Wait until the picture is as large as the stage's width and a height allow."""
    viewer.wait(
        "(() => { const {scene} = viewer, stage = document.getElementById('stage');"
        "const {width, height} = document.getElementById('picture').getBoundingClientRect();"
        f"const scale = Math.min(stage.clientWidth / scene.width, {room} / scene.height);"
        "const off = [width - scale * scene.width, height - scale * scene.height];"
        "return off.every(pixels => Math.abs(pixels) < 1); })()"
    )


TIMELINE = "document.getElementById('timeline').getBoundingClientRect().top"


@pytest.mark.parametrize(
    ("sizes", "room"),
    [
        ([(1280, 800), (844, 390), (640, 360), (568, 320)], TIMELINE),
        ([(700, 500), (700, 800), (390, 844)], "0.55 * innerHeight"),
    ],
    ids=["beside the controls", "above the controls"],
)
def test_the_picture_takes_the_room_that_there_is(
    viewer: Page, sizes: list[tuple[int, int]], room: str
) -> None:
    for width, height in sizes:
        viewer.resize(width, height)
        wait_until_filled(viewer, room)
        viewer.press("h")
        wait_until_filled(viewer, "innerHeight")
        viewer.press("h")
    wait_until_filled(viewer, room)


# Over time


def test_a_layout_draws_anew_where_the_size_is_another(viewer: Page) -> None:
    layout = "(viewer.dirty = false, viewer.fit({}), viewer.dirty)"
    assert not viewer.run(layout.format("...viewer.room"))
    assert viewer.run(layout.format("viewer.room[0] / 2, viewer.room[1]"))


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
    still = "globalThis.requestAnimationFrame = () => 0"  # the turns below are the only ones
    viewer.run(
        f"(ask => {{ {still}; return new Promise(f => ask(() => ask(f))) }})(requestAnimationFrame)"
    )
    viewer.run("viewer.set({playing: true})")
    turns = "for (let i = 0; i < {}; i++) viewer.tick(now += {});"
    run = "(() => {{ globalThis.now ??= performance.now() + 1e5; {} return viewer.isSlow(); }})()"
    assert viewer.run(run.format(turns.format(20, 16))) is False
    assert viewer.run("viewer.framesPerSecond()") == pytest.approx(62.5)
    assert viewer.run(run.format(turns.format(1, 5000) + turns.format(4, 16))) is False
    assert viewer.run("viewer.frameTimes.length") == 5
    assert viewer.run(run.format(turns.format(8, 700))) is True  # a slow GPU always pauses


def test_recorded_frames_of_a_scene_that_is_replaced_are_given_back(viewer: Page) -> None:
    viewer.run("viewer.set({split: true}), viewer.set({time: 2})")
    viewer.run(
        "(real => { globalThis.given = [];"
        "URL.revokeObjectURL = address => { given.push(address); real.call(URL, address); };"
        "})(URL.revokeObjectURL)"
    )
    shown = viewer.run("viewer.scene.views.map(view => view.address).filter(Boolean)")
    fresh = "viewer.scene.views.map(({address, ...view}) => view)"
    viewer.run(f"viewer.replace({{...viewer.scene, views: {fresh}}})")
    assert len(shown) == 2 and set(shown) <= set(viewer.run("given"))
    recorded = viewer.run("document.getElementById('recorded').src")
    assert recorded.startswith("blob:") and recorded not in shown
