"""Gaussians as PLY files: what is written is what the field draws, at any time;
refusals are sentences; restarts keep what is there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import fake_run
from hdr_nsff.tonemap.tonemapper import ToneMapConfig
from presets import random_field, small

from hdr_nsff import cli
from hdr_nsff.core.checkpoints import pack, save_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.fields.kernels.projection import ALPHA_MIN
from hdr_nsff.fields.splat.rasterize import rasterize
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.maths import color
from hdr_nsff.rendering import export, ply
from hdr_nsff.rendering.export import (
    Coloring,
    ExportConfig,
    GaussianField,
    export_one,
    export_sequence,
)
from hdr_nsff.rendering.shots import develop
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.build import tone_mapper_for
from hdr_nsff.training.run_folder import Run, write_config

LINEAR = Coloring(linear=True)


def make_run(toy: Scene, folder: Path, preset: str = "splat") -> Run:
    """An untrained run with something in every part of its field."""
    tonemapper = tone_mapper_for(ToneMapConfig(), toy)
    return Run(
        folder, small(preset), toy, random_field(preset, toy), tonemapper, step=7, seconds=1.0
    )


@pytest.fixture
def run(toy: Scene, tmp_path: Path) -> Run:
    return make_run(toy, tmp_path / "run")


def splat(run: Run) -> Splat:
    assert isinstance(run.field, Splat)
    return run.field


def raw(path: Path) -> tuple[list[str], np.ndarray]:
    """Header lines and vertices (G, 17) of a PLY, read by the format's own rules."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    return lines, np.frombuffer(body, "<f4").reshape(-1, len(names))


