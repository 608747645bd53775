"""Looks of OpenColorIO, by the configurations that the library brings along."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fakes import fake_run
from test_hdr_shots import large_shot

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import read_exr
from hdr_nsff.core.images import read_image
from hdr_nsff.core.ocio import Look
from hdr_nsff.rendering.output import Output
from hdr_nsff.rendering.shots import render_shot

pytest.importorskip("PyOpenColorIO")
ACES = "ACES 2.0 - SDR 100 nits (Rec.709)"


@pytest.fixture(scope="module")
def aces() -> Look:
    return Look("studio-config-latest", ACES)


def test_aces_keeps_gray_gray_and_rolls_highlights_off(aces: Look) -> None:
    ramp = np.geomspace(0.01, 100, 32)[None, :, None] * np.ones(3)
    seen = aces.develop(ramp)
    assert np.abs(seen - seen.mean(-1, keepdims=True)).max() < 0.01
    assert (np.diff(seen[0, :, 1]) > -1e-4).all() and seen.min() >= 0 and seen[0, -1, 1] > 0.97
    mid_gray = aces.develop(np.full((1, 1, 3), 0.18))[0, 0]
    assert mid_gray == pytest.approx([0.35] * 3, abs=0.03)  # ACES 2.0: 10 of 100 nits


def test_the_view_without_a_tone_map_is_srgb() -> None:
    look = Look("cg-config-latest", "Un-tone-mapped", "sRGB - Display")
    seen = look.develop(np.array([[[0.214, 1.0, 0.0]]]))
    assert seen[0, 0] == pytest.approx([0.5, 1, 0], abs=2e-3)


def test_pictures_of_a_shot_are_developed_by_the_look(tmp_path: Path, aces: Look) -> None:
    run = fake_run(tmp_path)
    output = Output(exr="float", ev=-1.0, ocio="studio-config-latest", view=ACES)
    render_shot(run, large_shot(), tmp_path, output)
    radiance = read_exr(tmp_path / "some/00000.exr")["RGB"]
    neutral = run.tonemapper.neutral(0).detach().numpy()
    expected = aces.develop(0.5 * radiance * neutral)
    assert np.allclose(read_image(tmp_path / "some/00000.png"), expected, atol=0.003)


@pytest.mark.parametrize(
    ("config", "view", "display", "message"),
    [
        ("nonsense", None, None, "--ocio nonsense: no configuration"),
        ("missing.ocio", None, None, "--ocio missing.ocio: no configuration"),
        (
            "cg-config-latest",
            "Nice",
            None,
            "--view 'Nice': not in this configuration; it has 'ACES",
        ),
        ("cg-config-latest", None, "TV", "--display 'TV': not in this configuration"),
    ],
)
def test_what_a_configuration_does_not_have_is_refused(
    config: str, view: str | None, display: str | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Look(config, view, display)
