"""The verb `render`: stills, EXR sequences and videos of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import check_encoder
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say
from hdr_nsff.geometry.paths import MAX_EV
from hdr_nsff.rendering.interpolate import LayeredField
from hdr_nsff.rendering.lens import original_lens
from hdr_nsff.rendering.output import Output, Shot
from hdr_nsff.rendering.shot_views import MAX_VIEWS, SHOTS, plan_shot, short_count
from hdr_nsff.rendering.shots import name_results, render_shot
from hdr_nsff.rendering.standard_set import render_all
from hdr_nsff.rendering.write_view import open_look
from hdr_nsff.training.run_folder import Run

__all__ = ["RenderConfig", "render", "render_all"]

MAX_PIXELS = 64_000_000  # of one picture: twice those of an 8K frame
MIN_SIDE_PX = 2  # H.264 with 4:2:0 color takes even sizes
MAX_FPS = 1000  # no player shows more
MIN_FPS = 0.001  # video files hold no slower one
FILE = "FILE.json"
# which paths use an option; those that are not here are used by all
USED_BY = {
    "frame": ("fixed", "bullet", "slowmo", FILE),  # slowmo where several cameras filmed
    "scale": (*SHOTS, FILE),
    "factor": ("slowmo",),
    "views": ("bullet",),
    "fps": (*SHOTS, FILE),
    "budget": ("all",),
}


@dataclass(frozen=True)
class RenderConfig:
    """Pictures, EXR sequences and videos from a run."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    path: str = "all"
    """training, fixed, bullet, slowmo, or a JSON file with a camera path; all: the set
    that `run` makes (no frame, scale, factor, views, fps).
    """
    out: Path | None = None
    """Folder of the pictures; default: RUN/render."""
    frame: int | None = None
    """Frame whose camera (fixed, bullet) and time (bullet) are used; default: the
    middle one.
    """
    scale: float = 1.0
    """Size of the pictures relative to the clip's, up to 64 megapixels."""
    factor: int = 4
    """Slow motion: views per recorded frame, up to 10,000 views in all."""
    views: int = 48
    """Bullet time: number of views, up to 10,000."""
    fps: float | None = None
    """Frames per second of videos; default: the clip's."""
    budget: float = 90.0
    """For path `all`: seconds it may take; videos become smaller and shorter to fit."""
    device: str = "auto"
    """auto, cpu or cuda."""
    output: Annotated[Output, tyro.conf.arg(name="")] = field(default_factory=Output)


def render(config: RenderConfig) -> dict[str, Path]:
    """The verb: the files it has written, by name."""
    check_settings(config)
    run = Run.open(config.run, config.device)
    if config.output.between == "splat" and not isinstance(run.field, LayeredField):
        raise InputError("--between splat: this field has no layers to splat; use --between direct")
    if config.output.lens == "original":
        original_lens(run.scene.manifest, config.output.camera_id)
        if config.path == "all":
            raise InputError("--lens original: name a path with it, such as `--path training`")
    out = config.out or Path(config.run) / "render"
    with writing_to(out), lock_output(out):
        if config.path == "all":
            return render_all(run, out, config.budget, config.output)
        planned = plan_shot(run, config.path, config.frame, config.factor, config.views)
        shot = resize_shot(planned, config.scale, config.fps)
        result = render_shot(run, shot, out, config.output)
        named = name_results(out, shot, shot.name, config.output, result)
        for name, path in named.items():
            say(f"{name}: {path}")
        return named


def resize_shot(shot: Shot, scale: float, fps: float | None) -> Shot:
    """The shot with `scale` times the pixels along each side, at `fps` (None: its own).

    InputError for pictures that are too large or too small.
    """
    for view in shot.views:
        check_size(view.camera.width, view.camera.height, scale)
    return Shot(shot.name, [view.resized(scale) for view in shot.views], fps or shot.fps)


def check_size(width: int, height: int, scale: float) -> None:
    """InputError where a scaled picture is too large or too small.

    It has `width` x `height` pixels times `scale`.
    """
    scaled_width, scaled_height = width * scale, height * scale
    size = f"pictures of {scaled_width:.3g} x {scaled_height:.3g} pixels"
    if scaled_width * scaled_height > MAX_PIXELS:
        largest = math.floor(100 * math.sqrt(MAX_PIXELS / (width * height))) / 100
        limit = f"at most {MAX_PIXELS / 1e6:.0f} megapixels are rendered"
        raise InputError(f"--scale {scale:g}: {size}; {limit}, use {largest:g} or less")
    if round(min(scaled_width, scaled_height)) < MIN_SIDE_PX:
        smallest = math.ceil(100 * MIN_SIDE_PX / min(width, height)) / 100
        limit = f"a picture has at least {MIN_SIDE_PX} pixels a side"
        raise InputError(f"--scale {scale:g}: {size}; {limit}, use {smallest:g} or more")


def check_settings(config: RenderConfig) -> None:
    """InputError for settings that make no sense, whatever the run is."""
    check_count("--factor", config.factor)
    check_count("--views", config.views)
    check_positive("--scale", config.scale)
    check_positive("--budget", config.budget)
    if config.fps is not None:
        check_positive("--fps", config.fps)
        if config.fps > MAX_FPS:
            limit = f"no player shows that many; use {MAX_FPS} at most"
            raise InputError(f"--fps {config.fps:g}: {limit}")
        if config.fps < MIN_FPS:
            limit = f"no video is that slow; use {MIN_FPS} at least"
            raise InputError(f"--fps {config.fps:g}: {limit}")
    check_used(config)
    output = config.output
    if output.ev is not None and not abs(output.ev) < MAX_EV:
        meaning = "an exposure in stops relative to the reference, like -2 or 1.5"
        raise InputError(f"--ev {output.ev:g}: {meaning}")
    if output.hdr_video:
        check_encoder(output.hdr_codec)
    hdr = output.hdr_video or output.hdr_still
    if "avif" in output.hdr_still:
        check_encoder("av1")
    open_look(output)
    if output.ocio is None and (output.view or output.display):
        raise InputError("--view, --display: need a configuration; add --ocio studio-config-latest")
    if output.exr == "none" and not (output.png or output.video or hdr):
        options = "--exr none --no-png --no-video"
        raise InputError(f"{options}: nothing left to write; leave one of them out")


def check_used(config: RenderConfig) -> None:
    """InputError for an option without effect on the path."""
    path = FILE if config.path.endswith(".json") else config.path
    if path not in ("all", *SHOTS, FILE):
        return  # refused with the run
    for option, paths in USED_BY.items():
        given = getattr(config, option) != getattr(RenderConfig, option)
        if given and path not in paths:
            advice = f"leave it out, or use it with --path {' or '.join(paths)}"
            raise InputError(f"--{option}: has no effect with --path {path}; {advice}")


def check_positive(option: str, value: float) -> None:
    """InputError unless `value` is a number above 0."""
    if not (value > 0 and math.isfinite(value)):
        raise InputError(f"{option} {value:g}: must be a number above 0")


def check_count(option: str, value: int) -> None:
    """InputError unless `value` is a count of views that a shot may have."""
    if value <= 0:
        raise InputError(f"{option} {short_count(value)}: must be a number above 0")
    if value > MAX_VIEWS:
        limit = f"a shot has at most {MAX_VIEWS:,} views"
        raise InputError(f"{option} {short_count(value)}: {limit}; use fewer")
