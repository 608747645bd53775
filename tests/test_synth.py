"""The synthetic room: exact geometry, what is held out, resuming; one tiny picture
where Mitsuba is installed.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hdr_nsff.core import io
from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.exposure_lists import read_exposure_csv
from hdr_nsff.footage.ingest import open_footage
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, true_pictures
from hdr_nsff.synth import pathtracer
from hdr_nsff.synth import synth as verb
from hdr_nsff.synth import textures as synth_textures
from hdr_nsff.synth.motion import exact_flow
from hdr_nsff.synth.oracle import visible
from hdr_nsff.synth.pathtracer import PASS, Surface, Tracer, smooth
from hdr_nsff.synth.scenes.base import Views
from hdr_nsff.synth.scenes.geometry import intrinsics, look_at, project
from hdr_nsff.synth.scenes.interior import (
    BACK,
    CORD,
    FLOOR,
    INTERIOR,
    PIVOT,
    ball_pose,
    box_pose,
    camera_pose,
)
from hdr_nsff.synth.synth import SynthConfig, clip_shots, parse_ev, parse_size, synth, truth_shots

ROOM, BOX, BALL = 0, 1, 2


def test_camera_sees_57_degrees_across() -> None:
    """Half of 240 pixels over tan(28.5 degrees) = 0.54296: focal 221.0."""
    K = intrinsics(240, 136)
    assert K[0, 0] == pytest.approx(221.0, abs=0.05) and K[1, 1] == K[0, 0]
    pixel, depth = project(np.array([0.5, -0.25, 2.0]), K, np.eye(3, 4))
    np.testing.assert_allclose(pixel, [120 + K[0, 0] / 4, 68 - K[0, 0] / 8])
    assert depth == 2.0


def test_camera_looks_at_its_target_level() -> None:
    eye, target = np.array([0.3, -0.2, 0.1]), np.array([-0.1, 0.4, 3.0])
    c2w = look_at(eye, target)
    pixel, depth = project(target, intrinsics(240, 136), c2w)
    np.testing.assert_allclose(pixel, [120, 68], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm(target - eye))
    np.testing.assert_allclose(c2w[:, :3].T @ c2w[:, :3], np.eye(3), atol=1e-12)
    assert c2w[1, 0] == pytest.approx(0) and c2w[1, 1] > 0.9  # x horizontal, y down


def test_projection_agrees_with_the_camera_of_the_package() -> None:
    points, c2w, K = (
        np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (9, 3)),
        camera_pose(5.5),
        intrinsics(240, 136),
    )
    pixels, depth = project(points, K, c2w)
    expected, expected_depth = Camera(torch.tensor(K), torch.tensor(c2w), 240, 136).project(
        torch.tensor(points)
    )
    np.testing.assert_allclose(pixels, expected.numpy(), atol=1e-9)
    np.testing.assert_allclose(depth, expected_depth.numpy(), atol=1e-12)


def test_ball_swings_on_a_circle_about_its_pivot() -> None:
    """At angle a the ball hangs CORD cos(a) below the pivot and CORD sin(a) beside it."""
    for t in (0.0, 3.5, 17.0):
        center = (ball_pose(t) @ [0, CORD, 0, 1])[:3] - PIVOT
        angle = np.radians(18) * np.sin(2 * np.pi * (t + 4) / 30)
        assert center[1] == pytest.approx(CORD * np.cos(angle))
        assert np.hypot(center[0], center[2]) == pytest.approx(CORD * abs(np.sin(angle)))


def test_moved_carries_movers_rigidly_and_leaves_the_room() -> None:
    rng = np.random.default_rng(0)
    local = rng.normal(size=(5, 3))
    start, end = (local @ box_pose(t)[:3, :3].T + box_pose(t)[:3, 3] for t in (4.0, 9.5))
    points = np.concatenate([start, local])
    result = INTERIOR.moved(points, np.array([BOX] * 5 + [ROOM] * 5), np.zeros((10, 2)), 4.0, 9.5)
    np.testing.assert_allclose(result[:5], end, atol=1e-12)
    np.testing.assert_array_equal(result[5:], local)


def test_flow_of_a_known_point_is_exact() -> None:
    """A pixel that shows the ball's center flows to where the next camera projects the
    next position of that center.
    """
    K, center = intrinsics(240, 136), [0, CORD, 0, 1]
    pixel, _ = project((ball_pose(7) @ center)[:3], K, camera_pose(7))
    after, _ = project((ball_pose(8) @ center)[:3], K, camera_pose(8))
    points = np.broadcast_to((ball_pose(7) @ center)[:3], (136, 240, 3))
    x, y = np.floor(pixel).astype(int)
    there = INTERIOR.moved(points, np.full((136, 240), BALL), np.zeros((136, 240, 2)), 7, 8)
    flow = exact_flow(there, K, camera_pose(8))[y, x]
    np.testing.assert_allclose(flow, after - (np.array([x, y]) + 0.5), atol=1e-9)


def test_motion_between_frames_stays_within_ten_pixels() -> None:
    K = intrinsics(240, 136)
    for t in range(36):
        for pose, point in ((box_pose, [0.1, 0.1, 0.1, 1]), (ball_pose, [0, CORD, 0, 1])):
            (a, depth), (b, _) = (
                project((pose(s) @ point)[:3], K, camera_pose(s)) for s in (t, t + 1)
            )
            assert np.linalg.norm(b - a) < 10 and depth > 1
            assert (a > 0).all() and (a < [240, 136]).all()  # always in the picture


def test_held_out_views_are_never_frames_of_the_clip() -> None:
    clip, views = clip_shots(INTERIOR, 36, 1, 0), truth_shots(INTERIOR, 36, 1, 0)
    assert [v.name.split("_")[0] for v in views] == ["view"] * 8 + ["time"] * 6 + ["off"] * 2
    for view in views:
        same_time = [c for c in clip if c.time == view.time]
        assert all(np.abs(c.c2w - view.c2w).max() > 0.01 for c in same_time)
        at_anchor = np.linalg.norm(view.c2w[:, 3] - clip[view.anchor].c2w[:, 3])
        assert (0.02 < at_anchor < 0.1) if view.off_path else at_anchor == 0
    assert len({v.seed for v in clip + views}) == len(clip + views) == 52


def test_the_rig_is_two_rows_of_cameras_that_look_at_one_place() -> None:
    eyes = np.array([INTERIOR.pose("rig", k)[:, 3] for k in range(9)])
    assert np.ptp(eyes, axis=0) == pytest.approx([1.2, 0.28, 0])
    assert sorted(np.unique(eyes[:, 1], return_counts=True)[1]) == [4, 5]
    beside = np.linalg.norm(eyes - np.roll(eyes, 1, axis=0), axis=1)
    assert beside.max() < 0.35  # whoever records next stands beside, also after the last
    for k in range(9):
        np.testing.assert_allclose(
            project(np.array(INTERIOR.rig_target), intrinsics(240, 136), INTERIOR.pose("rig", k))[
                0
            ],
            [120, 68],
            atol=1e-9,
        )


def test_every_camera_of_the_rig_always_sees_both_movers() -> None:
    K = intrinsics(240, 136)
    centers = [
        (b(t) @ p)[:3]
        for t in range(36)
        for b, p in ((box_pose, [0, 0, 0, 1]), (ball_pose, [0, CORD, 0, 1]))
    ]
    for k in range(9):
        pixels, depth = project(np.array(centers), K, INTERIOR.pose("rig", k))
        assert (pixels > 20).all() and (pixels < [220, 116]).all() and (depth > 1.5).all()


def test_frame_i_of_a_rig_is_what_camera_i_modulo_nine_records() -> None:
    for t, shot in enumerate(clip_shots(INTERIOR, 20, 1, 0, "rig")):
        assert shot.time == t and shot.anchor == t
        np.testing.assert_allclose(shot.c2w[:, 3], INTERIOR.rig[t % 9])


@pytest.mark.parametrize("frames", [12, 36])
def test_a_rig_holds_out_other_cameras_than_the_one_that_records_then(frames: int) -> None:
    clip, views = (
        clip_shots(INTERIOR, frames, 1, 0, "rig"),
        truth_shots(INTERIOR, frames, 1, 0, "rig"),
    )
    assert len({v.name for v in views}) == 16 and sum(v.time % 1 == 0.5 for v in views) == 6
    for view in views:
        recording = clip[int(view.time)]
        apart = np.linalg.norm(view.c2w[:, 3] - recording.c2w[:, 3])
        assert (0.02 < apart < 0.1) if view.off_path else apart > 0.3
        assert view.off_path or np.array_equal(view.c2w, clip[view.anchor].c2w)
    assert (
        frames < 36 or len({v.anchor % 9 for v in views}) == 9
    )  # every camera is asked for something


def test_textures_are_physical_albedos_and_the_seed_repeats_them() -> None:
    for paint in (
        synth_textures.bricks,
        synth_textures.planks,
        synth_textures.tiles,
        synth_textures.poster,
        synth_textures.books,
    ):
        a, b = (paint(60, 80, np.random.default_rng(3)) for _ in range(2))
        assert a.shape == (60, 80, 3) and a.dtype == np.float32
        assert a.min() > 0 and a.max() <= 0.82 and a.std() > 0.05
        np.testing.assert_array_equal(a, b)


def plane(height: int = 12, width: int = 16, depth: float = 2.0, bodies: int = ROOM) -> Surface:
    """A wall at z = `depth` seen from the origin, pixels 1 cm apart."""
    y, x = np.mgrid[:height, :width] * 0.01
    points = np.stack([x, y, np.full_like(x, depth)], -1)
    normals = np.broadcast_to([0.0, 0, -1], points.shape)
    return Surface(
        points,
        normals,
        np.full((height, width), depth),
        np.full((height, width), bodies),
        points[..., :2],
    )


def test_smoothing_keeps_even_light_and_lowers_noise() -> None:
    surface = plane(40, 40)
    np.testing.assert_allclose(smooth(np.full((40, 40, 3), 0.7), surface, 0.05), 0.7, rtol=1e-5)
    noisy = np.random.default_rng(0).normal(1, 0.2, (40, 40, 3))
    # a Gaussian of 5 pixels averages 4 pi 25 = 314 independent values: 0.2 / 17.7 =
    # 0.011; the cut at 9 pixels costs a little
    assert 0.009 < smooth(noisy, surface, 0.05)[15:25, 15:25].std() < 0.02


def test_smoothing_does_not_cross_a_mover_or_a_corner() -> None:
    light = np.zeros((12, 16, 3))
    light[:, 8:] = 1
    half = np.arange(16) >= 8
    surface = plane()
    other_body = replace(surface, bodies=np.where(half, BOX, ROOM) * np.ones((12, 1), int))
    corner = replace(
        surface, normals=np.where(half[:, None], [1.0, 0, 0], [0, 0, -1.0]) * np.ones((12, 1, 1))
    )
    for parted in (other_body, corner):
        np.testing.assert_allclose(smooth(light, parted, 0.05), light, atol=1e-6)
    assert 0.2 < smooth(light, surface, 0.05)[6, 7, 0] < 0.8


def test_visible_is_false_out_of_the_frame_and_behind_something() -> None:
    """Everything moves two pixels to the right, where a pole now stands in columns 4
    and 5 of eight.
    """
    flow = np.zeros((6, 8, 2))
    flow[..., 0] = 2.0
    there = np.full((6, 8), 3.0)
    there[:, 4:6] = 1.0
    seen = visible(flow, np.full((6, 8), 3.0), there)
    np.testing.assert_array_equal(seen[0], [True, True, False, True, True, False, False, False])


class Flat:
    """In Mitsuba's place: an even wall 3 m away, whatever the camera."""

    rendered = 0

    def __init__(self, *_: object) -> None:
        pass

    def surface(self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int]) -> Surface:
        surface = plane(size[1], size[0], 3.0)
        return replace(
            surface, bodies=np.where(np.arange(size[0]) < 4, BOX, ROOM) * np.ones((size[1], 1), int)
        )

    def radiance(
        self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int], spp: int, seed: int
    ) -> np.ndarray:
        Flat.rendered += spp > PASS  # what is traced for the estimate of time does not count
        return np.full((size[1], size[0], 3), 0.25, np.float32)


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> SynthConfig:
    monkeypatch.setattr(verb, "Tracer", Flat)
    Flat.rendered = 0
    return SynthConfig("interior", tmp_path / "room", size="16x16", frames=12, noise=0, oracle=True)


