"""Time-local Gaussians before training, on the toy's card as if it were not rigid."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from estimates import with_movers
from test_initialize_gaussians import recorded
from toy_scene import CARD, card_offset

from hdr_nsff.fields.build import build_field
from hdr_nsff.fields.point_cloud import PointCloud
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.initialize_gaussians import initialize_gaussians, mover_points
from hdr_nsff.fields.splat.initialize_local import (
    MAX_APPROACH,
    bound_approach,
    count_local_pixels,
    gap_beside,
    local_mask,
    place_local,
    start_duration,
    start_durations,
    velocities_around,
)
from hdr_nsff.fields.splat.local_gaussians import MAX_AGE
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.scene.scene import Frame, Scene, surely_moving


@pytest.fixture(scope="module")
def soft(toy: Scene) -> Scene:
    """The toy's first frames, with a mover that is not rigid."""
    scene = with_movers(replace(toy, train=toy.train[:6]))
    return replace(scene, movers=tuple(replace(m, rigid=False) for m in scene.movers))


@pytest.fixture(scope="module")
def field(soft: Scene) -> Splat:
    config = SplatConfig(static=400, moving=150, local=600, bases=3)
    field = Splat(config, soft.times, soft.near, soft.far, 60 * 34)
    initialize_gaussians(field, soft, recorded, -1.0)
    return field


def test_a_soft_mover_gets_local_gaussians_and_no_rigid_ones(field: Splat) -> None:
    assert bool((field.local.colors.detach()[:, 3] > 0).any())
    assert float(field.moving.opacity_logits.detach().max()) < -9


@pytest.mark.parametrize("time", range(6))
def test_those_of_a_frame_lie_on_the_card_at_its_time(field: Splat, time: int) -> None:
    local = field.local
    own = (local.means.detach()[:, 3] == time) & (local.colors.detach()[:, 3] > 0)
    places = local.means.detach()[own, :3]
    assert len(places) > 40 and float((places[:, 2] - CARD).abs().max()) < 0.05
    middle = torch.from_numpy(card_offset(float(time))).float()
    torch.testing.assert_close(places[:, :2].mean(0), middle, atol=0.05, rtol=0)


def test_velocities_are_those_of_the_card(field: Splat) -> None:
    local = field.local
    for time in (1, 3):
        own = (local.means.detach()[:, 3] == time) & (local.colors.detach()[:, 3] > 0)
        step = torch.from_numpy(card_offset(time + 1.0) - card_offset(time - 1.0)).float() / 2
        median = local.velocities.detach()[own, :2].median(0).values
        torch.testing.assert_close(median, step, atol=0.01, rtol=0.1)


def colors_at_time_2(scene: Scene) -> torch.Tensor:
    """Log radiance (P, 3) of the Gaussians born at time 2."""
    field = Splat(SplatConfig(static=400, moving=0, local=600), scene.times, 1.0, 6.0, 60 * 34)
    with torch.no_grad():
        place_local(field.local, scene, recorded, scene.near)
        own = (field.local.means[:, 3] == 2) & (field.local.colors[:, 3] > 0)
        return field.local.colors[own, :3]


def test_clipped_pixels_take_their_color_from_another_exposure(soft: Scene) -> None:
    def white(without_flow: bool) -> Scene:
        frame = replace(soft.train[2], image=torch.ones_like(soft.train[2].image))
        if without_flow:
            frame = replace(frame, flow={}, flow_valid={})
        return replace(soft, train=[*soft.train[:2], frame, *soft.train[3:]])

    truth = colors_at_time_2(soft)
    by_flow, alone = (colors_at_time_2(white(without)) for without in (False, True))
    errors = [float((found - truth).abs().mean()) for found in (by_flow, alone)]
    assert errors[0] < 0.4 * errors[1] and errors[1] > 0.5


def test_the_count_follows_the_pixels_of_soft_movers(toy: Scene, soft: Scene) -> None:
    pixels = count_local_pixels(soft)
    assert pixels == sum(int(surely_moving(f).sum()) for f in soft.train)
    rigid = replace(soft, movers=tuple(replace(m, rigid=True) for m in soft.movers))
    assert count_local_pixels(rigid) == 0 and not local_mask(rigid, 0).any()
    without = replace(soft, movers=())
    assert count_local_pixels(without) == pixels  # all that moves is taken for soft
    config = SplatConfig()
    assert config.counts(10_000, 1_000, 20)[2] == 500
    assert config.counts(10_000, 100_000, 20)[2] == 6_000
    assert config.counts(640 * 360, 10**9, 50)[2] == 345_600
    assert config.counts(640 * 360, 10**9, 200)[2] == 400_000
    assert config.counts(1280 * 720, 10**9, 50)[2] == 400_000


def test_two_movers_share_the_mask_by_their_tracks(soft: Scene) -> None:
    (mover,) = soft.movers
    west = replace(mover, pixels=mover.pixels - np.array([1000.0, 0.0]), rigid=True)
    assert torch.equal(local_mask(replace(soft, movers=(mover, west)), 2), local_mask(soft, 2))
    east = replace(mover, pixels=mover.pixels + np.array([1000.0, 0.0]))
    near = replace(mover, rigid=True)
    assert not local_mask(replace(soft, movers=(east, near)), 2).any()


def test_points_of_rigid_movers_are_counted_among_these(soft: Scene) -> None:
    (mover,) = soft.movers
    east = replace(mover, pixels=mover.pixels + np.array([1000.0, 0.0]))
    near = replace(mover, rigid=True)
    scene = replace(soft, movers=(east, near))
    points, owner = mover_points(scene, 2, 2, [near], recorded)
    assert len(points.positions) == len(owner) > 40 and (owner == 0).all()


