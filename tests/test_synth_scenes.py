"""Laws of every synthetic scene: what its pictures say of depth and motion is exact,
its movers are seen, and each is hard as promised.
"""

from typing import get_args, get_type_hints

import numpy as np
import pytest

from hdr_nsff.geometry.pinhole import project
from hdr_nsff.synth.motion import UV, view_geometry
from hdr_nsff.synth.pathtracer import Surface, Tracer
from hdr_nsff.synth.scenes import SCENES
from hdr_nsff.synth.scenes.base import SynthScene
from hdr_nsff.synth.scenes.geometry import intrinsics, look_at
from hdr_nsff.synth.scenes.night import DROP, bulb_pose
from hdr_nsff.synth.scenes.shapes import Builder
from hdr_nsff.synth.settings import SynthConfig

NAMES = sorted(SCENES)
SIZE = (48, 27)
K = intrinsics(*SIZE)
PIXELS = np.stack(np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5), -1)


@pytest.fixture(scope="module")
def tracers() -> dict[str, Tracer]:
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")
    return {name: Tracer(SCENES[name], 0, "scalar_rgb") for name in NAMES}


def motion(scene: SynthScene, surface: Surface, t: float, other: float) -> np.ndarray:
    """Where what a picture shows is at another time, (H, W, 3)."""
    return scene.moved(surface.points, surface.bodies, surface.uv, t, other)


