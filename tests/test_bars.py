"""Black bars around the picture are found and cut off; dark pictures keep theirs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.images import write_png
from hdr_nsff.footage.bars import bars_of, find_bars, with_bars
from hdr_nsff.footage.footage import Bars, open_footage
from hdr_nsff.footage.ingest import read_frames
from hdr_nsff.prepare.prepare import open_clip
from hdr_nsff.prepare.work import PrepareConfig

HEIGHT, WIDTH = 60, 80


def picture(rows: int = 0, columns: int = 0, black: float = 0.0) -> np.ndarray:
    """Noise (H, W) between 0.1 and 1, with bars."""
    values = np.random.default_rng(0).uniform(0.1, 1, (HEIGHT, WIDTH))
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[rows : HEIGHT - rows, columns : WIDTH - columns] = True
    return np.where(inside, values, black)


def write_clip(folder: Path, images: list[np.ndarray]) -> Path:
    folder.mkdir()
    for k, image in enumerate(images):
        write_png(folder / f"{k:03d}.png", np.repeat(image[..., None], 3, -1).astype(np.float32))
    return folder


@pytest.mark.parametrize("black", [0.0, 0.063])
@pytest.mark.parametrize(("rows", "columns"), [(0, 0), (8, 0), (0, 10), (8, 10)])
def test_bars_are_found_to_the_pixel_and_one_soft_one(rows: int, columns: int, black: float):
    expected = Bars(rows + 1 if rows else 0, columns + 1 if columns else 0)
    assert bars_of(picture(rows, columns, black)) == expected


def test_the_wider_of_two_bars_is_cut_on_both_sides():
    image = picture(8)
    image[-9] = 0
    assert bars_of(image) == Bars(10, 0)


def test_one_black_border_is_part_of_the_picture():
    image = picture()
    image[:12] = 0
    assert not bars_of(image)


def test_a_dark_picture_has_no_bars():
    assert not bars_of(np.zeros((HEIGHT, WIDTH)))
    assert not bars_of(0.1 * picture(8))
    assert not bars_of(picture(22))  # more than the picture


def test_what_lights_up_later_is_no_bar(tmp_path: Path):
    dark, bright = picture(8), picture()
    clip = write_clip(tmp_path / "clip", [dark] * 20 + [bright])
    assert not find_bars(open_footage(clip))
    clip = write_clip(tmp_path / "dark", [dark] * 21)
    assert find_bars(open_footage(clip)) == Bars(9, 0)


def test_bars_of_a_clip_that_begins_in_black_or_later_are_found(tmp_path: Path):
    black, dark, bright = np.zeros((HEIGHT, WIDTH)), picture(8), picture()
    clip = write_clip(tmp_path / "black", [black] * 14 + [dark] * 3)
    assert find_bars(open_footage(clip)) == Bars(9, 0)
    clip = write_clip(tmp_path / "later", [bright] * 14 + [dark] * 3)
    assert not find_bars(open_footage(clip))
    assert find_bars(open_footage(clip), 14) == Bars(9, 0)


def test_frames_are_read_without_bars_before_they_are_shrunk(tmp_path: Path):
    image = picture(8, 10)
    clip = write_clip(tmp_path / "clip", [image] * 3)
    footage = with_bars(open_footage(clip))
    frames = list(read_frames(footage, 0, None, 1, 640))
    assert frames[0].rgb.shape == (HEIGHT - 18, WIDTH - 22, 3)
    np.testing.assert_allclose(frames[1].rgb[..., 0], image[9:-9, 11:-11], atol=1 / 255)
    small = next(read_frames(footage, 0, None, 1, 32))
    assert small.rgb.shape[1] == 32


def test_frames_of_different_sizes_are_left_to_the_reader(tmp_path: Path):
    clip = write_clip(tmp_path / "clip", [picture(8), picture(8)[:-2]])
    assert not find_bars(open_footage(clip))


def test_several_cameras_keep_their_frames(tmp_path: Path):
    (tmp_path / "rig").mkdir()
    for camera in "ab":
        write_clip(tmp_path / "rig" / camera, [picture(8)] * 3)
    assert not with_bars(open_footage(tmp_path / "rig")).bars


def test_what_is_given_pixel_by_pixel_keeps_the_frames_whole(tmp_path: Path):
    clip = write_clip(tmp_path / "clip", [picture(8)] * 3)
    alone = PrepareConfig(clip, tmp_path / "scene")
    assert open_clip(alone, None).bars == Bars(9, 0)
    assert open_clip(PrepareConfig(clip, tmp_path / "scene", depth="geometric"), None).bars
    with_masks = PrepareConfig(clip, tmp_path / "scene", masks=tmp_path / "masks")
    assert not open_clip(with_masks, None).bars
