"""The numbers of a report: the headline in tiles, and every score in tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hdr_nsff.core.page import Table, number

Score = tuple[str, int]  # label, and digits after the point

RGB_SCORES: dict[str, Score] = {
    "psnr": ("PSNR, dB", 2),
    "psnr_moving": ("PSNR moving, dB", 2),
    "ssim": ("SSIM", 3),
    "ssim_moving": ("SSIM moving", 3),
    "lpips": ("LPIPS", 3),
    "lpips_moving": ("LPIPS moving", 3),
    "psnr_all_exposures": ("PSNR over all exposures, dB", 2),
    "psnr_moving_all_exposures": ("PSNR moving over all exposures, dB", 2),
    "psnr_novel_exposures": ("PSNR at exposures outside the clip, dB", 2),
    "psnr_moving_novel_exposures": ("PSNR moving at exposures outside the clip, dB", 2),
}
TILES: dict[str, tuple[str, int, str]] = {  # label, digits, unit
    "psnr": ("PSNR", 2, " dB"),
    "psnr_moving": ("PSNR, moving only", 2, " dB"),
    "ssim": ("SSIM", 3, ""),
    "ssim_moving": ("SSIM, moving only", 3, ""),
    "mu5000": ("HDR PSNR, μ-law 5000", 2, " dB"),
    "mu5000_recordable": ("HDR PSNR, recordable pixels", 2, " dB"),
    "lpips": ("LPIPS", 3, ""),
}
ALWAYS = ("psnr", "psnr_moving", "ssim", "ssim_moving")  # tiles with a dash where unknown
STABILITY = {
    "hdr_tae": "HDR-TAE",
    "hdr_tae_moving": "HDR-TAE moving",
    "pairs": "pairs of training frames, along the clip's own flow",
}
CAMERA = {
    "response_rmse": "response curve, RMS error of the recorded value",
    "power": "power: learned exposures over true ones",
    "response_rmse_after_power": "response curve, RMS error once the power is undone",
    "power_of_response": "power at which the response curves agree best",
    "true_ev": "true exposures, EV",
    "learned_ev": "learned exposures, EV",
    "largest_ev_error": "largest error of an exposure, EV",
    "largest_step_error": "largest error of a step between exposures, EV",
    "largest_step_error_after_power": "the same once the power of the curves is undone",
}
POSES = {
    "ate": "camera centers, RMS error after alignment, true units",
    "ate_share": "camera centers, RMS error as a share of the path's extent",
    "rotation_degrees": "rotation, mean error in degrees",
    "focal": "focal length, pixels",
    "true_focal": "true focal length, pixels",
    "focal_error": "focal length, relative error",
}


@dataclass(frozen=True)
class Tile:
    """One number in large type."""

    value: str
    label: str


@dataclass(frozen=True)
class Headline:
    """The most important numbers of a run."""

    views: int
    kind: str  # of the views
    protocol: str | None
    tiles: list[Tile]
    notes: list[str]


@dataclass(frozen=True)
class ScorePart:
    """One table of scores."""

    title: str
    table: Table
    note: str = ""


@dataclass(frozen=True)
class Quality:
    """All tables of scores."""

    parts: list[ScorePart]
    lpips: str  # its weights, or why it is absent


def headline_of(metrics: dict[str, Any] | None) -> Headline | None:
    """The headline; None before `evaluate` has run."""
    if metrics is None:
        return None
    scores = metrics["headline"]
    tiles = []
    for key, (label, digits, unit) in TILES.items():
        if key in ALWAYS or key in scores:
            tiles.append(Tile(number(scores.get(key), digits, unit), label))
    protocol = metrics.get("protocol")
    return Headline(scores["views"], metrics["kind"], protocol, tiles, metrics["notes"])


def quality_tables(metrics: dict[str, Any] | None) -> Quality | None:
    """All metrics in tables; None before `evaluate` has run."""
    if metrics is None:
        return None
    groups = metrics["groups"] | metrics.get("protocols", {}) | {"headline": metrics["headline"]}
    parts = [ScorePart("Recorded rgb", score_table(groups, RGB_SCORES))]
    if metrics.get("hdr_scores") is not None:
        table = score_table(groups, metrics["hdr_scores"])
        parts.append(ScorePart("Linear radiance", table, radiance_note(metrics)))
    if metrics.get("geometry_scores") is not None:
        table = score_table(groups, metrics["geometry_scores"])
        parts.append(ScorePart("Depth and motion", table, geometry_note(metrics)))
    errors = {
        "Stability along the training path": ("stability", STABILITY),
        "Learned camera against the true one": ("camera", CAMERA),
        "Poses of the scene against the true ones": ("poses", POSES),
    }
    for title, (key, labels) in errors.items():
        found = metrics.get(key) or {}
        rows = [(label, text(found[name])) for name, label in labels.items() if name in found]
        if rows:
            parts.append(ScorePart(title, Table(("", ""), rows)))
    return Quality(parts, metrics["lpips"])


def score_table(groups: Mapping[str, dict[str, Any]], scores: Mapping[str, Score]) -> Table:
    """Rows of scores, columns of groups; scores that no group has are left out."""
    rows = []
    for key, (label, digits) in scores.items():
        values = [group.get(key) for group in groups.values()]
        if any(value is not None for value in values):
            rows.append([label, *(number(value, digits) for value in values)])
    header = ["", *(f"{name} ({group['views']})" for name, group in groups.items())]
    return Table(header, rows)


def radiance_note(metrics: dict[str, Any]) -> str:
    """The scales of the radiance scores, in sentences."""
    per_channel = ", ".join(f"{scale:.4f}" for scale in metrics["scale_per_channel"])
    sentences = [
        f"Normalized by the largest exact radiance, {metrics['peak']:.3g};",
        f"recordable pixels by theirs, {metrics['recordable_peak']:.3g}.",
        f"Predicted radiance was multiplied by {metrics['scale']:.4f} for all views",
        f"(per channel: {per_channel}).",
    ]
    if "pu21" in metrics:
        white, nits = metrics["pu21"]["white"], metrics["pu21"]["nits"]
        sentences.append(f"PU21 takes luminance {white:.3g} for {nits:g} cd/m².")
    return " ".join(sentences)


def geometry_note(metrics: dict[str, Any]) -> str:
    """The scales of the scores of depth and motion, in a sentence."""
    sentence = f"Predicted depth was multiplied by {metrics['depth_scale']:.4f} for all views"
    if "world_scale" in metrics:
        sentence += f", scene flow by {metrics['world_scale']:.4f}"
    return f"{sentence}."


def text(value: int | float | list[float]) -> str:
    """A value for people.

    A count as it is, a number with four digits after the point, a list of numbers with
    three and their signs.
    """
    if isinstance(value, int):
        return str(value)
    if isinstance(value, list):
        return ", ".join(f"{element:+.3f}" for element in value)
    return number(value, 4)