def carried(tracer: Tracer, body: str, point: np.ndarray, t: float, other: float) -> np.ndarray:
    """A slow oracle: the triangle of the body's meshes that a world point is on, at
    another time, and there the same weights.
    """
    best, found = np.inf, point
    for part in tracer.parts.values():
        if part.body != body or part.radius is not None:
            continue
        there = tracer.content.vertices(part, other)[part.faces]
        a, b, c = np.moveaxis(tracer.content.vertices(part, t)[part.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        area = np.maximum((normal**2).sum(-1), 1e-30)
        v = (np.cross(point - a, c - a) * normal).sum(-1) / area
        w = (np.cross(b - a, point - a) * normal).sum(-1) / area
        weights = np.stack([1 - v - w, v, w], -1)
        off = np.abs(((point - a) * normal).sum(-1)) / np.sqrt(area) + np.abs(
            weights.clip(0, 1) - weights
        ).sum(-1)
        off[area < 1e-14] = np.inf  # the seam of a pole
        k = int(off.argmin())
        if off[k] < best:
            best, found = off[k], weights[k] @ there[k]
    assert best < 1e-3, "the ray hit no triangle of this body"
    return found


@pytest.mark.parametrize("name", NAMES)
def test_what_a_pixel_shows_is_carried_by_its_triangle(
    tracers: dict[str, Tracer], name: str
) -> None:
    """Between a frame, a half time and other frames; the flow of a held-out view is
    where that lands in the picture.
    """
    tracer, scene = tracers[name], SCENES[name]
    t, c2w = 7.5, scene.camera_pose(3)
    surface = tracer.surface(t, K, c2w, SIZE)
    channels = {
        "Z": surface.depth,
        "body": surface.bodies,
        **{n: surface.uv[..., k] for k, n in enumerate(UV)},
    }
    geometry = view_geometry(scene, channels, t, K, c2w)
    rng = np.random.default_rng(0)
    bulbs = {p.body for p in tracer.parts.values() if p.radius is not None}
    for index, body in enumerate(scene.bodies, 1):
        y, x = np.nonzero(surface.bodies == index)
        assert len(y) > 0 or "-" in body.name  # a limb may be hidden
        for k in rng.choice(len(y), min(6, len(y)), replace=False):
            point, here = surface.points[y[k], x[k]], (y[k], x[k])
            if body.name in bulbs and surface_is_round(tracer, body.name, point, t):
                continue
            for other in (t - 1, t + 1, t + 0.5):
                np.testing.assert_allclose(
                    motion(scene, surface, t, other)[here],
                    carried(tracer, body.name, point, t, other),
                    atol=2e-4,
                )
            landed = project(carried(tracer, body.name, point, t, t + 1), K, c2w)[0]
            flow = np.stack([geometry["forward.u"], geometry["forward.v"]], -1)[here]
            np.testing.assert_allclose(PIXELS[here] + flow, landed, atol=0.02)


def surface_is_round(tracer: Tracer, body: str, point: np.ndarray, t: float) -> bool:
    """Whether a point is on a lamp that is a sphere, not a mesh."""
    lamps = [p for p in tracer.parts.values() if p.body == body and p.radius is not None]
    return any(
        abs(np.linalg.norm(point - tracer.content.vertices(p, t)[0]) - (p.radius or 0)) < 1e-3
        for p in lamps
    )


@pytest.mark.parametrize("name", NAMES)
def test_depth_is_along_the_ray_through_the_pixel_center(
    tracers: dict[str, Tracer], name: str
) -> None:
    """Where a ray of Mitsuba's own camera through that center meets the scene."""
    scene, tracer = SCENES[name], tracers[name]
    rng = np.random.default_rng(0)
    for views, t in (("mono", 4.0), ("rig", 5.5)):
        c2w = scene.pose(views, round(t))
        surface = tracer.surface(t, K, c2w, SIZE)
        sensor = tracer.sensor(K, c2w, SIZE, rows=(0, SIZE[1]))
        for x, y in rng.integers(0, SIZE, (12, 2)):
            film = tracer.mi.Point2f(*(PIXELS[y, x] / SIZE))
            ray, _ = sensor.sample_ray(0.0, 0.5, film, tracer.mi.Point2f(0.5, 0.5))
            point = np.ravel(tracer.scene.ray_intersect(ray).p)
            np.testing.assert_allclose(surface.points[y, x], point, atol=1e-3)
            z = (point - c2w[:, 3]) @ c2w[:, 2]
            assert surface.depth[y, x] == pytest.approx(z, abs=1e-3)


@pytest.mark.parametrize("views", ["mono", "rig"])
@pytest.mark.parametrize("name", NAMES)
def test_every_mover_is_visible_in_most_frames_and_other_pixels_are_static(
    tracers, name, views
) -> None:
    """In four of five frames at least, by any of its limbs. Geometry fills every wide
    picture.
    """
    scene = SCENES[name]
    times = range(0, 36, 3)
    surfaces = [tracers[name].surface(t, K, scene.pose(views, t), SIZE) for t in times]
    assert all((surface.depth > 0).all() for surface in surfaces)
    seen = [surface.bodies for surface in surfaces]
    movers: dict[str, list[int]] = {}
    for index, body in enumerate(scene.bodies, 1):
        movers.setdefault(body.name.partition("-")[0], []).append(index)
    for mover, indices in movers.items():
        share = np.mean([np.isin(bodies, indices).any() for bodies in seen])
        assert share >= 0.8, f"{mover} is seen in {share:.0%} of the frames"
    assert 0.4 < np.mean([(bodies == 0).mean() for bodies in seen]) < 0.97


@pytest.mark.parametrize("name", NAMES)
def test_what_is_carried_over_a_half_time_arrives_where_it_does_at_once(name: str) -> None:
    scene, rng = SCENES[name], np.random.default_rng(0)
    part = {p.body: p for p in scene.build(0) if p.radius is None}
    for index, body in enumerate(scene.bodies, 1):
        mesh = part[body.name]
        corners = rng.choice(len(mesh.vertices), 40)
        start, half, end = (scene.vertices(mesh, t)[corners] for t in (6.0, 6.5, 7.0))
        bodies, uv = np.full(40, index), mesh.uv[corners]
        np.testing.assert_allclose(scene.moved(start, bodies, uv, 6, 6.5), half, atol=1e-9)
        np.testing.assert_allclose(
            scene.moved(scene.moved(start, bodies, uv, 6, 6.5), bodies, uv, 6.5, 7), end, atol=1e-9
        )
        assert np.linalg.norm(end - start, axis=-1).max() > 0.005


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_repeats_a_scene_and_another_paints_it_otherwise(name: str) -> None:
    a, b, other = (SCENES[name].build(seed) for seed in (1, 1, 2))
    assert len({p.name for p in a}) == len(a)
    assert {p.body for p in a} == {
        "room",
        *(m.name for m in SCENES[name].bodies),
    }
    for first, second in zip(a, b, strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)
        np.testing.assert_array_equal(first.texture, second.texture)
    assert any(
        p.texture.shape == q.texture.shape and (p.texture != q.texture).any()
        for p, q in zip(a, other, strict=True)
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_rig_is_two_rows_of_nine_aimed_at_one_place(name: str) -> None:
    scene = SCENES[name]
    eyes = np.array(scene.rig)
    assert sorted(np.unique(eyes[:, 1], return_counts=True)[1]) == [4, 5]
    width, beside = np.ptp(eyes[:, 0]), np.linalg.norm(eyes - np.roll(eyes, 1, axis=0), axis=1)
    assert beside.max() < 0.36 * width  # the next to record stands beside
    for k in range(9):
        np.testing.assert_allclose(
            project(np.array(scene.rig_target), K, scene.pose("rig", k))[0], [24, 13.5], atol=1e-9
        )


@pytest.mark.parametrize("name", NAMES)
def test_the_moving_camera_sees_parallax_all_the_time(name: str) -> None:
    """Over a clip it moves by a fifth of the distance of what it looks at, and never
    stands still.
    """
    scene = SCENES[name]
    eyes = np.array([scene.camera_pose(t)[:, 3] for t in range(36)])
    assert np.ptp(eyes[:, 0]) > 0.2 * scene.rig_target[2]
    assert (np.linalg.norm(np.diff(eyes, axis=0), axis=1) > 0.002 * scene.rig_target[2]).all()


@pytest.mark.parametrize(
    ("name", "decades"),
    [("interior", 4.0), ("lamp", 4.0), ("night", 5.0), ("cloth", 3.0), ("walk", 3.0)],
)
def test_radiance_spans_the_decades_that_are_promised(
    tracers: dict[str, Tracer], name: str, decades: float
) -> None:
    """From the darkest thousandth of the values to the brightest: in at least one of
    three frames, for what is brightest may be hidden.
    """
    pictures = [
        tracers[name].radiance(t, K, SCENES[name].camera_pose(t), SIZE, 4, 0) for t in (0, 9, 20)
    ]
    assert all(np.isfinite(p).all() and p.min() >= 0 for p in pictures)
    assert max(np.log10(p.max() / np.percentile(p, 0.1).clip(1e-12)) for p in pictures) >= decades
    assert all(np.percentile(p, 10) > 1e-4 for p in pictures)  # what is dark is not black


def test_movers_rush_past_the_lamp_and_hide_it(tracers: dict[str, Tracer]) -> None:
    """More than a twentieth of the picture's width per frame, in the median of their
    pixels.
    """
    scene, speeds = SCENES["lamp"], []
    lamp = next(p for p in tracers["lamp"].parts.values() if p.radius is not None)
    hidden = []
    for t in range(36):
        c2w = scene.camera_pose(t)
        surface = tracers["lamp"].surface(t, K, c2w, SIZE)
        flow = project(motion(scene, surface, t, t + 1), K, c2w)[0] - PIXELS
        speeds.append(np.linalg.norm(flow[surface.bodies > 0], axis=-1))
        x, y = np.floor(project(lamp.vertices[0], K, c2w)[0]).astype(int)
        hidden.append(surface.bodies[y, x] > 0)
    assert np.median(np.concatenate(speeds)) > 0.05 * SIZE[0]
    assert np.mean([np.median(s) > 0.05 * SIZE[0] for s in speeds]) > 0.6
    assert 3 <= sum(hidden) <= 20


def test_lights_move_with_what_carries_them(tracers: dict[str, Tracer]) -> None:
    """At two times the lamp on the cable is bright where its pose says, and no more
    where it was.
    """
    tracer, scene = tracers["night"], SCENES["night"]
    c2w = scene.camera_pose(0)
    places = {
        t: project((bulb_pose(t) @ [0, DROP, 0, 1])[:3], intrinsics(160, 90), c2w)[0].astype(int)
        for t in (3.0, 10.0)
    }
    for t, other in ((3.0, 10.0), (10.0, 3.0)):
        picture = tracer.radiance(t, intrinsics(160, 90), c2w, (160, 90), 1, 0)
        assert (
            picture[places[t][1], places[t][0], 0]
            > 100
            > 10
            > picture[places[other][1], places[other][0], 0]
        )


def test_dim_lights_share_a_circuit(tracers: dict[str, Tracer]) -> None:
    """Sign, window and sky; two head lights, the lantern, the street lamp and that on
    the cable: six circuits of eight lamps.
    """
    tracer = tracers["night"]
    assert sum(p.emits for p in tracer.parts.values()) == 8 and len(tracer.lamps) == 6


@pytest.mark.parametrize("body", [1, 2])
def test_no_rigid_motion_explains_what_deforms(body: int) -> None:
    """The best one, by Kabsch, is off by centimeters."""
    scene = SCENES["cloth"]
    mesh = next(p for p in scene.build(0) if p.body == scene.bodies[body - 1].name)
    a, b = (scene.vertices(mesh, t) for t in (4.0, 9.0))
    a, b = a - a.mean(0), b - b.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    assert np.sqrt(((a @ turn - b) ** 2).sum(-1).mean()) > 0.02


def test_light_from_all_around_comes_from_above() -> None:
    """A sky of radiance 1 above the horizon and black below: even ground of albedo 0.5
    has radiance 0.5.
    """
    pytest.importorskip("mitsuba", reason="mitsuba is not installed: pip install 'hdr-nsff[synth]'")

    def ground(seed: int) -> list:
        b = Builder(seed)
        b.panel((-50, 1, -50), (100, 0, 0), (0, 0, 100), lambda h, w, rng: np.full((1, 1, 3), 0.5))
        return b.parts

    above = np.repeat(
        (np.arange(32) < 16)[:, None, None] * np.ones((1, 64, 3), np.float32), 1, axis=0
    )
    pose = look_at(np.zeros(3), np.array([0.1, 3.0, 1.0]))
    scene = SynthScene(
        ground, (), lambda t: pose, ((0, 0, 0),), (0, 1, 1), sky=lambda: above.astype(np.float32)
    )
    picture = Tracer(scene, 0, "scalar_rgb").radiance(0, intrinsics(16, 9), pose, (16, 9), 64, 0)
    assert picture.mean() == pytest.approx(0.5, rel=0.03)


def test_the_interior_is_the_one_that_measurements_rest_on() -> None:
    """Counted and summed when the demo clip was made."""
    parts = SCENES["interior"].build(0)
    assert len(parts) == 52
    assert [p.name for p in parts if p.emits] == [
        "light47",
        "light48",
        "bulb49",
    ]
    assert sum(float(np.abs(p.vertices).sum()) for p in parts) == pytest.approx(
        20207.0272, abs=1e-3
    )
    assert sum(float(p.texture.mean()) for p in parts if not p.emits) == pytest.approx(
        13.8444, abs=1e-3
    )


def test_the_command_line_offers_every_scene() -> None:
    assert set(
        get_args(get_args(get_type_hints(SynthConfig, include_extras=True)["name"])[0])
    ) == set(SCENES)