def test_exposures_alternate_about_the_middle_bracket(flat: SynthConfig) -> None:
    """EV -4, -2, 0: relative to the middle -2, 0, 2; green, radiance 0.25: exposures
    1/16, 1/4, 1 (recorded 1).
    """
    synth(flat)
    truth = Truth.open(flat.out / "truth")
    assert truth.bracket_ev == [-2, 0, 2] and truth.reference_bracket == 1
    greens = [float(io.read_image(flat.out / "clip" / f"{t:05d}.png")[0, 0, 1]) for t in range(6)]
    assert greens[:3] == greens[3:] and greens[2] == 1
    expected = np.interp([1 / 16, 1 / 4], truth.response_x, truth.response_y[1])
    np.testing.assert_allclose(greens[:2], expected, atol=0.5 / 255)


def test_truth_and_video_hold_what_was_rendered(flat: SynthConfig) -> None:
    synth(flat)
    truth = Truth.open(flat.out / "truth")
    assert len(truth.views) == 16 and len(truth.clip_c2w or []) == 12
    view = truth.views[0]
    np.testing.assert_array_equal(
        io.read_exr(flat.out / "truth" / view.radiance)["RGB"], np.full((16, 16, 3), 0.25)
    )
    assert io.read_mask(flat.out / "truth" / str(view.mask)).sum() == 4 * 16
    assert sum(1 for _ in io.read_video(flat.out / "clip.mp4")) == 12


