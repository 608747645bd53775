"""Re-exposed clips: what is recorded, what is kept aside, and what each says about the
other.
"""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_hdr_video import decoded, luma

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.io import write_json, write_npy
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.pose_files import import_poses
from hdr_nsff.maths.hdr_signal import display_light, encode, pq_decode, ycbcr_planes
from hdr_nsff.radiometry.exposure_cycle import detect_cycle
from hdr_nsff.radiometry.recording import response_curve
from hdr_nsff.scene.truth import Truth
from hdr_nsff.synth.auto_exposure import auto_exposure
from hdr_nsff.synth.reexpose import ReexposeConfig, plan_frames, reexpose


def ordinary_clip(folder: Path, count: int = 20, width: int = 40) -> Path:
    """A ramp that slides by a pixel per frame, 24 rows high."""
    for t in range(count):
        ramp = 0.15 + 0.7 * ((np.arange(width) + t) % width) / width
        write_png(folder / f"{t:03d}.png", np.broadcast_to(ramp[None, :, None], (24, width, 3)))
    return folder


def llff(count: int, width: int = 40, height: int = 24) -> np.ndarray:
    """poses_bounds rows (count, 17): axes of the world (columns down, right, back of an
    OpenCV identity), center (t, 0, 0), focal 50.
    """
    pose = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
    rows = [
        np.concatenate([pose, [[t], [0], [0]], [[height], [width], [50]]], 1).ravel()
        for t in range(count)
    ]
    return np.concatenate([np.array(rows), np.full((count, 1), 1.0), np.full((count, 1), 9.0)], 1)


