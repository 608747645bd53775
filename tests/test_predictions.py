"""Held-out frames are recorded as training frames of their exposure and color are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from presets import small
from test_late_mixing import contrasty
from test_splat import CAMERA
from torch import Tensor

from hdr_nsff.evaluation.predictions import recordings
from hdr_nsff.evaluation.targets import Target
from hdr_nsff.fields.outputs import record_pixels
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.radiometry.response import Response
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.build import build_tone_mapper
from hdr_nsff.training.run_folder import Run

KNOTS = np.linspace(0, 1, 256)
GAMMA = Response(
    KNOTS**2.2, np.tile(KNOTS, (1, 3, 1)), np.zeros(1), np.zeros((1, 3)), "static points",
    0.05, 1000, False, (),
)  # fmt: skip
Kind = Literal["shared", "fixed", "mlp", "per_image", "sigmoid", "none"]


def recorded_of(
    tonemapper: ToneMapper,
    toy: Scene,
    bracket: int = 0,
    drift: float = 0.0,
    white_balance: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> Tensor:
    """What is recorded (S, 3) of a held-out view."""
    picture = torch.zeros(CAMERA.height, CAMERA.width, 3)
    view, rgb = PathView(CAMERA, 2.0), {bracket: picture}
    target = Target("", "", view, bracket, 0, rgb, None, None)
    target = replace(target, drift=drift, white_balance=white_balance)
    run = Run(Path(), small("splat"), toy, contrasty(), tonemapper, 0, 0.0)
    with torch.no_grad():
        radiance = run.field.render(CAMERA, 2.0).radiance.view_as(picture)
    return recordings(run, target, radiance)[bracket].view(-1, 3)


@pytest.mark.parametrize("kind", ["shared", "fixed", "mlp", "per_image", "sigmoid", "none"])
def test_drift_counts_for_light_and_for_what_is_averaged_late(kind: Kind, toy: Scene) -> None:
    """Without any camera, as `none` has it, it counts for nothing."""
    balance = (0.0, 0.0, 0.0) if kind == "sigmoid" else (0.3, 0.0, -0.3)
    opposite = tuple(-stops for stops in balance)
    known = Recordings((0, 0), (0, 0), (0.0,), 0, 1, (0.5, -0.5), (balance, opposite))
    tonemapper = build_tone_mapper(ToneMapConfig(kind=kind), known)
    tonemapper.start(GAMMA)
    trained_on = tonemapper.recorder(0, 0, frame=0)
    with torch.no_grad():
        (trained,) = record_pixels(contrasty(), CAMERA, 2.0, [trained_on])
    found = recorded_of(tonemapper, toy, drift=0.5, white_balance=balance)
    torch.testing.assert_close(found, trained, atol=1e-5, rtol=1e-4)
    assert torch.allclose(found, recorded_of(tonemapper, toy)) == (kind == "none")


def test_a_little_drift_leaves_the_mean_gain_and_curve_of_a_bracket(toy: Scene) -> None:
    """Where gains and curves are of images, and not those of the reference image."""
    known = Recordings((0, 1, 0, 1), (0,) * 4, (None, None), 0, 1)
    tonemapper = build_tone_mapper(ToneMapConfig(kind="per_image"), known)
    generator = torch.Generator().manual_seed(0)
    for p in tonemapper.parameters():
        p.data += 0.1 * torch.rand(p.shape, generator=generator)
    little = recorded_of(tonemapper, toy, bracket=1, drift=1e-6)
    torch.testing.assert_close(little, recorded_of(tonemapper, toy, bracket=1), atol=1e-5, rtol=0)
