"""Time-local Gaussians: short lives at constant velocity, of which only those alive are
drawn and updated.
"""

from dataclasses import replace

import pytest
import torch
from test_splat import BESIDE, CAMERA, TIMES, batch_of, tile_plane
from torch import Tensor

from hdr_nsff.fields.base import FrameError
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.local_gaussians import (
    MIN_WINDOW,
    LocalGaussians,
    TakeRows,
    least_duration,
)
from hdr_nsff.fields.splat.relocate import relocate_unseen
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.fields.splat.training_view import TrainingView, flow_to_neighbor
from hdr_nsff.training.optimizers import Optimizers

DURATION = 1.5  # frames
CENTERS = torch.tensor([2.0, 3.0, 8.0])
VELOCITY = torch.tensor([0.05, -0.02, 0.1])  # scene units a frame


def three() -> LocalGaussians:
    """Three lives around times 2, 3 and 8."""
    local = LocalGaussians(3)
    with torch.no_grad():
        local.means[:, :3] = torch.tensor([0.0, 0, 2.0])
        local.means[:, 3] = CENTERS
        local.velocities[:, :3] = VELOCITY
        local.log_scales[:, :3] = -2.0
        local.log_scales[:, 3] = torch.tensor(DURATION).log()
        local.colors[:, 3] = 0.0
    return local


def local_field(count: int = 20) -> Splat:
    """A wall, and time-local Gaussians before it that all move alike, born all over the
    clip.
    """
    config = SplatConfig(static=33 * 25, moving=0, local=count)
    field = Splat(config, torch.arange(TIMES), 1.0, 6.0, 1200)
    local = field.local
    with torch.no_grad():
        tile_plane(field.static, 33, 25, z=4.0, spacing=0.1)
        local.means[:, :3] = torch.tensor([0.0, 0, 2.0])
        local.means[:, 3] = torch.linspace(0, TIMES - 1, count)
        local.velocities[:, :3] = VELOCITY
        local.means[:, :3] += (local.means[:, 3:] - 4.5) * local.velocities[:, :3]
        local.log_scales[:, :3] = -2.0
        local.log_scales[:, 3] = 0.0
        local.colors[:, 3] = 3.0
    local.find_neighbors(1.0)
    return field


def test_alive_are_those_whose_window_is_open() -> None:
    local = three()
    assert local.alive(2.5).tolist() == [0, 1]
    assert local.alive(5.9).tolist() == [0, 1, 2]
    assert local.alive(7.5).tolist() == [2]
    reach = DURATION * (-2 * torch.tensor(MIN_WINDOW).log()).sqrt()  # 2.8 durations
    assert local.alive(8.0 + float(reach) - 1e-3).tolist() == [2]
    assert local.alive(8.0 + float(reach) + 1e-3).tolist() == []


@pytest.mark.parametrize("time", [1.0, 2.0, 3.75, 4.5])
def test_lives_move_straight_and_fade_around_their_center(time: float) -> None:
    local, alive = three(), torch.tensor([0, 1])
    ages = time - CENTERS[:2]
    expected = torch.tensor([0.0, 0, 2.0]) + ages[:, None] * VELOCITY
    torch.testing.assert_close(local.living(alive).positions(time).detach(), expected)
    opacities = 0.5 * torch.exp(-0.5 * (ages / DURATION) ** 2)
    torch.testing.assert_close(local.living(alive).opacities(time, 1.2).detach(), opacities)


def test_the_center_time_has_no_gradient_and_all_else_has() -> None:
    local, alive = three(), torch.tensor([0, 1])
    living = local.living(alive)
    drawn = [living.positions(4.0), living.opacities(4.0, 1.2), living.radiance()]
    sum(values.square().sum() for values in drawn).backward()  # type: ignore[union-attr]
    assert local.means.grad is not None and local.velocities.grad is not None
    assert float(local.means.grad[:, 3].abs().max()) == 0
    assert float(local.means.grad[:2, :3].abs().max()) > 0
    assert float(local.velocities.grad[:2, :3].abs().min()) > 0
    assert local.log_scales.grad is not None
    assert float(local.log_scales.grad[:2, 3].abs().min()) > 0


def test_unevenness_is_the_mean_square_difference_to_the_neighbors() -> None:
    local = three()
    local.neighbors[:] = torch.tensor([[1] * 4, [0] * 4, [0] * 4], dtype=torch.int32)
    everyone = torch.arange(3)
    assert float(local.unevenness(everyone, local.living(everyone), 2.0).detach()) == 0
    with torch.no_grad():
        local.velocities[1, 0] += 0.6
    first = torch.tensor([0])
    alone = local.unevenness(first, local.living(first), 2.0)
    assert float(alone.detach()) == pytest.approx(0.3**2 / 3)
    alone.backward()
    assert local.velocities.grad is not None
    assert local.velocities.grad[1].abs().max() == 0  # the neighbor counts as given


def test_neighbors_are_near_in_space_and_time() -> None:
    local = LocalGaussians(12)
    with torch.no_grad():
        local.means[:, 0] = torch.arange(12) % 6  # two rows of six, at times 0 and 1000
        local.means[6:, 3] = 1000.0
    local.find_neighbors(1.0)
    assert set(local.neighbors[2].tolist()) == {0, 1, 3, 4}
    assert all(n >= 6 for n in local.neighbors[9].tolist())


