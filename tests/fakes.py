"""A closed-form scene: a bright disc moves before a wall with a horizontal gradient.

Cameras slide along x.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from estimates import tone_mapper
from torch import Tensor

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.fields.base import Render
from hdr_nsff.fields.outputs import Layers
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.radiometry.bracket_response import from_brightness
from hdr_nsff.radiometry.static_samples import ResponseView
from hdr_nsff.scene.manifest import FrameEntry, Manifest, StepRecord
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.run_folder import Run

W, H, FOCAL = 48, 32, 40.0
WALL, DISC = 4.0, 2.0  # z of the two planes
SPEED = torch.tensor([0.4, 0.1, 0.0])  # scene units per frame: (8, 2) pixels at the disc
EV = (-4.0, -2.0, 0.0)


def views_of(frames: list[Frame]) -> list[ResponseView]:
    """The frames as input of the estimation of the response."""
    return [
        ResponseView(f.image.numpy(), f.bracket, f.time, np.eye(3), np.eye(3, 4), np.ones((H, W)))
        for f in frames
    ]


def camera(x: float = 0.0) -> Camera:
    """Looking along z from (x, 0, 0)."""
    K = torch.tensor([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]])
    return Camera(K, torch.cat([torch.eye(3), torch.tensor([[x], [0.0], [0.0]])], 1), W, H)


class DiscBeforeWall:
    """The scene as a field, with samples on two planes.

    Without `wall` there is the disc alone. With `empty_moves`, empty samples around the
    disc have its scene flow.
    """

    def __init__(
        self,
        wall: bool = True,
        empty_moves: bool = False,
        speed: Tensor = SPEED,
        red: float = 100.0,
    ) -> None:
        self.wall = wall
        self.empty_moves = empty_moves
        self.speed = speed
        self.red = red
        self.calls = 0

    def layers(self, camera: Camera, time: float, pixels: Tensor | None = None) -> Layers:
        rays = camera.rays(camera.pixel_grid() if pixels is None else pixels)
        steps = [(z - rays.origins[:, 2:]) / rays.directions[:, 2:] for z in (DISC, WALL)]
        positions = torch.stack([rays.origins + t * rays.directions for t in steps], 1)  # (S, 2, 3)
        offset = positions[:, 0] - torch.tensor([-0.4, -0.2, DISC]) - time * self.speed
        inside = (offset[:, :2].norm(dim=-1) * FOCAL / DISC < 5.0).float()
        gradient = torch.stack([(0.5 + positions[:, 1, 0] / 8).clamp(0.02, 1)] * 3, -1)
        red = torch.tensor([self.red, 0, 0]).expand_as(gradient)
        flow = torch.zeros_like(positions)
        flow[:, 0] = self.speed * (1.0 if self.empty_moves else inside[:, None])
        alpha = torch.stack([inside, torch.full_like(inside, float(self.wall))], -1)
        motion = torch.tensor([1.0, 0.0]).expand_as(alpha)
        return Layers(
            positions, alpha, torch.stack([red, gradient], 1), {1: flow, -1: -flow}, motion
        )

    def render(
        self, camera: Camera, time: float, pixels: Tensor | None = None, scene_flow: bool = True
    ) -> Render:
        self.calls += 1
        layers = self.layers(camera, time, pixels)
        near = layers.alpha[:, 0, None]
        far = (1 - near) * layers.alpha[:, 1, None]
        weights = torch.stack([near, far], 1)  # (S, 2, 1)
        depth = camera.to_camera(layers.positions)[..., 2:]
        return Render(
            radiance=(weights * layers.radiance).sum(1),
            depth=(weights * depth).sum(1)[:, 0] / (near + far).clamp_min(1e-6)[:, 0],
            opacity=(near + far)[:, 0],
            motion=near[:, 0],
            scene_flow={o: (weights * f).sum(1) for o, f in layers.scene_flow.items()},
        )

    def __call__(self, batch: Any) -> Any:
        raise AssertionError("not trained here")

    def loss_weights(self) -> dict[str, float]:
        return {}

    def param_groups(self) -> list[ParamGroup]:
        return []

    def after_step(self, step: int, frame_errors: object = None) -> bool:
        del step

    def shared_maxima(self) -> list[Tensor]:
        return []


def fake_run(
    folder: Path,
    num_frames: int = 6,
    parallax: Any = "full",
    held_out: int = 0,
    field: DiscBeforeWall | None = None,
) -> Run:
    """A run whose field is the exact scene.

    Its camera records with gamma 2.2 at EV -4, -2, 0 in turn. The last `held_out`
    frames are test frames.
    """
    field = field or DiscBeforeWall(speed=SPEED / 4, red=3.0)
    spacing = 0.05 if parallax == "full" else 0.0
    tonemapper = tone_mapper(
        [i % 3 for i in range(num_frames)], [0] * num_frames, EV, reference=2, residual=False
    )
    frames = []
    for i in range(num_frames):
        c = camera(spacing * i)
        seen = field.render(c, float(i))
        rgb = tonemapper(seen.radiance, i % 3, 0, leaky=False).detach().reshape(H, W, 3)
        moving = seen.motion.reshape(H, W) > 0.5
        frames.append(Frame(i, float(i), c, 0, i % 3, rgb, moving=moving))
    cut = num_frames - held_out
    scene = Scene(
        folder=folder / "scene",
        train=frames[:cut],
        test=frames[cut:],
        near=1.0,
        far=8.0,
        points=torch.zeros(0, 3),
        response=from_brightness(views_of(frames), EV, 2, 1, "brightness", "made up"),
        movers=(),
        manifest=fake_manifest(frames, cut, parallax),
    )
    return Run(
        folder,
        TrainConfig(scene=folder / "scene", out=folder),
        scene,
        field,
        tonemapper,
        step=7,
        seconds=3.0,
    )


def fake_manifest(frames: list[Frame], cut: int, parallax: Any) -> Manifest:
    """The manifest of these frames, those from `cut` on held out."""
    entries = [
        FrameEntry(
            index=f.index,
            image=f"images/{f.index:05d}.png",
            source="made",
            time=f.time,
            bracket=f.bracket,
            ev=EV[f.bracket],
            K=f.camera.K.tolist(),
            c2w=f.camera.c2w.tolist(),
            split="test" if f.index >= cut else "train",
        )
        for f in frames
    ]
    steps = {
        "exposure": StepRecord(
            done=True, provenance="given", note="EV -4, -2, 0 from --ev", seconds=0.1
        ),
        "poses": StepRecord(done=True, note="6 of 6 frames registered", seconds=12.5),
        "depth": StepRecord(done=True, provenance="absent", note="no parallax"),
    }
    return Manifest(
        source="made up <clip>",
        width=W,
        height=H,
        fps=12,
        cycle=3,
        reference_bracket=2,
        bracket_ev=list(EV),
        exposure_given=True,
        parallax=parallax,
        near=1.0,
        far=8.0,
        frames=entries,
        steps=steps,
    )
