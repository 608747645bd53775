"""Tables of a report: how long everything took, and what was estimated or given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hdr_nsff.core import notes
from hdr_nsff.core.page import Table, number
from hdr_nsff.training.run_folder import Run

LEARNED_RESPONSES = ("shared", "per_image", "mlp")  # kinds of tone mappers that learn one
PARALLAX = {
    "full": "the camera moved",
    "rotation": "the camera only turned: no depth, no novel viewpoints",
    "none": "the camera stood still: no depth, no novel viewpoints",
}


def timing_table(run: Run, metrics: dict[str, Any] | None, renders: Path) -> Table:
    """Seconds of every step."""
    rows = []
    for name, step in run.scene.manifest.steps.items():
        rows.append((f"prepare: {name}", number(step.seconds, 1, " s")))
    rows.append(("train", number(run.seconds, 1, " s")))
    for path in sorted(renders.glob("*/sequence.json")):
        sequence = notes.read(path, notes.Sequence)
        if sequence is not None:
            label = f"render: {path.parent.name}, {len(sequence.views)} views"
            rows.append((label, number(sequence.seconds, 1, " s")))
    seconds = None if metrics is None else metrics["seconds"]
    rows.append(("evaluate", number(seconds, 1, " s")))
    return Table(("", ""), rows)


def provenance_table(run: Run) -> Table:
    """Every step of `prepare`: estimated, given or absent, and its result."""
    manifest = run.scene.manifest
    rows: list[tuple[str, str, str]] = []
    for name, step in manifest.steps.items():
        rows.append((name, step.provenance, step.note))
    rows.append(("exposure values", exposure_provenance(run), cycle_text(run)))
    kind = run.config.tonemap.kind
    response = "estimated" if kind in LEARNED_RESPONSES else "given"
    rows.append(("response curve", response, f"tone map: {kind}"))
    rows.append(("parallax", "estimated", PARALLAX[manifest.parallax]))
    return Table(("", "", ""), rows, num_labels=3)


def exposure_provenance(run: Run) -> str:
    """Whether the exposures were estimated or given."""
    manifest = run.scene.manifest
    if any(ev is None for ev in manifest.bracket_ev):
        return "estimated"
    return "given" if manifest.exposure_given else "reference only"


def cycle_text(run: Run) -> str:
    """The exposure cycle in words."""
    manifest = run.scene.manifest
    if manifest.cycle <= 1:
        return "one exposure"
    values = ", ".join(f"{ev:+.1f}" for ev in run.tonemapper.exposures().tolist())
    source = "given" if manifest.exposure_given else "learned"
    return f"exposure cycle of {manifest.cycle} (EV {values}, {source})"
