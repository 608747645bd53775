"""What `prepare` does where structure from motion finds a lens."""

from dataclasses import replace

import numpy as np
import pytest
from posed_clips import FOCAL, PLACES, H, K, W, sliding

from hdr_nsff.core.images import read_image, read_mask, write_png
from hdr_nsff.core.io import read_npy, write_npy
from hdr_nsff.geometry import pinhole
from hdr_nsff.geometry.lens import (
    Lens,
    distorted_picture,
    undistorted_flow,
    undistorted_picture,
    undistortion,
)
from hdr_nsff.prepare.prepare import STEPS, begin
from hdr_nsff.prepare.table import run_steps
from hdr_nsff.prepare.undistort import UNDISTORTED_FLOW
from hdr_nsff.prepare.work import PrepareConfig
from hdr_nsff.scene.manifest import Manifest

LENS = Lens(K, (0.15, 0.0, 0.0, 0.0), W, H)
UP_TO_POSES = {name: STEPS[name] for name in ("frames", "exposure", "flow", "poses")}


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """A clip that the lens records, as frames."""
    folder = tmp_path_factory.mktemp("bent")
    for t, picture in enumerate(sliding(PLACES)):
        write_png(folder / f"{t}.png", distorted_picture(picture, K, LENS))
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory, footage):
    """That clip, prepared up to its poses, and its manifest."""
    folder = tmp_path_factory.mktemp("scene")
    run_steps(begin(PrepareConfig(footage, folder)), UP_TO_POSES)
    return folder, Manifest.load(folder)


@pytest.mark.parametrize("k1", [0.15, -0.15])
def test_flow_is_what_the_pinhole_camera_would_have_seen(k1):
    lens = Lens(K, (k1, 0.0, 0.0, 0.0), W, H)
    shift = np.array([6.0, -3.0])  # of undistorted pictures
    straight = lens.pinhole()
    recorded = pinhole.pixel_centers(H, W)
    target = lens.distort(lens.undistort(recorded, straight) + shift, straight)
    valid = ((target >= 0) & (target <= [W, H])).all(-1)
    flow, kept = undistorted_flow(target - recorded, valid, lens, undistortion(lens))
    assert 0.8 < kept.mean() < 0.97
    assert np.abs(flow[kept] - shift).max() < 0.02
    ends = pinhole.pixel_centers(H, W) + shift
    outside = ((ends < 0) | (ends > [W, H])).any(-1)
    assert outside.any() and not kept[outside].any()


def test_the_scene_is_that_of_undistorted_frames(scene, footage):
    folder, m = scene
    lens = m.lens[0].lens()
    assert lens.max_displacement_px() == pytest.approx(LENS.max_displacement_px(), rel=0.25)
    straight = undistorted_picture(read_image(footage / "2.png"), lens)
    assert np.abs(read_image(folder / m.frames[2].image) - straight).max() < 3e-3
    focal = m.frames[0].K[0][0]
    assert focal == pytest.approx(FOCAL, rel=0.1)
    assert all(m.steps[name].done for name in UP_TO_POSES) and not (folder / "raw_flow").exists()


def test_the_flow_of_static_points_agrees_with_the_poses(scene):
    folder, m = scene
    K_of, c2w = (np.array([getattr(f, name) for f in m.frames]) for name in ("K", "c2w"))
    sightings = read_npy(folder / "poses/sightings.npy")
    points = read_npy(folder / str(m.points))[sightings[sightings[:, 0] == 3, 1]]
    start, _ = pinhole.project(points, K_of[3], c2w[3])
    end, _ = pinhole.project(points, K_of[4], c2w[4])
    x, y = start.astype(int).T
    flow = read_npy(folder / m.frames[3].raw_flow[4].flow)[y, x]
    assert np.median(np.linalg.norm(flow - (end - start), axis=-1)) < 0.5


def test_a_command_that_is_stopped_meanwhile_ends_at_the_same(scene, footage, tmp_path):
    def stopped(work):
        raise KeyboardInterrupt

    calls = []

    def frames(work):
        calls.append(work)
        return stopped(work) if len(calls) == 2 else STEPS["frames"].run(work)

    interrupted = {**UP_TO_POSES, "frames": replace(STEPS["frames"], run=frames)}
    config = PrepareConfig(footage, tmp_path / "scene")
    with pytest.raises(KeyboardInterrupt):
        run_steps(begin(config), interrupted)
    assert (config.out / UNDISTORTED_FLOW).is_dir() and Manifest.load(config.out).lens
    no_flow = {**UP_TO_POSES, "flow": replace(STEPS["flow"], run=stopped)}
    run_steps(begin(config), no_flow)  # it is there
    m, expected = Manifest.load(config.out), scene[1]
    for f, g in zip(m.frames, expected.frames, strict=True):
        assert np.allclose(f.c2w, g.c2w, atol=1e-6) and np.allclose(f.K, g.K)
    nothing = {name: replace(step, run=stopped) for name, step in UP_TO_POSES.items()}
    run_steps(begin(config), nothing)  # all is done


def test_frames_that_are_redone_start_over_once_and_their_flow_never(footage, tmp_path):
    begun = []

    def counted(name):
        def run(work):
            begun.append(name)
            return STEPS[name].run(work)

        return replace(STEPS[name], run=run)

    config = PrepareConfig(footage, tmp_path / "scene", redo=("frames",))
    run_steps(begin(config), {name: counted(name) for name in UP_TO_POSES})
    once_more = ["frames", "exposure", "poses"]
    assert begun == [*UP_TO_POSES, *once_more]
    assert (config.out / UNDISTORTED_FLOW).is_dir()


def test_given_maps_are_undistorted_like_the_frames_whenever_they_are_read(tmp_path):
    square = np.zeros((H, W), bool)
    square[4:20, 6:26] = True
    for t, picture in enumerate(sliding(PLACES[:4])):
        picture = np.where(square[..., None], (1, 0, 0), picture / 2)
        write_png(tmp_path / f"clip/{t}.png", picture)
        write_png(tmp_path / f"masks/{t}.png", square)
        write_npy(tmp_path / f"depth/{t}.npy", np.where(square, 2.0, 4.0).astype(np.float32))
        for j in range(4):
            flow = np.where(square[..., None], [6.0, 3.0], 0).astype(np.float32)
            write_npy(tmp_path / f"flow/{t:05d}_{j:05d}.npy", flow)
    folders = {name: tmp_path / name for name in ("masks", "depth", "flow")}
    config = PrepareConfig(
        tmp_path / "clip", tmp_path / "scene", tripod=True, lens_distortion="-0.3", **folders
    )  # the lens is known after the flow has been read
    steps = {name: STEPS[name] for name in (*UP_TO_POSES, "masks", "static_depth")}
    run_steps(begin(config), steps)
    late = read_npy(config.out / Manifest.load(config.out).frames[1].raw_flow[2].flow)
    run_steps(begin(replace(config, redo=("flow",))), steps)
    f = Manifest.load(config.out).frames[1]
    r, g, _ = np.moveaxis(read_image(config.out / f.image), -1, 0)
    red = r - g > 0.5
    assert (red ^ square).sum() > 50
    for found in (
        read_mask(config.out / str(f.mask)),
        read_npy(config.out / str(f.static_disparity)) > 0.3,
        np.linalg.norm(late, axis=-1) > 3,
    ):
        assert (found & red).sum() > 0.95 * (found | red).sum()
    assert set(np.unique(read_npy(config.out / str(f.static_disparity)))) == {0.25, 0.5}
    assert np.array_equal(read_npy(config.out / f.raw_flow[2].flow), late)
