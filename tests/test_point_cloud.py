"""Colored points from depth: unprojection worked by hand, trust, and thinning."""

import math

import pytest
import torch
from torch import Tensor

from hdr_nsff.fields.point_cloud import (
    CELLS_PER_KIND,
    PointCloud,
    assign_cells,
    concatenate,
    exposure_trust,
    merge_by_cell,
    unproject_frame,
)
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Frame

CAMERA = Camera(
    torch.tensor([[10.0, 0, 2], [0, 10, 1], [0, 0, 1]]),
    torch.tensor([[1.0, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0]]),
    4,
    2,
)


def frame(
    disparity: Tensor, image: Tensor | None = None, confidence: Tensor | None = None
) -> Frame:
    """A frame of 4 x 2 pixels, gray unless given."""
    image = torch.full((2, 4, 3), 0.5) if image is None else image
    return Frame(0, 0.0, CAMERA, 0, 0, image, disparity=disparity, disparity_confidence=confidence)


def double(rgb: Tensor, frame: int, pixels: Tensor | None = None) -> Tensor:
    """The inverse of a recording: half the radiance in frame 0, a third in frame 1."""
    return rgb * (2 + frame)


def points(positions: Tensor, trust: Tensor | None = None) -> PointCloud:
    """Points whose log radiance and footprint are their first coordinate."""
    trust = torch.ones(len(positions)) if trust is None else trust
    return PointCloud(positions, positions[:, :1].expand(-1, 3), trust, positions[:, 0])


def random_positions(count: int, seed: int = 0) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


EVERY = torch.ones(8, dtype=torch.bool)


def test_a_pixel_is_unprojected_to_its_depth_on_its_ray() -> None:
    # column 3, row 1: center (3.5, 1.5), so x / z = 0.15 and y / z = 0.05
    chosen = torch.arange(8) == 7
    p = unproject_frame(frame(torch.full((2, 4), 0.25)), 0, chosen, 1.0, 100.0, double)
    torch.testing.assert_close(p.positions, torch.tensor([[5 + 0.15 * 4, 0.05 * 4, 4.0]]))
    torch.testing.assert_close(p.footprint, torch.tensor([4.0 / 10]))


def test_depth_is_held_between_near_and_far() -> None:
    disparity = torch.tensor([[0.0, 0.01, 0.25, 9.0], [0.0, 0.01, 0.25, 9.0]])
    p = unproject_frame(frame(disparity), 0, EVERY, 2.0, 50.0, double)
    assert p.positions[:4, 2].tolist() == pytest.approx([50, 50, 4, 2])


def test_radiance_is_recovered_frame_by_frame() -> None:
    f = frame(torch.ones(2, 4))
    for i, radiance in ((0, 1.0), (1, 1.5)):
        p = unproject_frame(f, i, EVERY, 0.5, 9.0, double)
        torch.testing.assert_close(p.log_radiance, torch.full((8, 3), math.log(radiance)))


def test_black_has_a_finite_log_radiance() -> None:
    f = frame(torch.ones(2, 4), torch.zeros(2, 4, 3))
    black = unproject_frame(f, 0, EVERY, 0.5, 9.0, double)
    torch.testing.assert_close(black.log_radiance, torch.full((8, 3), math.log(1e-5)))
    assert float(black.trust.min()) > 0


def test_confidence_is_part_of_trust() -> None:
    confidence = torch.tensor([[0.0, 0.5, 1.0, 1.0], [0.0, 0.5, 1.0, 1.0]])
    f = frame(torch.ones(2, 4), confidence=confidence)
    p = unproject_frame(f, 0, EVERY, 0.5, 9.0, double)
    # gray of 0.5 is well exposed
    torch.testing.assert_close(p.trust[:3], torch.tensor([0.02, 0.52, 1.02]) * 0.5)


@pytest.mark.parametrize(
    "rgb", [[0.98, 0.5, 0.5], [0.5, 0.5, 1.0], [0.005, 0.5, 0.5], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
)
def test_one_clipped_channel_takes_all_trust(rgb: list[float]) -> None:
    clipped, gray = exposure_trust(torch.tensor([rgb, [0.5, 0.5, 0.5]])).tolist()
    assert 0 < clipped < 0.01 * gray


def test_clipped_recordings_are_hardly_trusted() -> None:
    rgb = torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [0.0, 0.0, 0.0], [0.2, 0.2, 0.2]])
    torch.testing.assert_close(exposure_trust(rgb), torch.tensor([0.5, 1e-3, 1e-3, 0.2]))


