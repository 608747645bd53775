"""Points on movers, where static points show too little of a camera's curve."""

from dataclasses import replace

import numpy as np
import pytest
from wall import HEIGHT, S_CURVE, WIDTH, K, X, record

from hdr_nsff.radiometry.debevec import shows_mid_tones
from hdr_nsff.radiometry.estimate_response import estimate_response
from hdr_nsff.radiometry.moving_samples import FlowLinks, moving_samples
from hdr_nsff.radiometry.response import Response
from hdr_nsff.radiometry.response_words import describe
from hdr_nsff.radiometry.samples import Samples
from hdr_nsff.radiometry.static_samples import ResponseView

EV = [-2.0, 0.0]
UNKNOWN = [None, None]
PIXELS_A_FRAME = 2
NUM_VIEWS = 12


def view(index: int, rng: np.random.Generator, wall: float = 0.04) -> ResponseView:
    """Somebody bright passes a wall that is `wall` bright at most, before a camera at
    rest.
    """
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    first = 4 + PIXELS_A_FRAME * index
    moving = (column >= first) & (column < first + 30) & (row >= 8) & (row < 44)
    on_wall = wall * 2 ** (2 * np.sin(0.1 * column) * np.cos(0.13 * row) - 2)
    on_mover = 0.9 * 2 ** (2 * np.sin(0.15 * (column - first)) * np.cos(0.11 * row) - 2)
    level = np.where(moving, on_mover, on_wall)
    radiance = np.stack([level, 0.8 * level, 0.7 * level], -1)
    bracket = index % 2
    return ResponseView(
        record(radiance * 2.0 ** EV[bracket], S_CURVE, rng),
        bracket,
        float(index),
        K,
        np.eye(3, 4),
        np.full((HEIGHT, WIDTH), 0.25),
        None,
        moving,
    )


def exact_links(views: list[ResponseView], read: list[tuple[int, int]] | None = None) -> FlowLinks:
    """Exact flow between neighbors; what is read of it is entered in `read`."""

    def flow_between(source: int, target: int) -> tuple[np.ndarray, np.ndarray]:
        if read is not None:
            read.append((source, target))
        moving = views[source].moving
        assert moving is not None
        flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
        flow[moving] = (PIXELS_A_FRAME * (target - source), 0)
        return flow, np.ones((HEIGHT, WIDTH), bool)

    last = len(views) - 1
    return FlowLinks([[max(k - 1, 0), min(k + 1, last)] for k in range(len(views))], flow_between)


@pytest.fixture(scope="module")
def views() -> list[ResponseView]:
    rng = np.random.default_rng(0)
    return [view(k, rng) for k in range(NUM_VIEWS)]


def respond(views: list[ResponseView], links: FlowLinks | None) -> Response:
    return estimate_response(views, [0] * len(views), UNKNOWN, 1, 1, links=links)


def test_points_of_movers_are_the_same_points_in_both_brackets(views: list[ResponseView]) -> None:
    samples = moving_samples(views, exact_links(views), 2, 1200, np.random.default_rng(0))
    both = samples.valid.all(1)
    stops = []
    for c in range(3):
        dark, light = (np.interp(samples.rgb[:, b, c][both[:, c]], S_CURVE[c], X) for b in (0, 1))
        stops.append(np.log2(light / dark))
    stops = np.concatenate(stops)
    assert both.sum() > 1000
    assert np.median(stops) == pytest.approx(2.0, abs=0.03)
    assert np.percentile(np.abs(stops - 2), 90) < 0.3
    assert samples.frame is not None and len(np.unique(samples.frame)) == NUM_VIEWS


def test_a_point_that_flow_leads_away_from_movers_is_not_read(views: list[ResponseView]) -> None:
    exact = exact_links(views)

    def astray(source: int, target: int) -> tuple[np.ndarray, np.ndarray]:
        flow, valid = exact.read(source, target)
        flow[: HEIGHT // 2] += (0, -HEIGHT)  # out of the picture
        flow[HEIGHT // 2 :, :, 0] += WIDTH  # and beyond its right edge
        return flow, valid

    samples = moving_samples(
        views, FlowLinks(exact.targets, astray), 2, 600, np.random.default_rng(0)
    )
    assert (samples.valid.any(-1).sum(1) == 1).all()


def test_movers_give_the_exposures_that_a_dark_wall_cannot(views: list[ResponseView]) -> None:
    with_movers = respond(views, exact_links(views))
    np.testing.assert_allclose(with_movers.ev, EV, atol=0.05)
    assert 0 < with_movers.num_moving < with_movers.num_points
    assert f"and {with_movers.num_moving} on movers" in describe(with_movers, UNKNOWN)
    wall_alone = respond(views, None)
    assert wall_alone.num_moving == 0
    assert interval(wall_alone) > 1.5 * interval(with_movers)  # and it says how little it knows


def interval(response: Response) -> float:
    """Of the step between the two exposures, as the ratio of its ends."""
    return response.scale_high / response.scale_low


def test_movers_are_not_read_where_static_points_show_the_mid_tones() -> None:
    rng = np.random.default_rng(0)
    bright = [view(k, rng, wall=0.9) for k in range(NUM_VIEWS)]
    read: list[tuple[int, int]] = []
    response = respond(bright, exact_links(bright, read))
    assert not read and response.num_moving == 0


def test_movers_serve_where_nothing_static_is_seen_twice(views: list[ResponseView]) -> None:
    alone = [replace(v, disparity=np.zeros_like(v.disparity)) for v in views]
    assert respond(alone, None).source == "brightness"
    response = respond(alone, exact_links(alone))
    assert response.source == "static points" and response.num_points == response.num_moving
    np.testing.assert_allclose(response.ev, EV, atol=0.05)


def test_given_exposures_of_frames_are_held_against_static_points_alone() -> None:
    rng = np.random.default_rng(0)
    dim = [view(k, rng, wall=0.18) for k in range(NUM_VIEWS)]
    links, cameras, drift = exact_links(dim), [0] * NUM_VIEWS, np.zeros(NUM_VIEWS)
    assert estimate_response(dim, cameras, EV, 1, 1, links=links).num_moving > 0
    response = estimate_response(dim, cameras, EV, 1, 1, drift=drift, links=links)
    assert response.disagreement == "" and response.num_points > 0
    assert response.num_moving == 0 and "on movers" not in describe(response, EV)


def test_mid_tones_count_only_where_two_brackets_link_them() -> None:
    rgb = np.full((100, 2, 3), 0.6)
    valid = np.ones((100, 2, 3), bool)
    saturated = np.zeros((100, 2, 3), bool)
    assert shows_mid_tones(Samples(rgb, valid, saturated))
    valid[:, 1] = False
    assert not shows_mid_tones(Samples(rgb, valid, saturated))
    assert not shows_mid_tones(Samples(rgb / 3, np.ones_like(valid), saturated))
