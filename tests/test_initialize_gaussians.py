"""Gaussians before training, on the scene in closed form: static ones on its wall,
moving ones on its card at every time.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from estimates import with_movers
from scipy.spatial.transform import Rotation
from torch import Tensor
from toy_scene import CARD, EV, WALL, ToyScene, card_offset

from hdr_nsff.fields.point_cloud import PointCloud
from hdr_nsff.fields.splat.cloud import opacities_at
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.gaussians import Gaussians
from hdr_nsff.fields.splat.initialize_gaussians import (
    initialize_gaussians,
    neighbor_distance,
    place,
    quaternions,
    share_bases,
    spread_centers,
    surely_moving,
)
from hdr_nsff.fields.splat.rasterize import rotation_matrices
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.fields.splat.terms import MIN_OPACITY
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.scene import Frame, Scene, outline

pytestmark = pytest.mark.filterwarnings("error")

CONFIG = SplatConfig(static=400, moving=150, bases=3)


def recorded(rgb: Tensor, frame: int, pixels: Tensor | None = None) -> Tensor:
    """Radiance of what the toy's frames recorded: their exposures repeat, their
    response is a gamma of 2.2.
    """
    return rgb**2.2 / 2.0 ** EV[frame % len(EV)]


def seeded(
    scene: Scene, config: SplatConfig = CONFIG, from_priors: bool = True
) -> tuple[Splat, str]:
    """A field started from a scene, none of whose numbers is NaN; and what was said."""
    field = Splat(config, scene.times, scene.near, scene.far, 60 * 34)
    note = initialize_gaussians(field, scene, recorded, -1.0, from_priors)
    assert all(torch.isfinite(v).all() for v in field.state_dict().values())
    assert all(torch.isfinite(field.positions(k)).all() for k in (0.0, 0.5, len(scene.times) - 1.0))
    return field, note


def changed(scene: Scene, change: Callable[[Frame], Frame], frames: int = 6) -> Scene:
    """The scene with its first frames changed, and the movers that these show."""
    train = [change(f) for f in scene.train[:frames]]
    scene = replace(scene, train=train)
    return scene if any(f.disparity is None for f in train) else with_movers(scene)


def seen(gaussians: Gaussians) -> Tensor:
    """(G,) bool: which of them draw anything."""
    return gaussians.opacity_logits.detach().sigmoid() > MIN_OPACITY


def moving_at(field: Splat, time: float) -> Tensor:
    """Where the moving Gaussians that draw anything are at a time: (G, 3)."""
    with torch.no_grad():
        return field.positions(field.knot(time))[len(field.static) :][seen(field.moving)]


@pytest.fixture(scope="module")
def field(toy: Scene) -> Splat:
    return seeded(toy)[0]


def test_static_gaussians_lie_on_the_wall(field: Splat) -> None:
    on = seen(field.static)
    assert 0.6 * 400 < int(on.sum()) <= 0.95 * 400
    assert (
        float((field.static.means.detach()[on, 2] - WALL).abs().max()) < 0.01
    )  # half-precision disparity


def test_places_of_fog_are_used_for_surfaces(toy: Scene) -> None:
    def pull_first(frame: Frame) -> Frame:
        """The first frame's wall half as far away as it is."""
        assert frame.disparity is not None
        return replace(frame, disparity=frame.disparity * (2.0 if frame.time == 0 else 1.0))

    field, _ = seeded(replace(toy, train=[pull_first(f) for f in toy.train]))
    on = seen(field.static)
    assert int(on.sum()) > 0.85 * 400
    assert float((field.static.means.detach()[on, 2] - WALL).abs().median()) < 0.01


