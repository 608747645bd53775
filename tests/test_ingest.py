"""Reading footage: what counts as footage, in which order, and where its exposures are
written down.
"""

import weakref
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import OpenEXR
import pytest
from mutations import check_reader
from PIL import Image

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.video import write_video
from hdr_nsff.footage import linear_light
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.ingest import read_frames, shrink
from hdr_nsff.footage.still_frames import read_frame
from hdr_nsff.prepare.prepare import PrepareConfig, prepare


def picture(value: float, height: int = 24, width: int = 32) -> np.ndarray:
    """A ramp of brightness around `value` (H, W, 3)."""
    return np.clip(
        np.linspace(0.5, 1.5, width)[None, :, None] * np.full((height, 1, 3), value), 0, 1
    ).astype(np.float32)


def folder_of(path: Path, values: list[float], suffix: str = ".png") -> Path:
    """Frames 1, 2, 3, ... with these values; the numbers are not padded."""
    for i, value in enumerate(values, start=1):
        write_png(path / f"f{i}{suffix}", picture(value))
    return path


def all_frames(path: Path, **choice) -> list:
    """What `read_frames` gives, with everything chosen by default."""
    return list(
        read_frames(
            open_footage(path), **{"start": 0, "end": None, "stride": 1, "max_size": 640, **choice}
        )
    )


def test_frames_are_sorted_by_their_numbers(tmp_path):
    frames = all_frames(folder_of(tmp_path, [0.1 * k for k in range(1, 12)]))
    assert [f.source for f in frames] == [f"f{i}.png" for i in range(1, 12)]
    assert np.allclose([f.rgb.mean() for f in frames[:5]], [0.1, 0.2, 0.3, 0.4, 0.5], atol=0.01)


def test_only_decimal_digits_are_numbers_in_names(tmp_path):
    for name in ("1²2.png", "1²10.png", "0.png"):
        write_png(tmp_path / name, picture(0.5))
    assert [f.source for f in all_frames(tmp_path)] == ["0.png", "1²2.png", "1²10.png"]


@pytest.mark.parametrize("name", ["render.", "render_"])
def test_numbers_of_frames_may_be_negative(name, tmp_path):
    for number in (-10, -2, 0, 3):
        write_png(tmp_path / f"{name}{number}.png", picture(0.5))
    expected = [f"{name}{number}.png" for number in (-10, -2, 0, 3)]
    assert [f.source for f in all_frames(tmp_path)] == expected


@pytest.mark.parametrize("name", ["a-", "-", "2020-01-"])
def test_a_minus_that_separates_a_number_is_no_sign(name, tmp_path):
    for number in (1, 2, 10):
        write_png(tmp_path / f"{name}{number}.png", picture(0.5))
    expected = [f"{name}{number}.png" for number in (1, 2, 10)]
    assert [f.source for f in all_frames(tmp_path)] == expected


def test_range_and_stride_choose_frames_by_their_number(tmp_path):
    folder_of(tmp_path, [0.5] * 10)
    assert [f.number for f in all_frames(tmp_path, start=2, end=9, stride=3)] == [2, 5, 8]


def test_a_folder_of_folders_is_a_rig(tmp_path):
    for name in ("b", "a", "c"):
        folder_of(tmp_path / name, [0.5] * 3)
    frames = all_frames(tmp_path)
    assert [(f.camera_id, f.number, f.source) for f in frames[:4]] == [
        (0, 0, "a/f1.png"),
        (0, 1, "a/f2.png"),
        (0, 2, "a/f3.png"),
        (1, 0, "b/f1.png"),
    ]


def test_cameras_of_a_rig_need_the_same_number_of_frames(tmp_path):
    folder_of(tmp_path / "a", [0.5] * 3), folder_of(tmp_path / "b", [0.5] * 4)
    with pytest.raises(InputError, match=r"4 frames, but .*a has 3"):
        open_footage(tmp_path)


def test_a_scene_folder_among_the_cameras_is_none_of_them(tmp_path):
    for camera in ("a", "b"):
        for t in range(3):
            write_png(tmp_path / f"{camera}/{t}.png", np.zeros((16, 16, 3)))
    write_png(tmp_path / "out/contact_sheet.png", np.zeros((16, 16, 3)))
    (tmp_path / "out/scene.json").write_text("{}")
    assert len(open_footage(tmp_path).cameras) == 2