@pytest.mark.parametrize("views", ["mono", "rig"])
def test_oracle_is_a_scene_that_says_what_it_is(flat: SynthConfig, views: Views) -> None:
    synth(replace(flat, views=views))
    scene = Scene.open(flat.out / "oracle")
    assert {s.note for s in scene.manifest.steps.values()} == {"oracle: from truth"}
    assert [f.bracket for f in scene.train] == [0, 1, 2] * 4
    frame, k = scene.train[5], 5
    pixels = np.stack(np.meshgrid(np.arange(16) + 0.5, np.arange(16) + 0.5), -1)
    still = pixels[:, 4:]
    points = plane(16, 16, 3.0).points
    for side in (-1, 1):
        exact = (
            project(points, intrinsics(16, 16), INTERIOR.pose(views, k + side))[0][:, 4:] - still
        )
        error = frame.flow[side].numpy()[:, 4:] - exact
        assert 0.2 < error.std() < 0.4 and abs(error.mean()) < 0.1  # 0.3 px of noise, no bias
    assert (
        frame.disparity is not None
        and abs(float(frame.disparity.log().mean() - np.log(1 / 3))) < 0.03
    )


def test_a_run_that_was_killed_renders_only_what_is_missing(flat: SynthConfig) -> None:
    synth(flat)
    assert Flat.rendered == 12 + 16
    (flat.out / "exact" / "clip_00003.exr").unlink()
    (flat.out / "clip.mp4").unlink()
    synth(flat)
    assert Flat.rendered == 12 + 16 + 1 and (flat.out / "clip.mp4").is_file()


