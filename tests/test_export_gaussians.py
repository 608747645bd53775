"""Exported Gaussians are those that the field draws, at any time; refusals are
sentences; restarts keep what is there.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import fake_run
from presets import random_field, small

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.fields.kernels.footprint import ALPHA_MIN
from hdr_nsff.fields.splat.rasterize import rasterize
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.maths import color
from hdr_nsff.rendering import ply
from hdr_nsff.rendering.develop import develop
from hdr_nsff.rendering.export_gaussians import (
    ColorTransform,
    GaussianField,
    export_one,
    export_sequence,
    exposure_of,
)
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import ToneMapConfig
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.run_folder import Run

LINEAR = ColorTransform(linear=True)
SH_0 = 0.28209479177387814


def make_run(toy: Scene, folder: Path, preset: str = "splat") -> Run:
    """An untrained run with content in every part of its field."""
    field = random_field(preset, toy)
    tonemapper = tone_mapper_for(ToneMapConfig(), toy)
    return Run(folder, small(preset), toy, field, tonemapper, step=7, seconds=1.0)


@pytest.fixture
def run(toy: Scene, tmp_path: Path) -> Run:
    return make_run(toy, tmp_path / "run")


def splat(run: Run) -> Splat:
    assert isinstance(run.field, Splat)
    return run.field


def read_raw(path: Path) -> tuple[list[str], np.ndarray]:
    """Header lines and vertices (G, 17) of a PLY, read by the format's own rules."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    return lines, np.frombuffer(body, "<f4").reshape(-1, len(names))


# One file


def test_the_header_follows_the_common_layout(run: Run, tmp_path: Path) -> None:
    lines, _ = read_raw(export_one(run, tmp_path / "a.ply", 2.5, LINEAR))
    count = len(splat(run).gaussians(2.5).means)
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2] == f"element vertex {count}"
    properties = [line for line in lines if line.startswith("property")]
    names = " ".join(line.removeprefix("property float ") for line in properties)
    assert names == (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity "
        "scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    )
    assert "comment time 2.5 frames" in lines
    assert "comment axes OpenCV: +x right, +y down, +z forward" in lines


def test_the_vertices_follow_the_common_layout(run: Run, tmp_path: Path) -> None:
    _, v = read_raw(export_one(run, tmp_path / "a.ply", 2.5, LINEAR))
    cloud = splat(run).gaussians(2.5)
    unit = torch.nn.functional.normalize(cloud.quaternions, dim=1)
    np.testing.assert_array_equal(v[:, :3], cloud.means)
    assert not v[:, 3:6].any()
    np.testing.assert_allclose(v[:, 6:9], (cloud.radiance - 0.5) / SH_0, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-v[:, 9])), cloud.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(v[:, 10:13]), cloud.scales, rtol=1e-5)
    np.testing.assert_allclose(v[:, 13:], unit, atol=1e-6)


@pytest.mark.parametrize("time", [0.0, 2.0, 3.4])
def test_the_file_renders_the_same_picture_as_the_field(
    run: Run, tmp_path: Path, time: float
) -> None:
    v = ply.read(export_one(run, tmp_path / "a.ply", time, LINEAR))
    camera = run.scene.train[2].camera
    parts = (v.means, v.quaternions, v.scales, v.opacities, v.colors)
    seen = rasterize(*(torch.from_numpy(np.array(p, np.float32)) for p in parts), camera)
    behind = (1 - seen.alpha)[..., None] * splat(run).background.detach().exp()
    picture = (seen.features + behind).reshape(-1, 3)
    expected = run.field.render(camera, time).radiance
    brightest = float(expected.max())
    torch.testing.assert_close(picture, expected, atol=1e-3 * brightest, rtol=0)
    change = (expected - run.field.render(camera, 5.0).radiance).abs().max()
    assert float(change) > 0.05 * brightest  # time matters


def test_invisible_and_broken_gaussians_are_left_out(run: Run, tmp_path: Path) -> None:
    field = splat(run)
    all_of_them = len(ply.read(export_one(run, tmp_path / "a.ply", 1.0, LINEAR)).means)
    seen = (field.static.opacity_logits.sigmoid() > ALPHA_MIN).nonzero()[:, 0]
    field.static.opacity_logits.data[seen[:3]] = -8.0
    field.static.means.data[seen[3], 1] = float("nan")
    exported = ply.read(export_one(run, tmp_path / "a.ply", 1.0, LINEAR))
    assert len(exported.means) == all_of_them - 4


def test_moving_gaussians_are_at_their_place(run: Run) -> None:
    early, late = splat(run).gaussians(0.0), splat(run).gaussians(4.5)
    moving = early.motion == 1
    assert 0 < int(moving.sum()) < len(moving)
    assert torch.equal(early.means[~moving], late.means[~moving])
    assert float((early.means[moving] - late.means[moving]).norm(dim=1).min()) > 0


