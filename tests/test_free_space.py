"""Static Gaussians before the toy's wall are fog; those on it and behind it are not."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from test_initialize_gaussians import seeded
from torch import Tensor
from toy_scene import WALL

from hdr_nsff.fields.splat.free_space import find_fog, remove_fog
from hdr_nsff.fields.splat.gaussians import START_LOGIT
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Frame, Scene

SOME = torch.arange(0, 200, 10)  # static Gaussians that are moved towards the camera


@pytest.fixture
def field(toy: Scene) -> Splat:
    return seeded(toy)[0]


def pull(field: Splat, which: Tensor, share: float) -> None:
    """Put Gaussians at a share of their distance from the origin."""
    field.static.means.data[which] *= share


def test_a_start_on_the_wall_has_no_fog(field: Splat, toy: Scene) -> None:
    assert not len(find_fog(field, toy.train))


def test_gaussians_before_the_wall_are_fog_and_no_others(field: Splat, toy: Scene) -> None:
    pull(field, SOME, 0.6)
    fog = find_fog(field, toy.train)
    assert set(fog.tolist()) <= set(SOME.tolist())
    assert len(fog) > 0.6 * len(SOME)  # a card hides some of them


@pytest.mark.parametrize("share", [0.9, 1.5])
def test_gaussians_within_the_margin_or_behind_stay(field: Splat, toy: Scene, share: float) -> None:
    pull(field, SOME, share)
    assert not len(find_fog(field, toy.train))


def test_fog_that_fog_hides_is_found_in_the_next_round(field: Splat, toy: Scene) -> None:
    wide = torch.tensor([0, 1, 2])
    depths = torch.tensor([0.4, 0.41, 0.6]) * WALL
    field.static.means.data[wide] = torch.stack([0 * depths, 0 * depths, depths], 1)
    field.static.log_scales.data[wide] = torch.tensor([[1.0], [1.0], [-2.0]])
    field.static.opacity_logits.data[wide] = 20.0
    assert find_fog(field, toy.train).tolist() == [0, 1]
    assert len(remove_fog(field, toy.train)) >= 3
    assert (field.static.opacity_logits[wide] == START_LOGIT).all()


@pytest.mark.parametrize(
    "change",
    [
        lambda f: replace(f, disparity=None),
        lambda f: replace(f, disparity_confidence=torch.zeros_like(f.disparity)),
        lambda f: replace(f, moving=torch.ones_like(f.moving)),
    ],
)
def test_what_knows_no_static_surface_has_no_vote(
    field: Splat, toy: Scene, change: Callable[[Frame], Frame]
) -> None:
    pull(field, SOME, 0.6)
    assert not len(find_fog(field, [change(f) for f in toy.train]))