def test_other_settings_do_not_mix_into_a_folder(flat: SynthConfig) -> None:
    synth(flat)
    with pytest.raises(InputError, match="other settings"):
        synth(replace(flat, seed=1))
    synth(
        replace(flat, ev="0,-3", response="srgb")
    )  # recording the same room otherwise renders nothing
    assert Flat.rendered == 12 + 16


def test_the_cameras_settings_are_in_the_truth_and_in_the_recording(flat: SynthConfig) -> None:
    """Without noise, a clip's frame is what the truth makes of the same radiance at the
    same bracket: gains, fall-off, curve and all.
    """
    synth(replace(flat, ev="0,-3", response="log", white_balance="2,1,0.5", vignetting=0.8))
    truth = Truth.open(flat.out / "truth")
    assert (
        truth.bracket_ev == [0, -3]
        and truth.white_balance == [2, 1, 0.5]
        and truth.vignetting == 0.8
    )
    assert (
        truth.settings is not None
        and truth.settings["name"] == "interior"
        and truth.settings["response"] == "log"
    )
    _, pictures = true_pictures(truth, truth.views[0], flat.out / "truth")
    for bracket in (0, 1):
        recorded = io.read_image(flat.out / "clip" / f"{bracket:05d}.png")
        np.testing.assert_allclose(recorded, pictures[bracket], atol=0.51 / 255)
    assert pictures[1][8, 8, 1] > pictures[1][0, 0, 1] + 0.02  # darker in the corner


