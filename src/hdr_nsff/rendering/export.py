"""The verb `export`: a page for browsers, Gaussians as PLY or USD, the camera
as text, or a scene in a public data layout.

The last two are for other programs. The writers of layouts are in `footage/layouts/`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say
from hdr_nsff.footage.layouts import held_out, llff, nerfstudio
from hdr_nsff.footage.layouts.writer import Source
from hdr_nsff.geometry.paths import MAX_EV
from hdr_nsff.rendering.export_gaussians import ColorTransform, export_one, export_sequence
from hdr_nsff.rendering.export_page import BARE, PAGE, export_page
from hdr_nsff.rendering.export_scene import CHAN, export_chan, export_usd
from hdr_nsff.rendering.usd import ENDINGS as USD_ENDINGS
from hdr_nsff.training.run_folder import Run, read_config

Layout = Literal["hdr-gopro", "nerfstudio"]
# What files of these endings are
KINDS = {PAGE: "a page", BARE: "the scene of a page", CHAN: "a camera path"}
KINDS |= dict.fromkeys(USD_ENDINGS, "USD")


@dataclass(frozen=True)
class ExportConfig:
    """A page to look around in, Gaussians for viewers, or a scene in a public layout.

    One HTML file that plays in every browser, without a network:
    hdr-nsff export out/run scene.html

    Moving Gaussians and the camera as USD: hdr-nsff export out/run scene.usdc

    The camera alone, for Nuke: hdr-nsff export out/run camera.chan

    Gaussians at a time: hdr-nsff export out/run frame.ply --ply --time 12.5

    Images, poses_bounds.npy, masks, depth, flow and a COLMAP model: hdr-nsff export
    out/scene out/gopro --layout hdr-gopro

    transforms.json, images and depth: hdr-nsff export
    out/scene out/ns --layout nerfstudio

    With held-out views, as recorded: hdr-nsff export out/scene out/ns --layout
    nerfstudio --truth truth

    `hdr-nsff prepare` reads both layouts back to the same scene.
    """

    run: tyro.conf.Positional[Path]
    """Run folder; for --layout a scene folder, or a run folder, whose scene is meant.
    """
    out: tyro.conf.Positional[Path]
    """The output: NAME.html for a page, NAME.hdr4d for its scene alone, NAME.usdc,
    .usda or .usd for USD, NAME.chan for the camera, a file NAME.ply with --ply, a
    folder with --ply-sequence and --layout.
    """
    layout: Layout | None = None
    """The scene's frames, poses, masks, depth and flow as HDR-GoPro / NSFF (LLFF), one
    picture per time, or as nerfstudio's.
    """
    truth: Path | None = None
    """With --layout: a truth folder, as `synth`, `reexpose` and `prepare` write them;
    its views become held-out pictures of the layout.
    """
    ply: bool = False
    """One PLY, at --time."""
    ply_sequence: bool = False
    """One numbered PLY per training time."""
    time: float | None = None
    """In frames of the clip, may be fractional; default: the middle one."""
    device: str = "auto"
    """auto, cpu or cuda."""
    colors: Annotated[ColorTransform, tyro.conf.arg(name="")] = field(
        default_factory=ColorTransform
    )


def export(config: ExportConfig) -> Path:
    """The verb: the file or folder that was written."""
    check_settings(config)
    if config.layout is not None:
        return export_scene(config.run, config.out, config.layout, config.truth)
    run = Run.open(config.run, config.device)
    with writing_to(config.out), lock_output(config.out):
        ending = config.out.suffix.lower()
        if ending in (PAGE, BARE):
            return export_page(run, config.out)
        if ending in USD_ENDINGS:
            return export_usd(run, config.out)
        if ending == CHAN:
            return export_chan(run, config.out)
        if config.ply_sequence:
            return export_sequence(run, config.out, config.colors)
        time = config.time
        if time is None:
            times = sorted({f.time for f in run.scene.train})
            time = times[len(times) // 2]
        return export_one(run, config.out, time, config.colors)


def is_whole(out: Path) -> bool:
    """Whether an output is of all times and needs no option, by its ending."""
    return out.suffix.lower() in (PAGE, BARE, CHAN, *USD_ENDINGS)


def check_settings(config: ExportConfig) -> None:
    """InputError for settings that make no sense, whatever the run is."""
    others = config.ply + config.ply_sequence + (config.layout is not None)
    if is_whole(config.out):
        check_whole(config, others)
    elif others != 1:
        raise InputError(nothing_chosen(config.out, others))
    check_output(config)
    check_colors(config.colors)
    if config.layout is not None:
        if config.time is not None or config.colors != ColorTransform():
            options = "--time, --ev, --linear and --camera-id are for Gaussians"
            raise InputError(f"--layout: writes the recorded frames; {options}")
    elif config.truth is not None:
        problem = "held-out views are pictures, and Gaussians have none"
        raise InputError(f"--truth: {problem}; use it with --layout NAME")
    if config.ply_sequence and config.time is not None:
        advice = "use --ply for one time"
        raise InputError(f"--time: --ply-sequence writes every training time; {advice}")


def nothing_chosen(out: Path, others: int) -> str:
    """The sentence for an output that no option, or more than one, says the kind of."""
    if others > 1:
        kinds = "--ply, --ply-sequence and --layout exclude each other"
        return f"{out}: {kinds}; choose what to write by one of them"
    if out.suffix.lower() == ".ply":
        folder = "name a folder and add --ply-sequence for those at every time"
        return f"{out}: add --ply for Gaussians at one time (--time), or {folder}"
    endings = f"{PAGE}, {BARE}, {', '.join(USD_ENDINGS)} or {CHAN}"
    return (
        f"{out}: choose what to write; the name does not say it: end it in {endings}, or in "
        ".ply and add --ply, or name a folder and add --ply-sequence or --layout NAME"
    )


def check_whole(config: ExportConfig, others: int) -> None:
    """InputError for options that have no use here; `others` counts outputs."""
    out = config.out
    kind = "a page" if out.suffix.lower() in (PAGE, BARE) else "a file with this ending"
    if others:
        problem = f"a file with this ending is {KINDS[out.suffix.lower()]}"
        advice = "name another output, or leave --ply, --ply-sequence and --layout out"
        raise InputError(f"{out}: {problem}; {advice}")
    if config.time is not None or config.colors != ColorTransform():
        problem = f"{kind} holds all times and linear radiance"
        raise InputError(f"{out}: {problem}; leave --time, --ev, --linear and --camera-id out")
    if out.is_dir():
        raise InputError(f"{out}: is a folder; name a file")


def check_output(config: ExportConfig) -> None:
    """InputError where the output is a folder instead of a file, or the reverse."""
    out = config.out
    if config.ply and (out.suffix.lower() != ".ply" or out.is_dir()):
        raise InputError(f"{out}: --ply writes one file; give it a name that ends in .ply")
    if config.ply_sequence and out.is_file():
        advice = "--ply-sequence writes a folder, name another one"
        raise InputError(f"{out}: is a file; {advice}")
    if config.ply_sequence and not Path(os.path.abspath(out)).name:  # its note would be beside it
        raise InputError(f"{out}: --ply-sequence writes a folder of its own; name one below this")


def check_colors(colors: ColorTransform) -> None:
    """InputError for a color transform that makes no sense."""
    if colors.linear and colors.ev is not None:
        problem = "linear radiance is not developed"
        raise InputError(f"--linear --ev: {problem}; leave one of them out")
    if colors.ev is not None and not abs(colors.ev) < MAX_EV:
        meaning = "an exposure in stops relative to the reference, like -2 or 1.5"
        raise InputError(f"--ev {colors.ev:g}: {meaning}")


def export_scene(folder: Path, out: Path, layout: Layout, truth: Path | None = None) -> Path:
    """Write the scene of a scene or run folder in a public layout; the folder written.

    The views of a `truth` folder become held-out pictures.
    """
    scene = scene_folder(folder)
    check_apart(out, scene, "scene")
    if truth is not None:
        check_apart(out, truth, "truth")
    source = Source.open(scene)
    views = held_out.views_of(source, truth) if truth is not None else []
    with writing_to(out), lock_output(out):
        match layout:
            case "hdr-gopro":
                llff.write(source, out, views)
            case "nerfstudio":
                nerfstudio.write(source, out, views)
    say(f"{out}: the scene in the {layout} layout; `hdr-nsff prepare {out} SCENE` reads it back")
    return out


def scene_folder(folder: Path) -> Path:
    """`folder` itself where it is a scene folder, the scene of a run folder.

    InputError for any other.
    """
    if (folder / "scene.json").is_file():
        return folder
    if (folder / "config.json").is_file():
        return read_config(folder).scene
    advice = "make a scene with `hdr-nsff prepare`"
    raise InputError(f"{folder}: neither a scene folder nor a run folder; {advice}")


def check_apart(out: Path, folder: Path, name: str) -> None:
    """InputError where `out` and `folder` overlap, so that `out` would change it."""
    target, kept = out.resolve(), folder.resolve()
    if target.is_relative_to(kept) or kept.is_relative_to(target):
        advice = "name a folder outside of it"
        raise InputError(f"{out}: overlaps the {name} folder {folder}; {advice}")
