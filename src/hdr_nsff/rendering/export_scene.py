"""A run as USD, and the camera of a run as `.chan` text."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from hdr_nsff.core import notes
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.core.tensors import tree_map
from hdr_nsff.fields.outputs import GaussianCloud
from hdr_nsff.fields.splat.gaussians import to_radiance
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.fields.splat.terms import MIN_OPACITY
from hdr_nsff.rendering import usd
from hdr_nsff.rendering.chan import is_chan, write_chan
from hdr_nsff.rendering.export_gaussians import NOT_OURS
from hdr_nsff.rendering.exr_header import neutral_gains
from hdr_nsff.rendering.output import render_folders
from hdr_nsff.rendering.shot_views import plan_shot
from hdr_nsff.training.run_folder import Run

CHAN = ".chan"
RADIANCE = (
    "linear Rec. 709 as the camera saw it, unbounded: 1 saturates the reference exposure; "
    "color = 0.5 + 0.28209479 * coefficient, do not clamp"
)


def export_usd(run: Run, path: Path) -> Path:
    """Write the run's Gaussians at all training times and its camera; `path`."""
    usd.check_library()
    if not isinstance(run.field, Splat):
        problem = "its field is not made of Gaussians, so there are none to export"
        raise InputError(f"{run.folder}: {problem}; train one with `train splat`")
    if path.exists() and not usd.is_ours(path):
        raise InputError(f"{path}: {NOT_OURS}; choose another name")
    times = run.scene.times.tolist()
    tracks = gaussian_tracks(run.field, times)
    frames = sorted(run.scene.train, key=lambda f: (f.camera_id, f.time))
    first = [frame for frame in frames if frame.camera_id == frames[0].camera_id]
    facts = {
        "radiance": RADIANCE,
        "background": background_of(run.field),
        "neutralWhiteBalance": [float(gain) for gain in neutral_gains(run, 0)],
        "bracketEV": [float(ev) for ev in run.tonemapper.exposures().tolist()],
        "time": "time codes are frames of the clip",
    }
    usd.write_usd(
        path,
        tracks,
        times,
        [frame.camera for frame in first],
        [frame.time for frame in first],
        run.field.model().nearest,
        run.scene.manifest.fps,
        facts,
    )
    count = sum(track.means.shape[1] for track in tracks)
    size = path.stat().st_size / 1e6
    say(f"{path}: {count} Gaussians over {len(times)} times, {size:.1f} MB")
    return path


@torch.no_grad()
def gaussian_tracks(field: Splat, times: list[float]) -> list[usd.Track]:
    """All Gaussians that are ever visible, in groups of constant number."""
    everyone = torch.arange(len(field.local), device=field.static.means.device)
    clouds = [tree_map(to_cpu, field.cloud(field.knot(t), everyone)) for t in times]
    ends = np.cumsum([0, len(field.static), len(field.moving), len(field.local)]).tolist()
    tracks = []
    for name, start, end in zip(("Static", "Moving", "Local"), ends[:-1], ends[1:], strict=True):
        opacities = np.stack([cloud.opacities[start:end].numpy() for cloud in clouds])
        rows = start + np.flatnonzero(opacities.max(0, initial=0) > MIN_OPACITY)
        if len(rows):
            tracks.append(track_of(name, clouds, rows, rest=name == "Static"))
    return tracks


def to_cpu(values: torch.Tensor) -> torch.Tensor:
    """The same on the CPU, float32."""
    return values.float().cpu()


def track_of(name: str, clouds: list[GaussianCloud], rows: np.ndarray, rest: bool) -> usd.Track:
    """The Gaussians `rows` of all `clouds`; those at `rest` keep place and opacity."""
    moments = clouds[:1] if rest else clouds

    def stack(kind: str, chosen: list[GaussianCloud]) -> np.ndarray:
        return np.stack([getattr(cloud, kind)[rows].numpy() for cloud in chosen])

    quaternions = stack("quaternions", moments)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True).clip(1e-12)
    radiance = stack("radiance", clouds)
    if rest:
        radiance = thin(radiance)
    return usd.Track(
        name,
        means=stack("means", moments),
        quaternions=keep_sign(quaternions),
        scales=stack("scales", clouds[:1])[0],
        opacities=stack("opacities", moments),
        radiance=radiance,
    )


def thin(values: np.ndarray) -> np.ndarray:
    """Values (T, ...) that hardly change in time as one row (1, ...), others as are."""
    change = np.abs(values - values[:1]).max()
    return values[:1] if math.isclose(change, 0, abs_tol=1e-6) else values


def keep_sign(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (T, G, 4) that never jump to their negative, the same rotation."""
    dots = (quaternions[1:] * quaternions[:-1]).sum(-1)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), 0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[..., None]])


@torch.no_grad()
def background_of(field: Splat) -> list[float]:
    """The linear radiance (3,) where no Gaussian is."""
    return [float(value) for value in to_radiance(field.background, field.bounded)]


def export_chan(run: Run, path: Path) -> Path:
    """Write the cameras of `render --path training`, by the numbers of its pictures."""
    if path.exists() and not is_chan(path):
        raise InputError(f"{path}: {NOT_OURS}; choose another name, or delete it")
    views = plan_shot(run, "training").views
    write_chan(path, [view.camera for view in views])
    say(f"{path}: {len(views)} cameras, numbered as the pictures of the training path")
    for folder in render_folders(run.folder):
        shot = folder / "training"
        made = notes.read(shot / "sequence.json", notes.Sequence)
        if made is not None and len(made.views) < len(views):
            problem = f"has {len(made.views)} of these pictures, numbered otherwise"
            command = f"hdr-nsff render {run.folder} --path training --out {folder}"
            say(f"{shot}: {problem}; `{command}` renders them all")
    return path