def test_a_scene_is_no_footage(tmp_path):
    folder_of(tmp_path, [0.5] * 3)
    (tmp_path / "scene.json").write_text('{"scale": 1, "center": [0, 0, 0]}')  # of a data set
    assert open_footage(tmp_path).count == 3
    (tmp_path / "scene.json").write_text('{"version": 2, "bracket_ev": [], "frames": []}')
    with pytest.raises(InputError, match=r"is a prepared scene, .*hdr-nsff train splat --scene"):
        open_footage(tmp_path)


def test_a_folder_of_videos_is_a_rig(tmp_path):
    for name, value in (("cam10.mp4", 0.6), ("cam2.mp4", 0.3)):
        write_video(tmp_path / name, [picture(value)] * 4, fps=12)
    write_png(tmp_path / "out/contact_sheet.png", np.zeros((16, 16, 3)))
    (tmp_path / "out/scene.json").write_text("{}")  # what `prepare` wrote there
    footage, frames = open_footage(tmp_path), all_frames(tmp_path, start=2)
    assert footage.root == tmp_path
    assert [(f.camera_id, f.number, f.source) for f in frames] == [
        (0, 2, "cam2.mp4#2"),
        (0, 3, "cam2.mp4#3"),
        (1, 2, "cam10.mp4#2"),
        (1, 3, "cam10.mp4#3"),
    ]
    assert np.allclose([f.rgb.mean() for f in frames], [0.3, 0.3, 0.6, 0.6], atol=0.03)


def test_stills_in_a_folder_beside_videos_are_no_footage(tmp_path):
    write_video(tmp_path / "a.mp4", [picture(0.5)] * 4, fps=12)
    folder_of(tmp_path / "thumbnails", [0.5] * 5)
    assert open_footage(tmp_path).cameras == [[tmp_path / "a.mp4"]]


@pytest.mark.parametrize(("frames", "fps"), [(5, 12), (4, 24)])
def test_videos_of_a_rig_need_one_length_and_one_rate(tmp_path, frames, fps):
    write_video(tmp_path / "a.mp4", [picture(0.5)] * 4, fps=12)
    write_video(tmp_path / "b.mp4", [picture(0.5)] * frames, fps=fps)
    with pytest.raises(InputError, match=r"b\.mp4: a\.mp4 and this video have"):
        open_footage(tmp_path)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".mov"])
def test_a_video_gives_its_frames_and_rate(tmp_path, suffix):
    clip = tmp_path / f"clip{suffix}"
    write_video(clip, [picture(0.1 * k) for k in range(1, 9)], fps=12)
    frames = all_frames(clip, start=1, stride=2)
    assert [f.source for f in frames] == [f"clip{suffix}#{k}" for k in (1, 3, 5, 7)]
    assert np.allclose([f.rgb.mean() for f in frames], [0.2, 0.4, 0.6, 0.8], atol=0.03)
    assert open_footage(clip).fps == 12


def test_paths_may_hold_spaces_and_any_letters(tmp_path):
    clip = tmp_path / "Žlutý kůň 夜 #1"
    folder_of(clip / "kamera één", [0.3] * 3)
    write_video(clip / "夜 film.mp4", [picture(0.5)] * 4)
    assert len(all_frames(clip / "kamera één")) == 3
    assert len(all_frames(clip / "夜 film.mp4")) == 4


def test_sixteen_bit_tiff_and_jpeg_keep_their_values(tmp_path):
    value = np.full((8, 8, 3), 12345, np.uint16)
    cv2.imwrite(str(tmp_path / "1.tiff"), value)
    Image.fromarray(np.full((8, 8, 3), 99, np.uint8)).save(tmp_path / "2.jpg", quality=100)
    frames = all_frames(tmp_path)
    assert np.allclose(frames[0].rgb, 12345 / 65535)
    assert np.allclose(frames[1].rgb, 99 / 255, atol=1 / 255)


def codes(largest: int, clipped: int, dtype: type = np.uint16) -> np.ndarray:
    """Noise (24, 32, 3) below the code `largest`, which so many pixels have."""
    picture = np.random.default_rng(0).integers(0, largest, (24, 32, 3)).astype(dtype)
    picture.reshape(-1, 3)[:clipped] = largest
    return picture


