"""Run folders: what is written, what is kept, and what is said where something is
damaged or from another version.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import small, trainer
from safetensors.torch import save_file

from hdr_nsff.core.checkpoints import (
    FORMAT,
    checksum,
    latest_checkpoint,
    read_checkpoint,
    save_checkpoint,
)
from hdr_nsff.core.errors import InputError
from hdr_nsff.scene.manifest import Manifest, StepRecord
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.budget import Budget, Clock, Schedule
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run, append_log, read_config, read_log, write_config
from hdr_nsff.training.train import train


@pytest.fixture(scope="module")
def finished(toy_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps: checkpoints of step 0 and 2."""
    return train(small("tiny", toy_folder, tmp_path_factory.mktemp("finished") / "run"))


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return shutil.copytree(finished, tmp_path / "run")


def newest(folder: Path) -> Path:
    return max((folder / "checkpoints").glob("step_*.safetensors"))


def test_a_run_opens_to_the_field_that_was_trained(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    t = trainer(small("tiny", toy_folder, tmp_path / "run", 3), toy)
    t.loop()
    opened, camera = Run.open(tmp_path / "run"), toy.train[1].camera
    assert opened.step == 3 and opened.seconds > 0
    ours, theirs = t.field.render(camera, 1.5), opened.field.render(camera, 1.5)
    assert torch.equal(ours.radiance, theirs.radiance) and torch.equal(ours.depth, theirs.depth)
    a, b = (m.curve(0)[1] for m in (t.tonemapper, opened.tonemapper))
    assert torch.equal(a, b)


@pytest.mark.parametrize("preset", list(PRESETS))
def test_every_preset_survives_json(preset: str) -> None:
    config = PRESETS[preset]
    assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


def test_the_newest_two_checkpoints_are_kept(tmp_path: Path) -> None:
    for step in (0, 9, 10, 100):
        save_checkpoint(tmp_path, step, 0.5 * step, {"a": torch.full((2,), float(step))})
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == [
        "step_00000010.safetensors",
        "step_00000100.safetensors",
    ]
    found = latest_checkpoint(tmp_path)
    assert found is not None
    assert (found.step, found.seconds, found.tensors["a"].tolist()) == (
        100,
        50.0,
        [100.0, 100.0],
    )


def test_a_failed_write_leaves_the_checkpoints_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_checkpoint(tmp_path, 1, 0.0, {"a": torch.ones(2)})

    def full(tensors: object, path: Path, metadata: object) -> None:
        path.write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hdr_nsff.core.checkpoints.save_file", full)
    with pytest.raises(OSError, match="No space"):
        save_checkpoint(tmp_path, 2, 0.0, {"a": torch.ones(2)})
    assert [p.name for p in (tmp_path / "checkpoints").iterdir()] == ["step_00000001.safetensors"]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def other_version(path: Path) -> None:
    save_file(
        {"a": torch.ones(1)},
        path,
        metadata={"format": "hdr-nsff checkpoint 99", "step": "2", "seconds": "0"},
    )


def empty(path: Path) -> None:
    path.write_bytes(b"")


def without_checksum(path: Path) -> None:
    metadata = {"format": "hdr-nsff checkpoint 1", "step": "2", "seconds": "0"}
    save_file(read_checkpoint(path).tensors, path, metadata=metadata)


def with_nan(path: Path) -> None:
    tensors = {"a": torch.tensor([torch.nan])}
    metadata = {"format": FORMAT, "step": "2", "seconds": "0.0"}
    save_file(tensors, path, metadata=metadata | {"checksum": checksum(2, 0.0, tensors)})


DAMAGE = {
    "holds NaN or Inf": with_nan,
    "cut short or damaged": cut,
    "another version": other_version,
    "cut short": empty,
    "damaged (KeyError)": without_checksum,
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_bad_checkpoint_is_replaced_by_the_one_before_and_reported(
    what: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    DAMAGE[what](newest(run))
    opened = Run.open(run)
    said = " ".join(capsys.readouterr().err.split())
    assert opened.step == 0
    assert what in said
    assert "using the one before, of step 0" in said
    assert newest(run).name in said


@pytest.mark.parametrize("what", DAMAGE)
def test_training_continues_from_the_checkpoint_before_a_bad_one(
    what: str, run: Path, toy_folder: Path, finished: Path
) -> None:
    DAMAGE[what](newest(run))
    train(replace(small("tiny", toy_folder, run)))
    ours, theirs = read_checkpoint(newest(run)), read_checkpoint(newest(finished))
    assert ours.step == 2
    assert all(torch.equal(ours.tensors[k], v) for k, v in theirs.tensors.items())


def test_no_readable_checkpoint_is_an_error(run: Path) -> None:
    for path in (run / "checkpoints").iterdir():
        cut(path)
    with pytest.raises(InputError, match=r"no readable checkpoint .*train again into a new folder"):
        Run.open(run)


def test_no_checkpoint_yet_is_an_error(run: Path) -> None:
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(InputError, match="no checkpoint yet"):
        Run.open(run)


def change_config(run: Path, change: Callable[[dict], object]) -> None:
    path = run / "config.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


CONFIG_DAMAGE: dict[str, Callable[[dict], object]] = {
    "unknown key": lambda d: d.update(sparkle=1),
    "unknown key in a part": lambda d: d["field"].update(sparkle=1),
    "missing part": lambda d: d.pop("tonemap"),
    "unknown encoding": lambda d: d.update(encoding="SplatConfig"),
    "part of another type": lambda d: d.update(field=7),
    "nothing at all": lambda d: d.clear(),
    "version 1": lambda d: d.pop("version"),
}


@pytest.mark.parametrize("what", CONFIG_DAMAGE)
def test_a_config_of_another_version_is_said_to_be_one(what: str, run: Path) -> None:
    change_config(run, CONFIG_DAMAGE[what])
    with pytest.raises(InputError, match="another version"):
        Run.open(run)


@pytest.mark.parametrize("text", ["{", "", "[]", "3", "\x00\x01"])
def test_a_config_that_is_no_config_is_refused(text: str, run: Path) -> None:
    (run / "config.json").write_text(text)
    with pytest.raises(InputError, match=r"config\.json"):
        Run.open(run)


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a run folder"):
        Run.open(tmp_path)


def test_what_is_taken_for_a_run_folder_is_named(run: Path, tmp_path: Path) -> None:
    (tmp_path / "note").write_text("mine")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/scene.json").write_text("{}")
    whole = run.rename(tmp_path / "run").parent
    for name, words in (
        ("note", "is a file and not a run folder"),
        ("scene", "a scene and not a run folder; train one from it with `hdr-nsff train splat"),
        ("", f"not a run folder, but {whole / 'run'} is one"),
    ):
        with pytest.raises(InputError, match=words):
            Run.open(whole / name if name else whole)


def test_a_config_without_its_scene_says_how_to_name_it(run: Path) -> None:
    change_config(run, lambda d: d.pop("scene"))
    with pytest.raises(InputError, match=r'config\.json: no scene is named; add "scene"'):
        Run.open(run)


def test_a_config_of_another_version_is_named_with_its_folder(run: Path) -> None:
    change_config(run, lambda d: d.update(version=0))
    with pytest.raises(InputError, match=f"^{run}: the run's config.json is of another version"):
        Run.open(run)


def test_a_scene_that_was_moved_is_named(run: Path) -> None:
    nowhere = {"scene": "/nowhere/scene", "scene_from_run": "../nowhere"}
    change_config(run, lambda d: d.update(nowhere))
    with pytest.raises(InputError, match="its scene is not at /nowhere/scene any more"):
        Run.open(run)


def move_a_camera(m: Manifest) -> None:
    c2w = m.frames[2].c2w
    assert c2w is not None
    c2w[0][3] += 0.01


def correct_an_exposure(m: Manifest) -> None:
    m.frames[2].bracket = 0


@pytest.mark.parametrize("change", [move_a_camera, correct_an_exposure])
def test_a_scene_that_was_changed_under_its_run_is_named(
    change: Callable[[Manifest], None],
    toy_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene = shutil.copytree(toy_folder, tmp_path / "scene")
    config = small("tiny", scene, tmp_path / "run")
    train(config)
    m = Manifest.load(scene)
    m.steps["frames"] = StepRecord(done=True, seconds=3.0)  # as of a step that was done again
    m.save(scene)
    Run.open(train(config))
    assert "was changed" not in capsys.readouterr().err
    change(m)
    m.save(scene)
    Run.open(config.out)
    assert f"its scene {scene} was changed, frames, cameras" in unwrapped(capsys)
    with pytest.raises(InputError, match="before that was changed, frames, cameras"):
        train(config)
    shutil.rmtree(config.out / "checkpoints")
    train(config)  # nothing was learned yet
    Run.open(config.out)
    assert "was changed" not in capsys.readouterr().err


def unwrapped(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, without line breaks."""
    return " ".join(capsys.readouterr().err.split())


def test_a_checkpoint_of_another_network_does_not_fit(run: Path) -> None:
    change_config(run, lambda d: d["field"]["encoding"].update(levels=3))
    with pytest.raises(InputError, match="does not fit this run's field"):
        Run.open(run)


def test_a_log_line_cut_short_is_left_out_and_the_next_one_is_whole(run: Path, toy: Scene) -> None:
    path = run / "log.jsonl"
    whole = '{"step": 25, "seconds": 1.0, "psnr": 10.0, "rays_per_second": 9.0, "losses": {}}'
    path.write_text(f"{whole}\n{whole[:40]}")
    assert [line.step for line in read_log(run)] == [25]
    clock = Clock(Budget(steps=100), Schedule(), num_frames=6)
    append_log(run, replace(clock, step=50, seconds=2.0), 64, {"psnr": 20.0, "depth": 1.0})
    append_log(run, replace(clock, step=75, seconds=3.0), 64, {"psnr": 30.0})
    lines = read_log(run)
    assert [line.step for line in lines] == [25, 50, 75] and lines[1].losses == {"depth": 1.0}
    assert path.read_text().count("\n") == 4


def test_a_step_logged_twice_counts_once(run: Path) -> None:
    rest = {"seconds": 1.0, "rays_per_second": 9.0, "losses": {}}
    lines = [{"step": s, "psnr": p, **rest} for s, p in ((25, 1.0), (50, 2.0), (25, 3.0))]
    (run / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert [(line.step, line.psnr) for line in read_log(run)] == [(25, 3), (50, 2)]


def test_without_a_log_there_are_no_lines(tmp_path: Path) -> None:
    assert read_log(tmp_path) == []


def test_config_is_written_whole_or_not_at_all(tmp_path: Path, toy_folder: Path) -> None:
    config = replace(PRESETS["tiny"], scene=toy_folder)
    write_config(tmp_path, config)
    assert read_config(tmp_path) == config
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def test_a_run_and_its_scene_that_moved_together_are_found(
    finished: Path, toy_folder: Path, tmp_path: Path
) -> None:
    original, moved = tmp_path / "a", tmp_path / "b/c"
    for place in (original, moved):
        shutil.copytree(toy_folder, place / "scene")
    shutil.copytree(finished, original / "run")
    write_config(original / "run", replace(read_config(finished), scene=original / "scene"))
    shutil.copytree(original / "run", moved / "run")
    shutil.rmtree(original)
    assert Run.open(moved / "run").scene.folder == moved / "scene"
