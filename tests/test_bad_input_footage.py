"""Footage, and settings for it, that cannot work: every verb that reads footage names
them in one sentence, and loses nothing.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from bad_input import (
    FOOTAGE_VERBS,
    FRAMES,
    Capture,
    call,
    clip,
    cut,
    on_footage,
    prepared,
    recorded,
    refused,
    snapshot,
)

from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import encode, write_png
from hdr_nsff.core.io import write_npy, write_text
from hdr_nsff.core.video import write_video
from hdr_nsff.scene.manifest import Manifest


@pytest.mark.parametrize("verb", FOOTAGE_VERBS)
def test_missing_and_empty_footage(verb: str, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty.mp4").touch()
    for name, word in (
        ("nowhere", "no such file or folder"),
        ("empty", "no frames"),
        ("empty.mp4", "is empty"),
    ):
        assert word in refused(capsys, *on_footage(verb, tmp_path / name, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def one_bad(folder: Path, damage: Callable[[Path], object], suffix: str = ".png") -> Path:
    """Frames, the fifth of them damaged."""
    for t, picture in enumerate(recorded()):
        name = folder / f"{t:03d}{suffix}"
        write_png(name, picture) if suffix == ".png" else write_exr(name, {"RGB": picture})
    damage(folder / f"004{suffix}")
    return folder


def exr_with(value: float) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        pixels = np.full((34, 60, 3), 0.5, np.float32)
        pixels[3, 5, 1] = value
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"RGB": pixels}) as file:
            file.write(str(path))

    return damage


def claim_size(path: Path) -> None:
    """Have a PNG claim 40000 x 30000 pixels in its header."""
    data = path.read_bytes()
    header = b"IHDR" + struct.pack(">II", 40000, 30000) + data[24:29]
    path.write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])


def clip_of_codes(folder: Path, white: int) -> Path:
    """Frames in 16-bit files whose white is the code `white`."""
    for t, picture in enumerate(recorded()):
        codes = np.rint(np.clip(1.2 * picture, 0, 1) * white).astype(np.uint16)
        encode(folder / f"{t:03d}.png", codes)
    return folder


def text_video(folder: Path) -> Path:
    folder.mkdir()
    (folder / "notes.mp4").write_text("not a film\n" * 100)
    return folder / "notes.mp4"


def cut_video(folder: Path) -> Path:
    write_video(folder / "clip.mp4", recorded(20))
    cut(folder / "clip.mp4")
    return folder / "clip.mp4"


FOOTAGE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a text file named mp4": (text_video, "not a readable video"),
    "a video cut short": (cut_video, "cut short"),
    "a PNG cut short": (lambda p: one_bad(p, cut), "004.png: the PNG is cut short"),
    "a text file named PNG": (
        lambda p: one_bad(p, lambda f: f.write_text("no picture")),
        "004.png",
    ),
    "an empty PNG": (lambda p: one_bad(p, lambda f: f.write_bytes(b"")), "004.png"),
    "an EXR cut short": (lambda p: one_bad(p, cut, ".exr"), "004.exr"),
    "a text file named EXR": (
        lambda p: one_bad(p, lambda f: f.write_text("no picture"), ".exr"),
        "004.exr: not a readable EXR",
    ),
    "NaN in an EXR": (lambda p: one_bad(p, exr_with(np.nan), ".exr"), "NaN or Inf"),
    "Inf in an EXR": (lambda p: one_bad(p, exr_with(np.inf), ".exr"), "NaN or Inf"),
    "negative radiance": (
        lambda p: one_bad(p, exr_with(-0.5), ".exr"),
        "004.exr: negative radiance",
    ),
    "one frame": (lambda p: clip(p, recorded(1)), "1 frame "),
    "two frames": (lambda p: clip(p, recorded(2)), "2 frames "),
    "frames of two sizes": (
        lambda p: one_bad(p, lambda f: write_png(f, np.full((30, 60, 3), 0.5))),
        "004.png: 60x30 pixels",
    ),
    "frames of one pixel": (
        lambda p: clip(p, [np.full((1, 1, 3), 0.5)] * FRAMES),
        "frames are 1x1 pixels, at least 11x11 are needed",
    ),
    "frames of one row": (
        lambda p: clip(p, [np.full((1, 64, 3), 0.5)] * FRAMES),
        "frames are 64x1 pixels",
    ),
    "frames of ten columns": (
        lambda p: clip(p, [np.full((64, 10, 3), 0.5)] * FRAMES),
        "frames are 10x64 pixels",
    ),
    "a PNG of a thousand megapixels": (
        lambda p: one_bad(p, claim_size),
        "004.png: 40000x30000 pixels, more than the 200 megapixels",
    ),
    "12 bits in files of 16": (
        lambda p: clip_of_codes(p, 4095),
        "looks like 12-bit values in 16-bit files",
    ),
    "all black": (lambda p: clip(p, [np.zeros((34, 60, 3))] * FRAMES), "all frames are black"),
    "all white": (lambda p: clip(p, [np.ones((34, 60, 3))] * FRAMES), "all frames are white"),
}


@pytest.mark.parametrize("verb", FOOTAGE_VERBS)
@pytest.mark.parametrize("what", FOOTAGE)
def test_footage_that_cannot_be_is_named(
    what: str, verb: str, tmp_path: Path, capsys: Capture
) -> None:
    make, expected = FOOTAGE[what]
    footage = make(tmp_path / "ein clip ü")
    before = snapshot(tmp_path)
    assert expected in refused(capsys, *on_footage(verb, footage, tmp_path / "out"))
    after = snapshot(tmp_path)
    assert after == before and not (tmp_path / "out").exists()


def test_a_truncated_exr_prints_one_sentence_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    footage = one_bad(tmp_path / "clip", cut, ".exr")
    assert call("prepare", footage, tmp_path / "scene") == 2
    printed = capfd.readouterr().err.strip()  # OpenEXR itself would print more
    assert len(printed.splitlines()) == 1


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_video_cut_short_anywhere(
    suffix: str, share: float, tmp_path: Path, capsys: Capture
) -> None:
    path = tmp_path / f"clip{suffix}"
    write_video(path, recorded(40))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert "cut short" in prepared(capsys, path)


def test_a_jpeg_cut_short(tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip")
    (folder / "004.png").unlink()
    encode(folder / "004.jpg", (recorded()[4] * 255).astype(np.uint8))
    cut(folder / "004.jpg")
    assert "004.jpg: the JPEG is cut short" in prepared(capsys, folder)


def test_a_single_picture_is_no_footage(tmp_path: Path, capsys: Capture) -> None:
    assert "a single frame is not footage" in prepared(capsys, clip(tmp_path / "clip") / "003.png")


def test_a_range_without_frames(tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip")
    assert "no frame 50" in prepared(capsys, folder, "--start", 50)
    assert "nothing to read" in prepared(capsys, folder, "--start", 5, "--end", 5)
    assert "--readout -1: give the milliseconds" in prepared(capsys, folder, "--readout", -1)
    assert "--readout nan: give the milliseconds" in prepared(capsys, folder, "--readout", "nan")
    sentence = prepared(capsys, folder, "--start", 50)
    assert f"--start 50: no frame 50 in {folder}, which has 9, counted from 0" in sentence
    assert "--hold-out -3: no number of frames; use 2" in prepared(capsys, folder, "--hold-out", -3)
    out = tmp_path / "problem"
    sentence = refused(capsys, "reexpose", folder, out, "--ev=-2,0", "--start", 50)
    assert "--start 50: no frame 50" in sentence and not out.exists()


def test_too_few_frames_are_refused_before_anything_is_written(
    tmp_path: Path, capsys: Capture
) -> None:
    footage, out = clip(tmp_path / "clip"), tmp_path / "out"
    for more in (["--start", 7], ["--stride", 5], ["--end", 2]):
        assert "2 frames to use; at least 3" in refused(capsys, "prepare", footage, out, *more)
        assert not out.exists()


def test_a_refused_first_step_keeps_what_else_is_there(tmp_path: Path, capsys: Capture) -> None:
    make, _ = FOOTAGE["frames of two sizes"]
    footage, out = make(tmp_path / "clip"), tmp_path / "out"
    out.mkdir()
    assert "60x30 pixels" in refused(capsys, "prepare", footage, out)
    assert out.is_dir() and not any(out.iterdir())
    assert "60x30 pixels" in refused(capsys, "prepare", footage, out / "a/b", "--segment", 0.2)
    assert not any(out.iterdir())


# Settings and maps


@pytest.mark.parametrize("verb", ["prepare", "reexpose"])
def test_settings_out_of_range(verb: str, tmp_path: Path, capsys: Capture) -> None:
    footage, out = clip(tmp_path / "clip"), tmp_path / "out"
    for option, value, words in (
        ("--hold-out", 1, "--hold-out 1"),
        ("--hold-out", -5, "--hold-out -5"),
        ("--max-size", 3, "--max-size 3"),
        ("--stride", 0, "in steps of 0"),
        ("--start", -1, "frames -1"),
        ("--end", 0, "to 0"),
        ("--ev", "0,1e308", "--ev 1e+308"),
    ):
        assert words in refused(capsys, verb, footage, out, f"{option}={value}")
    assert not out.exists()


@pytest.mark.parametrize(
    "option", ["--noise=nan", "--noise=-inf", "--noise=1e300", "--noise=-1", "--seed=-1"]
)
def test_noise_that_no_sensor_has(option: str, tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip")
    name = option.partition("=")[0]
    assert name in refused(capsys, "reexpose", folder, tmp_path / "out", option)
    assert not (tmp_path / "out").exists()


def test_an_end_beyond_the_clip_is_the_end(tmp_path: Path, capsys: Capture) -> None:
    """The frames are read, and the exposures found wrong after them."""
    folder = clip(tmp_path / "clip", recorded(24))
    sentence = prepared(capsys, folder, "--end", 10**30, "--stride", 1, "--ev=0,1")
    assert "2 exposures listed" in sentence
    assert "0 frames to use" in prepared(capsys, folder, "--start", 10**30, "--redo", "frames")


def test_flow_and_masks_of_the_wrong_size_or_number_are_refused(
    tmp_path: Path, capsys: Capture
) -> None:
    folder = clip(tmp_path / "clip")
    for i in range(FRAMES):
        write_png(tmp_path / f"masks/{i}.png", np.zeros((34, 59), bool))
        write_png(tmp_path / f"few/{i // 2}.png", np.zeros((34, 60), bool))
        for j in range(FRAMES):
            write_npy(tmp_path / f"small/{i:05d}_{j:05d}.npy", np.zeros((17, 30, 2), np.float32))
            write_npy(tmp_path / f"flow/{i:05d}_{j:05d}.npy", np.zeros((34, 60, 2), np.float32))
    flow = ["--flow", tmp_path / "flow"]
    assert "flow of shape (17, 30, 2)" in prepared(capsys, folder, "--flow", tmp_path / "small")
    assert "no flow from frame" in prepared(capsys, folder, "--flow", tmp_path / "few")
    assert "the mask is 59x34, frame 0 is 60x34" in prepared(
        capsys, folder, *flow, "--masks", tmp_path / "masks"
    )
    assert "5 maps for 9 frames" in prepared(capsys, folder, *flow, "--masks", tmp_path / "few")
    assert "the mask is 59x34" in refused(
        capsys, "reexpose", folder, tmp_path / "out", "--masks", tmp_path / "masks"
    )
    assert not (tmp_path / "out").exists()


def test_masks_and_depth_that_do_not_fit_are_found_before_flow(
    tmp_path: Path, capsys: Capture
) -> None:
    folder, wide = clip(tmp_path / "clip"), tmp_path / "wide"
    for i in range(FRAMES):
        write_png(wide / f"{i}.png", np.zeros((34, 61), bool))
        write_png(tmp_path / f"named/{i // 2:03d}.png", np.zeros((34, 60), bool))
        write_text(tmp_path / f"named/._{i // 2:03d}.png", "")  # as macOS leaves them
        write_npy(tmp_path / f"tall/{i}.npy", np.ones((35, 60), np.float32))
        write_npy(tmp_path / f"empty/{i}.npy", np.full((34, 60), i - 8.0, np.float32))
    named = f"{tmp_path / 'named'}: 5 maps for 9 frames, none for 005.png;"
    for option, place, words in (
        ("--mask", wide, f"--mask {wide / '0.png'}: the mask is 61x34"),
        ("--mask", tmp_path / "named", f"--mask {named}"),
        ("--depth", tmp_path / "named", f"--depth {named}"),
        ("--depth", tmp_path / "tall", "0.npy: a depth map of shape (35, 60)"),
        ("--depth", tmp_path / "empty", "0.npy: no depth above 0 in this map"),
        ("--mask", wide / "0.png", "0.png: is a file; name the folder that holds it"),
    ):
        assert words in prepared(capsys, folder, option, place)
    steps = Manifest.load(tmp_path / "scene").steps
    assert [name for name, step in steps.items() if step.done] == ["frames", "exposure"]
    # A step that would be done again keeps what it has left.
    write_text(tmp_path / "scene/raw_flow/00000_00001.npy", "")
    assert "61x34" in prepared(capsys, folder, "--mask", wide, "--redo", "flow")
    assert (tmp_path / "scene/raw_flow/00000_00001.npy").is_file()


# Output that is there already, or half there


def test_a_scene_of_other_footage_stays(tmp_path: Path, capsys: Capture) -> None:
    first = clip(tmp_path / "one", recorded(24))
    prepared(capsys, first, "--ev=0,1")  # its frames are in the scene already
    before = snapshot(tmp_path / "scene")
    assert "holds the scene of other footage" in prepared(capsys, clip(tmp_path / "other"))
    assert before and snapshot(tmp_path / "scene") == before


def test_output_in_which_no_step_was_finished_is_free(tmp_path: Path, capsys: Capture) -> None:
    assert "at least 3" in prepared(capsys, clip(tmp_path / "one", recorded(2)))
    assert "2 exposures listed" in prepared(
        capsys, clip(tmp_path / "other", recorded(24)), "--ev=0,1"
    )


def test_output_that_is_a_file_or_holds_other_files_is_refused(
    tmp_path: Path, capsys: Capture
) -> None:
    folder = clip(tmp_path / "clip")
    (tmp_path / "scene").write_text("mine")
    assert "is a file" in prepared(capsys, folder)
    (tmp_path / "scene").unlink()
    write_text(tmp_path / "scene/thesis.txt", "mine")
    assert "holds other files" in prepared(capsys, folder)
    assert (tmp_path / "scene/thesis.txt").read_text() == "mine"


def test_scene_json_edited_into_nonsense(tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip", recorded(2))
    assert "at least 3" in prepared(capsys, folder)
    (tmp_path / "scene").mkdir()
    for text in ("{", "[]", '{"source": 3}', '{"version": 99}', "\x00", ""):
        (tmp_path / "scene/scene.json").write_text(text)
        assert "scene.json: not a valid scene" in prepared(capsys, folder)
        assert (tmp_path / "scene/scene.json").read_text() == text
    # The command that the sentence suggests starts from the beginning.
    assert "at least 3" in prepared(capsys, folder, "--redo", "frames")


def test_a_disk_that_fills_up_between_frames_keeps_those_that_are_done(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, sync, calls = clip(tmp_path / "clip", recorded(24)), os.fsync, []

    def full(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(handle)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert "the disk is full" in prepared(capsys, folder, "--ev=0,1")
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "scene/images").glob("*.png")}
    assert kept and not list((tmp_path / "scene").rglob(".partial-*"))
    sentence = prepared(capsys, folder, "--ev=0,1")
    assert "2 exposures listed" in sentence  # in the step after the frames
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert len(list((tmp_path / "scene/images").glob("*.png"))) == 24
