"""A trained field of Gaussians as a scene file.

Only this file knows where a field keeps its numbers. Gaussians that draw nothing at any
time, and those with numbers that are not finite, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from hdr_nsff.fields.base import RadianceField
from hdr_nsff.fields.splat.gaussians import Gaussians, to_radiance
from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.fields.splat.terms import MIN_OPACITY
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.tonemap.base import ToneMapper
from hdr_nsff.viewer.scene_file import (
    CameraResponse,
    FilmedView,
    GaussianGroup,
    MotionBases,
    SceneFile,
)

MAX_RECORDED_PIXELS = 24e6  # of all recorded pictures in a file: about 4 MB of JPEG
PICTURE_QUALITY = 85  # of its JPEG
MIN_LENGTH = 1e-12  # of a quaternion
STOPS_BEYOND, STEPS_BEYOND = 8, 128  # of a response that is not white at 1
LEAST_RISE = 1 / 512  # of one that goes on rising there
Array = np.ndarray


def scene_of(
    field: RadianceField,
    tonemapper: ToneMapper,
    scene: Scene,
    title: str,
    display_exposure: float,
) -> SceneFile:
    """The scene file of a field that was trained on `scene`.

    A field that is not made of Gaussians gives one without Gaussians: cameras,
    responses and recorded pictures.
    """
    frames = sorted(scene.train, key=lambda f: f.time)
    exposures = tonemapper.exposures().tolist()
    views, recorded = filmed_views(frames, exposures)
    first = frames[0].camera
    shell = SceneFile(
        title=title,
        width=first.width,
        height=first.height,
        fps=scene.manifest.fps,
        times=scene.times.tolist(),
        near=scene.near,
        far=scene.far,
        parallax=scene.manifest.parallax,
        background=[0.0, 0.0, 0.0],
        exposures=exposures,
        display_exposure=display_exposure,
        views=views,
        responses=camera_responses(tonemapper),
        recorded=recorded,
    )
    return add_gaussians(shell, field) if isinstance(field, Splat) else shell


@torch.no_grad()
def add_gaussians(shell: SceneFile, field: Splat) -> SceneFile:
    """The scene with the Gaussians of a field."""
    moves = field.trajectories
    poses = moves.num_knots, moves.num_bases, 4
    bases = MotionBases(
        centers=to_numpy(moves.centers),
        quaternions=to_numpy(moves.rotations.view(poses)),
        shifts=to_numpy(moves.translations.view(poses)[..., :3]),
    )
    static = group_of(field.static, "static", 0.0)
    moving = replace(
        group_of(field.moving, "moving", 1.0),
        opacity_offsets=to_numpy(field.opacity_offsets),
        mixture=to_numpy(field.mixture_logits.softmax(0).T),
    )
    groups = [drop_invisible(group) for group in (static, moving, local_of(field.local))]
    return replace(
        shell,
        groups=[group for group in groups if len(group)],
        bases=bases,
        background=to_radiance(field.background, field.bounded).tolist(),
        radiance="sigmoid" if field.bounded else "exp",
    )


def group_of(gaussians: Gaussians, name: str, motion: float) -> GaussianGroup:
    """Gaussians at rest as a group; `motion` is their share of dynamic content."""
    offsets = gaussians.log_radiance_offsets
    return GaussianGroup(
        name=name,
        motion=motion,
        means=to_numpy(gaussians.means),
        quaternions=unit(to_numpy(gaussians.quaternions)),
        log_scales=to_numpy(gaussians.log_scales),
        opacity_logits=to_numpy(gaussians.opacity_logits),
        log_radiance=to_numpy(gaussians.log_radiance),
        color_offsets=to_numpy(offsets) if offsets.numel() else None,
        sh1=to_numpy(gaussians.sh1) if len(gaussians.sh1) else None,
    )


def local_of(gaussians: LocalGaussians) -> GaussianGroup:
    """Time-local Gaussians as a group."""
    means, log_scales = to_numpy(gaussians.means), to_numpy(gaussians.log_scales)
    colors = to_numpy(gaussians.colors)
    return GaussianGroup(
        name="local",
        motion=1.0,
        means=means[:, :3],
        quaternions=unit(to_numpy(gaussians.quaternions)),
        log_scales=log_scales[:, :3],
        opacity_logits=colors[:, 3],
        log_radiance=colors[:, :3],
        velocities=to_numpy(gaussians.velocities)[:, :3],
        centers=means[:, 3],
        log_durations=log_scales[:, 3],
    )


def drop_invisible(group: GaussianGroup) -> GaussianGroup:
    """The group without Gaussians that draw nothing at any time, or are not finite."""
    logits = group.opacity_logits
    if group.opacity_offsets is not None:
        logits = logits + group.opacity_offsets.max(0)
    kept = logits > np.log(MIN_OPACITY / (1 - MIN_OPACITY))
    for name in ("means", "quaternions", "log_scales", "log_radiance", "velocities"):
        values = getattr(group, name)
        if values is not None:
            kept &= np.isfinite(values).all(1)
    chosen: dict[str, Any] = {}
    for entry in fields(group):
        values = getattr(group, entry.name)
        if not isinstance(values, np.ndarray):
            continue
        along_knots = entry.name in ("color_offsets", "opacity_offsets")
        chosen[entry.name] = values[:, kept] if along_knots else values[kept]
    return replace(group, **chosen)


def filmed_views(
    frames: Sequence[Frame], exposures: Sequence[float]
) -> tuple[list[FilmedView], bytes]:
    """The recorded frames in order of time, and their pictures as JPEG files.

    `exposures` is the EV of every bracket. The pictures of long and large clips are
    made smaller.
    """
    num_pixels = sum(frame.camera.width * frame.camera.height for frame in frames)
    scale = min(1.0, math.sqrt(MAX_RECORDED_PIXELS / num_pixels))
    views, pictures, length = [], [], 0
    for frame in frames:
        picture = jpeg(shrink(to_numpy(frame.image), scale))
        view = FilmedView(
            time=float(frame.time),
            K=rows(frame.camera.K),
            c2w=rows(frame.camera.c2w),
            bracket=frame.bracket,
            camera_id=frame.camera_id,
            picture=[length, length + len(picture)],
            ev=exposures[frame.bracket] + frame.drift,
        )
        views.append(view)
        pictures.append(picture)
        length += len(picture)
    return views, b"".join(pictures)


def shrink(rgb: Array, scale: float) -> Array:
    """A picture (H, W, 3) with `scale` <= 1 times the pixels along each side."""
    if scale == 1:
        return rgb
    height, width = rgb.shape[:2]
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)


def jpeg(rgb: Array) -> bytes:
    """A JPEG file of rgb (H, W, 3) in [0, 1]."""
    bgr = np.rint(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, PICTURE_QUALITY]
    ok, buffer = cv2.imencode(".jpg", np.ascontiguousarray(bgr), options)
    assert ok
    return buffer.tobytes()


def camera_responses(tonemapper: ToneMapper) -> list[CameraResponse]:
    """The learned response of every physical camera."""
    responses = []
    for camera_id in range(tonemapper.num_cameras):
        x, y = whole_curve(tonemapper, camera_id)
        with torch.no_grad():
            white_balance = tonemapper.log_white_balance(camera_id).exp()
            neutral = tonemapper.neutral(camera_id)
        responses.append(CameraResponse(rows(x), rows(y), rows(white_balance), rows(neutral)))
    return responses


@torch.no_grad()
def whole_curve(tonemapper: ToneMapper, camera_id: int) -> tuple[Tensor, Tensor]:
    """The response of a camera: exposure x (M,) and recorded y (3, M).

    Most are white at 1; those that go on rising there are followed further.
    """
    x, y = tonemapper.curve(camera_id)
    stops = torch.linspace(0, STOPS_BEYOND, STEPS_BEYOND + 1, device=x.device)[1:]
    beyond = stops.exp2()
    exposed, gain = beyond[:, None].repeat(1, 3), torch.ones(3, device=x.device)
    values = tonemapper.respond(exposed, gain, camera_id, tonemapper.reference_frame, False).T
    if (values[:, -1] - y[:, -1]).max() < LEAST_RISE:
        return x, y
    return torch.cat([x, beyond]), torch.cat([y, values], 1)


def rows(values: Tensor) -> list:
    """A tensor as nested lists."""
    return values.detach().double().cpu().tolist()


def to_numpy(values: Tensor) -> Array:
    """A tensor as a float32 array."""
    return values.detach().float().cpu().numpy()


def unit(quaternions: Array) -> Array:
    """Quaternions (N, 4) of length 1."""
    return quaternions / (np.linalg.norm(quaternions, axis=1, keepdims=True) + MIN_LENGTH)
