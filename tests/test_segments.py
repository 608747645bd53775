"""A long clip becomes scenes that overlap and share poses, exposures and response."""

from __future__ import annotations

import multiprocessing
import shutil
import time
import tracemalloc
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_prepare import attempts, footage, given, stamps

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_codes
from hdr_nsff.core.io import read_npy, write_npy
from hdr_nsff.prepare import segments
from hdr_nsff.prepare.length import offered_segments
from hdr_nsff.prepare.prepare import PrepareConfig, begin, prepare, prepare_scenes
from hdr_nsff.prepare.segments import cut_clip, take_poses
from hdr_nsff.prepare.work import Segment, Work
from hdr_nsff.scene.manifest import FrameEntry, Manifest
from hdr_nsff.scene.scene import Scene

COUNT = 30
SECONDS = 0.8  # 19 frames at 24 a second


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> PrepareConfig:
    """A clip of 30 frames in two segments, with everything given (read only)."""
    root = tmp_path_factory.mktemp("segments")
    made = PrepareConfig(
        footage(root / "clip", COUNT), root / "out", segment=SECONDS, **given(root / "given", COUNT)
    )
    prepare(made)
    return made


def in_both(out: Path) -> list[tuple[FrameEntry, FrameEntry]]:
    """The frames that two neighboring segments share."""
    first, second = (Manifest.load(out / f"segment_{k:02d}").frames for k in range(2))
    by_time = {f.time: f for f in second}
    return [(f, by_time[f.time]) for f in first if f.time in by_time]


def test_segments_are_scenes_that_cover_the_clip_and_overlap_by_a_cycle(config):
    scenes = [Scene.open(config.out / f"segment_{k:02d}") for k in range(2)]
    frames = [scene.manifest.frames for scene in scenes]
    times = [[f.time for f in each] for each in frames]
    assert times[0][0] == 0 and times[1][-1] == COUNT - 1
    assert max(len(each) for each in times) <= round(24 * SECONDS)
    assert len(set(times[0]) & set(times[1])) >= 3
    assert sorted({*times[0], *times[1]}) == list(range(COUNT))
    for each in frames:
        assert [f.index for f in each] == list(range(len(each)))
        assert all(f.source == f"{f.time:03.0f}.png" for f in each)
        assert each[0].split == each[-1].split == "train"
    for scene in scenes:
        assert scene.train[3].neighbors == {-1: 2, 1: 4}


def test_frames_of_two_segments_have_one_camera_exposure_and_picture(config):
    shared = in_both(config.out)
    assert len(shared) >= 3
    for a, b in shared:
        for name in ("K", "c2w", "bracket", "ev", "drift", "white_balance", "split", "source"):
            assert getattr(a, name) == getattr(b, name), name
        pictures = [config.out / f"segment_{k:02d}" / f.image for k, f in enumerate((a, b))]
        assert (read_codes(pictures[0]) == read_codes(pictures[1])).all()
    responses = [path.read_bytes() for path in sorted(config.out.glob("*/response.json"))]
    assert len(responses) == 3 and len(set(responses)) == 1
    for path in config.out.glob("*/response.json"):  # each may be edited on its own
        assert path.stat().st_nlink == 1


def test_segments_equal_the_whole_clip_where_everything_is_given(config, tmp_path):
    whole = Manifest.load(prepare(replace(config, out=tmp_path / "whole", segment=None)))
    for k in range(2):
        folder = config.out / f"segment_{k:02d}"
        m = Manifest.load(folder)
        assert (m.cycle, m.reference_bracket, m.fps) == (
            whole.cycle,
            whole.reference_bracket,
            whole.fps,
        )
        for f in m.frames:
            same = whole.frames[int(f.time)]
            assert (f.K, f.c2w, f.bracket, f.split) == (same.K, same.c2w, same.bracket, same.split)
            for j, files in f.flow.items():
                other = same.flow[int(m.frames[j].time)]
                there = read_npy(tmp_path / "whole" / other.flow)
                assert (read_npy(folder / files.flow) == there).all()
            if f.split == "train":
                there = read_npy(tmp_path / "whole" / str(same.disparity))
                assert (read_npy(folder / str(f.disparity)) == there).all()