def test_scenes_do_not_mix_in_a_folder_and_are_exposed_as_suits_them(flat: SynthConfig) -> None:
    synth(flat)
    with pytest.raises(InputError, match="other settings"):
        synth(replace(flat, name="night"))
    synth(replace(flat, name="night", out=flat.out.parent / "night"))
    assert Truth.open(flat.out.parent / "night" / "truth").bracket_ev == [-3, 0, 3]


def test_the_estimate_of_time_is_exact_where_a_path_costs_the_same_every_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two seconds per picture and a tenth per path: 2 + 25.6 and 2 + 76.8."""
    now = [0.0]

    class Steady(Flat):
        def radiance(
            self,
            t: float,
            K: np.ndarray,
            c2w: np.ndarray,
            size: tuple[int, int],
            spp: int,
            seed: int,
        ) -> np.ndarray:
            now[0] += 2 + 0.1 * spp
            return super().radiance(t, K, c2w, size, spp, seed)

    monkeypatch.setattr(verb.clock, "monotonic", lambda: now[0])
    shots = [clip_shots(INTERIOR, 12, 256, 0)[0], truth_shots(INTERIOR, 12, 768, 0)[0]]
    assert verb.estimate(Steady(), shots, intrinsics(16, 16), (16, 16)) == pytest.approx(
        27.6 + 78.8
    )


@pytest.mark.parametrize("text", ["1,1", "a,b,c", "0,1,1", "nan,1,1", "1,1,1,1"])
def test_a_bad_white_balance_is_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(InputError, match="--white-balance"):
        verb.parse_white_balance(text)


def test_a_rig_lists_its_exposures_for_prepare(flat: SynthConfig) -> None:
    synth(replace(flat, views="rig"))
    for footage in ("clip.mp4", "clip"):
        table = read_exposure_csv(open_footage(flat.out / footage))
        assert table is not None and [table[1][f"#{t}"] for t in range(12)] == [-4, -2, 0] * 4


def test_the_poses_of_a_rig_are_in_its_truth_and_its_oracle(flat: SynthConfig) -> None:
    synth(replace(flat, views="rig"))
    poses = np.array([INTERIOR.pose("rig", t) for t in range(12)])
    np.testing.assert_allclose(np.array(Truth.open(flat.out / "truth").clip_c2w), poses)
    np.testing.assert_allclose(
        [e.c2w for e in Scene.open(flat.out / "oracle").manifest.frames], poses
    )


def test_a_rig_goes_on_after_a_kill_and_does_not_mix_with_one_camera(flat: SynthConfig) -> None:
    rig = replace(flat, views="rig")
    synth(rig)
    before = io.read_npy(rig.out / "oracle" / "flow" / "00003_00004.npy")
    (rig.out / "exact" / "clip_00003.exr").unlink()
    synth(rig)
    assert Flat.rendered == 12 + 16 + 1
    np.testing.assert_array_equal(
        io.read_npy(rig.out / "oracle" / "flow" / "00003_00004.npy"), before
    )
    with pytest.raises(InputError, match="other settings"):
        synth(flat)


@pytest.mark.parametrize("text", ["240", "240x", "axb", "8x8", "-240x136"])
def test_a_bad_size_is_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(InputError, match="WIDTHxHEIGHT"):
        parse_size(text)


@pytest.mark.parametrize("text", ["", "a,b", "1,,2", "nan,0", "inf"])
def test_bad_exposures_are_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(InputError, match="--ev"):
        parse_ev(text)


@pytest.mark.parametrize(
    "change",
    [
        *(
            {"frames": 3},
            {"seed": -1},
            {"spp": 0},
            {"noise": -1.0},
            {"noise": float("nan")},
            {"response": "kodak"},
        ),
        *({"vignetting": 1.1}, {"vignetting": float("nan")}, {"white_balance": "1"}),
        *({"depth_noise": 1.0}, {"depth_grain": -0.1}, {"flow_noise": float("nan")}),
    ],
)
def test_bad_numbers_are_refused_before_anything_is_rendered(
    flat: SynthConfig, change: dict
) -> None:
    with pytest.raises(InputError):
        synth(replace(flat, **change))
    assert Flat.rendered == 0 and not flat.out.exists()


def test_unusable_variants_are_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")
    monkeypatch.setattr(pathtracer, "newest_llvm", lambda: None)
    with pytest.raises(InputError, match="libllvm19"):
        pathtracer.start("llvm_ad_rgb")
    with pytest.raises(InputError, match="use auto"):
        pathtracer.start("fast")


def test_a_missing_mitsuba_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"hdr-nsff\[synth\]"):
        pathtracer.start("auto")


@pytest.fixture(scope="module")
def tracer() -> Tracer:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")
    return Tracer(INTERIOR, 0, "scalar_rgb")


def test_a_tiny_picture_holds_the_range_it_promises(tracer: Tracer) -> None:
    """The bulb's 700 and the window in view; shadows four decades below."""
    size = (32, 18)
    pictures = [tracer.radiance(t, intrinsics(*size), camera_pose(t), size, 2, 0) for t in (0, 1)]
    for picture in pictures:
        assert picture.shape == (18, 32, 3) and np.isfinite(picture).all() and picture.min() >= 0
        assert picture.max() > 20 and np.percentile(picture, 5) < 0.05
    assert np.abs(pictures[0] - pictures[1]).max() > 0.1  # the room moves