def test_static_gaussians_have_the_walls_radiance(toy: Scene) -> None:
    field, _ = seeded(toy, replace(CONFIG, static=3000))
    at = field.static.means[seen(field.static)].detach()
    truth = ToyScene()
    radiance, mask, _ = truth.see(2.0)
    xy = toy.train[2].camera.project(at)[0].long()
    inside = (xy[:, 0] >= 0) & (xy[:, 0] < 60) & (xy[:, 1] >= 0) & (xy[:, 1] < 34)
    x, y = xy[inside].T.numpy()
    log = field.static.log_radiance.detach()[seen(field.static)][inside][
        ~torch.from_numpy(mask[y, x])
    ]
    true = torch.from_numpy(np.log(radiance[y, x]))[~torch.from_numpy(mask[y, x])]
    assert float(true.std()) > 0.5 and float((log - true).abs().median()) < 0.2


@pytest.mark.parametrize("time", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
def test_moving_gaussians_follow_the_card(field: Splat, time: float) -> None:
    at = moving_at(field, time)
    assert len(at) > 50 and float((at[:, 2] - CARD).abs().max()) < 0.05
    assert at[:, :2].mean(0).numpy() == pytest.approx(
        card_offset(time), abs=0.05
    )  # the card is 0.7 x 0.6
    corner = (at[:, :2] - torch.from_numpy(card_offset(time)).float()).abs().amax(0)
    assert (
        0.2 < float(corner[0]) < 0.42 and 0.15 < float(corner[1]) < 0.37
    )  # its outline is left out


def test_the_rest_is_invisible_and_the_background_typical(field: Splat) -> None:
    assert float(field.background.detach().unique()) == -1.0
    assert int((~seen(field.static)).sum()) >= 0.05 * 400


def test_the_start_is_reported_in_a_sentence_and_reproducible(field: Splat, toy: Scene) -> None:
    again, note = seeded(toy)
    still, moving = int(seen(field.static).sum()), int(seen(field.moving).sum())
    assert note == (
        f"{still} static Gaussians from the depth prior; "
        f"{moving} moving ones on 1 rigid movers; 0 time-local ones"
    )
    assert all(torch.equal(v, field.state_dict()[k]) for k, v in again.state_dict().items())


@pytest.mark.parametrize("bases", [1, 2, 6])
def test_movers_are_never_more_than_bases(toy: Scene, bases: int) -> None:
    started, note = seeded(toy, replace(CONFIG, bases=bases))
    assert 1 <= int(note.split(" on ")[1].split()[0]) <= bases
    mixture = started.mixture_logits.detach()[:, : int(seen(started.moving).sum())].softmax(0)
    assert float(mixture.amax(0).min()) > 1 / bases - 1e-6  # each has one basis
    assert moving_at(started, 4.0)[:, :2].mean(0).numpy() == pytest.approx(
        card_offset(4.0), abs=0.05
    )


@pytest.mark.parametrize("none", [None, torch.zeros(34, 60, dtype=torch.bool)])
def test_without_movers_all_is_static(toy: Scene, none: Tensor | None) -> None:
    started, note = seeded(changed(toy, lambda f: replace(f, moving=none)))
    assert (
        note.endswith("0 moving ones on 0 rigid movers; 0 time-local ones")
        and not seen(started.moving).any()
    )
    assert (
        float(started.static.means.detach()[seen(started.static), 2].min()) < 2.6
    )  # the card as well


def test_where_everything_moves_no_gaussian_is_static(toy: Scene) -> None:
    every = torch.ones(34, 60, dtype=torch.bool)
    started, note = seeded(changed(toy, lambda f: replace(f, moving=every)))
    assert note.startswith("0 static Gaussians")
    assert not seen(started.static).any()
    assert seen(started.moving).any()


def test_movers_start_inside_a_doubtful_outline_but_thin_ones_stay_whole(toy: Scene) -> None:
    mask = torch.zeros(toy.train[0].image.shape[:2], dtype=torch.bool)
    mask[4:16, 4:16] = True
    mask[4:16, 25] = True  # a cord
    assert torch.equal(surely_moving(replace(toy.train[0], moving=mask, outline=None)), mask)
    sure = surely_moving(replace(toy.train[0], moving=mask, outline=outline(mask)))
    inner = sure[:, :20].nonzero()
    assert inner.amin(0).tolist() == [6, 6]
    assert inner.amax(0).tolist() == [13, 13]
    assert sure[:, 25].sum() == 12


def test_without_flow_movers_drift_with_their_middle(toy: Scene) -> None:
    started, note = seeded(changed(toy, lambda f: replace(f, flow={}, flow_valid={})))
    assert note.endswith("on 1 rigid movers; 0 time-local ones")
    for t in (1.0, 2.0, 3.0, 4.0):  # smoothing shortens the ends
        assert moving_at(started, t)[:, :2].mean(0).numpy() == pytest.approx(
            card_offset(t), abs=0.12
        )


def test_flow_without_valid_pixels_counts_as_no_flow(toy: Scene) -> None:
    doubted = {o: torch.zeros(34, 60, dtype=torch.bool) for o in (-1, 1)}
    one = seeded(changed(toy, lambda f: replace(f, flow_valid={o: doubted[o] for o in f.flow})))[0]
    none = seeded(changed(toy, lambda f: replace(f, flow={}, flow_valid={})))[0]
    assert torch.equal(one.moving.means, none.moving.means)
    assert torch.equal(one.trajectories.translations, none.trajectories.translations)


@pytest.mark.parametrize("given", [True, False])
def test_without_a_depth_prior_gaussians_are_scattered_in_view(toy: Scene, given: bool) -> None:
    scene = changed(toy, lambda f: replace(f, disparity=None)) if given else toy
    started, note = seeded(scene, from_priors=given)
    assert "random places" in note and "depth prior" in note
    at = started.static.means.detach()[seen(started.static)]
    assert len(at) >= 390 and not seen(started.moving).any()
    assert toy.near * 0.99 < float(at[:, 2].min()) < 2.2
    assert 4 < float(at[:, 2].max()) < toy.far * 1.01
    assert float(started.static.log_radiance.detach()[seen(started.static)].unique()) == -1.0


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_few_training_frames(toy: Scene, frames: int) -> None:
    started, note = seeded(changed(toy, lambda f: f, frames))
    assert started.trajectories.num_knots == frames and " 0 rigid movers" not in note
    assert moving_at(started, 0.0)[:, :2].mean(0).numpy() == pytest.approx(
        card_offset(0.0), abs=0.05
    )


def test_two_exposures(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "toy_scene.EV", [1.0, 0.0, 1.0]
    )  # frames alternate, but for two long ones on end
    monkeypatch.setitem(globals(), "EV", [1.0, 0.0, 1.0])
    started, _ = seeded(Scene.open(ToyScene().write(tmp_path)))
    assert moving_at(started, 3.0)[:, :2].mean(0).numpy() == pytest.approx(
        card_offset(3.0), abs=0.05
    )


def test_a_single_moving_pixel(toy: Scene) -> None:
    lone = torch.zeros(34, 60, dtype=torch.bool)
    lone[17, 30] = True
    started, _ = seeded(
        changed(toy, lambda f: replace(f, moving=lone if f.time == 2 else ~lone & lone))
    )
    assert int(seen(started.moving).sum()) == 1


def test_frozen_footage(toy: Scene) -> None:
    first = toy.train[0]
    same = {o: torch.zeros(34, 60, 2) for o in (-1, 1)}
    scene = changed(
        toy,
        lambda f: replace(
            first,
            time=f.time,
            neighbors=f.neighbors,
            flow=same,
            flow_valid={o: ~first.moving | True for o in same},
        ),
    )
    started, _ = seeded(scene)
    torch.testing.assert_close(moving_at(started, 0.0), moving_at(started, 5.0), atol=1e-4, rtol=0)


def test_movers_are_hidden_at_times_without_observations(toy: Scene) -> None:
    hidden = torch.zeros(34, 60, dtype=torch.bool)
    started, _ = seeded(changed(toy, lambda f: replace(f, moving=hidden) if f.time < 3 else f))
    share = [
        float(opacities_at(started.model(), t / 5).detach()[len(started.static) :].max())
        for t in (0.0, 1.0, 2.0, 3.0, 5.0)
    ]
    assert max(share[:3]) < 0.01 and share[3:] == pytest.approx([0.7, 0.7])


# Parts


def test_a_gaussian_is_as_wide_as_its_neighbors_are_away() -> None:
    grid = torch.tensor([[x, y, 0.0] for x in range(6) for y in range(6)])
    gaussians = Gaussians(40, 1, 1)
    with torch.no_grad():
        assert (
            place(gaussians, PointCloud(grid, torch.zeros(36, 3), torch.ones(36), torch.ones(36)))
            == 36
        )
    inner = (grid[:, :2] > 0).all(1) & (grid[:, :2] < 5).all(1)
    torch.testing.assert_close(gaussians.log_scales[:36][inner].exp(), torch.full((16, 3), 0.6))
    assert int(seen(gaussians).sum()) == 36


@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_few_points_are_placed_with_finite_sizes(count: int) -> None:
    gaussians = Gaussians(10, 1, 1)
    at = torch.zeros(count, 3)  # all in one place
    with torch.no_grad():
        assert (
            place(
                gaussians,
                PointCloud(at, torch.zeros(count, 3), torch.ones(count), torch.ones(count)),
            )
            == count
        )
    assert torch.isfinite(gaussians.log_scales).all() and int(seen(gaussians).sum()) == count
    assert len(neighbor_distance(at.numpy())) == count


@pytest.mark.parametrize("count", [1, 2, 4])
def test_bases_spread_over_separate_heaps(count: int) -> None:
    heaps = torch.tensor([[0.0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]])
    points = heaps[:count].repeat_interleave(20, 0) + 0.1 * torch.randn(
        20 * count, 3, generator=torch.Generator().manual_seed(0)
    )
    places = spread_centers(points, count, torch.zeros(3))
    assert float(torch.cdist(places, heaps[:count]).amin(0).max()) < 0.2


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.ones(2, 3), torch.ones(9, 3)])
def test_bases_of_hardly_any_points_are_finite(points: Tensor) -> None:
    places = spread_centers(points, 4, torch.tensor([1.0, 2, 3]))
    assert places.shape == (4, 3) and torch.isfinite(places).all()


