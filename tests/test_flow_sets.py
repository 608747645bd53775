"""Readers of sets with known flow, on miniature trees written by the formats' own
descriptions; and pairs recorded across exposures.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from mutations import check_reader

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.flow_training.flow_exposures import (
    random_crop,
    random_curve,
    record_middle_pair,
    training_example,
)
from hdr_nsff.flow_training.flow_sets import Sample, flow_pairs, read_flo, read_pfm, read_sample

H, W = 12, 16
# (x, y) at (x, y): no two pixels alike
FLOW = np.stack(np.meshgrid(np.arange(W), np.arange(H)), -1).astype(np.float32)


def write_flo(path: Path, flow: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        b"PIEH" + struct.pack("<ii", flow.shape[1], flow.shape[0]) + flow.astype("<f4").tobytes()
    )


def write_pfm(path: Path, flow: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rgb = np.concatenate([flow, np.zeros_like(flow[..., :1])], -1)
    path.write_bytes(f"PF\n{W} {H}\n-1.0\n".encode() + rgb[::-1].astype("<f4").tobytes())


def picture(path: Path, value: float) -> None:
    write_png(path, np.full((H, W, 3), value, np.float32))


def sintel(root: Path) -> Path:
    for k in (1, 2, 3):
        picture(root / f"training/final/alley/frame_{k:04d}.png", k / 5)
    for k in (1, 2):
        write_flo(root / f"training/flow/alley/frame_{k:04d}.flo", k * FLOW)
    invalid = np.zeros((H, W), bool)
    invalid[2, 3] = True
    write_png(root / "training/invalid/alley/frame_0001.png", invalid)
    return root


def things(root: Path) -> Path:
    scene = root / "optical_flow/TRAIN/A/0007"
    for eye, side in (("left", "L"), ("right", "R")):
        for k in (6, 7):
            picture(root / f"frames_finalpass/TRAIN/A/0007/{eye}/{k:04d}.png", k / 10)
        write_pfm(scene / f"into_future/{eye}/OpticalFlowIntoFuture_0006_{side}.pfm", FLOW)
        write_pfm(scene / f"into_past/{eye}/OpticalFlowIntoPast_0007_{side}.pfm", -FLOW)
        # its next frame is not there
        write_pfm(scene / f"into_future/{eye}/OpticalFlowIntoFuture_0007_{side}.pfm", FLOW)
    return root


def synth(root: Path, frames: int = 3, size: tuple[int, int] = (H, W)) -> Path:
    """Frames of noise whose flow is (1, 0) px."""
    rng = np.random.default_rng(0)
    still = np.broadcast_to(np.float32([1, 0]), (*size, 2))
    for k in range(frames):
        channels = {
            f"{name}.{axis}": s * still[..., c]
            for name, s in (("forward", 1), ("backward", -1))
            for c, axis in enumerate("uv")
        }
        write_exr(
            root / f"exact/clip_{k:05d}.exr",
            {"RGB": rng.random((*size, 3)).astype(np.float32), **channels},
            half=False,
        )
    return root


def test_sintel_has_forward_flow_and_masks_unknown_pixels(tmp_path: Path):
    pairs = flow_pairs(sintel(tmp_path))
    assert [(p.first.name, p.second.name, p.scene) for p in pairs] == [
        ("frame_0001.png", "frame_0002.png", "alley"),
        ("frame_0002.png", "frame_0003.png", "alley"),
    ]
    sample = read_sample(pairs[0])
    assert np.array_equal(sample.flow[0][5, 7], [7, 5])
    assert not sample.known[1].any()
    assert not sample.known[0][2, 3]
    assert sample.known[0].sum() == H * W - 1
    # sRGB 0.2: ((0.2 + 0.055) / 1.055)^2.4
    assert sample.radiance[0, 0, 0] == pytest.approx([0.0331] * 3, abs=1e-3)
    assert flow_pairs(tmp_path / "training") == pairs


def test_flyingthings_has_both_cameras_and_both_directions(tmp_path: Path):
    pairs = flow_pairs(things(tmp_path))
    assert [p.first.parent.name for p in pairs] == ["left", "right"]
    assert len({p.scene for p in pairs}) == 1
    sample = read_sample(pairs[1])
    assert np.array_equal(sample.flow[0], FLOW)
    assert np.array_equal(sample.flow[1], -FLOW)
    assert sample.known.all()


def test_rendered_scenes_are_pairs_of_neighbors(tmp_path: Path):
    pairs = flow_pairs(synth(tmp_path))
    sample = read_sample(pairs[1])
    assert len(pairs) == 2
    assert sample.known.all()
    assert (sample.flow[0] == [1, 0]).all()
    assert (sample.flow[1] == [-1, 0]).all()


def test_unknown_flow_is_marked_as_unknown(tmp_path: Path):
    pairs = flow_pairs(sintel(tmp_path))
    flow = FLOW.copy()
    flow[4, 4] = 1e9  # as the Middlebury format marks it
    write_flo(pairs[1].forward, flow)
    sample = read_sample(pairs[1])
    assert not sample.known[0][4, 4]
    assert (sample.flow[0][4, 4] == 0).all()


def test_big_endian_and_gray_float_maps(tmp_path: Path):
    (tmp_path / "a.pfm").write_bytes(b"Pf\n2 2\n1.0\n" + np.array([3, 4, 1, 2], ">f4").tobytes())
    # from the bottom to the top
    assert read_pfm(tmp_path / "a.pfm")[..., 0].tolist() == [
        [1, 2],
        [3, 4],
    ]


def test_files_cut_short_or_of_another_kind_are_refused(tmp_path: Path):
    pairs = flow_pairs(sintel(tmp_path))
    pairs[0].forward.write_bytes(pairs[0].forward.read_bytes()[:-4])
    with pytest.raises(InputError, match="for 16x12 pixels"):
        read_flo(pairs[0].forward)
    for reader in (read_flo, read_pfm):
        with pytest.raises(InputError, match="not a"):
            reader(pairs[0].first)
    write_flo(pairs[0].forward, FLOW[:-1])
    with pytest.raises(InputError, match="16x11"):
        read_sample(pairs[0])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no pairs with known flow"):
        flow_pairs(tmp_path / "empty")


@pytest.mark.parametrize("name", ["sintel", "things", "synth"])
def test_damaged_flow_is_read_or_refused(name: str, tmp_path: Path):
    make = {"sintel": sintel, "things": things, "synth": synth}[name]
    pair = flow_pairs(make(tmp_path))[0]
    check_reader(pair.forward, lambda: read_sample(pair), 150)


def sample(height: int = 60, width: int = 80) -> Sample:
    """A pair of a bright and dark ramp, flow (2, -1)."""
    ramp = np.broadcast_to(
        2.0 ** np.linspace(-8, 3, width)[None, :, None], (height, width, 3)
    ).astype(np.float32)
    flow = np.stack([np.broadcast_to(s * np.float32([2, -1]), (height, width, 2)) for s in (1, -1)])
    return Sample(np.stack([ramp, ramp]), flow.copy(), np.ones((2, height, width), bool))


def test_exposures_differ_by_the_requested_stops():
    """Around the median 2^-2.5 recorded at 0.18 in the middle, 4 EV apart: the halves
    of one ramp clip at different ends.
    """
    dark, bright = record_middle_pair(sample().radiance, 4, equal=False)
    assert (bright >= 0.999).all(-1).mean() > (dark >= 0.999).all(
        -1
    ).mean() + 0.3  # 4 EV of 11 saturate more: 36 %
    same = record_middle_pair(sample().radiance, 0, equal=False)
    assert np.abs(same[0] - same[1]).mean() < 0.02


def test_equalizing_brings_pairs_closer_in_brightness():
    raw, equal = (record_middle_pair(sample().radiance, 4, e) for e in (False, True))
    assert np.abs(equal[0] - equal[1]).mean() < 0.3 * np.abs(raw[0] - raw[1]).mean()


def test_crops_scale_and_mirror_flow_with_the_pixels():
    """80 px are matched at 240 (three times), times 0.8 to 1.25: flow (2, -1) grows as
    much, its signs follow the mirrors.
    """
    s = sample()
    for seed in range(8):
        one = random_crop(
            np.zeros((2, 60, 80, 3), np.float32), s, (96, 128), np.random.default_rng(seed)
        )
        assert one.images.shape == (2, 3, 96, 128)
        assert one.known.all()
        u, v = one.flow[0, :, 50, 50].abs().tolist()
        assert 2 * 2.3 < u < 2 * 3.9
        assert abs(u / v - 2) < 0.1
        assert (one.flow[0] + one.flow[1]).abs().max() < 1e-4


def test_an_example_is_a_matter_of_its_seed():
    def draw(seed):
        return training_example(sample(), 4, (96, 128), np.random.default_rng(seed)).images

    assert (draw(1) == draw(1)).all()
    assert not (draw(1) == draw(2)).all()


def test_random_responses_increase():
    for seed in range(20):
        curve = random_curve(np.random.default_rng(seed))
        assert (np.diff(curve.y, axis=1) > 0).all()
        assert np.allclose(curve.y[:, [0, -1]], [0, 1])
