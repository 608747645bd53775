"""Moving Gaussians and a camera as USD: `ParticleField3DGaussianSplat`, time samples.

Radiance stays linear and unbounded. The schema stores the constant spherical harmonic,
as PLY files do: color = 0.5 + SH_0 * coefficient. Axes are USD's: +y up, and cameras
look along -z; one rotation of the root turns the scene's OpenCV axes into them. Time
codes are frames of the clip.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.rendering.ply import SH_0

ENDINGS = (".usdc", ".usda", ".usd")
LAYER_KEY = "hdrNsff"  # of customLayerData: by it, files are recognized as ours
ROOT = "/Scene"
FLIP = np.diag([1.0, -1.0, -1.0])  # OpenCV axes to +y up, -z forward, and back
FARTHEST = 1e6  # z-depth of the camera's far plane, scene units: USD's default
APERTURE = 36.0  # width of the film, tenths of a scene unit: any; focal lengths follow


@dataclass(frozen=True)
class Track:
    """G Gaussians over the times of a scene. Arrays with T rows change in time."""

    name: str
    means: np.ndarray  # (T or 1, G, 3) scene units
    quaternions: np.ndarray  # (T or 1, G, 4) w x y z, length 1
    scales: np.ndarray  # (G, 3) standard deviations, scene units
    opacities: np.ndarray  # (T or 1, G) in [0, 1]
    radiance: np.ndarray  # (T or 1, G, 3) linear


def check_library() -> None:
    """InputError where usd-core is not installed, or has no Gaussians."""
    try:
        from pxr import UsdVol
    except ImportError as error:
        advice = "install it with `pip install 'hdr-nsff[usd]'`"
        raise InputError(f"USD: the library usd-core is not installed; {advice}") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        advice = "`pip install --upgrade usd-core` gets one that has them"
        raise InputError(f"USD: this usd-core has no Gaussians; {advice}")


def is_ours(path: Path) -> bool:
    """Whether `export` wrote the file, so that it may be replaced."""
    from pxr import Sdf, Tf

    try:
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
    except Tf.ErrorException:
        return False
    return layer is not None and LAYER_KEY in layer.customLayerData


def write_usd(
    path: Path,
    tracks: Sequence[Track],
    times: Sequence[float],
    cameras: Sequence[Camera],
    camera_times: Sequence[float],
    nearest: float,
    fps: float,
    facts: Mapping[str, Any],
) -> None:
    """Write Gaussians at `times` and a camera at `camera_times` (frames), atomically.

    `nearest` is the z-depth of which nothing nearer is drawn.
    `facts` become customLayerData.
    """
    from pxr import Usd, UsdGeom

    with atomic(path) as temporary:
        temporary.unlink()  # USD reads what is there before it writes
        stage = Usd.Stage.CreateNew(str(temporary))
        stage.SetMetadata("customLayerData", {LAYER_KEY: dict(facts)})
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(times[0])
        stage.SetEndTimeCode(times[-1])
        root = UsdGeom.Xform.Define(stage, ROOT)
        root.AddRotateXOp().Set(180.0)
        stage.SetDefaultPrim(root.GetPrim())
        for track in tracks:
            write_track(stage, track, times)
        write_camera(stage, cameras, camera_times, nearest)
        stage.GetRootLayer().Save()


def write_track(stage: Any, track: Track, times: Sequence[float]) -> None:
    """One prim of Gaussians."""
    from pxr import Usd, UsdVol, Vt

    prim = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"{ROOT}/{track.name}")
    reach = 3 * track.scales.max(1)  # of a Gaussian: 3 standard deviations
    coefficients = (track.radiance - 0.5) / SH_0
    xyzw = np.roll(track.quaternions, -1, -1)  # as USD lays quaternions out
    boxes = np.stack(
        [(track.means - reach[:, None]).min(1), (track.means + reach[:, None]).max(1)], 1
    )
    prim.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(packed(track.scales)))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    sampled = [
        (prim.CreatePositionsAttr(), track.means, Vt.Vec3fArray),
        (prim.CreateOrientationsAttr(), xyzw, Vt.QuatfArray),
        (prim.CreateOpacitiesAttr(), track.opacities, Vt.FloatArray),
        (prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(), coefficients, Vt.Vec3fArray),
        (prim.CreateExtentAttr(), boxes, Vt.Vec3fArray),
    ]
    for attribute, values, kind in sampled:
        if len(values) == 1:
            attribute.Set(kind.FromNumpy(packed(values[0])))
            continue
        for time, row in zip(times, values, strict=True):
            attribute.Set(kind.FromNumpy(packed(row)), Usd.TimeCode(time))


def packed(values: np.ndarray) -> np.ndarray:
    """Contiguous float32."""
    return np.ascontiguousarray(values, np.float32)


def write_camera(
    stage: Any, cameras: Sequence[Camera], times: Sequence[float], nearest: float
) -> None:
    """The camera as filmed, with its principal point."""
    from pxr import Gf, Usd, UsdGeom

    prim = UsdGeom.Camera.Define(stage, f"{ROOT}/Camera")
    transform = prim.AddTransformOp()
    prim.GetClippingRangeAttr().Set(Gf.Vec2f(nearest, FARTHEST))
    for camera, time in zip(cameras, times, strict=True):
        code = Usd.TimeCode(time)
        fx, fy, cx, cy = (float(camera.K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        tall = APERTURE * camera.height / camera.width * fx / fy
        prim.GetHorizontalApertureAttr().Set(APERTURE, code)
        prim.GetVerticalApertureAttr().Set(tall, code)
        prim.GetFocalLengthAttr().Set(APERTURE * fx / camera.width, code)
        prim.GetHorizontalApertureOffsetAttr().Set((0.5 - cx / camera.width) * APERTURE, code)
        prim.GetVerticalApertureOffsetAttr().Set((cy / camera.height - 0.5) * tall, code)
        pose = np.eye(4)
        pose[:3, :3] = camera.c2w[:, :3].double().cpu().numpy() @ FLIP
        pose[:3, 3] = camera.c2w[:, 3].double().cpu().numpy()
        transform.Set(Gf.Matrix4d(pose.T.tolist()), code)  # USD's vectors are rows
