"""Exposures that the user gives: on the command line, in a CSV, in EXIF."""

import math
from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import write_png
from hdr_nsff.core.video import write_video
from hdr_nsff.footage.exposure_lists import (
    log2_seconds,
    parse_exposures,
    parse_number,
    read_exif_ev,
    read_exposure_csv,
)
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.footage.timestamps import read_timestamps

GRAY = np.full((24, 32, 3), 0.5)


def write_frames(folder: Path, count: int) -> Path:
    """Frames f1.png, f2.png, ..."""
    for k in range(count):
        write_png(folder / f"f{k + 1}.png", GRAY)
    return folder


def test_exposure_times_become_log2_seconds():
    assert np.allclose(
        parse_exposures("1/1000, 1/250,0.25", None), [-math.log2(1000), -math.log2(250), -2]
    )
    assert parse_exposures(None, "-4,-2,0") == [-4, -2, 0]
    assert parse_exposures("auto", None) is None
    assert parse_exposures(None, None) is None


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("1/0", "divides by zero"),
        ("-1/60", "impossible"),
        ("abc", "not a number"),
        ("inf", "not finite"),
        ("", "not a number"),
    ],
)
def test_an_impossible_exposure_is_named(text, what):
    with pytest.raises(InputError, match=what):
        log2_seconds(text, "--exposures")


def test_both_kinds_of_list_at_once_are_refused():
    with pytest.raises(InputError, match="both given"):
        parse_exposures("1/60", "0")
    with pytest.raises(InputError, match="divides by zero"):
        parse_number("3/0", "--ev")


def test_a_csv_beside_the_frames_is_read(tmp_path):
    write_frames(tmp_path, 2)
    (tmp_path / "exposures.csv").write_text("file, exposure\nf1.png, 1/4\nf2.png, 1/2\n")
    path, rows = read_exposure_csv(open_footage(tmp_path))
    assert path.name == "exposures.csv"
    assert rows == {"f1.png": -2, "f2.png": -1}


def test_a_csv_beside_a_video_names_frames_by_number(tmp_path):
    write_video(tmp_path / "clip.mp4", [GRAY] * 2)
    (tmp_path / "clip.csv").write_text("frame,ev\n0,-3\n1,1.5\n", encoding="utf-8-sig")
    assert read_exposure_csv(open_footage(tmp_path / "clip.mp4"))[1] == {"#0": -3, "#1": 1.5}


def test_numbers_of_frames_may_have_leading_zeros(tmp_path):
    write_frames(tmp_path, 2)
    text = "frame,ev,timestamp_ns\n0000,-3,5e9\n0001,1.5,6e9\n"
    (tmp_path / "exposures.csv").write_text(text)
    footage = open_footage(tmp_path)
    assert read_exposure_csv(footage)[1] == {"#0": -3, "#1": 1.5}
    assert read_timestamps(footage) == {"#0": 5, "#1": 6}


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("file,ev\nf1.png,1/0\n", "line 2"),
        ("file,exposure\nf1.png,1e-300\n", "line 2: -996.6 EV is beyond"),
        ("file,ev\nf1.png,1e300\n", r"line 2: 1e\+300 EV is beyond all light \(at most 60\)"),
        ("name,value\n", "columns"),
        ("", "columns"),
        ("file;ev\nf1.png;1\n", "columns are file;ev"),
        ("file,ev\nf1.png\n", "line 2: no value for column ev"),
        ("exposure,frame\n1/100,0\n1/100\n", "line 3: no value for column frame"),
        ("file,ev\n\nf1.png,\n", "line 3: '' is not a number"),
        ("file,ev\nf1.png,0,5\n", "line 2: more values than columns"),
        ("file,ev\n" + "x" * 140_000 + ",1\n", "line 2: no readable CSV"),
        (b"file,ev\nf1.png,1\nf\xfc2.png,1\n", "line 3: not UTF-8"),
        ("file,ev\nf1.png,1\n".encode("utf-16"), "line 1: not UTF-8"),
    ],
)
def test_a_csv_that_makes_no_sense_is_named(tmp_path, text, what):
    write_frames(tmp_path, 1)
    data = text if isinstance(text, bytes) else text.encode()
    (tmp_path / "exposures.csv").write_bytes(data)
    with pytest.raises(InputError, match=f"exposures.csv.*{what}"):
        read_exposure_csv(open_footage(tmp_path))


def test_a_csv_may_end_its_lines_with_a_comma_and_leave_lines_empty(tmp_path):
    write_frames(tmp_path, 1)
    (tmp_path / "exposures.csv").write_text("file,ev,\r\n\r\nf1.png,1,\r\nf2.png,2,,\r\n")
    assert read_exposure_csv(open_footage(tmp_path))[1] == {"f1.png": 1, "f2.png": 2}


