"""A scene file keeps what it is given, within the precision of its arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load
from viewer_scenes import local_gaussians, scene_file

from hdr_nsff.core.errors import InputError
from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.scene_file import (
    OPTIONAL_ARRAYS,
    REQUIRED_ARRAYS,
    check_group,
    from_bytes,
    to_bytes,
)


def test_a_scene_is_read_back(toy: Scene) -> None:
    scene = scene_file(toy)
    scene = replace(scene, groups=[*scene.groups, local_gaussians(toy)])
    found = from_bytes(to_bytes(scene))
    assert replace(found, groups=[], bases=None) == replace(scene, groups=[], bases=None)
    for before, after in zip(scene.groups, found.groups, strict=True):
        for name in (*REQUIRED_ARRAYS, *OPTIONAL_ARRAYS):
            expected, values = getattr(before, name), getattr(after, name)
            assert (expected is None) == (values is None), name
            if expected is not None:
                np.testing.assert_allclose(values, expected, rtol=1e-3, atol=1e-4, err_msg=name)
    assert found.bases is not None and scene.bases is not None
    np.testing.assert_array_equal(found.bases.shifts, scene.bases.shifts)


def test_means_are_exact_and_colors_take_half_the_room(toy: Scene) -> None:
    stored = load(to_bytes(scene_file(toy)))
    assert stored["static.means"].dtype == np.float32
    assert stored["static.log_radiance"].dtype == np.float16
    assert stored["moving.mixture"].dtype == np.uint16


@pytest.mark.parametrize("data", [b"", b"<!doctype html>", bytes(100)])
def test_other_files_are_refused(data: bytes) -> None:
    with pytest.raises(InputError, match="not a scene file"):
        from_bytes(data)


def test_a_file_of_another_version_is_refused(toy: Scene) -> None:
    data = to_bytes(scene_file(toy)).replace(b'\\"version\\": 1', b'\\"version\\": 9')
    with pytest.raises(InputError, match="another version"):
        from_bytes(data)


def test_a_group_with_a_part_of_the_local_arrays_is_a_mistake(toy: Scene) -> None:
    with pytest.raises(AssertionError):
        check_group(replace(local_gaussians(toy), velocities=None))