def test_what_moves_beyond_a_rigid_mover_is_local(soft: Scene) -> None:
    (mover,) = soft.movers
    card = replace(mover, rigid=True)
    frame = soft.train[2]
    assert frame.moving is not None
    moving = frame.moving.clone()
    moving[:3, :3] = True  # far from the card
    scene = replace(soft, movers=(card,), train=[*soft.train])
    scene.train[2] = replace(frame, moving=moving)
    shadow = torch.zeros_like(moving)
    shadow[:3, :3] = True
    assert torch.equal(local_mask(scene, 2), surely_moving(scene.train[2]) & shadow)
    assert local_mask(scene, 2).any()


def test_rigid_movers_beyond_the_bases_become_time_local(soft: Scene) -> None:
    (mover,) = soft.movers
    card = replace(mover, rigid=True)
    elsewhere = replace(card, pixels=card.pixels + np.array([1000.0, 0.0]))
    scene = replace(soft, movers=(elsewhere, card))
    for bases, text in ((1, " 0 moving ones on 1 of 2 rigid movers"), (2, " on 2 rigid movers")):
        field = build_field(SplatConfig(static=400, moving=100, bases=bases), scene)
        note = initialize_gaussians(field, scene, recorded, -1.0)
        assert text in note and note.endswith("; 0 time-local ones") == (bases == 2)
        assert bool((field.local.colors.detach()[:, 3] > 0).any()) == (bases == 1)


def test_velocities_need_no_believed_flow(soft: Scene) -> None:
    def doubted(frame: Frame) -> Frame:
        nothing = {k: torch.zeros_like(v) for k, v in frame.flow_valid.items()}
        return replace(frame, flow_valid=nothing)

    scene = replace(soft, train=[doubted(frame) for frame in soft.train])
    field = Splat(SplatConfig(static=400, moving=0, local=600), scene.times, 1.0, 6.0, 60 * 34)
    with torch.no_grad():
        place_local(field.local, scene, recorded, scene.near)
    test_velocities_are_those_of_the_card(field)


def test_velocities_are_per_frame_also_where_frames_are_missing(soft: Scene) -> None:
    """Every second frame is held out: the card takes two frames for a step."""
    scene = replace(soft, train=[replace(f, time=2 * f.time) for f in soft.train])
    local = Splat(SplatConfig(static=400, moving=0, local=600), scene.times, 1.0, 6.0, 2040).local
    with torch.no_grad():
        place_local(local, scene, recorded, scene.near)
        own = (local.means[:, 3] == 6) & (local.colors[:, 3] > 0)
        median = local.velocities[own, :2].median(0).values
    step = torch.from_numpy(card_offset(4.0) - card_offset(2.0)).float() / 2
    torch.testing.assert_close(median, step / 2, atol=0.005, rtol=0.1)


def test_fast_lives_are_short_but_bridge_a_missing_frame(soft: Scene) -> None:
    f = soft.train[2]
    on_axis = f.camera.c2w[:, 3] + 2 * f.camera.c2w[:, 2]
    points = PointCloud(
        on_axis.repeat(4, 1), torch.zeros(4, 3), torch.ones(4), torch.full((4,), 0.01)
    )
    width = 0.01 * f.camera.width  # of the picture there, in scene units
    right, ahead = f.camera.c2w[:, 0], f.camera.c2w[:, 2]
    velocities = width * torch.stack([0 * right, right / 60, right, ahead])
    slow = start_duration(soft)
    found = start_durations(soft, f, points, velocities)
    torch.testing.assert_close(found, torch.tensor([slow, 60 * 0.023, 0.8, slow]))
    missing = replace(soft, train=[g for g in soft.train if g.time != 3])
    assert (gap_beside(soft, f), gap_beside(missing, f)) == (1, 2)
    assert float(start_durations(missing, f, points, velocities)[2]) == pytest.approx(1.6)


def test_nothing_comes_right_before_the_lens_while_it_is_alive(soft: Scene) -> None:
    f = soft.train[2]
    position, right, ahead = (f.camera.c2w[:, k] for k in (3, 0, 2))
    places = position + 2 * ahead.expand(4, 3)
    points = PointCloud(places, torch.zeros(4, 3), torch.ones(4), torch.full((4,), 0.01))
    slow, wild = 0.1 * ahead, right - 3 * ahead
    given = torch.stack([slow, wild, right, 3 * ahead])
    found = bound_approach(f, points, given, torch.full((4,), 1.5))
    most = MAX_APPROACH * 2 / (MAX_AGE * 1.5)  # a frame, of a distance of 2
    expected = torch.stack([slow, right - most * ahead, right, most * ahead])
    torch.testing.assert_close(found, expected)


def test_lives_last_a_cycle_of_exposures(soft: Scene) -> None:
    assert start_duration(soft) == pytest.approx(0.7 * soft.manifest.num_brackets)


def test_a_velocity_is_the_median_of_the_nearest_believed_ones() -> None:
    pixels = torch.arange(30.0)[:, None].expand(30, 2)
    velocities = torch.zeros(30, 3)
    velocities[:13, 0] = 1.0
    found = velocities_around(torch.tensor([[0.0, 0.0], [29.0, 29.0]]), pixels, velocities)
    assert found[:, 0].tolist() == [1.0, 0.0]
    assert float(velocities_around(torch.zeros(2, 2), pixels[:0], velocities[:0]).abs().max()) == 0


def test_fewer_gaussians_than_frames_are_spread_over_the_clip(soft: Scene) -> None:
    field = Splat(SplatConfig(static=400, moving=0, local=3), soft.times, 1.0, 6.0, 60 * 34)
    with torch.no_grad():
        assert place_local(field.local, soft, recorded, soft.near) == 3
    assert field.local.means.detach()[:, 3].tolist() == [0, 2, 5]