@pytest.mark.parametrize(("bits", "factor"), [(10, 64), (12, 16), (14, 4)])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_narrow_codes_in_16_bit_files_are_refused(tmp_path, bits, factor, suffix):
    folder = tmp_path / "clip"
    folder.mkdir()
    for t, clipped in enumerate((0, 100, 0)):
        cv2.imwrite(str(folder / f"{t}{suffix}"), codes(2**bits - 1, clipped))
    assert len(all_frames(folder, end=1)) == 1  # nothing is clipped there
    words = rf"clip: looks like {bits}-bit values in 16-bit files.*multiply all values by {factor},"
    with pytest.raises(InputError, match=words):
        all_frames(folder)
    for file in folder.iterdir():  # as the message advises
        cv2.imwrite(str(file), factor * cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
    frames = all_frames(folder)
    assert max(f.rgb.max() for f in frames) == pytest.approx(1, abs=1e-3)


def test_narrow_codes_of_one_camera_are_refused_before_the_next_one(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), codes(4095, 100))
    frames = read_frames(open_footage(tmp_path), 0, None, 1, 640)
    assert next(frames).camera_id == 0
    with pytest.raises(InputError, match=r"a: looks like 12-bit values"):
        next(frames)


def test_dark_pictures_of_full_range_are_read(tmp_path):
    for name, frames in {
        "a single pixel is the brightest": [codes(4095, 1), codes(2000, 0)],
        "another code": [codes(4094, 100), codes(4094, 100)],
        "brighter in another frame": [codes(4095, 100), codes(4097, 1)],
        "8 bits": [codes(15, 100, np.uint8), codes(15, 100, np.uint8)],
        "8 bits scaled up": [257 * codes(15, 100), 256 * codes(16, 100)],
    }.items():
        (tmp_path / name).mkdir()
        for t, frame in enumerate(frames):
            cv2.imwrite(str(tmp_path / name / f"{t}.png"), frame)
        assert len(all_frames(tmp_path / name)) == 2, name


def test_linear_frames_share_one_scale_and_are_encoded(tmp_path):
    for i, level in enumerate((0.5, 2.0, 8.0)):
        write_exr(tmp_path / f"{i}.exr", {"RGB": np.full((16, 16, 3), level, np.float32)})
    decoded = [f.rgb.mean() ** 2.2 for f in all_frames(tmp_path)]
    assert np.allclose(decoded, [0.5 / 8, 2 / 8, 1], rtol=0.01)


def test_linear_frames_within_one_are_not_scaled(tmp_path):
    write_exr(tmp_path / "0.exr", {"RGB": np.full((16, 16, 3), 0.25, np.float32)})
    assert np.allclose(all_frames(tmp_path)[0].rgb, 0.25 ** (1 / 2.2), atol=1e-3)


def test_the_scale_of_linear_frames_is_found_with_one_of_them_in_memory(monkeypatch):
    rng = np.random.default_rng(0)
    stored = {f"{t}.exr": (2.0**t * rng.random((37, 50, 3))).astype(np.float32) for t in range(6)}
    given: list[weakref.ref] = []

    def read(path: Path) -> np.ndarray:
        assert not any(ref() is not None for ref in given), f"a frame is left before {path}"
        frame = stored[path.name].copy()
        given.append(weakref.ref(frame))
        return frame

    monkeypatch.setattr(linear_light, "read_frame", read)
    scale = linear_light.linear_scale([Path(name) for name in stored])
    sampled = np.concatenate([frame[::4, ::4].ravel() for frame in stored.values()])
    assert len(given) == 6 and scale == 1 / float(np.percentile(sampled, 99.9))


def test_raw_frames_are_not_read_for_a_scale(monkeypatch):
    """They are never brighter than 1; reading one takes seconds."""
    monkeypatch.setattr(linear_light, "read_frame", lambda path: pytest.fail(f"{path} is read"))
    assert linear_light.linear_scale([Path("a.dng"), Path("b.DNG")]) == 1


def test_only_the_colors_of_a_linear_frame_have_to_be_finite(tmp_path):
    light, depth = picture(0.5), np.full((24, 32), np.inf, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": light, "Z": depth}) as file:
        file.write(str(tmp_path / "a.exr"))
    assert np.array_equal(read_frame(tmp_path / "a.exr"), light)
    with OpenEXR.File(header, {"RGB": light * np.float32(np.inf), "Z": depth}) as file:
        file.write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match="channel RGB holds NaN or Inf"):
        read_frame(tmp_path / "a.exr")


