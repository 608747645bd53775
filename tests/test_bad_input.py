"""Bad input at the command line's door, verb by verb: exit code 2, one sentence that names the place, never a traceback, and nothing
that was there is lost. What each part of the library refuses by itself is tested beside it."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from safetensors.torch import save_file
from toy_scene import ToyScene, camera_centre

from hdr_nsff import cli, io
from hdr_nsff.run import Run, latest_checkpoint
from hdr_nsff.scene import Scene

Capture = pytest.CaptureFixture[str]
FRAMES = 9


def call(*arguments: object) -> int:
    """Exit code of the command line."""
    try:
        cli.main([str(a) for a in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def refused(capsys: Capture, *arguments: object) -> str:
    """The one sentence with which the command line refuses."""
    capsys.readouterr()
    assert call(*arguments) == 2, arguments
    error = capsys.readouterr().err
    said = [line for line in error.splitlines() if line.startswith("hdr-nsff: ")]
    assert "Traceback" not in error and len(said) == 1 and error.strip().endswith(said[0]) and len(said[0]) < 600, error
    return said[0]


def snapshot(folder: Path) -> dict[Path, bytes]:
    """All files below `folder` with their contents."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def recorded(count: int = FRAMES) -> list[np.ndarray]:
    """The toy scene in three exposures."""
    scene = ToyScene(frames=count)
    return [np.clip(scene.see(t)[0] * 2.0 ** (-1.5 * (t % 3)), 0, 1) ** (1 / 2.2) for t in range(count)]


def clip(folder: Path, pictures: list[np.ndarray] | None = None) -> Path:
    """A folder of PNG frames."""
    for t, picture in enumerate(recorded() if pictures is None else pictures):
        io.write_png(folder / f"{t:03d}.png", picture)
    return folder