def test_the_file_follows_the_common_layout(run: Run, tmp_path: Path) -> None:
    lines, v = raw(export_one(run, tmp_path / "a.ply", 2.5, LINEAR))
    cloud = splat(run).gaussians(2.5)
    assert lines[:3] == [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(cloud.means)}",
    ]
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert (
        " ".join(
            line.removeprefix("property float ") for line in lines if line.startswith("property")
        )
        == names
    )
    assert (
        "comment time 2.5 frames" in lines
        and "comment axes OpenCV: +x right, +y down, +z forward" in lines
    )
    np.testing.assert_array_equal(v[:, :3], cloud.means)
    assert not v[:, 3:6].any()
    np.testing.assert_allclose(
        v[:, 6:9], (cloud.radiance - 0.5) / 0.28209479177387814, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(1 / (1 + np.exp(-v[:, 9])), cloud.opacities, rtol=1e-5)
    np.testing.assert_allclose(np.exp(v[:, 10:13]), cloud.scales, rtol=1e-5)
    np.testing.assert_allclose(
        v[:, 13:], torch.nn.functional.normalize(cloud.quaternions, dim=1), atol=1e-6
    )


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    g = np.random.default_rng(0)
    quaternions = g.normal(size=(9, 4)).astype(np.float32)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    given = ply.Splats(
        g.normal(size=(9, 3)),
        quaternions,
        g.random((9, 3)) + 0.01,
        g.random(9),
        100 * g.random((9, 3)),
    )
    ply.write(tmp_path / "a.ply", given, ["a remark"])
    found = ply.read(tmp_path / "a.ply")
    for name in ("means", "quaternions", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(found, name), getattr(given, name), rtol=1e-5, atol=1e-6)


def test_extremes_stay_finite(tmp_path: Path) -> None:
    given = ply.Splats(
        np.zeros((2, 3)), np.eye(4)[:2], np.zeros((2, 3)), np.array([0.0, 1.0]), np.zeros((2, 3))
    )
    ply.write(tmp_path / "a.ply", given)
    assert np.isfinite(raw(tmp_path / "a.ply")[1]).all()
    np.testing.assert_allclose(ply.read(tmp_path / "a.ply").opacities, [0, 1], atol=2e-6)


@pytest.mark.parametrize("time", [0.0, 2.0, 3.4])
def test_the_file_renders_the_fields_own_picture(run: Run, tmp_path: Path, time: float) -> None:
    v = ply.read(export_one(run, tmp_path / "a.ply", time, LINEAR))
    camera = run.scene.train[2].camera
    parts = (v.means, v.quaternions, v.scales, v.opacities, v.colors)
    seen = rasterize(*(torch.from_numpy(np.array(p, np.float32)) for p in parts), camera)
    behind = (1 - seen.alpha)[..., None] * splat(run).background.detach().exp()
    picture = (seen.features + behind).reshape(-1, 3)
    expected = run.field.render(camera, time).radiance
    torch.testing.assert_close(picture, expected, atol=1e-3 * float(expected.max()), rtol=0)
    assert float((expected - run.field.render(camera, 5.0).radiance).abs().max()) > 0.05 * float(
        expected.max()
    )  # time matters


def test_invisible_and_broken_gaussians_are_left_out(run: Run, tmp_path: Path) -> None:
    field = splat(run)
    whole = len(ply.read(export_one(run, tmp_path / "a.ply", 1.0, LINEAR)).means)
    seen = (field.static.logits.sigmoid() > ALPHA_MIN).nonzero()[:, 0]
    field.static.logits.data[seen[:3]] = -8.0
    field.static.means.data[seen[3], 1] = float("nan")
    assert len(ply.read(export_one(run, tmp_path / "a.ply", 1.0, LINEAR)).means) == whole - 4


def test_moving_gaussians_are_at_their_place(run: Run) -> None:
    field = splat(run)
    early, late = field.gaussians(0.0), field.gaussians(4.5)
    moving = early.motion == 1
    assert 0 < int(moving.sum()) < len(moving)
    assert torch.equal(early.means[~moving], late.means[~moving])
    assert float((early.means[moving] - late.means[moving]).norm(dim=1).min()) > 0


def test_colors_are_developed_by_the_learned_camera(run: Run, tmp_path: Path) -> None:
    radiance = ply.read(export_one(run, tmp_path / "linear.ply", 1.0, LINEAR)).colors
    rgb = ply.read(export_one(run, tmp_path / "rgb.ply", 1.0, Coloring(ev=-1.0))).colors
    np.testing.assert_allclose(rgb, develop(run, radiance, -1.0, 0, 1.0), atol=1e-5)
    expected = (0.5 * radiance).clip(0, 1) ** (1 / 2.2)  # the untrained curve
    np.testing.assert_allclose(rgb, expected, atol=0.01)


def test_without_an_ev_colors_are_tone_mapped_for_a_display(run: Run, tmp_path: Path) -> None:
    radiance = ply.read(export_one(run, tmp_path / "linear.ply", 1.0, LINEAR)).colors
    shown = ply.read(export_one(run, tmp_path / "shown.ply", 1.0, Coloring())).colors
    np.testing.assert_allclose(
        shown, color.display(radiance, export.exposure_of(run, Coloring())), atol=1e-4
    )
    assert shown.min() >= -1e-6 and shown.max() <= 1 + 1e-6 and 0.1 < np.median(shown) < 0.9


def test_a_sequence_has_a_file_per_training_time_and_a_restart_keeps_them(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "sequence"
    export_sequence(run, out, LINEAR)
    files = sorted(out.glob("*.ply"))
    assert [f.name for f in files] == [f"{i:05d}.ply" for i in range(len(run.scene.train))]
    alone = export_one(run, tmp_path / "alone.ply", run.scene.train[3].time, LINEAR)
    assert files[3].read_bytes() == alone.read_bytes()
    files[1].unlink()
    asked: list[float] = []
    ask = splat(run).gaussians
    monkeypatch.setattr(run.field, "gaussians", lambda time: asked.append(time) or ask(time))
    export_sequence(run, out, LINEAR)
    assert asked == [run.scene.train[1].time] and files[1].exists()


def test_another_checkpoint_or_look_starts_the_sequence_over(run: Run, tmp_path: Path) -> None:
    export_sequence(run, tmp_path, LINEAR)
    first = (tmp_path / "00002.ply").read_bytes()
    splat(run).static.means.data += 0.01
    export_sequence(replace(run, step=8), tmp_path, LINEAR)
    second = (tmp_path / "00002.ply").read_bytes()
    export_sequence(replace(run, step=8), tmp_path, Coloring(ev=0.0))
    assert len({first, second, (tmp_path / "00002.ply").read_bytes()}) == 3


def test_a_field_without_gaussians_is_refused_in_one_sentence(toy: Scene, tmp_path: Path) -> None:
    for other in (make_run(toy, tmp_path, "tiny"), fake_run(tmp_path)):
        assert not isinstance(other.field, GaussianField)
        with pytest.raises(InputError, match="not made of Gaussians"):
            export_one(other, tmp_path / "a.ply", 1.0, LINEAR)
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize(
    ("time", "word"),
    [(-1.0, "outside the clip"), (99.0, "outside the clip"), (float("nan"), "outside")],
)
def test_times_outside_the_clip_are_refused(
    run: Run, tmp_path: Path, time: float, word: str
) -> None:
    with pytest.raises(InputError, match=word):
        export_one(run, tmp_path / "a.ply", time, LINEAR)


def test_a_camera_the_run_has_not_learned_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="learned cameras 0 to 0"):
        export_sequence(run, tmp_path / "out", Coloring(ev=0.0, camera_id=3))


def test_no_file_of_the_users_is_overwritten(run: Run, tmp_path: Path) -> None:
    (tmp_path / "00001.ply").write_bytes(b"ply\nmy mesh")
    with pytest.raises(InputError, match="not made by export"):
        export_one(run, tmp_path / "00001.ply", 1.0, LINEAR)
    with pytest.raises(InputError, match="not made by export"):
        export_sequence(run, tmp_path, LINEAR)
    assert (tmp_path / "00001.ply").read_bytes() == b"ply\nmy mesh"


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({}, "--ply-sequence"),
        ({"ply": True, "ply_sequence": True}, "--ply-sequence"),
        ({"ply": True, "out": Path("a.obj")}, "ends in .ply"),
        ({"ply_sequence": True, "time": 1.0}, "every training time"),
        ({"ply": True, "coloring": Coloring(ev=1.0, linear=True)}, "not developed"),
        ({"ply": True, "coloring": Coloring(ev=float("nan"))}, "in stops"),
    ],
)
def test_settings_that_make_no_sense_are_one_sentence(change: dict, word: str) -> None:
    with pytest.raises(InputError, match=word):
        export.export(replace(ExportConfig(Path("run"), Path("a.ply")), **change))


def test_the_verb_exports_from_a_run_folder(run: Run, toy_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    write_config(folder, replace(run.config, scene=toy_folder, out=folder))
    save_checkpoint(folder, 7, 1.0, pack({"field": splat(run), "tonemapper": run.tonemapper}, {}))
    cli.main(
        ["export", str(folder), str(tmp_path / "one.ply"), "--ply", "--time", "1.5", "--linear"]
    )
    cli.main(["export", str(folder), str(tmp_path / "all"), "--ply-sequence", "--ev", "-1"])
    expected = splat(run).gaussians(1.5)
    np.testing.assert_array_equal(ply.read(tmp_path / "one.ply").means, expected.means)
    assert len(list((tmp_path / "all").glob("*.ply"))) == len(run.scene.train)


@pytest.mark.parametrize("cut", [3, 300, -4])
def test_a_file_cut_short_is_refused(run: Run, tmp_path: Path, cut: int) -> None:
    path = export_one(run, tmp_path / "a.ply", 1.0, LINEAR)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match="export it again"):
        ply.read(path)