@pytest.mark.parametrize("channel", ["RGB", "Y"])
def test_radiance_below_zero_is_refused_in_color_and_gray(channel, tmp_path):
    light = picture(0.5) - 0.4
    write_exr(tmp_path / "a.exr", {channel: light if channel == "RGB" else light[..., 0]})
    with pytest.raises(InputError, match=r"a\.exr: negative radiance"):
        read_frame(tmp_path / "a.exr")


def test_linear_frames_need_one_data_window(tmp_path):
    for i in range(3):
        window = (np.array([0, i // 2], np.int32), np.array([31, 23 + i // 2], np.int32))
        write_exr(tmp_path / f"{i}.exr", {"RGB": picture(0.5)}, {"dataWindow": window})
    with pytest.raises(InputError, match=r"2\.exr: .* begins at \(0, 1\), that of 0\.exr"):
        all_frames(tmp_path)
    assert len(all_frames(tmp_path, end=2)) == 2


def test_shrinking_averages_and_keeps_the_shape():
    image = np.arange(2 * 4 * 6 * 3, dtype=np.float32).reshape(8, 6, 3)
    small = shrink(image, 4)
    assert small.shape == (4, 3, 3)
    assert np.allclose(small[0, 0], image[:2, :2].mean((0, 1)))
    assert shrink(image, 8) is image


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".exr"])
def test_damaged_frames_are_read_or_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    if suffix == ".exr":
        write_exr(path, {"RGB": picture(0.5)})
    else:
        cv2.imwrite(str(path), (picture(0.5) * 255).astype(np.uint8))
    check_reader(path, lambda: read_frame(path), 100)


def test_damaged_videos_are_read_or_refused(tmp_path):
    path = tmp_path / "a.mp4"
    write_video(path, [picture(0.1 * k) for k in range(6)])
    check_reader(path, lambda: all_frames(path), 60)


def write_held_video(path: Path, count: int = 30) -> Path:
    """Frames of noise, 30 a second, and the last of them is shown for a second."""
    noise = np.random.default_rng(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        packets = []
        for number in range(count):
            picture = noise.integers(0, 256, (48, 64, 3), np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            packets += stream.encode(frame)
        packets += stream.encode(None)
        max(packets, key=lambda p: p.pts).duration = 30
        for packet in packets:
            container.mux(packet)
    return path


def test_seconds_since_1970_in_names_are_decimals(tmp_path):
    """Programs that write them leave out last zeros."""
    times = [1548266470 + k / 30 for k in range(7)]
    for second in times:
        write_png(tmp_path / f"{round(second, 5)}.png", picture(0.5))
    found = [float(file.stem) for file in open_footage(tmp_path).cameras[0]]
    assert found == sorted(found) and len(found) == 7


def test_videos_of_different_length_are_refused_without_a_count_in_their_headers(tmp_path):
    for name, count in (("a.mkv", 6), ("b.mkv", 4)):
        write_held_video(tmp_path / name, count)
    assert open_footage(tmp_path).count == 0
    with pytest.raises(InputError, match="6 and 4 frames"):
        prepare(PrepareConfig(tmp_path, tmp_path.parent / "scene"))


def test_all_fragments_of_a_video_are_read(tmp_path):
    """The header of a fragmented file counts the frames of the first fragment."""
    path = tmp_path / "a.mp4"
    options = {"movflags": "frag_keyframe"}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "6"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number in range(24):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 5 * number, np.uint8))
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert len(all_frames(path)) == 24
    assert open_footage(path).count in (0, 24)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".mov"])
def test_a_video_whose_last_frame_is_held_long_is_whole(tmp_path, suffix):
    frames = all_frames(write_held_video(tmp_path / f"a{suffix}"))
    assert len(frames) == 30 and frames[-1].seconds == pytest.approx(29 / 30, abs=1e-3)


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".mov"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_video_is_cut_short_before_a_frame_that_is_held_long(tmp_path, suffix, share):
    path = write_held_video(tmp_path / f"a{suffix}")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputError, match="cut short"):
        all_frames(path)
