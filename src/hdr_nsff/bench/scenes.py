"""Scenes of a benchmark.

Scene folders, folders of `synth` and `reexpose` with footage and truth, public data
sets, and footage alone, which is measured on the frames that `prepare` holds out.
"""

from __future__ import annotations

import os
from pathlib import Path

from hdr_nsff.bench.config import BenchConfig, BenchScene, safe_name
from hdr_nsff.core.errors import InputError
from hdr_nsff.evaluation.evaluate import views_of_clip
from hdr_nsff.footage.datasets import layout_of
from hdr_nsff.footage.footage import open_footage
from hdr_nsff.pipeline import RunConfig, held_out_every
from hdr_nsff.prepare.prepare import PrepareConfig
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.synth.oracle import ORACLE_NOTE


def parse_scene(text: str, config: BenchConfig) -> BenchScene:
    """The scene of "[NAME=]PLACE[:TRUTH]"; InputError where there is none."""
    label, folder, given_truth = split_scene(text.strip())
    own_name = folder.stem if folder.is_file() else Path(os.path.abspath(folder)).name
    name = safe_name(label or own_name, "--scenes")
    option = f"--scenes {text.strip()!r:.200}"
    if given_truth is not None and not has_truth(given_truth):
        advice = "correct the path, or leave it out"
        raise InputError(f"{option}: no truth.json in {given_truth}; {advice}")
    if (folder / "scene.json").is_file():
        return prepared_scene(name, folder, given_truth, config)
    footage = footage_in(folder)
    if footage is not None and (given_truth is not None or has_truth(folder / "truth")):
        truth = given_truth or folder / "truth"
        if config.oracle:
            return oracle_scene(name, folder, truth)
        return footage_scene(name, footage, truth, config)
    if layout_of(folder) is not None and not config.oracle:
        return footage_scene(name, folder, given_truth, config)
    if config.oracle:
        raise InputError(f"{option}: no clip with its truth/; leave `--oracle` out")
    try:
        open_footage(folder)
    except InputError as error:
        known = "no scene.json, no clip with its truth/, no public data set and no footage"
        raise InputError(f"{option}: {known}: {error}") from None
    return footage_scene(name, folder, given_truth, config)


def split_scene(text: str) -> tuple[str | None, Path, Path | None]:
    """Name, place and truth folder of "[NAME=]PLACE[:TRUTH]".

    A text that is a folder or file as it stands counts as one.
    """
    candidates: list[tuple[str | None, str]] = [(None, text)]
    label, equals, rest = text.partition("=")
    if equals:
        candidates.append((label, rest))
    for name, place in candidates:
        folder, colon, truth = place.rpartition(":")
        if place and Path(place).exists():
            return name, Path(place), None
        if colon and folder and Path(folder).exists():
            return name, Path(folder), Path(truth)
    advice = "correct the path (one with a comma in it cannot be given)"
    raise InputError(f"--scenes {text!r:.200}: no such folder or video; {advice}")


def has_truth(folder: Path) -> bool:
    """Whether `folder` is a truth folder."""
    return (folder / "truth.json").is_file()


def footage_in(folder: Path) -> Path | None:
    """The clip in a folder of `synth` or `reexpose`."""
    for path in (folder / "clip.mp4", folder / "clip"):
        if path.exists():
            return path
    return None


def prepared_scene(
    name: str, folder: Path, given_truth: Path | None, config: BenchConfig
) -> BenchScene:
    """A scene folder that is there already."""
    manifest = Manifest.load(folder)
    oracle = any(ORACLE_NOTE in step.note for step in manifest.steps.values())
    if config.oracle and not oracle:
        problem = f"{folder} is a scene made from footage"
        advice = "give a folder that `hdr-nsff synth --oracle` wrote"
        raise InputError(f"--oracle: {problem}; {advice}")
    if config.protocol is not None and manifest.protocol != config.protocol:
        problem = f"{folder} is prepared already, for {manifest.protocol or 'none'}"
        advice = "give its footage, or leave the option out"
        raise InputError(f"--protocol {config.protocol}: {problem}; {advice}")
    truth = given_truth or truth_beside(folder)
    if truth is not None:
        views_of_clip(truth)  # refuses a folder without truth
    return BenchScene(oracle_name(name) if oracle else name, folder, truth, None, oracle)


def truth_beside(folder: Path) -> Path | None:
    """The truth folder in or beside a scene folder."""
    place = folder.absolute()
    candidates = (folder / "truth", place.parent / "truth", place.with_name(f"{place.name}_truth"))
    return next((path for path in candidates if has_truth(path)), None)


def oracle_name(name: str) -> str:
    """A name that shows that the scene was made from the truth."""
    return name if "oracle" in name else f"{name}-oracle"


def oracle_scene(name: str, folder: Path, truth: Path) -> BenchScene:
    """The oracle scene that `synth --oracle` wrote."""
    if not (folder / "oracle" / "scene.json").is_file():
        advice = "run `hdr-nsff synth` with `--oracle` on it again"
        raise InputError(f"--oracle: {folder} holds no oracle/; {advice}")
    views_of_clip(truth)
    return BenchScene(oracle_name(name), folder / "oracle", truth, None, True)


def footage_scene(name: str, clip: Path, truth: Path | None, config: BenchConfig) -> BenchScene:
    """A scene that `prepare` makes of a clip, with the poses that were given for it."""
    out = config.out / "scenes" / name
    hold_out = held_out_every(RunConfig(clip, out, truth=truth, protocol=config.protocol))
    footage = PrepareConfig(
        clip,
        out,
        max_size=config.max_size,
        hold_out=hold_out,
        protocol=config.protocol,
        poses=poses_beside(clip) if truth is not None else None,
    )
    return BenchScene(name, out, truth, footage, False)


def poses_beside(clip: Path) -> Path | None:
    """The poses that `reexpose` wrote beside a clip, LLFF's in folders of old."""
    candidates = (clip.parent / name for name in ("transforms.json", "poses_bounds.npy"))
    return next((path for path in candidates if path.is_file()), None)
