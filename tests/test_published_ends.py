"""The terms of the preset `paper` at the ends of a clip, where a neighbor is missing:
slow oracles in plain loops and float64, on a random field of the published kind.
"""

import pytest
from published import SIDES, Case, disocclusion_of, paper_case, raw_at, samples_of
from published_terms import cycle, energy, roughness, summed

from hdr_nsff.scene.scene import Scene

FRAMES = 6  # of the clip
ENDS = {"first": (0, *SIDES[0]), "last": (FRAMES - 1, *SIDES[1])}


@pytest.fixture(params=ENDS, scope="module")
def end(request: pytest.FixtureRequest, toy: Scene) -> tuple[Case, int, int]:
    """Rays of the first or the last frame, and the column of flow to its only neighbor,
    with the offset of that.
    """
    frame, side, offset = ENDS[request.param]
    assert len(toy.train) == FRAMES
    return paper_case(toy, frame, chain=offset), side, offset


def test_flow_to_the_missing_neighbor_is_not_held(end: tuple[Case, int, int]) -> None:
    case, side, offset = end
    assert summed(case, "cycle") == pytest.approx(cycle(case, side, offset))
    assert summed(case, "smoothness") == pytest.approx(roughness(case, side))


def test_kinetic_energy_counts_along_the_chain_alone(end: tuple[Case, int, int]) -> None:
    case, _, offset = end
    assert summed(case, "kinetic") == pytest.approx(energy(case, offset))


def test_disocclusion_of_both_sides_counts_as_it_does_inside(end: tuple[Case, int, int]) -> None:
    case, _, _ = end
    raws = [raw_at(case, x, case.knot, i) for i, _, x in samples_of(case)]
    total = sum(disocclusion_of(raw, side) for raw in raws for side, _ in SIDES) / len(raws)
    assert summed(case, "disocclusion") == pytest.approx(total)


def test_nothing_is_warped_from_the_missing_neighbor(end: tuple[Case, int, int]) -> None:
    case, _, offset = end
    render = case.scene_flow.render()
    assert [warp.offset for warp in render.warps] == [offset, 2 * offset]
    assert list(render.scene_flow) == [offset]
