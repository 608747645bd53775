"""Footage and settings that cannot work: each is named in one sentence, and nothing that was there is lost."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.errors import InputError
from hdr_nsff.io import write_exr, write_npy, write_png, write_video
from hdr_nsff.prepare import PrepareConfig, prepare


def frames(count: int = 9, evs: tuple[float, ...] = (-2, 0, 2), size: tuple[int, int] = (32, 48)) -> list[np.ndarray]:
    """A noisy texture (H, W, 3) recorded with alternating exposures."""
    radiance = np.exp(np.random.default_rng(0).normal(size=(*size, 3)) - 2.5)
    return [np.clip(radiance * 2.0 ** evs[t % len(evs)], 0, 1) ** (1 / 2.2) for t in range(count)]


def clip(folder: Path, pictures: list[np.ndarray] | None = None) -> Path:
    """A folder of PNG frames."""
    for t, picture in enumerate(frames() if pictures is None else pictures):
        write_png(folder / f"{t:03d}.png", picture)
    return folder


def snapshot(folder: Path) -> dict[Path, bytes]:
    """All files below `folder` with their contents."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def refused(what: str, **settings: object) -> str:
    """That `prepare` refuses in one sentence with `what` in it, and leaves its input alone."""
    source = Path(str(settings["clip"]))
    before = {p: b for p, b in snapshot(source.parent).items() if "scene" not in p.relative_to(source.parent).parts}
    with pytest.raises(InputError, match=what) as caught:
        prepare(PrepareConfig(**{"out": source.parent / "scene", **settings}))  # type: ignore[arg-type]
    after = snapshot(source.parent)
    assert all(after[path] == contents for path, contents in before.items())
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_missing_input(tmp_path):
    refused("no such file or folder", clip=tmp_path / "nowhere.mp4")