def test_surfaces_lie_on_the_rays_through_pixel_centers(tracer: Tracer) -> None:
    size, c2w = (32, 18), camera_pose(3)
    K = intrinsics(*size)
    surface = tracer.surface(3.0, K, c2w, size)
    pixels, depth = project(surface.points, K, c2w)
    np.testing.assert_allclose(
        pixels, np.stack(np.meshgrid(np.arange(32) + 0.5, np.arange(18) + 0.5), -1), atol=1e-6
    )
    np.testing.assert_allclose(depth, surface.depth, rtol=1e-6)
    assert (
        surface.points[..., 2].max() < BACK + 0.25 and surface.points[..., 1].max() < FLOOR + 1e-3
    )
    assert set(np.unique(surface.bodies)) == {ROOM, BOX, BALL}
    ball = surface.points[surface.bodies == BALL] - (ball_pose(3.0) @ [0, CORD, 0, 1])[:3]
    assert (
        np.abs(np.linalg.norm(ball, axis=1) - 0.165).min() < 0.003
    )  # on the sphere, where it is no cord


def test_the_demo_is_whole_and_small_enough_for_git() -> None:
    demo = Path(__file__).parents[1] / "demo"
    kept = [
        f for f in demo.rglob("*") if f.is_file() and demo / "out" not in f.parents
    ]  # `make demo` writes its results there
    assert sum(f.stat().st_size for f in kept) < 4_000_000
    frames = np.stack([rgb for rgb, _ in io.read_video(demo / "clip.mp4")])
    assert frames.shape == (36, 136, 240, 3)
    means = frames.mean((1, 2, 3)).reshape(12, 3)
    assert (np.diff(means, axis=1) > 0.1).all()  # dark, middle, bright, over and over
    truth = Truth.open(demo / "truth")
    for view in truth.views:
        assert io.read_exr(demo / "truth" / view.radiance)["RGB"].shape == (136, 240, 3)
        assert 0.02 < io.read_mask(demo / "truth" / str(view.mask)).mean() < 0.15
    np.testing.assert_allclose(
        np.array(truth.clip_c2w), [s.c2w for s in clip_shots(INTERIOR, 36, 1, 0)]
    )  # the code still makes this clip
    assert [(v.name, v.time, v.anchor) for v in truth.views] == [
        (s.name, s.time, s.anchor) for s in truth_shots(INTERIOR, 36, 1, 0)
    ]