def test_a_second_run_does_nothing_and_redo_reaches_all_segments(config, tmp_path):
    config = replace(config, out=tmp_path / "out")
    prepare(config)
    before = stamps(config.out)
    prepare(config)
    assert stamps(config.out) == before
    prepare(replace(config, redo=("poses",)))
    assert attempts(config.out / "clip")["poses"] == 2
    for k in range(2):
        done = attempts(config.out / f"segment_{k:02d}")
        assert done["poses"] == done["masks"] == done["response"] == done["depth"] == 2
        assert done["frames"] == done["flow"] == 1


def test_killed_at_any_moment_segments_continue_to_the_same_scenes(config, tmp_path):
    again = replace(config, out=tmp_path / "out")
    kills = 0
    for delay in (0.1, 0.3, 0.6, 0.9, 1.2):
        process = multiprocessing.get_context("fork").Process(target=prepare, args=(again,))
        process.start()
        time.sleep(delay)
        process.kill()
        process.join()
        kills += process.exitcode != 0
    assert kills
    prepare(again)
    files = [p.relative_to(config.out) for p in config.out.rglob("*") if p.is_file()]
    for name in files:
        if name.name != "scene.json":
            assert (config.out / name).read_bytes() == (again.out / name).read_bytes(), name


def test_given_flow_across_held_out_frames_stays_in_every_segment(config, tmp_path):
    flow = shutil.copytree(config.flow, tmp_path / "flow")
    held_out = {f.source for f in Manifest.load(config.out / "clip").frames if f.split == "test"}
    for path in flow.iterdir():
        i, j = sorted(int(number) for number in path.stem.split("_"))
        if j - i == 2 and f"{i + 1:03d}.png" not in held_out:
            path.unlink()  # training asks for no such pair
    prepare(replace(config, out=tmp_path / "out", flow=flow))
    for k in range(2):
        m = Manifest.load(tmp_path / f"out/segment_{k:02d}")
        used = [files.flow for f in m.frames for files in f.flow.values()]
        assert used and all(name.startswith("raw_flow/") for name in used)


def peak_of_segments(config: PrepareConfig, monkeypatch: pytest.MonkeyPatch) -> int:
    """The most bytes that the steps of one segment add."""
    peaks = []

    def measured(work: Work, steps: dict) -> None:
        tracemalloc.start()
        run_steps(work, steps)
        if work.segment is not None:
            peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()

    run_steps = segments.run_steps
    with monkeypatch.context() as patch:
        patch.setattr(segments, "run_steps", measured)
        prepare(config)
    return max(peaks)


def test_the_memory_of_a_segment_does_not_grow_with_the_clip(tmp_path, monkeypatch):
    peaks = []
    for count in (14, 20, 40):  # the first compiles and imports
        root = tmp_path / str(count)
        priors = {**given(root / "given", count), "masks": None}
        clip = footage(root / "clip", count)
        config = PrepareConfig(clip, root / "out", segment=0.6, **priors)
        peaks.append(peak_of_segments(config, monkeypatch))
    assert peaks[2] < 1.2 * peaks[1]


def test_a_segment_takes_the_points_that_its_frames_see(config, tmp_path):
    clip = begin(replace(config, out=config.out / "clip"))
    clip.config = replace(clip.config, out=tmp_path)
    clip.manifest.points = "points.npy"
    write_npy(tmp_path / "points.npy", np.arange(9, dtype=np.float32).reshape(3, 3))
    write_npy(tmp_path / "poses/sightings.npy", np.array([[1, 0], [9, 2], [4, 2]], np.int32))
    work = Work(clip.config, clip.footage, clip.manifest, segment=Segment("s", (4, 5), COUNT))
    take_poses(clip, work).files["points.npy"](tmp_path / "own.npy")
    assert read_npy(tmp_path / "own.npy").tolist() == [[6, 7, 8]]


