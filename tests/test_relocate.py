"""Unseen Gaussians are relocated to where the picture is wrong; no others change."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from presets import small, trainer
from test_splat import CAMERA, card_field, scattered

from hdr_nsff.fields.base import FrameError
from hdr_nsff.fields.splat.rasterize import dense
from hdr_nsff.fields.splat.relocate import (
    HALF_OFFSET,
    HALF_SCALE,
    MAX_RELOCATED_SHARE,
    error_scores,
    relocate,
    relocate_unseen,
)
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.measure import spread_frames


def frame_error(
    error: torch.Tensor | None = None, time: float = 3.0, camera: Camera = CAMERA
) -> FrameError:
    """An error (H, W) of a frame, 1 everywhere by default."""
    wrong = torch.ones(camera.height, camera.width) if error is None else error
    return FrameError(camera, time, lambda radiance: wrong.flatten())


def corner() -> torch.Tensor:
    """An error in the picture's upper left quarter alone."""
    error = torch.zeros(CAMERA.height, CAMERA.width)
    error[: CAMERA.height // 2, : CAMERA.width // 2] = 1
    return error


def test_scores_are_the_weights_of_the_slow_twin_times_the_error() -> None:
    field = scattered()
    generator = torch.Generator().manual_seed(1)
    error = torch.rand(CAMERA.height, CAMERA.width, generator=generator)
    cloud = field.cloud(field.knot(3.0))
    parts = (cloud.means, cloud.quaternions, cloud.scales, cloud.opacities)
    one_hot = torch.eye(len(cloud.means))
    weights = dense(*(p.detach() for p in parts), one_hot, CAMERA).features  # (H, W, G)
    times_error, alone = error_scores(field.model(), frame_error(error))[0].unbind(1)
    expected = (weights * error[..., None]).sum((0, 1))
    torch.testing.assert_close(times_error, expected, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(alone, weights.sum((0, 1)), atol=1e-3, rtol=1e-3)


def in_corner(field: Splat) -> int:
    """Static Gaussians in and around the picture's upper left quarter."""
    pixels, _ = CAMERA.project(field.static.means.detach())
    low = torch.tensor([-2.0, -2.0])
    high = torch.tensor([CAMERA.width / 2 + 2, CAMERA.height / 2 + 2])
    return int(((pixels > low) & (pixels < high)).all(1).sum())


def test_unseen_gaussians_move_to_where_the_error_is() -> None:
    field = card_field()
    field.static.opacity_logits.data[::20] = -10.0  # faded away; others lie outside the picture
    before = in_corner(field)
    count = relocate_unseen(
        field.model(), [frame_error(corner())], torch.Generator().manual_seed(0)
    )
    assert count == int(MAX_RELOCATED_SHARE * len(field.static))  # more are unseen
    # some that were relocated had faded in that very quarter
    assert before + 0.6 * count < in_corner(field) <= before + count


def test_floaters_that_no_view_sees_are_relocated() -> None:
    field = card_field()
    field.static.means.data[:5] = torch.tensor([0.0, 0.0, -3.0])  # behind every camera
    relocate_unseen(field.model(), [frame_error()], torch.Generator().manual_seed(0))
    assert bool((field.static.means[:5, 2] > 3).all())


def test_a_gaussian_seen_in_any_frame_stays() -> None:
    field = card_field()
    away = CAMERA.moved(torch.tensor([[1.0, 0, 0, 50], [0, 1, 0, 0], [0, 0, 1, 0]]))  # sees nothing
    before = {n: p.detach().clone() for n, p in field.named_parameters()}
    errors = [frame_error(), frame_error(camera=away)]
    relocate_unseen(field.model(), errors, torch.Generator().manual_seed(0))
    seen = error_scores(field.model(), frame_error())[0][: len(field.static), 1] > 1
    assert int(seen.sum()) > 200
    kept = (field.static.means == before["static.means"]).all(1)
    limit = 2 * MAX_RELOCATED_SHARE * len(field.static)  # the halves and what they were cut from
    assert int((~kept & seen).sum()) <= limit


def test_a_half_lies_beside_the_other_and_is_narrower() -> None:
    field = scattered()
    g, scores = field.moving, torch.zeros(30, 2)
    scores[:, 1] = 1.0
    scores[7, 1] = 0.0  # only the eighth is unseen
    scores[4, 0] = 3.0  # only the fifth has an error
    g.quaternions.data[4] = torch.tensor([1.0, 0, 0, 0])
    g.log_scales.data[4] = torch.tensor([-2.0, -1.0, -3.0])
    mean, mixture = g.means[4].detach().clone(), field.mixture_logits[:, 4].clone()
    opacity_offsets = field.opacity_offsets[:, 4].clone()
    others = g.means.detach()[[0, 1, 2, 3, 5, 6, 8, 9]].clone()
    companions = [field.opacity_offsets, field.mixture_logits]
    assert relocate(g, scores, companions, torch.Generator().manual_seed(0)) == 1
    along = torch.tensor([0.0, HALF_OFFSET * math.exp(-1.0), 0.0])
    torch.testing.assert_close(g.means[4].detach(), mean - along)
    torch.testing.assert_close(g.means[7].detach(), mean + along)
    log_scales = torch.tensor([-2.0, -1.0 + math.log(HALF_SCALE), -3.0])
    for i in (4, 7):
        torch.testing.assert_close(g.log_scales[i].detach(), log_scales)
        torch.testing.assert_close(field.mixture_logits[:, i], mixture)
        torch.testing.assert_close(field.opacity_offsets[:, i], opacity_offsets)
    torch.testing.assert_close(g.means.detach()[[0, 1, 2, 3, 5, 6, 8, 9]], others)


def test_a_turned_gaussian_is_cut_across_its_own_longest_axis() -> None:
    g, scores = scattered().static, torch.tensor([[0.0, 1.0]] * 40)
    scores[4, 0], scores[7, 1] = 3.0, 0.0
    g.quaternions.data[4] = torch.tensor([math.cos(0.25), 0, 0, math.sin(0.25)])
    g.log_scales.data[4] = torch.tensor([-2.0, -1.0, -3.0])  # along y, turned by 0.5 about z
    mean = g.means[4].detach().clone()
    assert relocate(g, scores, [], torch.Generator().manual_seed(0)) == 1
    length = HALF_OFFSET * math.exp(-1.0)
    along = length * torch.tensor([-math.sin(0.5), math.cos(0.5), 0.0])
    torch.testing.assert_close(g.means[[4, 7]].detach(), torch.stack([mean - along, mean + along]))


def test_without_error_nothing_moves() -> None:
    field = scattered()
    before = [p.detach().clone() for p in field.parameters()]
    no_error = frame_error(torch.zeros(CAMERA.height, CAMERA.width))
    assert relocate_unseen(field.model(), [no_error], torch.Generator().manual_seed(0)) == 0
    assert all(torch.equal(a, b) for a, b in zip(before, field.parameters(), strict=True))


@pytest.mark.parametrize("view_dependence", [False, True])
def test_training_relocates_until_late_in_the_run(
    toy: Scene, toy_folder: Path, tmp_path: Path, view_dependence: bool
) -> None:
    config = small("splat", toy_folder, tmp_path / "run", steps=10)
    config = replace(
        config, field=replace(config.field, relocate_every=1, view_dependence=view_dependence)
    )
    t = trainer(config, toy)
    assert isinstance(t.field, Splat)
    t.field.static.means.data[:40] = torch.tensor([0.0, 0.0, -50.0])  # floaters
    behind = []
    for _ in range(10):
        t.field.static.means.data[40:50] = torch.tensor([0.0, 0.0, -50.0])
        t.step()
        behind.append(int((t.field.static.means[:50, 2] < 0).sum()))
        t.clock = replace(t.clock, step=t.clock.step + 1)
    assert behind[3] < 40  # at most 20 of 400 find a place at a time
    assert behind[-1] >= 10 and behind[-2] >= 10  # from 80 % on nothing is relocated


@pytest.mark.parametrize("num_frames", [1, 2, 11, 23, 24, 60])
def test_errors_are_taken_of_all_frames_in_turn(num_frames: int) -> None:
    chosen = [spread_frames(24, num_frames, step) for step in range(0, 4000, 200)]
    assert {len(positions) for positions in chosen} == {min(24, num_frames)}
    assert {p for positions in chosen for p in positions} == set(range(num_frames))


def test_frame_errors_are_the_recorded_differences(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    t = trainer(small("splat", toy_folder, tmp_path / "run"), toy)
    found = t.frame_errors(len(toy.train))
    assert [x.time for x in found] == [f.time for f in toy.train]
    f = toy.train[2]
    radiance = t.field.render(f.camera, f.time).radiance
    shaded = t.tonemapper.shade(radiance, f.camera, f.camera_id)
    rgb = t.tonemapper(shaded, f.bracket, f.camera_id, 2, leaky=False)
    expected = (rgb.detach().view_as(f.image) - f.image).abs().mean(-1)
    torch.testing.assert_close(found[2].error(radiance).view_as(expected), expected)
    assert len({x.time for x in t.frame_errors(3)}) == 3
