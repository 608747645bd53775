"""Mattes of moving objects: every Gaussian belongs to the mover that it is seen on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from fakes import fake_run
from viewer_scenes import trained

from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.mattes import ObjectMattes
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.run_folder import Run


def mover_at(scene: Scene, place: tuple[float, float]) -> Mover:
    """A mover with one track, at a place of the picture."""
    times = len(scene.train)
    return Mover(
        frames=np.array([frame.index for frame in scene.train]),
        pixels=np.tile(np.array(place), (1, times, 1)),
        trust=np.ones((1, times)),
        points=np.zeros((1, 3)),
        rotations=np.tile(np.eye(3), (times, 1, 1)),
        translations=np.zeros((times, 3)),
        center=np.zeros(3),
        known=np.ones(times, bool),
        error=0.0,
    )


def run_with(toy: Scene, folder: Path, *places: tuple[float, float]) -> Run:
    """A run of Gaussians whose scene has one mover at each of the places."""
    field, tonemapper = trained(toy, "splat")
    scene = replace(toy, movers=tuple(mover_at(toy, place) for place in places))
    return replace(fake_run(folder), scene=scene, field=field, tonemapper=tonemapper)


def test_coverages_add_up_and_movers_share_the_moving_content(toy: Scene, tmp_path: Path) -> None:
    run = run_with(toy, tmp_path, (10.0, 17.0), (50.0, 17.0))
    mattes = ObjectMattes.of_run(run)
    assert mattes is not None
    frame = toy.train[1]
    seen = mattes.coverage(PathView(frame.camera, frame.time))
    assert list(seen) == ["static", "moving", "mover_0", "mover_1"]
    assert np.allclose(np.stack(list(seen.values())).sum(0), 1, atol=1e-4)
    with torch.no_grad():
        motion = run.field.render(frame.camera, frame.time).motion.reshape(34, 60)
    movers = seen["moving"] + seen["mover_0"] + seen["mover_1"]
    assert np.allclose(movers, motion, atol=1e-3) and movers.max() > 0.5


def test_content_belongs_to_the_nearer_mover(toy: Scene, tmp_path: Path) -> None:
    frame = toy.train[1]
    view = PathView(frame.camera, frame.time)
    places = (10.0, 17.0), (1000.0, 17.0)
    for order, owner in ((places, "mover_0"), (places[::-1], "mover_1")):
        mattes = ObjectMattes.of_run(run_with(toy, tmp_path, *order))
        assert mattes is not None
        seen = mattes.coverage(view)
        assert seen[owner].max() > 0.5 and seen["moving"].max() < 0.1


def test_without_movers_or_gaussians_there_are_no_mattes(toy: Scene, tmp_path: Path) -> None:
    assert ObjectMattes.of_run(run_with(toy, tmp_path)) is None
    assert ObjectMattes.of_run(fake_run(tmp_path)) is None
