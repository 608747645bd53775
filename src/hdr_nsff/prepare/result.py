"""What a step of `prepare` hands back; the engine writes it into the scene folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_half
from hdr_nsff.scene.manifest import Manifest, Provenance


@dataclass(frozen=True)
class StepResult:
    """The findings of one step. Steps write nothing themselves, except flow, which is
    stored pair by pair as it is done.
    """

    note: str  # one sentence for people
    provenance: Provenance = "estimated"
    details: dict[str, Any] = field(default_factory=dict)  # plain data, for the record
    manifest: dict[str, Any] = field(default_factory=dict)  # fields of scene.json
    # field of a frame's entry -> {frame index: value}; frames left out get None
    frames: dict[str, dict[int, Any]] = field(default_factory=dict)
    # the same of maps (H, W), which become files (`MAPS`)
    maps: dict[str, Mapping[int, np.ndarray]] = field(default_factory=dict)
    # name of a file of the folder -> what writes it
    files: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)


@dataclass(frozen=True)
class MapKind:
    """How the maps of one field of a frame's entry are stored."""

    folder: str
    suffix: str
    write: Callable[[Path, np.ndarray], None]

    def name(self, index: int) -> str:
        """The file of frame `index`."""
        return f"{self.folder}/{index:05d}{self.suffix}"


MAPS = {
    "mask": MapKind("masks", ".png", write_png),
    "static_disparity": MapKind("static_disparity", ".npy", write_half),
    "static_confidence": MapKind("static_confidence", ".npy", write_half),
    "still": MapKind("still", ".png", write_png),
    "mover_disparity": MapKind("mover_disparity", ".npy", write_half),
    "mover_confidence": MapKind("mover_confidence", ".npy", write_half),
    "disparity": MapKind("disparity", ".npy", write_half),
    "disparity_confidence": MapKind("disparity_confidence", ".npy", write_half),
}


def store(folder: Path, manifest: Manifest, result: StepResult) -> None:
    """Write a result's files and put its values into the (unsaved) manifest."""
    frames = dict(result.frames)
    for name, maps in result.maps.items():
        kind = MAPS[name]
        for index, array in maps.items():
            kind.write(folder / kind.name(index), array)
        frames[name] = {index: kind.name(index) for index in maps}
    for entry in manifest.frames:
        for name, values in frames.items():
            setattr(entry, name, values.get(entry.index))
    for name, write in result.files.items():
        write(folder / name)
    for name, value in result.manifest.items():
        setattr(manifest, name, value)
