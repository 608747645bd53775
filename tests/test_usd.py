"""USD files, read back by usd-core itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_export_gaussians import SH_0, make_run, splat

from hdr_nsff.core.errors import InputError
from hdr_nsff.fields.kernels.footprint import NEAREST
from hdr_nsff.rendering import usd
from hdr_nsff.rendering.export_scene import export_usd, keep_sign
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.run_folder import Run

pxr = pytest.importorskip("pxr.UsdVol")
from pxr import Gf, Usd, UsdGeom, UsdVol  # noqa: E402


@pytest.fixture
def run(toy: Scene, tmp_path: Path) -> Run:
    run = make_run(toy, tmp_path / "run")
    with torch.no_grad():
        splat(run).moving.opacity_logits.clamp_(min=0)  # none is left out
        splat(run).moving.log_radiance += 5  # far above 1
        splat(run).opacity_offsets += torch.linspace(0, 1, len(splat(run).opacity_offsets))[:, None]
    return run


@pytest.fixture
def stage(run: Run, tmp_path: Path) -> Any:
    return Usd.Stage.Open(str(export_usd(run, tmp_path / "scene.usdc")))


def test_gaussians_are_those_of_the_field_at_training_times(run: Run, stage: Any) -> None:
    prim = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/Scene/Moving")
    cloud = splat(run).cloud(splat(run).knot(2.0))
    first, count = len(splat(run).static), len(splat(run).moving)
    rows = slice(first, first + count)
    assert np.allclose(prim.GetPositionsAttr().Get(2.0), cloud.means[rows].detach(), atol=1e-5)
    assert np.allclose(prim.GetScalesAttr().Get(2.0), cloud.scales[rows].detach(), rtol=1e-5)
    assert np.allclose(prim.GetOpacitiesAttr().Get(2.0), cloud.opacities[rows].detach(), atol=1e-5)
    written = prim.GetOrientationsAttr().Get(2.0)[0]
    expected = torch.nn.functional.normalize(cloud.quaternions[first], dim=0).detach().numpy()
    found = np.array([written.GetReal(), *written.GetImaginary()])
    assert abs(found @ expected) == pytest.approx(1, abs=1e-5)


def test_radiance_above_1_survives(run: Run, stage: Any) -> None:
    prim = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/Scene/Moving")
    coefficients = prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(2.0)
    found = 0.5 + SH_0 * np.array(coefficients)
    cloud = splat(run).cloud(splat(run).knot(2.0))
    first = len(splat(run).static)
    expected = cloud.radiance[first : first + len(found)].detach()
    assert found.max() > 10 and np.allclose(found, expected, rtol=1e-4)
    assert "do not clamp" in stage.GetRootLayer().customLayerData["hdrNsff"]["radiance"]


def test_half_times_are_interpolated(stage: Any) -> None:
    prim = UsdVol.ParticleField3DGaussianSplat.Get(stage, "/Scene/Moving")
    for attribute in (prim.GetPositionsAttr(), prim.GetOpacitiesAttr()):
        before, between, after = (np.array(attribute.Get(t)) for t in (2.0, 2.5, 3.0))
        assert np.allclose(between, (before + after) / 2, atol=1e-5)
        assert not np.allclose(before, after)


def test_the_camera_sees_points_where_the_scene_does(run: Run, stage: Any) -> None:
    frame = run.scene.train[2]
    prim = UsdGeom.Camera.Get(stage, "/Scene/Camera")
    camera = prim.GetCamera(frame.time)  # in the world, the root's rotation included
    point = frame.camera.c2w[:, :3] @ torch.tensor([0.3, -0.2, 3.0]) + frame.camera.c2w[:, 3]
    to_world = UsdGeom.Xformable(stage.GetPrimAtPath("/Scene")).ComputeLocalToWorldTransform(0)
    world = to_world.Transform(Gf.Vec3d(*point.tolist()))
    frustum = camera.frustum
    seen = frustum.ComputeProjectionMatrix().Transform(frustum.ComputeViewMatrix().Transform(world))
    x = (seen[0] + 1) / 2 * frame.camera.width
    y = (1 - seen[1]) / 2 * frame.camera.height
    expected = frame.camera.project(point)[0].tolist()
    assert [x, y] == pytest.approx(expected, abs=1e-2)


def test_only_own_files_are_replaced(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "scene.usda"
    export_usd(run, path)
    export_usd(run, path)
    assert usd.is_ours(path)
    for text in ("#usda 1.0\n", "no USD"):
        path.write_text(text)
        with pytest.raises(InputError, match="was not made by export"):
            export_usd(run, path)
        assert path.read_text() == text


def test_quaternions_never_jump_to_their_negative() -> None:
    one = np.array([0.5, 0.5, 0.5, 0.5])
    seen = keep_sign(np.stack([one, -one, -one, one])[:, None])
    assert np.array_equal(seen, np.tile(one, (4, 1, 1)))


def test_the_camera_clips_nothing_that_is_drawn(run: Run, stage: Any) -> None:
    near, far = UsdGeom.Camera.Get(stage, "/Scene/Camera").GetClippingRangeAttr().Get()
    assert near == pytest.approx(NEAREST * run.scene.near) and far > 1e5