def test_a_step_moves_only_those_alive() -> None:
    field = local_field()
    optimizers = Optimizers(field.param_groups())
    before = {name: p.detach().clone() for name, p in field.local.named_parameters()}
    render, own = field(batch_of(4, 1, seed=1))
    (render.radiance.sum() + sum(own.values())).backward()
    alive = field.alive(4.0)
    assert 0 < len(alive) < len(field.local)
    optimizers.step(1.0, 0.0)
    for name, p in field.local.named_parameters():
        moved = (p.detach() != before[name]).any(1).nonzero()[:, 0]
        assert set(moved.tolist()) <= set(alive.tolist()), name
    assert bool((field.local.means.detach() != before["means"]).any())


def test_scene_flow_of_a_life_is_its_velocity_also_at_fractional_times() -> None:
    field = local_field()
    field.static.opacity_logits.data[:] = -20.0
    field.local.colors.data[:, 3] = 9.0
    for time in (3.0, 3.5, 0.0, 9.0):
        render = field.render(CAMERA, time)
        at = int(render.opacity.argmax())
        # 1/255: fainter Gaussians draw nothing, so what is drawn sums up to a bit less
        shown = render.scene_flow[1][at] / render.opacity[at]
        torch.testing.assert_close(shown, VELOCITY, atol=1e-3, rtol=0.02)
        back = render.scene_flow[-1][at] / render.opacity[at]
        torch.testing.assert_close(back, -VELOCITY, atol=1e-3, rtol=0.02)
        assert float(render.motion[at]) > 0.9


def test_optical_flow_follows_the_velocity() -> None:
    field = local_field()
    alive = field.alive(4.0)
    means = field.positions(4.0, alive)
    view = TrainingView(batch_of(4, 1), 4.0, alive, [1], rigidity=False)
    flow = flow_to_neighbor(field.model(), view, field.local.living(view.alive), means, 1).detach()
    life = -len(alive)  # the last ones are time-local
    moved = BESIDE.project(means[life:] + VELOCITY)[0] - CAMERA.project(means[life:])[0]
    torch.testing.assert_close(flow[life:], moved.detach(), atol=1e-3, rtol=1e-4)


def test_a_life_is_judged_by_the_frames_in_which_it_is_alive() -> None:
    field = local_field()
    unseen = 0  # far behind the camera
    field.local.means.data[unseen, 2] = -50.0

    def error(radiance: Tensor) -> Tensor:
        return torch.ones(len(radiance))

    frames = [FrameError(CAMERA, float(time), error) for time in range(10)]
    before = field.local.means.detach().clone()
    field.static.opacity_logits.data[:] = -20.0
    count = relocate_unseen(field.model(), frames, torch.Generator().manual_seed(0))
    assert count >= 1 and float(field.local.means.detach()[unseen, 2]) > 0
    kept = (field.local.means.detach() == before).all(1)
    assert int(kept.sum()) >= len(field.local) - 2 * count


def test_one_that_was_alive_in_no_judged_frame_stays() -> None:
    field = local_field()
    field.local.means.data[:, 2] = -50.0

    def error(radiance: Tensor) -> Tensor:
        return torch.ones(len(radiance))

    before = field.local.means.detach().clone()
    late = [FrameError(CAMERA, 9.0, error)]
    relocate_unseen(field.model(), late, torch.Generator().manual_seed(0))
    asleep = torch.ones(len(field.local), dtype=torch.bool)
    asleep[field.alive(9.0)] = False
    assert asleep.any()
    assert torch.equal(field.local.means.detach()[asleep], before[asleep])


def test_a_field_without_local_ones_is_as_before() -> None:
    field = local_field(count=0)
    batch = batch_of(4, 1, seed=1)
    _, own = field(replace(batch, flow={}))
    assert float(own["evenness"].detach()) == 0 and len(field.alive(3.0)) == 0


def test_gradients_of_rows_add_up_in_their_table() -> None:
    table = torch.nn.Parameter(torch.arange(12.0).view(3, 4))
    rows = torch.tensor([2, 0])
    for weight in (1.0, 10.0):
        taken = TakeRows.apply(table, rows)
        assert torch.equal(taken, table.detach()[rows])
        (weight * taken[:, 1] * torch.tensor([5.0, 7.0])).sum().backward()
    expected = torch.zeros(3, 4)
    expected[2, 1], expected[0, 1] = 55.0, 77.0
    assert table.grad is not None and torch.equal(table.grad, expected)


def test_a_life_shorter_than_a_step_does_not_learn_to_be_shorter() -> None:
    """Between frames nothing is supervised: lives that end before would leave holes."""
    local, alive = three(), torch.tensor([0, 1])

    def gradient(sign: float, least: float) -> torch.Tensor:
        local.log_scales.grad = None
        (sign * local.living(alive).opacities(4.0, least).sum()).backward()
        assert local.log_scales.grad is not None
        return local.log_scales.grad[:2, 3].clone()

    longer = gradient(-1.0, 0.5)  # more opacity away from the center: a longer life
    assert (longer < 0).all() and torch.equal(gradient(-1.0, 2.0), longer)
    assert torch.equal(gradient(1.0, 0.5), -longer)  # longer than the least of 0.5 frames
    assert not gradient(1.0, 2.0).any()  # shorter than the least of 2 frames


def test_the_least_life_follows_the_gaps_between_frames() -> None:
    assert least_duration(torch.tensor([0.0, 1, 2, 4])) == pytest.approx(1.2)
    assert least_duration(torch.tensor([0.0, 2, 4])) == pytest.approx(2.4)
    for count in range(6, 12):  # pairs of frames, the next two held out
        pairs = torch.tensor([4.0 * (k // 2) + k % 2 for k in range(count)])
        assert least_duration(pairs) == pytest.approx(3.6)
    assert least_duration(torch.tensor([3.0])) == pytest.approx(1.2)
