"""Structure from motion past what stays in place and moves all the same: a waving cloth
bends no camera.
"""

import numpy as np
import pytest

from hdr_nsff.core.images import encode
from hdr_nsff.footage.colmap import read_model
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.trimming import TrimmingTuning
from hdr_nsff.synth.scenes.geometry import look_at

pytest.importorskip("pycolmap")

WIDTH, HEIGHT, FOCAL, FRAMES = 320, 180, 300.0, 12
STATIC, WAVING = 220, 130


def world(rng: np.random.Generator, time: int) -> np.ndarray:
    """Points (N, 3) in front of the cameras: a room that stands still, and a cloth
    before it.
    """
    room = np.stack(
        [rng.uniform(-2, 2, STATIC), rng.uniform(-1.1, 1.1, STATIC), rng.uniform(3, 7, STATIC)], 1
    )
    u, v = rng.uniform(-0.8, 0.8, (2, WAVING))
    wave = 0.06 * np.sin(5 * u + 2 * np.pi * time / 9)
    return np.concatenate([room, np.stack([u + 0.3 * wave, v, 2.6 + wave], 1)])


def filmed() -> list[np.ndarray]:
    """Where each frame sees the points (N, 2), a fifth of a pixel off."""
    noise, clip = np.random.default_rng(1), []
    for t in range(FRAMES):
        a = 2 * np.pi * t / FRAMES
        eye = np.array([0.45 * np.sin(a), 0.18 * np.cos(2 * a), 0.15 * np.cos(a)])
        points = (world(np.random.default_rng(0), t) - eye) @ look_at(
            eye, np.array([0.0, 0.0, 4.0])
        )[:, :3]
        seen = FOCAL * points[:, :2] / points[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        clip.append(seen + 0.2 * noise.standard_normal(seen.shape))
    return clip


def test_a_waving_cloth_bends_no_camera(tmp_path):
    clip = filmed()
    names = [f"{t:05d}.png" for t in range(FRAMES)]
    for name in names:
        encode(tmp_path / "images" / name, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    inside = [((p > 0) & (p < [WIDTH, HEIGHT])).all(1) for p in clip]
    pairs = [(i, j) for i in range(FRAMES) for j in range(i + 1, FRAMES)]
    both = [np.flatnonzero(inside[i] & inside[j]) for i, j in pairs]
    sfm.write_matches(
        tmp_path,
        names,
        clip,
        [(names[i], names[j]) for i, j in pairs],
        [np.stack([b, b], 1) for b in both],
    )
    wanted = [(names[i], names[j]) for i, j in pairs]
    job = sfm.Job(
        str(tmp_path),
        [names],
        wanted,
        focal=1.2 * FOCAL,
        task="incremental",
        threads=1,
    )

    ((folder,),) = sfm.run_in_turn([job], 1)
    model = read_model(folder)

    assert len(model.images) == FRAMES
    assert next(iter(model.cameras.values())).K[0, 0] == pytest.approx(FOCAL, rel=0.015)
    for image in model.images.values():
        kept = np.flatnonzero(image.point_ids >= 0)
        assert len(kept) >= TrimmingTuning().min_image_points
        assert np.mean(kept >= STATIC) < 0.1  # of 0.37
