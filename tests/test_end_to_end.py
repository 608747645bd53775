"""The one job, from frames to report, on the CPU: `run` once on a small clip whose
radiance is known in closed form, then every other verb on what it made.
"""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from toy_scene import WALL, ToyScene, camera_center

from hdr_nsff import cli
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.io import read_npy, write_npy
from hdr_nsff.core.video import read_video
from hdr_nsff.pipeline import finish_scene
from hdr_nsff.rendering.shot_views import filmed_frames
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.training.budget import Budget
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run

FRAMES, WIDTH, HEIGHT = 14, 112, 64
EXPOSURES = (0.0, -1.5, -3.0)  # EV; the brightest clips a little
CPU = ["--device", "cpu"]


def made_scene() -> ToyScene:
    """The wall and the card with softer textures, so that neighboring frames can be
    matched.
    """
    scene = ToyScene(WIDTH, HEIGHT, FRAMES)
    soft = [cv2.GaussianBlur(t, (0, 0), 3.0) for t in scene.textures]
    scene.textures = [np.clip((t - t.mean()) * 3 + 0.5, 0.02, 1).astype(np.float32) for t in soft]
    return scene


def write_clip(folder: Path) -> list[str]:
    """Frames in alternating exposures, their cameras in the LLFF layout (two planes are
    too little for structure from motion); the command.
    """
    scene, rows = made_scene(), []
    for t in range(FRAMES):
        radiance, _, _ = scene.see(t)
        exposure = radiance * 2.0 ** EXPOSURES[t % 3]
        write_png(folder / f"frames/{t:05d}.png", np.clip(exposure, 0, 1) ** (1 / 2.2))
        x, y, z = camera_center(t)
        # Columns: down, right, back, center, (height, width, focal length).
        matrix = [[0, 1, 0, x, HEIGHT], [1, 0, 0, y, WIDTH], [0, 0, -1, z, scene.f]]
        rows.append([*np.ravel(matrix), 1.8, 5.0])
    write_npy(folder / "poses_bounds.npy", np.array(rows))
    ev = ",".join(f"{e:g}" for e in EXPOSURES)
    options = ["--ev", ev, "--preset", "tiny", "--poses", str(folder / "poses_bounds.npy")]
    return ["run", str(folder / "frames"), str(folder / "out"), *options, *CPU]


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command, done once."""
    arguments = write_clip(tmp_path_factory.mktemp("a clip, é"))
    cli.main(arguments)
    return arguments


@pytest.fixture
def out(command: list[str]) -> Path:
    """What it made."""
    return Path(command[2])


def stamps(folder: Path) -> dict[str, int]:
    """When every file was last written."""
    files = [p for p in folder.rglob("*") if p.is_file()]
    return {p.relative_to(folder).as_posix(): p.stat().st_mtime_ns for p in files}


def test_the_scene_is_what_was_filmed(out: Path) -> None:
    m = Manifest.load(out / "scene")
    assert len(m.frames) == FRAMES and m.cycle == 3 and m.parallax == "full" and m.exposure_given
    assert [f.bracket for f in m.frames[:4]] == [0, 1, 2, 0]
    assert sum(f.split == "test" for f in m.frames) == 2
    assert np.allclose(np.diff([e for e in m.bracket_ev if e is not None]), -1.5)
    scene = made_scene()
    for f in m.frames[4:8]:
        if f.disparity is not None:
            _, moving, _ = scene.see(f.time)
            disparity = np.asarray(read_npy(out / "scene" / f.disparity), np.float32)
            assert abs(float(np.median(disparity[~moving])) * WALL - 1) < 0.1


def test_radiance_is_linear_unclipped_and_at_the_right_scale(out: Path) -> None:
    run, scene = Run.open(out / "run"), made_scene()
    files = sorted((out / "render/training").glob("*.exr"))
    frames = filmed_frames(run)  # those held out too
    assert len(files) == len(frames) == 14 and len(run.scene.train) == 12
    # Radiance 1 saturates the reference exposure.
    unit = 2.0 ** EXPOSURES[run.scene.manifest.reference_bracket]
    for path, frame in list(zip(files, frames, strict=True))[2:12]:
        channels = read_exr(path)
        assert channels["RGB"].shape == (HEIGHT, WIDTH, 3) and float(channels["RGB"].min()) >= 0
        truth = scene.see(frame.time)[0] * unit
        ratio = channels["RGB"] / truth
        assert 0.8 < float(np.median(ratio)) < 1.25
        error, flat = np.abs(channels["RGB"] - truth).mean(), np.abs(truth - truth.mean()).mean()
        assert error < 0.75 * flat, "no better than one gray"
        assert float(channels["motion"].min()) >= 0 and float(channels["motion"].max()) <= 1
        assert abs(float(np.median(channels["Z"])) / WALL - 1) < 0.15


def test_videos_play(out: Path) -> None:
    for name, at_least in (("training", 12), ("fixed", 12), ("bullet", 10), ("slowmo", 20)):
        frames = [rgb for rgb, _ in read_video(out / f"render/{name}.mp4")]
        assert len(frames) >= at_least and frames[0].shape[:2] == (HEIGHT, WIDTH)
        assert 0.02 < float(np.mean(frames)) < 0.98 and float(np.std(frames[0])) > 0.02


def test_ldr_views_depth_and_scene_flow_are_there_for_every_frame(out: Path) -> None:
    brightness = [
        np.mean([read_image(p).mean() for p in folder.glob("*.png")])
        for folder in sorted((out / "render/ldr").iterdir())
    ]
    assert len(brightness) == 3 and max(brightness) > 1.5 * min(brightness)
    for name in ("depth", "scene_flow"):
        assert len(list((out / "render" / name).glob("*.png"))) == 14


def test_held_out_frames_are_predicted_better_than_by_one_gray(out: Path) -> None:
    metrics = json.loads((out / "run/metrics.json").read_text())
    assert metrics["headline"]["views"] == 2 and metrics["kind"] == "held-out frames"
    test = Run.open(out / "run").scene.test
    gray = np.mean([-10 * np.log10(float(f.image.var(unbiased=False))) for f in test])
    assert metrics["headline"]["psnr"] > gray + 1


def test_the_report_is_one_self_contained_page(out: Path) -> None:
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/") >= 5 and "PSNR" in page
    for attribute, scheme in product(("src", "href"), ("http:", "https:", "file:", "/")):
        assert f'{attribute}="{scheme}' not in page


def test_the_same_command_again_redoes_nothing(command: list[str], out: Path) -> None:
    before = stamps(out)
    cli.main(command)
    after = stamps(out)
    redone = {p for p in before if after[p] != before[p]}
    assert before.keys() <= after.keys()
    assert not {p for p in redone if p.endswith((".exr", ".mp4", ".npy", ".safetensors"))}, redone


def test_the_other_verbs_work_on_what_run_made(
    out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(out / "run")
    scene, page = str(out / "scene"), tmp_path / "again.html"
    half = ["--path", "fixed", "--scale", "0.5", "--out", str(tmp_path / "fixed")]
    cli.main(["train", "tiny", "--scene", scene, "--out", run, *CPU])  # finished already
    cli.main(["render", run, *half, *CPU])
    picture = read_exr(next((tmp_path / "fixed").rglob("*.exr")))["RGB"]
    assert picture.shape == (HEIGHT // 2, WIDTH // 2, 3)
    cli.main(["evaluate", run, *CPU])
    cli.main(["report", run, "--out", str(page), "--renders", str(out / "render")])
    assert page.stat().st_size > 50_000
    cli.main(["reexpose", str(out / "render/slowmo.mp4"), str(tmp_path / "problem")])
    assert len(list((tmp_path / "problem/clip").glob("*.png"))) >= 20
    assert list((tmp_path / "problem/truth/radiance").glob("*.exr"))


def psnr_of(run: Path) -> float:
    """The score of an evaluated run."""
    return json.loads((run / "metrics.json").read_text())["headline"]["psnr"]


def test_gaussians_of_the_same_scene_are_closer_to_it_and_move_between_frames(
    out: Path, tmp_path: Path
) -> None:
    """They also have a page to look around in, which the report links to."""
    run = tmp_path / "run"
    places = {"scene": out / "scene", "out": run, "device": "cpu"}
    settings = replace(PRESETS["splat"], budget=Budget(steps=250, minutes=None), **places)
    made = finish_scene(settings, None)
    assert made["viewer"] == tmp_path / "scene.html" and (tmp_path / "scene.html").is_file()
    assert 'href="scene.html"' in (tmp_path / "report.html").read_text()
    assert psnr_of(run) > psnr_of(out / "run") + 1
    cli.main(["render", str(run), "--path", "slowmo", "--factor", "2", "--no-video", *CPU])
    moving = [read_exr(p)["motion"] for p in sorted((run / "render/slowmo").glob("*.exr"))[4:9]]
    columns = [float((m * np.arange(m.shape[1])).sum() / m.sum()) for m in moving]
    assert all(m.max() > 0.5 for m in moving) and columns == sorted(columns), (
        "the card moves to the right, half frames between"
    )