def test_without_poses_truth_frames_stay_in_the_clip(tmp_path):
    out = reexpose(ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out"))
    truth = Truth.open(out / "truth")
    assert len(list((out / "clip").glob("*.png"))) == 20
    assert [(v.time, v.anchor, v.bracket, v.c2w) for v in truth.views] == [
        (4, 4, 1, None),
        (12, 12, 0, None),
    ]


def test_with_poses_truth_frames_are_missing_and_lie_between_their_neighbors(tmp_path):
    write_npy(tmp_path / "poses_bounds.npy", llff(20))
    out = reexpose(
        ReexposeConfig(
            ordinary_clip(tmp_path / "in"), tmp_path / "out", poses=tmp_path / "poses_bounds.npy"
        )
    )
    truth = Truth.open(out / "truth")
    assert len(list((out / "clip").glob("*.png"))) == 18
    assert [(v.name, v.time, v.anchor) for v in truth.views] == [
        ("00004", 3.5, 3),
        ("00012", 10.5, 10),
    ]
    assert truth.views[0].c2w == [[1, 0, 0, 4], [0, 1, 0, 0], [0, 0, 1, 0]]
    assert [pose[0][3] for pose in truth.clip_c2w] == [t for t in range(20) if t not in (4, 12)]
    assert truth.K == [[50, 0, 20], [0, 50, 12], [0, 0, 1]] and truth.views[0].K is None


def test_given_cameras_are_handed_on_as_they_are(tmp_path):
    """Off-center, of two focal lengths and a zoom, with their near and far."""
    frames = []
    for t in range(20):
        matrix = np.eye(4)
        matrix[0, 3] = 0.1 * t
        lens = {"fl_x": 50.0 + t, "fl_y": 47.0 + t, "cx": 17.0, "cy": 14.0}
        frames.append({"file_path": f"{t:03d}.png", "transform_matrix": matrix.tolist(), **lens})
    path = tmp_path / "transforms.json"
    write_json(path, {"w": 40, "h": 24, "near": 0.5, "far": 9.0, "frames": frames})
    clip = ordinary_clip(tmp_path / "in")
    given = import_poses(path, [f"{t:03d}.png" for t in range(20)], (24, 40))
    out = reexpose(ReexposeConfig(clip, tmp_path / "out", poses=path))
    names = [f"{k:05d}.png" for k in range(18)]
    again = import_poses(out / "transforms.json", names, (24, 40))  # as `prepare --poses` does
    kept = [t for t in range(20) if t not in (4, 12)]
    assert np.allclose(again.K, given.K[kept]) and np.allclose(again.c2w, given.c2w[kept])
    assert (again.near, again.far) == (given.near, given.far) == (0.5, 9.0)
    views = Truth.open(out / "truth").views
    assert np.allclose([view.K for view in views], given.K[[4, 12]])


def test_recordings_follow_the_response_and_truth_is_the_clip(tmp_path):
    out = reexpose(ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out", noise=0))
    radiance = read_exr(out / "truth/radiance/00004.exr")["RGB"]
    assert np.allclose(radiance, read_image(tmp_path / "in/004.png") ** 2.2, rtol=2e-3)
    expected = response_curve("film").apply(np.clip(radiance, 0, 1))  # frame 4 is taken at EV 0
    assert np.abs(read_image(out / "clip/00004.png") - expected).max() < 1.5 / 255


def test_exposures_of_a_reexposed_clip_are_found_again(tmp_path):
    out = reexpose(ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out", ev="0,-3,-1"))
    video = np.stack([read_image(f) for f in sorted((out / "clip").glob("*.png"))])
    cycle = detect_cycle(video)
    assert (cycle.length, cycle.order) == (3, [1, 2, 0])


def test_the_cycle_runs_unbroken_over_the_recorded_frames():
    work = plan_frames(20, 3, 8, remove=True)
    assert [work.bracket[k] for k in work.kept] == [n % 3 for n in range(18)]


@pytest.mark.parametrize("cycle", [2, 3, 4, 7])
@pytest.mark.parametrize("remove", [False, True])
def test_all_exposures_are_held_out_in_turn(cycle, remove):
    plan = plan_frames(120, cycle, 8, remove)
    first = [plan.bracket[k] for k in plan.test[:cycle]]
    assert sorted(first) == list(range(cycle))


def test_noise_repeats_with_its_seed(tmp_path):
    clip = ordinary_clip(tmp_path / "in", 4)
    images = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        out = reexpose(ReexposeConfig(clip, tmp_path / name, seed=seed))
        images.append(np.stack([read_image(f) for f in sorted((out / "clip").glob("*.png"))]))
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_masks_of_the_clip_become_masks_of_the_truth(tmp_path):
    for t in range(20):
        write_png(tmp_path / f"masks/{t:03d}.png", np.full((24, 40), t == 12))
    out = reexpose(
        ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out", masks=tmp_path / "masks")
    )
    views = Truth.open(out / "truth").views
    assert [read_image(out / "truth" / v.mask).mean() for v in views] == [0, 1]


def test_poses_shrink_with_the_frames(tmp_path):
    write_npy(tmp_path / "poses_bounds.npy", llff(20))
    out = reexpose(
        ReexposeConfig(
            ordinary_clip(tmp_path / "in"),
            tmp_path / "out",
            poses=tmp_path / "poses_bounds.npy",
            max_size=32,
        )
    )
    rows = 19 / 24  # 40x24 pixels become 32x19
    K = [[0.8 * 50, 0, 16], [0, rows * 50, rows * 12], [0, 0, 1]]
    assert np.allclose(Truth.open(out / "truth").K, K)


def test_an_interrupted_run_continues_and_a_finished_one_is_left_alone(tmp_path):
    config = ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out")
    out = reexpose(config)
    before = {f: f.read_bytes() for f in out.rglob("*") if f.is_file()}
    (out / "clip/00007.png").unlink()
    (out / "truth/truth.json").unlink()
    untouched = (out / "clip/00003.png").stat().st_mtime_ns
    reexpose(config)
    assert {f: f.read_bytes() for f in out.rglob("*") if f.is_file()} == before
    assert (out / "clip/00003.png").stat().st_mtime_ns == untouched


def test_output_of_another_clip_is_not_touched(tmp_path):
    reexpose(ReexposeConfig(ordinary_clip(tmp_path / "a"), tmp_path / "out"))
    note = (tmp_path / "out/reexpose.json").read_text()
    with pytest.raises(InputError, match="other settings"):
        reexpose(ReexposeConfig(tmp_path / "a", tmp_path / "out", ev="-1,1"))
    with pytest.raises(InputError, match="another clip"):
        reexpose(ReexposeConfig(ordinary_clip(tmp_path / "b", 19), tmp_path / "out"))
    with pytest.raises(InputError, match="not made by reexpose"):
        reexpose(ReexposeConfig(tmp_path / "a", tmp_path / "b"))
    assert (tmp_path / "out/reexpose.json").read_text() == note
    assert json.loads(note)["ev"] == "-2,0,2"


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"ev": "1/0"}, "divides by zero"),
        ({"ev": "auto"}, "list the log2 exposures"),
        ({"response": "velvia"}, "unknown"),
        ({"poses": Path("nowhere.npy")}, "no such file"),
        ({"masks": Path("nowhere")}, "0 masks"),
        ({"end": 2}, "at least 3"),
        ({"end": 0}, "nothing to read"),
        ({"stride": 0}, "nothing to read"),
        ({"noise": float("nan")}, "--noise nan"),
        ({"noise": float("-inf")}, "--noise -inf"),
        ({"hold_out": -1}, "--hold-out -1"),
        ({"seed": -1}, "--seed -1"),
    ],
)
def test_bad_settings_are_named(tmp_path, change, what):
    with pytest.raises(InputError, match=what):
        reexpose(ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out", **change))


def test_too_few_poses_are_named(tmp_path):
    write_npy(tmp_path / "poses_bounds.npy", llff(7))
    with pytest.raises(InputError, match="7 poses for 20 frames"):
        reexpose(
            ReexposeConfig(
                ordinary_clip(tmp_path / "in"),
                tmp_path / "out",
                poses=tmp_path / "poses_bounds.npy",
            )
        )


def test_auto_exposure_drifts_and_is_kept_as_truth(tmp_path):
    clip = ordinary_clip(tmp_path / "in")
    settings = ReexposeConfig(clip, tmp_path / "out", ev="-1", exposure="auto", noise=0)
    out = reexpose(settings)
    drift = np.array(Truth.open(out / "truth").clip_drift)
    files = sorted((out / "clip").glob("*.png"))
    assert len(drift) == len(files) == 20
    assert np.mean(drift) == pytest.approx(0, abs=1e-9) and 2 < np.ptp(drift) < 4
    brightness = [np.median(read_image(f)) for f in files]
    assert np.corrcoef(brightness, drift)[0, 1] > 0.8


def test_auto_exposure_may_jump_and_the_jumps_are_written_down(tmp_path):
    clip = ordinary_clip(tmp_path / "in", count=70)
    auto = ReexposeConfig(clip, tmp_path / "auto", exposure="auto", max_size=40)
    steps = replace(auto, out=tmp_path / "steps", exposure="steps")
    drifts = [
        np.array(Truth.open(reexpose(c) / "truth").clip_drift, np.float64) for c in (auto, steps)
    ]
    jumps = json.loads((tmp_path / "steps/reexpose.json").read_text())["jumps"]
    assert len(jumps) == 2 and set(map(abs, jumps.values())) == {1.0}
    expected = np.zeros(70)
    for frame, ev in jumps.items():
        expected[int(frame) :] += ev
    assert np.abs(expected).max() == 1.0
    np.testing.assert_allclose(drifts[1] - drifts[0], expected - expected.mean(), atol=1e-9)
    assert "jumps" not in json.loads((tmp_path / "auto/reexpose.json").read_text())
    reexpose(steps)  # once more, it is the same problem


def test_auto_exposure_without_jumps_stays_as_it_was_measured():
    """The documentation has results on clips that it made."""
    found = auto_exposure(6, range(6), 0, {})
    expected = [
        1.030327029901727,
        0.3897665181620387,
        -1.0641601354166277,
        -1.7824671068401656,
        0.12659122765504704,
        1.2999424665379804,
    ]
    assert found.tolist() == pytest.approx(expected, abs=1e-12)


def test_without_auto_exposure_no_drift_is_kept(tmp_path):
    out = reexpose(ReexposeConfig(ordinary_clip(tmp_path / "in"), tmp_path / "out"))
    assert Truth.open(out / "truth").clip_drift is None


def test_the_lost_rate_of_a_video_is_said(tmp_path, capsys):
    frames = [np.full((24, 40, 3), 0.1 + 0.03 * t) for t in range(20)]
    for fps in (24, 30):
        write_video(tmp_path / "in.mp4", frames, fps)
        reexpose(ReexposeConfig(tmp_path / "in.mp4", tmp_path / f"{fps}"))
        printed = " ".join(capsys.readouterr().err.split())
        assert ("30 frames a second are now 24" in printed) == (fps == 30)


def test_hdr_references_hold_the_linearized_clip(tmp_path):
    clip = tmp_path / "in"
    for t in range(8):
        write_png(clip / f"{t:03d}.png", np.full((64, 64, 3), 0.1 * (t + 1)))
    config = ReexposeConfig(clip, tmp_path / "out", hdr_video=("pq", "hlg"))
    out = reexpose(config)
    others = replace(config, hdr_video=("pq",), hdr_codec="prores", hdr_still=("png16",))
    reexpose(others)  # the same problem
    assert decoded(out / "reference_pq_prores.mov")[0].codec_context.name == "prores"
    still = cv2.imread(str(out / "reference/00003_pq.png"), cv2.IMREAD_UNCHANGED)
    light = display_light(np.full((1, 1, 3), 0.4**2.2), 1.0, "pq")
    assert np.allclose(pq_decode(still / 65535), light, rtol=0.01)
    for transfer in ("pq", "hlg"):
        _, frames = decoded(out / f"reference_{transfer}.mp4")
        assert len(frames) == 8
        light = display_light(np.full((2, 2, 3), 0.4**2.2), 1.0, transfer)
        expected = ycbcr_planes(encode(light, transfer))[0][0, 0]
        assert abs(float(np.median(luma(frames[3]))) - expected) < 4
