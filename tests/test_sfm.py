"""The worker process of structure from motion: its end, its errors, and full disks."""

import json
import os
import resource
import signal
import sys
import time
from dataclasses import asdict, replace

import numpy as np
import pytest
from posed_clips import PLACES, sliding
from scipy.spatial.transform import Rotation

from hdr_nsff import cli
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import FULL
from hdr_nsff.footage.colmap import read_model
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.colmap_matches import MIN_PAIRS_OF_PROCESS
from hdr_nsff.priors.poses.reconstruct import SfmViews, attempts, failure_message
from hdr_nsff.priors.poses.rotation import focal_length
from hdr_nsff.priors.poses.sfm_worker import LOST_PX, drop_lost_points, mean_error
from hdr_nsff.priors.poses.trimming import TrimmingTuning
from hdr_nsff.priors.poses.view_matches import EarlierRounds


def test_a_worker_that_crashes_reports_why(tmp_path):
    pytest.importorskip("pycolmap")
    (tmp_path / "images").mkdir()
    job = sfm.Job(str(tmp_path), [["missing.png"]], [], 100.0, "nonsense")  # type: ignore[arg-type]
    with pytest.raises(sfm.SfmError):
        sfm.run_worker(job)


def test_a_worker_that_was_killed_says_that_memory_may_be_short(tmp_path, monkeypatch):
    (tmp_path / "killed.py").write_text("import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.setattr(sfm, "WORKER", "killed")
    with pytest.raises(sfm.SfmError, match="was killed, probably because memory") as killed:
        sfm.run_worker(sfm.Job(str(tmp_path), [], [], 1.0, "global"))
    views = SfmViews(np.zeros((2, 8, 8, 3)), np.zeros((2, 8, 8), bool), [[0, 1]], np.arange(2))
    message = failure_message(None, views, [str(killed.value)])
    assert message.startswith("poses failed: its process was killed") and "--max-size" in message
    assert "texture" not in message


def test_a_worker_reads_no_module_from_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "here/random.py").write_text("raise SystemExit('the script of a user')")
    (tmp_path / "worker.py").write_text("import random; random.random()")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(sfm, "WORKER", "worker")
    sfm.run_worker(sfm.Job(str(tmp_path), [], [], 1.0, "global"))


def test_processes_find_the_matches_of_one(tmp_path):
    pytest.importorskip("pycolmap")
    names = [f"{t:02d}.png" for t in range(15)]
    pairs = [(a, b) for k, a in enumerate(names) for b in names[k + 1 :]]
    assert len(pairs) >= 2 * MIN_PAIRS_OF_PROCESS
    found = []
    for threads in (1, 3):
        folder = tmp_path / str(threads)
        for name, frame in zip(names, sliding(np.linspace(PLACES[0], PLACES[-1], 15)), strict=True):
            write_png(folder / "images" / name, frame)
        sfm.run_worker(sfm.Job(str(folder), [names], pairs, 150.0, "match", threads))
        found.append(sfm.read_matches(folder, names, pairs))
    (keypoints, matches), (others, other_matches) = found
    assert all(len(rows) > 50 for rows in matches[:5])
    for a, b in zip(keypoints + matches, others + other_matches, strict=True):
        assert np.array_equal(a, b)


FAILS_OR_SLEEPS = """
import json, os, pathlib, sys, time
job = json.loads(pathlib.Path(sys.argv[1]).read_text())
if job["focal"] < 3:
    sys.exit(f"no models at {job['focal']:.0f}")
pathlib.Path(job["folder"], "pid").write_text(str(os.getpid()))
time.sleep(60)
"""


def test_jobs_fail_in_their_order_and_those_that_work_ahead_are_stopped(tmp_path, monkeypatch):
    (tmp_path / "fails_or_sleeps.py").write_text(FAILS_OR_SLEEPS)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.setattr(sfm, "WORKER", "fails_or_sleeps")
    jobs = [sfm.Job(str(tmp_path), [], [], float(focal), "global") for focal in (1, 2, 3)]
    results = sfm.run_in_turn(jobs, 2)
    assert str(next(results)) == "no models at 1"
    pid = tmp_path / "pid"
    assert not pid.exists()  # the first works alone
    assert str(next(results)) == "no models at 2"
    for _ in range(100):
        if pid.exists() and pid.read_text():
            break
        time.sleep(0.1)
    worker = int(pid.read_text())
    assert os.path.exists(f"/proc/{worker}")
    results.close()
    assert not os.path.exists(f"/proc/{worker}")


FULL_DISK = """
import errno, os, pathlib
write = pathlib.Path.write_text

def write_text(self, *arguments, **named):
    if self.name == "pairs.txt":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    return write(self, *arguments, **named)

pathlib.Path.write_text = write_text
"""


def test_a_worker_on_a_full_disk_reports_it_in_one_sentence(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pycolmap")
    (tmp_path / "inject").mkdir()
    # Python imports it first: in the worker only
    (tmp_path / "inject/sitecustomize.py").write_text(FULL_DISK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "inject"), *sys.path]))
    for t, frame in enumerate(sliding(PLACES)):
        write_png(tmp_path / f"clip/{t:03d}.png", frame)
    with pytest.raises(SystemExit) as stop:
        cli.main(["prepare", str(tmp_path / "clip"), str(tmp_path / "scene"), "--ev", "0"])
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if line.startswith("hdr-nsff: ")]
    assert stop.value.code == 2 and len(errors) == 1
    assert "scene/poses: the disk is full" in errors[0]
    assert not list((tmp_path / "scene/poses").glob(".sfm-*"))