def test_damaged_exposure_lists_are_read_or_refused(tmp_path):
    write_frames(tmp_path, 1)
    path = tmp_path / "exposures.csv"
    path.write_text('file, exposure\nf1.png, 1/4\nf2.png, 1/2\n"f3.png", 0.25\n')
    check_reader(path, lambda: read_exposure_csv(open_footage(tmp_path)), 300)


def test_exif_exposure_counts_time_sensitivity_and_aperture(tmp_path):
    exif = Image.Exif()
    # 1/64 s, ISO 400, f/2: -6 + 2 - 2
    exif.get_ifd(0x8769).update(
        {0x829A: IFDRational(1, 64), 0x8827: 400, 0x829D: IFDRational(2, 1)}
    )
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    Image.new("RGB", (8, 8)).save(tmp_path / "b.jpg")
    assert read_exif_ev(tmp_path / "a.jpg") == pytest.approx(-6)
    assert read_exif_ev(tmp_path / "b.jpg") is None


def test_damaged_exif_holds_no_exposure_or_one(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829A: IFDRational(1, 64), 0x8827: 400})
    path = tmp_path / "a.jpg"
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    check_reader(path, lambda: read_exif_ev(path), 300)


@pytest.mark.parametrize("value", [IFDRational(0, 1), IFDRational(1, 0), IFDRational(-1, 60)])
def test_exif_of_an_impossible_exposure_holds_none(tmp_path, value):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829A: value, 0x8827: 400})
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    assert read_exif_ev(tmp_path / "a.jpg") is None


@pytest.mark.parametrize(
    ("columns", "cells", "ev"),
    [
        ("exposure_s", "1/4", -2),
        ("exposure_us", "250000", -2),
        ("exposure_ns", "250000000", -2),
        ("exposure_us,iso", "250000,400", 0),
        ("exposure_s,gain_db", "1/4,12.0412", 0),
        ("exposure_s,aperture", "1/4,2", -4),
        ("exposure,iso,gain_db,aperture", "1/4,200,6.0206,4", -4),
        ("ev,iso", "-1,400", -1),
    ],
)
def test_a_csv_holds_times_in_any_unit_and_gains(columns, cells, ev, tmp_path):
    write_frames(tmp_path, 1)
    (tmp_path / "exposures.csv").write_text(f"file,{columns}\nf1.png,{cells}\n")
    _, rows = read_exposure_csv(open_footage(tmp_path))
    assert rows["f1.png"] == pytest.approx(ev, abs=1e-4)


@pytest.mark.parametrize("column", ["iso", "aperture"])
def test_a_gain_that_is_not_above_zero_is_refused(column, tmp_path):
    write_frames(tmp_path, 1)
    (tmp_path / "exposures.csv").write_text(f"file,exposure,{column}\nf1.png,1/4,0\n")
    with pytest.raises(InputError, match=f"{column} 0 is not above 0"):
        read_exposure_csv(open_footage(tmp_path))


def test_lists_in_the_folders_of_cameras_are_not_passed_over(tmp_path):
    for camera in ("a", "b"):
        write_frames(tmp_path / camera, 2)
    (tmp_path / "b/exposures.csv").write_text("file,ev\nf1.png,0\nf2.png,1\n")
    with pytest.raises(InputError, match=r"b/exposures.csv: .* one list for all cameras; join"):
        read_exposure_csv(open_footage(tmp_path))


@pytest.mark.parametrize("read", [read_exposure_csv, read_timestamps])
def test_a_folder_in_the_place_of_a_list_is_not_passed_over(tmp_path, read):
    write_frames(tmp_path, 2)
    (tmp_path / "exposures.csv").mkdir()
    with pytest.raises(InputError, match=r"exposures\.csv: is no file, .*; rename it"):
        read(open_footage(tmp_path))


def test_a_frame_has_one_exposure(tmp_path):
    write_frames(tmp_path, 2)
    text = "file,ev\nf1.png,0\nf2.png,2\nf2.png,2\nf1.png,{}\n"
    (tmp_path / "exposures.csv").write_text(text.format(0))
    assert read_exposure_csv(open_footage(tmp_path))[1] == {"f1.png": 0, "f2.png": 2}
    (tmp_path / "exposures.csv").write_text(text.format(1))
    with pytest.raises(InputError, match=r"line 5: a second exposure of f1\.png"):
        read_exposure_csv(open_footage(tmp_path))
