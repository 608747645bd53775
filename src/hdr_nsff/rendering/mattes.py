"""Mattes of a scene's moving objects, where the field can tell them apart.

Gaussians belong to movers of the prepared scene; other fields have the matte of all
moving content alone, the channel `motion`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hdr_nsff.core.tensors import to_device
from hdr_nsff.fields.splat.object_labels import ObjectLabels, label_objects, object_coverage
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.training.run_folder import Run

STATIC, UNLABELED = "static", "moving"  # names of what belongs to no mover


@dataclass(frozen=True)
class ObjectMattes:
    """The objects of a run."""

    field: Splat
    labels: ObjectLabels
    names: tuple[str, ...]

    @classmethod
    def of_run(cls, run: Run) -> ObjectMattes | None:
        """None where the field has no Gaussians or the scene no movers."""
        if not isinstance(run.field, Splat) or not run.scene.movers:
            return None
        movers = [f"mover_{k}" for k in range(len(run.scene.movers))]
        labels = label_objects(run.field, run.scene)
        return cls(run.field, labels, (STATIC, UNLABELED, *movers))

    def coverage(self, view: PathView) -> dict[str, np.ndarray]:
        """Coverages (H, W) in [0, 1] of all objects by name; they add up to 1."""
        camera = to_device(view.camera, self.field.static.means.device)
        count = len(self.names) - 2
        seen = object_coverage(self.field, self.labels, count, camera, view.time)
        seen[:, 0] = (1 - seen[:, 1:].sum(1)).clamp_min(0)  # with the field's background
        pictures = seen.reshape(camera.height, camera.width, -1).cpu().numpy()
        return {name: pictures[..., i] for i, name in enumerate(self.names)}
