"""`synth`: footage, truth and oracle fit together; a killed run continues."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synth_scene import Flat, plane
from test_hdr_video import decoded, luma
from test_ultra_hdr import decode

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.core.images import read_image, read_mask
from hdr_nsff.core.io import read_npy, write_text
from hdr_nsff.core.video import read_video
from hdr_nsff.footage.exposure_lists import read_exposure_csv
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.lens import Lens
from hdr_nsff.geometry.pinhole import pixel_centers, project
from hdr_nsff.maths.hdr_signal import display_light, encode, ycbcr_planes
from hdr_nsff.radiometry.recording import response_curve
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene
from hdr_nsff.scene.truth import Truth, true_pictures
from hdr_nsff.synth import synth as verb
from hdr_nsff.synth.pathtracer import Surface
from hdr_nsff.synth.scenes.base import Views
from hdr_nsff.synth.scenes.geometry import intrinsics
from hdr_nsff.synth.scenes.interior import INTERIOR
from hdr_nsff.synth.settings import SynthConfig
from hdr_nsff.synth.synth import lens_canvas, lens_radiance, record_clip, synth
from hdr_nsff.synth.views import TracedView, clip_views, held_out_views


def test_exposures_alternate_about_the_middle_bracket(flat: SynthConfig) -> None:
    """EV -4, -2, 0: relative to the middle -2, 0, 2; green, radiance 0.25: exposures
    1/16, 1/4, 1 (recorded 1).
    """
    synth(flat)
    truth = Truth.open(flat.out / "truth")
    assert truth.bracket_ev == [-2, 0, 2] and truth.reference_bracket == 1
    greens = [float(read_image(flat.out / "clip" / f"{t:05d}.png")[0, 0, 1]) for t in range(6)]
    assert greens[:3] == greens[3:] and greens[2] == 1
    expected = np.interp([1 / 16, 1 / 4], truth.response_x, truth.response_y[1])
    np.testing.assert_allclose(greens[:2], expected, atol=0.5 / 255)


def test_truth_and_video_hold_what_was_rendered(flat: SynthConfig) -> None:
    synth(flat)
    truth = Truth.open(flat.out / "truth")
    assert len(truth.views) == 16 and len(truth.clip_c2w or []) == 12
    view = truth.views[0]
    radiance = read_exr(flat.out / "truth" / view.radiance)["RGB"]
    np.testing.assert_array_equal(radiance, np.full((16, 16, 3), 0.25))
    assert read_mask(flat.out / "truth" / str(view.mask)).sum() == 4 * 16
    assert sum(1 for _ in read_video(flat.out / "clip.mp4")) == 12


@pytest.mark.parametrize("views", ["mono", "rig"])
def test_an_oracle_is_a_scene_that_is_marked_as_one(flat: SynthConfig, views: Views) -> None:
    synth(replace(flat, views=views))
    assert Manifest.load(flat.out / "oracle").rig == (9 if views == "rig" else 1)
    scene = Scene.open(flat.out / "oracle")
    assert {s.note for s in scene.manifest.steps.values()} == {"oracle: from truth"}
    assert [f.bracket for f in scene.train] == [0, 1, 2] * 4
    k = 5
    frame = scene.train[k]
    points = plane(16, 16, 3.0).points
    for side in (-1, 1):
        seen_at, _ = project(points, intrinsics(16, 16), INTERIOR.pose(views, k + side))
        exact = (seen_at - pixel_centers(16, 16))[:, 4:]  # columns of the static wall
        error = frame.flow[side].numpy()[:, 4:] - exact
        assert 0.2 < error.std() < 0.4 and abs(error.mean()) < 0.1  # 0.3 px of noise, no bias
    assert frame.disparity is not None
    assert float(frame.disparity.log().mean()) == pytest.approx(np.log(1 / 3), abs=0.03)


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
    synth(replace(flat, ev="0,-3", response="srgb"))  # another recording of the same pictures
    assert Flat.rendered == 12 + 16


def test_the_cameras_settings_are_in_the_truth_and_in_the_recording(flat: SynthConfig) -> None:
    """Without noise, a clip's frame is what the truth makes of the same radiance at the
    same bracket: gains, fall-off, curve and all.
    """
    synth(replace(flat, ev="0,-3", response="log", white_balance="2,1,0.5", vignetting=0.8))
    truth = Truth.open(flat.out / "truth")
    assert (truth.bracket_ev, truth.white_balance) == ([0, -3], [2, 1, 0.5])
    assert truth.vignetting == 0.8 and truth.settings is not None
    assert (truth.settings["name"], truth.settings["response"]) == ("interior", "log")
    _, pictures = true_pictures(truth, truth.views[0], flat.out / "truth")
    for bracket in (0, 1):
        recorded = read_image(flat.out / "clip" / f"{bracket:05d}.png")
        np.testing.assert_allclose(recorded, pictures[bracket], atol=0.51 / 255)
    assert pictures[1][8, 8, 1] > pictures[1][0, 0, 1] + 0.02  # darker in the corner


def test_a_lens_is_in_the_recording_and_not_in_the_held_out_views(flat: SynthConfig) -> None:
    synth(replace(flat, oracle=False))
    synth(replace(flat, oracle=False, lens="-0.1"))
    assert Flat.rendered == 12 + 16 + 12  # wider pictures of the clip alone
    assert Truth.open(flat.out / "truth").lens == [-0.1, 0]


def test_corners_are_as_dark_as_the_rays_that_a_lens_brings_there(
    flat: SynthConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verb, "lens_radiance", lambda *_: np.full((16, 16, 3), 0.9))
    config = replace(flat, ev="0", white_balance="1,1,1", vignetting=1.0, lens="-0.2", noise=0.0)
    K = intrinsics(16, 16)
    lens = Lens(K, (-0.2, 0, 0, 0), 16, 16)
    clip = clip_views(INTERIOR, 12, 1, 0)
    exposed = response_curve(config.response).invert(record_clip(clip, [0.0], K, config)[0])
    rays = pinhole.camera_rays(lens.undistort(pixel_centers(16, 16), K), K)
    np.testing.assert_allclose(exposed[..., 1], 0.9 / (rays**2).sum(-1) ** 2, atol=0.01)


def test_a_pixel_through_a_lens_has_the_radiance_of_its_bent_ray(monkeypatch) -> None:
    K = pinhole.intrinsics(60.0, 64, 48)
    lens = Lens(K, (-0.1, 0.0, 0.0, 0.0), 64, 48)
    wide_K, (width, height) = lens_canvas(K, (64, 48))
    rays = pinhole.camera_rays(pinhole.pixel_centers(height, width), wide_K)
    monkeypatch.setattr("hdr_nsff.synth.synth.exact", lambda out, view: {"RGB": rays + 1})
    view = TracedView("clip_00000", 0.0, np.eye(4)[:3], spp=4, seed=0, anchor=0)
    seen = lens_radiance(view, lens, Path("unused"))[..., :2] - 1
    pixels = pinhole.pixel_centers(48, 64)
    assert (
        np.abs(lens.bend(seen) - pinhole.camera_rays(pixels, K)[..., :2]).max() < 1e-3
    )  # a sixteenth of a pixel


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
        def radiance(self, *arguments: Any) -> np.ndarray:
            spp = arguments[4]
            now[0] += 2 + 0.1 * spp
            return super().radiance(*arguments)

    monkeypatch.setattr(verb.clock, "monotonic", lambda: now[0])
    views = [clip_views(INTERIOR, 12, 256, 0)[0], held_out_views(INTERIOR, 12, 768, 0)[0]]
    seconds = verb.estimate_seconds(Steady(), views, intrinsics(16, 16), (16, 16))
    assert seconds == pytest.approx(27.6 + 78.8)


def test_a_rig_lists_its_exposures_for_prepare(flat: SynthConfig) -> None:
    synth(replace(flat, views="rig"))
    for footage in ("clip.mp4", "clip"):
        table = read_exposure_csv(open_footage(flat.out / footage))
        assert table is not None and [table[1][f"#{t}"] for t in range(12)] == [-4, -2, 0] * 4


def test_the_poses_of_a_rig_are_in_its_truth_and_its_oracle(flat: SynthConfig) -> None:
    synth(replace(flat, views="rig"))
    poses = np.array([INTERIOR.pose("rig", t) for t in range(12)])
    np.testing.assert_allclose(np.array(Truth.open(flat.out / "truth").clip_c2w), poses)
    entries = Scene.open(flat.out / "oracle").manifest.frames
    np.testing.assert_allclose([entry.c2w for entry in entries], poses)


def test_an_oracle_of_other_settings_is_removed_and_one_of_the_same_is_kept(
    flat: SynthConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    synth(flat)
    plain = replace(flat, oracle=False)
    synth(plain)
    assert (flat.out / "oracle/scene.json").is_file()
    synth(replace(plain, ev="0,-3"))
    assert not (flat.out / "oracle").exists()
    assert "add --oracle to write it again" in " ".join(capsys.readouterr().err.split())
    write_text(flat.out / "oracle/notes.txt", "of somebody else")
    synth(plain)
    assert (flat.out / "oracle/notes.txt").is_file()


def test_an_oracle_knows_that_the_sky_is_far_away(
    flat: SynthConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a picture has a depth of 0: a disparity of 0, and no point."""

    class Open(Flat):
        def surface(
            self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int]
        ) -> Surface:
            wall = super().surface(t, K, c2w, size)
            sky = np.arange(size[1])[:, None] < 3
            return replace(wall, depth=np.where(sky, 0, wall.depth))

    monkeypatch.setattr(verb, "Tracer", Open)
    synth(flat)
    scene = Scene.open(flat.out / "oracle")
    assert (scene.near, scene.far) == pytest.approx((0.95 * 3, 1.05 * 3))
    disparity = scene.train[5].disparity
    assert disparity is not None
    assert (disparity[:3] == 0).all() and (disparity[3:] > 0.2).all()
    assert scene.points[:, 2].min() > 2