def test_a_disk_without_free_space_is_full_however_the_worker_ended(tmp_path):
    sfm.check_free_space(tmp_path, "all went well")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (sfm.MIN_FREE_BYTES // 2, before[1]))
    try:
        with pytest.raises(OSError) as full:
            sfm.check_free_space(tmp_path, "all went well")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert full.value.errno in FULL and not list(tmp_path.iterdir())


def test_a_job_reaches_the_worker_unchanged(tmp_path):
    tuning = sfm.SfmTuning(max_features=99, trimming=TrimmingTuning(max_rounds=3))
    job = sfm.Job(str(tmp_path), [["a.png"]], [], 100.0, "global", tuning=tuning)
    (tmp_path / "job.json").write_text(json.dumps(asdict(job)))
    assert sfm.read_job(tmp_path / "job.json") == job


def write_seen_points(folder, focal, size, count=12):
    """Names and named pairs of `count` images (none shows anything) of random points,
    seen from an orbit; keypoints and matches are in `folder`.
    """
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, 8), (2, 2, 16), (400, 3))
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = np.stack([1.5 * np.sin(angle), 0.5 * np.sin(2 * angle), np.cos(angle)], 1)
    names = [f"{v:02d}.png" for v in range(count)]
    keypoints, seen = [], []
    for name, eye in zip(names, eyes, strict=True):
        turn = Rotation.from_euler("yx", (-eye[0] / 12, eye[1] / 12)).inv()  # looks at (0, 0, 12)
        x, y, z = turn.apply(points - eye).T
        noise = rng.normal(0, 0.3, (400, 2))
        pixels = focal * np.stack([x / z, y / z], 1) + size / 2 + noise
        rows = np.flatnonzero(((pixels > 0) & (pixels < size)).all(1))
        keypoints.append(pixels[rows])
        seen.append(rows)
        write_png(folder / "images" / name, np.zeros((size, size, 3)))
    pairs = [(a, b) for a in range(count) for b in range(a + 1, count)]
    matches = [
        np.stack(np.intersect1d(seen[a], seen[b], return_indices=True)[1:], 1) for a, b in pairs
    ]
    named = [(names[a], names[b]) for a, b in pairs]
    sfm.write_matches(folder, names, keypoints, named, matches)
    return names, named


def models_of(jobs, at_once):
    return [[read_model(path) for path in paths] for paths in sfm.run_in_turn(jobs, at_once)]


def test_a_long_lens_is_found_from_the_guess_of_one(tmp_path):
    pytest.importorskip("pycolmap")
    size, focal = 320, focal_length(11, 320)
    names, named = write_seen_points(tmp_path, focal, size)
    job = sfm.Job(str(tmp_path), [names], named, focal_length(60, size), "match")
    usual, long, held, _ = attempts(job, EarlierRounds(), focal_length(24, size))
    found = models_of([usual, long, held], 2)
    assert len(found[0][0].images) < len(names)  # few at an absurd focal length come first
    for (model,) in found[1:]:
        assert len(model.images) == len(names)
        assert model.cameras[1].K[0, 0] == pytest.approx(focal, rel=0.03)


@pytest.mark.parametrize("task", ["incremental", "global"])
def test_every_mapping_of_the_same_matches_gives_the_same_model(tmp_path, task):
    pytest.importorskip("pycolmap")
    names, named = write_seen_points(tmp_path, 300.0, 320)
    job = sfm.Job(str(tmp_path), [names], named, 277.0, task)
    (alone,), (one,), (other,) = models_of([job, replace(job, focal=278.0), job], 2)
    assert len(alone.images) == len(names)
    for key, image in alone.images.items():
        assert np.array_equal(image.c2w, other.images[key].c2w)
        assert not np.array_equal(image.c2w, one.images[key].c2w)


def test_a_point_behind_a_camera_does_not_hide_the_error_of_the_others(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    names, named = write_seen_points(tmp_path, 300.0, 320)
    job = sfm.Job(str(tmp_path), [names], named, 277.0, "incremental")
    ((folder,),) = sfm.run_in_turn([job], 1)
    found = pycolmap.Reconstruction(folder)
    error, count = mean_error(found), len(found.points3D)
    next(iter(found.points3D.values())).xyz = np.array([0.0, 0.0, -1e3])
    assert error < 1 and mean_error(found) > LOST_PX
    drop_lost_points(found)
    assert len(found.points3D) == count - 1
    assert mean_error(found) == pytest.approx(error, rel=0.01)


def adjusted_focal(folder, job, start, focal):
    """The focal length after an `adjust` of the model in `start` from `focal`."""
    pycolmap = pytest.importorskip("pycolmap")
    known = pycolmap.Reconstruction(start)
    known.cameras[1].focal_length = focal
    (folder / "known").mkdir(exist_ok=True)
    known.write_binary(folder / "known")
    ((model,),) = models_of([replace(job, task="adjust", start=str(folder / "known"))], 1)
    return model.cameras[1].K[0, 0]


def test_a_known_focal_length_stays_unless_another_fits_clearly_better(tmp_path):
    pytest.importorskip("pycolmap")
    names, named = write_seen_points(tmp_path, 300.0, 320)
    job = sfm.Job(str(tmp_path), [names], named, 277.0, "incremental")
    ((start,),) = sfm.run_in_turn([job], 1)
    assert adjusted_focal(tmp_path, job, start, 303.0) == pytest.approx(303, abs=0.01)
    assert adjusted_focal(tmp_path, job, start, 390.0) == pytest.approx(300, rel=0.03)
    eager = replace(job, tuning=sfm.SfmTuning(max_free_known_focal_error_share=1.01))
    assert adjusted_focal(tmp_path, eager, start, 303.0) != pytest.approx(303, abs=0.5)