@pytest.mark.parametrize("seconds", [0.5, 0.8, 1.0, 5.0])
@pytest.mark.parametrize("hold_out", [0, 2, 8])
def test_every_cut_covers_the_clip_and_ends_in_training_frames(config, seconds, hold_out):
    clip = begin(replace(config, out=config.out / "clip", segment=seconds))
    for f in clip.manifest.frames:
        f.split = "test" if hold_out and f.index % hold_out == 1 else "train"
    clip.manifest.frames[-1].split = "train"
    cut = cut_clip(clip)
    assert sorted({row for s in cut for row in s.rows}) == list(range(COUNT))
    for before, after in pairwise(cut):
        assert len(set(before.rows) & set(after.rows)) >= 3
    for s in cut:
        ends = [clip.manifest.frames[row] for row in (s.rows[0], s.rows[-1])]
        assert all(f.split == "train" for f in ends)
        assert len(s.rows) <= round(24 * seconds) + 2


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"segment": 0.1}, "at least 0.5 seconds"),
        ({"segment": -1.0}, "give the seconds of a segment"),
        ({"segment": 1e308}, "give the seconds of a segment"),
        ({"mask_points": Path("points.json")}, "--mask-points"),
        ({"rig": 2}, "2 cameras take the frames in turn"),
    ],
)
def test_segments_that_cannot_be_are_refused_in_a_sentence(config, changes, sentence, tmp_path):
    with pytest.raises(InputError, match=sentence):
        prepare(replace(config, out=tmp_path / "out", **changes))


def test_a_clip_that_cannot_be_cut_is_refused_before_flow(config, tmp_path):
    short = replace(config, out=tmp_path / "out", segment=0.1)
    with pytest.raises(InputError, match=r"--segment 0\.1: 2 frames"):
        prepare(short)
    assert list(Manifest.load(short.out / "clip").steps) == ["frames", "exposure"]
    with pytest.raises(InputError, match="in turn"):
        prepare(replace(config, out=tmp_path / "rig", rig=2))
    assert not (tmp_path / "rig").exists()


def test_what_was_found_before_a_refusal_becomes_the_scene_without_segments(config, tmp_path):
    short = replace(config, out=tmp_path / "out", segment=0.1)
    with pytest.raises(InputError, match="2 frames"):
        prepare(short)
    found = Manifest.load(short.out / "clip").steps
    prepare(replace(short, segment=None))
    scene = Manifest.load(short.out)
    assert {name: scene.steps[name] for name in found} == found and scene.steps["sheet"].done
    assert not (short.out / "clip").exists()


def test_segments_do_not_go_into_a_folder_with_something_else(config, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for out, sentence in (
        (config.out / "segment_00", "holds the scene of a whole clip"),
        (tmp_path, "holds other files"),
        (tmp_path / "notes.txt", "is a file"),
    ):
        with pytest.raises(InputError, match=sentence):
            prepare(replace(config, out=out))
    with pytest.raises(InputError, match="holds the segments of a long clip; give --segment"):
        prepare(replace(config, segment=None))


def test_folders_of_an_earlier_cut_are_named(config, tmp_path, capsys):
    config = replace(config, out=tmp_path / "out")
    assert len(prepare_scenes(config)) == 2
    assert len(prepare_scenes(replace(config, segment=5.0))) == 1
    assert "segment_01 of an earlier cut" in capsys.readouterr().err


def test_a_clip_longer_than_the_time_of_training_follows_is_offered_segments():
    pixels = 640 * 360
    assert offered_segments(200, pixels, 30) is None
    offer = offered_segments(300, pixels, 30)
    assert offer is not None and (offer.longest, offer.seconds) == (265, 4)
    assert "`hdr-nsff prepare CLIP OUT --segment 4`" in offer.advice("hdr-nsff prepare")
    assert offered_segments(60, pixels, 30) is None


def test_a_folder_of_segments_names_them_where_a_scene_is_asked_for(config):
    for folder in (config.out, config.out / "clip"):
        with pytest.raises(InputError, match=r"such as .*segment_00"):
            Scene.open(folder)
