"""A field as a scene file: its Gaussians, cameras, responses and recorded pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from presets import random_field
from viewer_scenes import local_gaussians, scene_file, trained, trained_local

from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer import field_scene
from hdr_nsff.viewer.field_scene import drop_invisible, scene_of


def test_all_visible_gaussians_are_kept(toy: Scene) -> None:
    field, tonemapper = trained(toy)
    with torch.no_grad():
        field.static.opacity_logits.fill_(1.0)[:5] = -10.0
        field.moving.opacity_logits.fill_(1.0)[:7] = -10.0
        field.opacity_offsets[:, :7] = 0.0
        field.opacity_offsets[3, 2] = 12.0  # the third one appears for a while
    scene = scene_of(field, tonemapper, toy, "Toy", 1.0)
    static, moving = scene.groups[:2]
    assert len(static) == len(field.static) - 5
    assert len(moving) == len(field.moving) - 6
    np.testing.assert_array_equal(moving.means[0], field.moving.means[2].detach())
    assert moving.mixture is not None
    np.testing.assert_allclose(moving.mixture.sum(1), 1, rtol=1e-6)


def test_gaussians_that_are_not_finite_are_left_out(toy: Scene) -> None:
    group = local_gaussians(toy)
    group.means[2, 1] = np.nan
    kept = drop_invisible(group)
    assert len(kept) == len(group) - 1
    assert kept.centers is not None and group.centers is not None
    np.testing.assert_array_equal(kept.centers, np.delete(group.centers, 2))


def test_time_local_gaussians_are_a_group_of_their_own(toy: Scene) -> None:
    field, tonemapper = trained_local(toy)
    (group,) = scene_of(field, tonemapper, toy, "Toy", 1.0).groups
    assert (group.name, group.mixture, len(group)) == ("local", None, len(field.local))
    assert group.velocities is not None and group.velocities.shape == (len(group), 3)


def test_recorded_pictures_are_those_of_the_frames(toy: Scene) -> None:
    scene = scene_file(toy)
    frames = sorted(toy.train, key=lambda f: f.time)
    for view, frame in zip(scene.views, frames, strict=True):
        assert view.picture is not None
        first, last = view.picture
        bgr = cv2.imdecode(np.frombuffer(scene.recorded[first:last], np.uint8), cv2.IMREAD_COLOR)
        difference = bgr[..., ::-1] / 255 - frame.image.numpy()
        assert np.abs(difference.mean(-1)).mean() < 0.06  # noise, as a JPEG
        assert view.time == frame.time


def test_recorded_pictures_of_large_clips_are_made_smaller(
    toy: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    width, height = toy.train[0].camera.width, toy.train[0].camera.height
    monkeypatch.setattr(field_scene, "MAX_RECORDED_PIXELS", len(toy.train) * width * height / 4)
    scene = scene_file(toy)
    assert scene.views[0].picture is not None
    first, last = scene.views[0].picture
    picture = cv2.imdecode(np.frombuffer(scene.recorded[first:last], np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[:2] == (height // 2, width // 2)


def test_a_field_without_gaussians_gives_cameras_and_responses(toy: Scene) -> None:
    _, tonemapper = trained(toy)
    scene = scene_of(random_field("grid", toy), tonemapper, toy, "Toy", 1.0)
    assert scene.groups == [] and scene.bases is None
    assert len(scene.views) == len(toy.train)
    assert len(scene.responses[0].y) == 3