def test_darks_are_trusted_less() -> None:
    trust = exposure_trust(torch.tensor([[0.02] * 3, [0.1] * 3, [0.3] * 3, [0.6] * 3]))
    assert trust.tolist() == sorted(trust.tolist())
    assert float(trust[3]) == pytest.approx(0.6)  # well exposed: only brightness counts


def test_thinning_takes_trust_weighted_means() -> None:
    # cell 7: positions 1 and 4 with trusts 3 and 1: (3 * 1 + 1 * 4) / 4 = 1.75
    p = points(torch.tensor([[1.0, 0, 0], [9.0, 2, 1], [4.0, 4, 8]]), torch.tensor([3.0, 0.5, 1.0]))
    kept = merge_by_cell(p, torch.tensor([7, 2, 7]))
    torch.testing.assert_close(kept.positions, torch.tensor([[9.0, 2, 1], [1.75, 1, 2]]))
    torch.testing.assert_close(kept.log_radiance, torch.tensor([[9.0] * 3, [1.75] * 3]))
    torch.testing.assert_close(kept.footprint, torch.tensor([9.0, 1.75]))
    assert kept.trust.tolist() == [0.5, 4.0]


def thin_points(points: PointCloud, coords: Tensor, limit: int) -> PointCloud:
    """At most `limit` points: one per cubic cell of `coords` (P, 3)."""
    one_kind = torch.zeros(len(points), dtype=torch.long)
    return merge_by_cell(points, assign_cells(coords, one_kind, limit))


def test_concatenated_points_keep_their_order() -> None:
    a, b = points(random_positions(3)), points(random_positions(2, 1))
    both = concatenate([a, b])
    assert len(both) == 5
    assert torch.equal(both.positions, torch.cat([a.positions, b.positions]))


@pytest.mark.parametrize("limit", [1, 2, 10, 300, 999])
@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_never_more_points_than_the_limit(limit: int, scale: float) -> None:
    p = points(random_positions(1000))
    kept = thin_points(p, p.positions * scale, limit)
    assert 0.3 * limit <= len(kept) <= limit
    assert float(kept.trust.sum()) == pytest.approx(1000)


def test_points_fewer_than_the_limit_are_all_kept() -> None:
    p = points(random_positions(50))
    kept = thin_points(p, p.positions, 60)
    assert len(kept) == 50
    assert torch.equal(kept.positions.sort(0).values, p.positions.sort(0).values)


def test_thinning_does_not_depend_on_the_order_of_the_points() -> None:
    p = points(random_positions(500))
    order = torch.randperm(500, generator=torch.Generator().manual_seed(3))
    shuffled = points(p.positions[order])
    one = thin_points(p, p.positions, 100)
    other = thin_points(shuffled, shuffled.positions, 100)
    torch.testing.assert_close(one.positions, other.positions)
    assert torch.equal(one.positions, thin_points(p, p.positions, 100).positions)


def test_duplicate_points_become_one() -> None:
    p = points(torch.tensor([[1.0, 2, 3], [4, 5, 6]]).repeat(20, 1))
    kept = thin_points(p, p.positions, 10)
    torch.testing.assert_close(kept.positions, torch.tensor([[1.0, 2, 3], [4, 5, 6]]))
    assert kept.trust.tolist() == [20, 20]


@pytest.mark.parametrize("limit", [1, 5])
@pytest.mark.parametrize("count", [0, 1])
def test_one_point_or_none(count: int, limit: int) -> None:
    p = points(random_positions(count))
    kept = thin_points(p, p.positions, limit)
    assert len(kept) == count and torch.isfinite(kept.positions).all()


def test_points_of_different_kinds_never_share_a_cell() -> None:
    coords = random_positions(30).repeat(3, 1)  # three kinds at the same places
    kind = torch.arange(3).repeat_interleave(30)
    for limit in (1, 3, 20, 80, 90):
        cell = assign_cells(coords, kind, limit)
        assert torch.equal(cell // CELLS_PER_KIND, kind)
        assert 3 <= len(torch.unique(cell)) <= max(limit, 3)