def test_empty_folder_and_empty_file(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty.mp4").touch()
    refused("no frames", clip=tmp_path / "empty")
    refused("is empty", clip=tmp_path / "empty.mp4")


def test_text_file_named_mp4(tmp_path):
    (tmp_path / "notes.mp4").write_text("not a film\n" * 100)
    refused("not a readable video", clip=tmp_path / "notes.mp4")


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_truncated_video(tmp_path, suffix, share):
    path = tmp_path / f"clip{suffix}"
    write_video(path, frames(40))
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refused("cut short", clip=path)


@pytest.mark.parametrize("name", ["004.png", "004.jpg"])
def test_truncated_image(tmp_path, name):
    folder = clip(tmp_path / "clip")
    (folder / "004.png").unlink()
    from hdr_nsff.io import encode

    encode(folder / name, (frames()[4] * 255).astype(np.uint8))
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[: len(data) // 2])
    assert name in refused("cut short", clip=folder)


def test_truncated_exr(tmp_path):
    for t, picture in enumerate(frames()):
        write_exr(tmp_path / f"clip/{t}.exr", {"RGB": picture})
    data = (tmp_path / "clip/4.exr").read_bytes()
    (tmp_path / "clip/4.exr").write_bytes(data[: len(data) // 2])
    assert "4.exr" in refused("cut short|not a readable EXR", clip=tmp_path / "clip")


@pytest.mark.parametrize("count", [1, 2])
def test_one_and_two_frames(tmp_path, count):
    refused(f"{count} frames? to use; at least 3", clip=clip(tmp_path / "clip", frames(count)))


def test_a_single_picture_is_no_footage(tmp_path):
    refused("one frame is no footage", clip=clip(tmp_path / "clip") / "003.png")


def test_a_range_without_frames(tmp_path):
    refused("no frame 50", clip=clip(tmp_path / "clip"), start=50)
    refused("nothing to read", clip=tmp_path / "clip", start=5, end=5)


def test_frames_of_different_sizes(tmp_path):
    folder = clip(tmp_path / "clip")
    write_png(folder / "005.png", np.full((30, 48, 3), 0.5))
    refused("005.png: 48x30 pixels, but 000.png has 48x32", clip=folder)


@pytest.mark.parametrize(("value", "word"), [(0.0, "black"), (1.0, "white")])
def test_all_black_and_all_white(tmp_path, value, word):
    refused(f"all frames are {word}", clip=clip(tmp_path / "clip", [np.full((32, 48, 3), value)] * 9))


@pytest.mark.parametrize(("value", "word"), [(np.nan, "NaN"), (np.inf, "Inf"), (-0.5, "negative")])
def test_exr_with_impossible_radiance(tmp_path, value, word):
    import OpenEXR

    for t, picture in enumerate(frames()):
        pixels = np.ascontiguousarray(picture, dtype=np.float32)
        if t == 4:
            pixels[3, 5, 1] = value
        (tmp_path / "clip").mkdir(exist_ok=True)
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGB": pixels}) as file:
            file.write(str(tmp_path / f"clip/{t}.exr"))
    assert "4.exr" in refused(word, clip=tmp_path / "clip")


def test_exposure_list_that_fits_no_cycle(tmp_path):
    folder = clip(tmp_path / "clip", frames(24))
    refused("2 exposures listed.*repeats every 3", clip=folder, ev="-2,0")
    refused("4 exposures listed.*repeats every 3", clip=folder, exposures="1/1000,1/500,1/250,1/125")


def test_exposure_list_longer_than_the_clip(tmp_path):
    refused("5 exposures listed for 4 frames", clip=clip(tmp_path / "clip", frames(4)), ev="0,1,2,3,4")


@pytest.mark.parametrize("exposures", ["1/1000,1/0", "1/60,,1/30", "1/60;1/30", "-1/60,1/30", "0,1/30"])
def test_impossible_exposures(tmp_path, exposures):
    refused("--exposures", clip=clip(tmp_path / "clip"), exposures=exposures)


def test_a_csv_that_leaves_frames_out(tmp_path):
    folder = clip(tmp_path / "clip")
    (folder / "exposures.csv").write_text("file,ev\n000.png,-2\n")
    refused("no row for frame 001.png", clip=folder)


def test_settings_out_of_range(tmp_path):
    folder = clip(tmp_path / "clip")
    refused("--hold-out 1", clip=folder, hold_out=1)
    refused("--max-size 3", clip=folder, max_size=3)
    refused("--masks .*no such", clip=folder, masks=tmp_path / "nowhere")


def test_output_that_exists_from_another_input(tmp_path):
    refused("2 exposures listed", clip=clip(tmp_path / "one", frames(24)), ev="0,1")  # its frames are in the scene already
    before = snapshot(tmp_path / "scene")
    refused("holds the scene of other footage", clip=clip(tmp_path / "other"))
    assert snapshot(tmp_path / "scene") == before


def test_output_in_which_no_step_was_finished_is_free(tmp_path):
    refused("at least 3", clip=clip(tmp_path / "one", frames(2)))
    refused("2 exposures listed", clip=clip(tmp_path / "other", frames(24)), ev="0,1")


def test_output_that_is_a_file_or_holds_something_else(tmp_path):
    folder = clip(tmp_path / "clip")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.txt").write_text("mine")
    refused("is a file", clip=folder, out=tmp_path / "file")
    refused("holds other files", clip=folder, out=tmp_path / "full")


def test_scene_json_edited_into_nonsense(tmp_path):
    folder = clip(tmp_path / "clip", frames(2))
    refused("at least 3", clip=folder)
    for text in ("{", "[]", '{"source": 3}', '{"version": 99}', "\x00", ""):
        (tmp_path / "scene/scene.json").write_text(text)
        refused("scene.json: not a valid scene", clip=folder)
        assert (tmp_path / "scene/scene.json").read_text() == text
    refused("at least 3", clip=folder, redo=("frames",))  # offered by the sentence: starts anew


def test_disk_full_while_writing_is_said_and_the_next_run_goes_on(tmp_path, monkeypatch):
    folder, sync, calls = clip(tmp_path / "clip", frames(24)), os.fsync, []

    def full(handle: int) -> None:
        calls.append(handle)
        if len(calls) > 6:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(handle)

    monkeypatch.setattr(os, "fsync", full)
    refused("the disk is full", clip=folder)
    kept = {p: p.stat().st_mtime_ns for p in (tmp_path / "scene/images").glob("*.png")}
    assert kept and not list((tmp_path / "scene").rglob(".partial-*"))
    monkeypatch.setattr(os, "fsync", sync)
    with pytest.raises(InputError, match="2 exposures listed"):  # as far as it goes without poses: frames are done
        prepare(PrepareConfig(folder, tmp_path / "scene", ev="0,1"))
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    assert len(list((tmp_path / "scene/images").glob("*.png"))) == 24


def test_flow_and_masks_of_the_wrong_size_or_number(tmp_path):
    folder = clip(tmp_path / "clip")
    for i in range(9):
        write_png(tmp_path / f"masks/{i}.png", np.zeros((32, 47), bool))
        write_png(tmp_path / f"few/{i // 2}.png", np.zeros((32, 48), bool))
        for j in range(9):
            write_npy(tmp_path / f"small/{i:05d}_{j:05d}.npy", np.zeros((16, 24, 2), np.float32))
            write_npy(tmp_path / f"flow/{i:05d}_{j:05d}.npy", np.zeros((32, 48, 2), np.float32))
    refused("flow of shape .16, 24, 2.*size of the frames", clip=folder, flow=tmp_path / "small")
    refused("no flow from frame", clip=folder, flow=tmp_path / "few")
    refused("the mask is 47x32, frame 0 is 48x32", clip=folder, flow=tmp_path / "flow", masks=tmp_path / "masks")
    refused("5 maps for 9 frames", clip=folder, flow=tmp_path / "flow", masks=tmp_path / "few")