def poses(path: Path, count: int = FRAMES) -> Path:
    """The cameras of the toy scene as LLFF writes them."""
    s, rows = ToyScene(), []
    for t in range(count):
        x, y, z = camera_centre(t)
        pose = np.array([[0, 1, 0, x, s.height], [1, 0, 0, y, s.width], [0, 0, -1, z, s.f]])  # columns: down, right, back
        rows.append([*pose.ravel(), 1.8, 5.0])
    io.write_npy(path, np.array(rows))
    return path


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.fixture(scope="module")
def finished(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps with its own copy of the scene."""
    out = tmp_path_factory.mktemp("a run, é 日")
    shutil.copytree(toy_folder, out / "scene")
    assert call(*training(out / "scene", out / "run", 2)) == 0
    return out


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy to damage, scene and all."""
    shutil.copytree(finished, tmp_path / "ü b")
    config = json.loads((tmp_path / "ü b/run/config.json").read_text())
    (tmp_path / "ü b/run/config.json").write_text(json.dumps({**config, "scene": str(tmp_path / "ü b/scene")}))
    return tmp_path / "ü b/run"


def training(scene: Path, out: Path, steps: int) -> list[object]:
    few = ["--field.samples", 8, "--field.render-samples", 8, "--rays", 64]
    return ["train", "tiny", "--scene", scene, "--out", out, "--steps", steps, "--device", "cpu", *few]


def small_view(run: Path, out: Path) -> list[object]:
    return ["render", run, "--path", "fixed", "--scale", 0.3, "--out", out, "--device", "cpu"]


# Missing and empty


@pytest.mark.parametrize("verb", ["run", "prepare", "reexpose"])
def test_missing_and_empty_footage(verb: str, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty.mp4").touch()
    for name, word in (("nowhere", "no such file or folder"), ("empty", "no frames"), ("empty.mp4", "is empty")):
        assert word in refused(capsys, verb, tmp_path / name, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("verb", ["render", "evaluate", "report"])
def test_a_missing_and_an_empty_run(verb: str, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("nowhere", "empty"):
        assert "not a run folder" in refused(capsys, verb, tmp_path / name)
    assert not (tmp_path / "nowhere").exists() and not list((tmp_path / "empty").iterdir())


def test_what_an_option_names_must_be_there(run: Path, tmp_path: Path, capsys: Capture) -> None:
    footage, nowhere = clip(tmp_path / "clip"), tmp_path / "nowhere"
    for option in ("--poses", "--flow", "--masks", "--depth"):
        assert option in refused(capsys, "prepare", footage, tmp_path / "out", option, nowhere)
    for verb, option in (("run", "--poses"), ("run", "--truth"), ("reexpose", "--poses"), ("reexpose", "--masks")):
        assert str(nowhere) in refused(capsys, verb, footage, tmp_path / "out", option, nowhere)
    assert "truth.json" in refused(capsys, "run", footage, tmp_path / "out", "--truth", footage)
    assert "truth.json" in refused(capsys, "evaluate", run, "--truth", nowhere)
    assert "--renders" in refused(capsys, "report", run, "--renders", nowhere)
    assert str(nowhere) in refused(capsys, "render", run, "--path", f"{nowhere}.json")
    assert not (tmp_path / "out").exists()


# Footage that cannot be


def one_bad(folder: Path, damage: Callable[[Path], object], suffix: str = ".png") -> Path:
    """Frames, the fifth of them damaged."""
    for t, picture in enumerate(recorded()):
        name = folder / f"{t:03d}{suffix}"
        io.write_png(name, picture) if suffix == ".png" else io.write_exr(name, {"RGB": picture})
    damage(folder / f"004{suffix}")
    return folder


def exr_with(value: float) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        pixels = np.full((34, 60, 3), 0.5, np.float32)
        pixels[3, 5, 1] = value
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGB": pixels}) as file:
            file.write(str(path))

    return damage


def text_video(folder: Path) -> Path:
    folder.mkdir()
    (folder / "notes.mp4").write_text("not a film\n" * 100)
    return folder / "notes.mp4"


def cut_video(folder: Path) -> Path:
    io.write_video(folder / "clip.mp4", recorded(20))
    cut(folder / "clip.mp4")
    return folder / "clip.mp4"


FOOTAGE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a text file named mp4": (text_video, "not a readable video"),
    "a video cut short": (cut_video, "cut short"),
    "a PNG cut short": (lambda p: one_bad(p, cut), "004.png: the PNG is cut short"),
    "a text file named PNG": (lambda p: one_bad(p, lambda f: f.write_text("no picture")), "004.png"),
    "an empty PNG": (lambda p: one_bad(p, lambda f: f.write_bytes(b"")), "004.png"),
    "an EXR cut short": (lambda p: one_bad(p, cut, ".exr"), "004.exr"),
    "a text file named EXR": (lambda p: one_bad(p, lambda f: f.write_text("no picture"), ".exr"), "004.exr: not a readable EXR"),
    "NaN in an EXR": (lambda p: one_bad(p, exr_with(np.nan), ".exr"), "NaN or Inf"),
    "Inf in an EXR": (lambda p: one_bad(p, exr_with(np.inf), ".exr"), "NaN or Inf"),
    "negative radiance": (lambda p: one_bad(p, exr_with(-0.5), ".exr"), "004.exr: negative radiance"),
    "one frame": (lambda p: clip(p, recorded(1)), "1 frame "),
    "two frames": (lambda p: clip(p, recorded(2)), "2 frames "),
    "frames of two sizes": (lambda p: one_bad(p, lambda f: io.write_png(f, np.full((30, 60, 3), 0.5))), "004.png: 60x30 pixels"),
    "all black": (lambda p: clip(p, [np.zeros((34, 60, 3))] * FRAMES), "all frames are black"),
    "all white": (lambda p: clip(p, [np.ones((34, 60, 3))] * FRAMES), "all frames are white"),
}


@pytest.mark.parametrize("verb", ["run", "prepare", "reexpose"])
@pytest.mark.parametrize("what", FOOTAGE)
def test_footage_that_cannot_be_is_named(what: str, verb: str, tmp_path: Path, capsys: Capture) -> None:
    make, expected = FOOTAGE[what]
    footage = make(tmp_path / "ein clip ü")
    before = snapshot(tmp_path)
    assert expected in refused(capsys, verb, footage, tmp_path / "out")
    after = snapshot(tmp_path)
    assert all(after[p] == contents for p, contents in before.items()) and not list(tmp_path.rglob(".partial-*"))


def test_nothing_but_the_sentence_is_printed_for_an_exr_cut_short(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    footage = one_bad(tmp_path / "clip", cut, ".exr")
    assert call("prepare", footage, tmp_path / "scene") == 2
    assert len(capfd.readouterr().err.strip().splitlines()) == 1  # OpenEXR has words of its own for it


# Exposures


@pytest.mark.parametrize("verb", ["run", "prepare"])
def test_exposures_that_cannot_be(verb: str, tmp_path: Path, capsys: Capture) -> None:
    footage, out = clip(tmp_path / "clip", recorded(24)), tmp_path / "out"
    assert "divides by zero" in refused(capsys, verb, footage, out, "--exposures", "1/1000,1/0")
    assert "is not a number" in refused(capsys, verb, footage, out, "--ev=0,dark")
    assert not out.exists()
    assert "2 exposures listed" in refused(capsys, verb, footage, out, "--ev=0,-1.5")


@pytest.mark.parametrize("value", ["1/0", "nan", "dark", ""])
def test_exposures_that_cannot_be_made(value: str, tmp_path: Path, capsys: Capture) -> None:
    assert "--ev" in refused(capsys, "reexpose", clip(tmp_path / "clip"), tmp_path / "out", f"--ev={value},0")
    assert "--ev" in refused(capsys, "synth", tmp_path / "out", f"--ev={value},0")
    assert not (tmp_path / "out").exists()


# Paths


def test_a_name_that_is_no_text_is_refused_and_shown(tmp_path: Path, capsys: Capture) -> None:
    assert "UTF-8" in refused(capsys, "prepare", clip(tmp_path / "clip"), f"{tmp_path}/sc\udcffne")
    footage = clip(tmp_path / "other")
    (footage / "004.png").rename(footage / "004\udcff.png")
    assert "UTF-8" in refused(capsys, "prepare", footage, tmp_path / "scene")


@pytest.mark.parametrize("place", ["file", "file/below", "y" * 300])
@pytest.mark.parametrize("verb", ["run", "prepare", "train", "render", "report", "reexpose", "synth"])
def test_a_place_that_cannot_be_written_is_named(verb: str, place: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").write_text("mine")
    footage, out = clip(tmp_path / "clip", recorded(3)), tmp_path / place
    commands: dict[str, list[object]] = {
        "run": ["run", footage, out],
        "prepare": ["prepare", footage, out],
        "train": training(run.parent / "scene", out, 1),
        "render": small_view(run, out),
        "report": ["report", run, "--out", out],
        "reexpose": ["reexpose", footage, out],
        "synth": ["synth", out],
    }
    assert place.partition("/")[0][:40] in refused(capsys, *commands[verb])
    assert (tmp_path / "file").read_text() == "mine"


# Output that is there already


def test_a_report_replaces_reports_only(run: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "thesis.html").write_text("<p>mine</p>")
    assert "no report" in refused(capsys, "report", run, "--out", tmp_path / "thesis.html")
    assert (tmp_path / "thesis.html").read_text() == "<p>mine</p>"
    assert "is a folder" in refused(capsys, "report", run, "--out", tmp_path)
    for _ in range(2):
        assert call("report", run, "--out", tmp_path / "report.html") == 0


@pytest.mark.parametrize("name", ["fixed.mp4", "fixed/00001.png", "fixed/7.exr", "fixed_sheet.png"])
def test_pictures_of_the_users_own_are_not_replaced(name: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    io.write_text(tmp_path / "mine" / name, "mine")
    assert name in refused(capsys, *small_view(run, tmp_path / "mine"))
    assert snapshot(tmp_path / "mine") == {tmp_path / "mine" / name: b"mine"}


def test_the_standard_set_replaces_no_depth_maps_of_the_users_own(run: Path, tmp_path: Path, capsys: Capture) -> None:
    io.write_text(tmp_path / "mine/depth/00000.png", "mine")
    assert "depth" in refused(capsys, "render", run, "--out", tmp_path / "mine", "--device", "cpu")
    assert snapshot(tmp_path / "mine") == {tmp_path / "mine/depth/00000.png": b"mine"}


def test_footage_is_not_prepared_over_another_scene(toy_folder: Path, tmp_path: Path, capsys: Capture) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "out/scene")  # it was not made by `prepare`: none of its steps is done
    before = snapshot(tmp_path / "out")
    footage = clip(tmp_path / "clip")
    assert "other footage" in refused(capsys, "prepare", footage, scene)
    assert "other footage" in refused(capsys, "run", footage, tmp_path / "out")
    assert snapshot(tmp_path / "out") == before


def test_a_run_with_other_settings_stays_as_it_is(run: Path, capsys: Capture) -> None:
    before = snapshot(run)
    assert "other settings" in refused(capsys, *training(run.parent / "scene", run, 3))
    assert snapshot(run) == before


# A full disk


def full(handle: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("verb", ["run", "prepare", "train", "render", "evaluate", "report", "reexpose", "synth"])
def test_a_full_disk_is_one_sentence(
    verb: str, run: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    footage, out = clip(tmp_path / "clip", recorded(3)), tmp_path / "out"
    commands: dict[str, list[object]] = {
        "run": ["run", footage, out],
        "prepare": ["prepare", footage, out],
        "train": training(run.parent / "scene", out, 1),
        "render": small_view(run, out),
        "evaluate": ["evaluate", run, "--device", "cpu"],
        "report": ["report", run, "--out", out / "report.html"],
        "reexpose": ["reexpose", footage, out],
        "synth": ["synth", out],
    }
    before = snapshot(run)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert "the disk is full" in refused(capsys, *commands[verb])
    assert not snapshot(out) and snapshot(run) == before


def test_a_disk_that_fills_up_in_the_middle_of_a_map_is_said_to_be_full(tmp_path: Path) -> None:
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(io.InputError, match="the disk is full"), io.writing_to(tmp_path):
            io.write_npy(tmp_path / "map.npy", np.zeros(500))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


FAILING = """
import gc, pathlib, sys
import numpy as np
from hdr_nsff import io

def broken(self, data):
    view = memoryview(data)
    raise OSError(28, "No space left on device")

gc.disable()
pathlib.Path.write_bytes = broken
try:
    io.write_npy(sys.argv[1], np.zeros(50))
except OSError as error:
    error.itself = error  # a cycle: what the traceback holds is left to the collector
gc.collect()
"""


def test_a_map_that_could_not_be_written_leaves_nothing_that_crashes_python_later(tmp_path: Path) -> None:
    path = os.pathsep.join([str(Path(cli.__file__).parents[1]), *sys.path])
    command = [sys.executable, "-c", FAILING, str(tmp_path / "map.npy")]
    assert subprocess.run(command, env=os.environ | {"PYTHONPATH": path}).returncode == 0


# Ctrl-C


@pytest.mark.parametrize("verb", ["prepare", "render", "evaluate", "reexpose"])
def test_ctrl_c_loses_nothing_and_the_same_command_goes_on(
    verb: str, run: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    footage, out, sync = clip(tmp_path / "clip"), tmp_path / "out", os.fsync
    commands: dict[str, list[object]] = {
        "prepare": ["prepare", footage, out, "--poses", poses(tmp_path / "poses_bounds.npy")],
        "render": small_view(run, out),
        "evaluate": ["evaluate", run, "--device", "cpu"],
        "reexpose": ["reexpose", footage, out],
    }
    calls: list[int] = []

    def interrupted(handle: int) -> None:
        calls.append(handle)
        if len(calls) == 6:
            raise KeyboardInterrupt
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupted)
        assert call(*commands[verb]) == 130
    error = capsys.readouterr().err
    assert "Traceback" not in error and "the same command goes on where it was" in error
    kept = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.suffix in (".png", ".exr", ".npy")}
    assert not list(tmp_path.rglob(".partial-*"))
    assert call(*commands[verb]) == 0
    pictures = [p for p in kept if verb != "evaluate" or p.suffix != ".png"]  # which draws its comparisons anew
    assert pictures and all(p.stat().st_mtime_ns == kept[p] for p in pictures)


def test_ctrl_c_while_the_libraries_load_leaves_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "tyro.py").write_text("raise KeyboardInterrupt\n")
    path = os.pathsep.join([str(tmp_path), str(Path(cli.__file__).parents[1])])
    command = [sys.executable, "-c", "from hdr_nsff.cli import main; main()", "prepare", "a", "b"]
    result = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
    assert result.returncode == 130 and result.stderr == ""


# Checkpoints


def other_version(path: Path) -> None:
    import torch

    save_file({"a": torch.ones(1)}, path, metadata={"format": "hdr-nsff checkpoint 99", "step": "2", "seconds": "0"})


@pytest.mark.parametrize("damage", [cut, other_version])
def test_a_bad_checkpoint_gives_way_to_the_one_before_for_every_verb(
    damage: Callable[[Path], None], run: Path, tmp_path: Path, capsys: Capture
) -> None:
    checkpoints = sorted((run / "checkpoints").glob("step_*"))
    damage(checkpoints[-1])
    verbs: list[list[object]] = [["report", run], ["evaluate", run, "--device", "cpu"], small_view(run, tmp_path / "out")]
    for command in [*verbs, training(run.parent / "scene", run, 2)]:
        capsys.readouterr()
        assert call(*command) == 0
        said = " ".join(capsys.readouterr().err.split())
        assert "going on from the one before, step 0" in said and checkpoints[-1].name in said
    found = latest_checkpoint(run)
    assert found is not None and found.step == 2  # training made it again
    for path in (run / "checkpoints").iterdir():
        damage(path)
    before = snapshot(run)
    for command in [*verbs, training(run.parent / "scene", run, 2)]:
        assert "no readable checkpoint" in refused(capsys, *command)
    assert snapshot(run) == before


# scene.json edited by hand


def edit(scene: Path, change: Callable[[dict], object]) -> None:
    data = json.loads((scene / "scene.json").read_text())
    change(data)
    (scene / "scene.json").write_text(json.dumps(data))


EDITS: dict[str, tuple[Callable[[dict], object], str]] = {
    "a word for a width": (lambda d: d.update(width="wide"), "width"),
    "a held-out frame in no bracket": (lambda d: d["frames"][3].update(split="test", bracket=9), "bracket 9"),
    "a pose with NaN": (lambda d: d["frames"][3].update(c2w=[[float("nan")] * 4] * 3), "frames.3.c2w"),
    "no focal length": (lambda d: d["frames"][3].update(K=[[0, 0, 30], [0, 0, 17], [0, 0, 1]]), "frame 3 has a K"),
    "near beyond far": (lambda d: d.update(near=9.0), "near 9 and far 5"),
    "two frames of one index": (lambda d: d["frames"][3].update(index=2), "same index"),
    "a file outside the folder": (lambda d: d["frames"][3].update(image="../clip/003.png"), "outside the scene folder"),
}


@pytest.mark.parametrize("what", EDITS)
def test_every_verb_that_reads_a_scene_names_what_is_wrong_in_it(what: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    change, expected = EDITS[what]
    scene, footage = run.parent / "scene", clip(tmp_path / "clip")
    edit(scene, change)
    before = snapshot(tmp_path)
    assert expected in refused(capsys, *training(scene, tmp_path / "new", 1))
    assert expected in refused(capsys, "prepare", footage, scene)
    assert expected in refused(capsys, "run", footage, run.parent)
    for command in (small_view(run, tmp_path / "new"), ["evaluate", run], ["report", run]):
        assert expected in refused(capsys, *command)
    assert snapshot(tmp_path) == before


def test_a_prepared_scene_whose_frames_are_out_of_order_is_not_built_on(
    toy_folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "scene")
    edit(scene, lambda d: d["frames"].reverse())
    assert "out of order" in refused(capsys, "prepare", clip(tmp_path / "clip"), scene)
    assert len(Scene.open(scene).train) == 6  # which is nothing to training


def test_missing_maps_and_maps_of_the_wrong_size(run: Path, tmp_path: Path, capsys: Capture) -> None:
    scene = run.parent / "scene"
    commands: list[list[object]] = [training(scene, tmp_path / "new", 1), small_view(run, tmp_path / "new"), ["report", run]]
    for name, wrong in (("masks/00002.png", np.zeros((9, 60))), ("flow/00002_00003.npy", np.zeros((9, 60, 2)))):
        kept = (scene / name).read_bytes()
        (io.write_png if name.endswith("png") else io.write_npy)(scene / name, wrong)
        assert all(name in said and "shape (9, 60" in said for said in (refused(capsys, *c) for c in commands))
        (scene / name).unlink()
        assert all(name in refused(capsys, *c) for c in commands)
        (scene / name).write_bytes(kept)
    assert call("report", run) == 0 and not (tmp_path / "new").exists()


def test_given_maps_of_the_wrong_size(tmp_path: Path, capsys: Capture) -> None:
    footage = clip(tmp_path / "clip")
    for t in range(FRAMES):
        io.write_png(tmp_path / f"masks/{t}.png", np.zeros((34, 59), bool))
        for o in range(FRAMES):
            io.write_npy(tmp_path / f"flow/{t:05d}_{o:05d}.npy", np.zeros((17, 30, 2), np.float32))
    assert "the mask is 59x34" in refused(capsys, "reexpose", footage, tmp_path / "out", "--masks", tmp_path / "masks")
    assert not (tmp_path / "out").exists()
    assert "flow of shape (17, 30, 2)" in refused(capsys, "prepare", footage, tmp_path / "out", "--flow", tmp_path / "flow")


# Truth edited by hand


def truth(folder: Path) -> Path:
    """Truth of two frames of the toy scene."""
    scene, x = ToyScene(), (np.linspace(0, 1, 64) ** 2.2).tolist()
    views = []
    for t in (1, 3):
        io.write_exr(folder / f"radiance/{t}.exr", {"RGB": scene.see(t)[0].astype(np.float32)})
        views.append({"name": f"{t:05d}", "time": t, "bracket": 1, "anchor": t, "radiance": f"radiance/{t}.exr"})
    told = {"bracket_ev": [2.0, 0.0, -2.0], "reference_bracket": 1, "response_x": x, "response_y": [x] * 3, "views": views}
    centres = [np.c_[np.eye(3), camera_centre(t)].tolist() for t in range(6)]
    io.write_json(folder / "truth.json", {**told, "K": scene.K.tolist(), "clip_c2w": centres})
    return folder


def view(key: str, value: object) -> Callable[[dict], object]:
    return lambda d: d["views"][0].update({key: value})


TRUTHS: dict[str, tuple[Callable[[dict], object], str]] = {
    "a name that leads elsewhere": (view("name", "../../elsewhere"), "name"),
    "no name": (view("name", ""), "name"),
    "two views of one name": (view("name", "00003"), "same name"),
    "a bracket that is none": (view("bracket", 3), "bracket 3"),
    "a frame that is none": (view("anchor", 99), "frame 99"),
    "a ragged pose": (view("c2w", [[1.0], [2.0, 3.0]]), "c2w"),
    "a pose with NaN": (view("c2w", [[float("nan")] * 4] * 3), "c2w"),
    "a picture elsewhere": (view("radiance", "/etc/passwd"), "outside"),
    "a picture that is gone": (view("radiance", "none.exr"), "none.exr"),
    "true poses of no shape": (lambda d: d.update(clip_c2w=[[[1.0]]] * 6), "clip_c2w"),
    "a reference that is none": (lambda d: d.update(reference_bracket=7), "reference_bracket 7"),
    "an exposure with NaN": (lambda d: d.update(bracket_ev=[2.0, 0.0, float("nan")]), "bracket_ev"),
    "an exposure beyond all light": (lambda d: d.update(bracket_ev=[2.0, 0.0, 1e9]), "bracket_ev"),
    "no response": (lambda d: d.update(response_x=[]), "response_x"),
    "two channels": (lambda d: d.update(response_y=d["response_y"][:2]), "response_y"),
    "a response that falls": (lambda d: d.update(response_x=d["response_x"][::-1]), "response_x"),
    "a white balance of nothing": (lambda d: d.update(white_balance=[0.0] * 3), "white_balance"),
    "no focal length": (lambda d: d.update(K=[[0.0] * 3] * 3), "K is no"),
    "no views": (lambda d: d.update(views=[]), "lists none"),
}


@pytest.mark.parametrize("what", TRUTHS)
def test_truth_edited_into_nonsense_is_named(what: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    change, expected = TRUTHS[what]
    path = truth(tmp_path / "truth") / "truth.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    before = snapshot(tmp_path)
    assert expected in refused(capsys, "evaluate", run, "--truth", path.parent, "--device", "cpu")
    assert snapshot(tmp_path) == before


def test_truth_of_impossible_radiance_is_named(run: Path, tmp_path: Path, capsys: Capture) -> None:
    folder = truth(tmp_path / "truth")
    command = ["evaluate", run, "--truth", folder, "--device", "cpu"]
    for value, word in ((-1.0, "negative"), (0.0, "every view is 0")):
        for t in (1, 3):
            io.write_exr(folder / f"radiance/{t}.exr", {"RGB": np.full((34, 60, 3), value, np.float32)})
        assert word in refused(capsys, *command)
    cut(folder / "radiance/1.exr")
    assert "radiance/1.exr" in refused(capsys, *command)
    truth(folder)
    assert call(*command) == 0


# What earlier verbs have left, damaged


def test_notes_that_cannot_be_read_are_made_again(run: Path, tmp_path: Path) -> None:
    assert call(*small_view(run, tmp_path / "out")) == 0 and call("evaluate", run, "--device", "cpu") == 0
    for text in ("{", "[" * 100_000, "\x00", "7", '{"headline": 3}'):
        for note in (tmp_path / "out/fixed/sequence.json", run / "metrics.json", run / "log.jsonl"):
            note.write_text(text)
        assert call("report", run) == 0
        assert call(*small_view(run, tmp_path / "out")) == 0
        assert "views" in json.loads((tmp_path / "out/fixed/sequence.json").read_text())
    assert Run.open(run).log() == []


@pytest.mark.parametrize("text", ["[" * 100_000, '{"width": ' + "9" * 5000 + "}", "\x00"])
def test_json_that_overwhelms_the_parser_is_refused_like_any_other(text: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "path.json").write_text(text)
    assert "path.json: not a JSON file" in refused(capsys, "render", run, "--path", tmp_path / "path.json", "--device", "cpu")
    (truth(tmp_path / "truth") / "truth.json").write_text(text)
    assert "not a valid truth file" in refused(capsys, "evaluate", run, "--truth", tmp_path / "truth", "--device", "cpu")
    (tmp_path / "transforms.json").write_text(text)
    footage, out = clip(tmp_path / "clip"), tmp_path / "out"
    assert "not readable as poses" in refused(capsys, "reexpose", footage, out, "--poses", tmp_path / "transforms.json")
    (run.parent / "scene/scene.json").write_text(text)
    assert "not a valid scene" in refused(capsys, *training(run.parent / "scene", out, 1))
    (run / "config.json").write_text(text)
    assert "config.json" in refused(capsys, "report", run)


def test_checkpoints_without_their_config_are_not_taken_over(run: Path, capsys: Capture, tmp_path: Path) -> None:
    lone = tmp_path / "run"
    shutil.copytree(run, lone)
    (lone / "config.json").unlink()
    before = snapshot(lone)
    assert "no config.json" in refused(capsys, *training(run.parent / "scene", lone, 3))
    assert snapshot(lone) == before


def test_a_room_is_not_rendered_into_a_folder_of_something_else(capsys: Capture, tmp_path: Path) -> None:
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "00000.png").write_bytes(b"mine")
    assert "holds something else" in refused(capsys, "synth", str(tmp_path), "--size", "16x16", "--frames", "12")
    assert (tmp_path / "clip" / "00000.png").read_bytes() == b"mine"