def test_shared_motions_move_and_turn_as_their_mover_does() -> None:
    rng, count = np.random.default_rng(0), 6
    places = torch.from_numpy(rng.random((20, 3))).float()
    turns = Rotation.from_rotvec(np.outer(0.3 * np.arange(count), [0.3, 1.0, -0.5])).as_matrix()
    mover = Mover(
        frames=np.arange(count),
        pixels=np.zeros((0, count, 2)),
        trust=np.zeros((0, count)),
        points=np.zeros((0, 3)),
        rotations=turns,
        translations=rng.normal(size=(count, 3)),
        center=np.array([0.2, 0.5, 2.0]),
        known=np.ones(count, bool),
        error=0.1,
    )
    field = Splat(SplatConfig(static=0, moving=20, bases=3), torch.arange(count), 1.0, 6.0, 1200)
    with torch.no_grad():
        field.moving.means[:] = places
        share_bases(field, [mover], places, torch.zeros(20, dtype=torch.long))
        for t in range(count):
            cloud = field.cloud(float(t))
            expected = torch.from_numpy(mover.world(places.double().numpy(), t)).float()
            torch.testing.assert_close(cloud.means, expected, atol=1e-4, rtol=1e-4)
            turned = rotation_matrices(cloud.quaternions)
            torch.testing.assert_close(turned, torch.from_numpy(turns[t]).float().expand(20, 3, 3))


def test_quaternions_do_not_jump() -> None:
    angles = torch.linspace(0, 12, 100)  # nearly twice around
    c, s, o, i = angles.cos(), angles.sin(), 0 * angles, 0 * angles + 1
    q = quaternions(torch.stack([c, -s, o, s, c, o, o, o, i], -1).view(-1, 3, 3))
    assert float((q[1:] * q[:-1]).sum(-1).min()) > 0.99