def test_colors_are_developed_by_the_learned_camera(run: Run, tmp_path: Path) -> None:
    radiance = ply.read(export_one(run, tmp_path / "linear.ply", 1.0, LINEAR)).colors
    rgb = ply.read(export_one(run, tmp_path / "rgb.ply", 1.0, ColorTransform(ev=-1.0))).colors
    np.testing.assert_allclose(rgb, develop(run, radiance, -1.0, 0, 1.0), atol=1e-5)
    expected = (0.5 * radiance).clip(0, 1) ** (1 / 2.2)  # the untrained curve
    np.testing.assert_allclose(rgb, expected, atol=0.01)


def test_without_an_ev_colors_are_tone_mapped_for_a_display(run: Run, tmp_path: Path) -> None:
    radiance = ply.read(export_one(run, tmp_path / "linear.ply", 1.0, LINEAR)).colors
    shown = ply.read(export_one(run, tmp_path / "shown.ply", 1.0, ColorTransform())).colors
    exposure = exposure_of(run, ColorTransform())
    np.testing.assert_allclose(shown, color.display(radiance, exposure), atol=1e-4)
    assert shown.min() >= -1e-6 and shown.max() <= 1 + 1e-6 and 0.1 < np.median(shown) < 0.9


# A file per training time


def test_a_sequence_has_a_file_per_training_time(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "sequence"
    export_sequence(run, out, LINEAR)
    files = sorted(out.glob("*.ply"))
    assert [f.name for f in files] == [f"{i:05d}.ply" for i in range(len(run.scene.train))]
    alone = export_one(run, tmp_path / "alone.ply", run.scene.train[3].time, LINEAR)
    assert files[3].read_bytes() == alone.read_bytes()
    note = notes.read(tmp_path / "sequence.sequence.json", notes.ExportedSequence)
    assert note is not None and note.times == [f.time for f in run.scene.train]


def test_supersplat_recognizes_a_sequence(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    export_sequence(run, folder, LINEAR)
    note = tmp_path / "out.sequence.json"
    note.rename(folder / "sequence.json")  # as older versions have left it
    export_sequence(run, folder, LINEAR)
    names = re.compile(r"(.*?)(\d+)(?:\.compressed)?\.ply$")  # all files of a sequence match
    assert note.is_file() and len(list(folder.iterdir())) == len(run.scene.train)
    assert all(names.match(file.name) for file in folder.iterdir())


def test_a_restart_exports_only_the_missing_files(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_sequence(run, tmp_path / "out", LINEAR)
    (tmp_path / "out/00001.ply").unlink()
    asked: list[float] = []
    gaussians = splat(run).gaussians

    def counted(time: float) -> object:
        asked.append(time)
        return gaussians(time)

    monkeypatch.setattr(run.field, "gaussians", counted)
    export_sequence(run, tmp_path / "out", LINEAR)
    assert asked == [run.scene.train[1].time] and (tmp_path / "out/00001.ply").exists()


def test_another_checkpoint_or_color_starts_the_sequence_over(run: Run, tmp_path: Path) -> None:
    export_sequence(run, tmp_path, LINEAR)
    first = (tmp_path / "00002.ply").read_bytes()
    splat(run).static.means.data += 0.01
    export_sequence(replace(run, step=8), tmp_path, LINEAR)
    second = (tmp_path / "00002.ply").read_bytes()
    export_sequence(replace(run, step=8), tmp_path, ColorTransform(ev=0.0))
    assert len({first, second, (tmp_path / "00002.ply").read_bytes()}) == 3


# What is refused


def test_a_field_without_gaussians_is_refused_in_one_sentence(toy: Scene, tmp_path: Path) -> None:
    for other in (make_run(toy, tmp_path, "tiny"), fake_run(tmp_path)):
        assert not isinstance(other.field, GaussianField)
        with pytest.raises(InputError, match="not made of Gaussians"):
            export_one(other, tmp_path / "a.ply", 1.0, LINEAR)
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize("time", [-1.0, 99.0, float("nan")])
def test_times_outside_the_clip_are_refused(run: Run, tmp_path: Path, time: float) -> None:
    with pytest.raises(InputError, match="outside the clip"):
        export_one(run, tmp_path / "a.ply", time, LINEAR)


def test_a_camera_the_run_has_not_learned_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="learned cameras 0 to 0"):
        export_sequence(run, tmp_path / "out", ColorTransform(ev=0.0, camera_id=3))


def test_no_file_of_the_users_is_overwritten(run: Run, tmp_path: Path) -> None:
    (tmp_path / "00001.ply").write_bytes(b"ply\nmy mesh")
    with pytest.raises(InputError, match="not made by export"):
        export_one(run, tmp_path / "00001.ply", 1.0, LINEAR)
    with pytest.raises(InputError, match="not made by export"):
        export_sequence(run, tmp_path, LINEAR)
    assert (tmp_path / "00001.ply").read_bytes() == b"ply\nmy mesh"