def test_a_killed_rig_continues_and_does_not_mix_with_one_camera(flat: SynthConfig) -> None:
    rig = replace(flat, views="rig")
    synth(rig)
    flow = rig.out / "oracle" / "flow" / "00003_00004.npy"
    before = read_npy(flow)
    (rig.out / "exact" / "clip_00003.exr").unlink()
    synth(rig)
    assert Flat.rendered == 12 + 16 + 1
    np.testing.assert_array_equal(read_npy(flow), before)
    with pytest.raises(InputError, match="other settings"):
        synth(flat)


@pytest.mark.parametrize(
    ("codec", "name"), [("hevc", "reference_pq.mp4"), ("av1", "reference_pq_av1.mp4")]
)
def test_hdr_references_hold_the_radiance_of_the_clip(
    flat: SynthConfig, codec: Codec, name: str
) -> None:
    config = replace(flat, size="64x64", hdr_video=("pq",), hdr_codec=codec)
    synth(config)
    stream, frames = decoded(flat.out / name)
    assert stream.codec_context.name == {"hevc": "hevc", "av1": "libdav1d"}[codec]
    assert len(frames) == flat.frames
    light = display_light(np.full((2, 2, 3), 0.18), 1.0, "pq")  # an even wall is mid gray
    expected = ycbcr_planes(encode(light, "pq"))[0][0, 0]
    assert abs(float(np.median(luma(frames[1]))) - expected) <= 4
    synth(replace(config, hdr_video=(), hdr_still=("ultrahdr", "png16")))  # the same problem
    stills = flat.out / "reference"
    assert len(list(stills.glob("*"))) == 2 * flat.frames
    found = decode((stills / "00001_ultrahdr.jpg").read_bytes())
    assert np.allclose(np.median(found, (0, 1)), 0.18, rtol=0.03)


def test_hdr_references_of_too_small_frames_are_refused_before_rendering(
    flat: SynthConfig,
) -> None:
    before = Flat.rendered
    with pytest.raises(InputError, match="an HDR encoder takes at least 64"):
        synth(replace(flat, hdr_video=("pq",)))
    assert Flat.rendered == before
