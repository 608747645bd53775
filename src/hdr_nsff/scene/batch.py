"""A batch of pixels of one frame with everything the objective compares them to, and
how pixels are drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Frame, Scene


@dataclass(frozen=True)
class Recorder:
    """One recording, for the baselines' fields that must know of it before samples are
    composited; the others never ask.
    """

    rgb: Callable[[Tensor], Tensor]  # radiance (M, 3) to what is recorded of it (M, 3)
    # positions in `scene.train` of the images recorded like this one: the image itself,
    # or those of its exposure
    images: tuple[int, ...]


@dataclass(frozen=True)
class PixelBatch:
    """`N` pixels of one training frame."""

    frame: int  # position of the frame in `scene.train`
    time: float  # in frames
    camera: Camera
    camera_id: int
    bracket: int
    # {+-1: camera of the next / previous training frame}; a missing side is absent
    neighbors: dict[int, Camera]
    pixels: Tensor  # (N, 2) xy, centers at +0.5
    rgb: Tensor  # (N, 3) recorded, in [0, 1]
    uniform: Tensor  # (N,) bool: drawn uniformly (not added by motion-weighted drawing)
    # for the field's own randomness (jitter, noise): the same seed gives the same pass
    seed: int = 0
    recorder: Recorder | None = None  # the recording, while training
    chain: int = 0  # direction of the two-step warp: +1, -1, or 0 for none
    moving: Tensor | None = None  # (N,) bool
    outline: Tensor | None = None  # (N,) bool: near the moving mask's outline
    disparity: Tensor | None = None  # (N,) 1 / scene units (or relative)
    disparity_confidence: Tensor | None = None  # (N,) in [0, 1]
    flow: dict[int, Tensor] = field(default_factory=dict)  # {+-1: (N, 2)} pixels
    flow_valid: dict[int, Tensor] = field(default_factory=dict)  # {+-1: (N,)} bool


def gather(scene: Scene, frame: int, pixels: Tensor, uniform: Tensor | None = None) -> PixelBatch:
    """The batch of integer `pixels` (N, 2; column, row) of training frame `frame`."""
    column, row = pixels[:, 0], pixels[:, 1]
    return read_off(scene, frame, pixels + 0.5, lambda image: image[row, column], uniform)


def whole_frame(scene: Scene, frame: int) -> PixelBatch:
    """The batch of every pixel of training frame `frame`, row by row: views of its
    images, not copies.
    """
    return read_off(
        scene, frame, scene.train[frame].camera.pixel_grid(), lambda image: image.flatten(0, 1)
    )


def read_off(
    scene: Scene,
    frame: int,
    pixels: Tensor,
    at: Callable[[Tensor], Tensor],
    uniform: Tensor | None = None,
) -> PixelBatch:
    """The batch of `pixels` (N, 2; centers at +0.5) of training frame `frame`; `at`
    takes an image (H, W, ...) to its values there.
    """
    f: Frame = scene.train[frame]

    def maybe(image: Tensor | None) -> Tensor | None:
        return None if image is None else at(image)

    return PixelBatch(
        frame=frame,
        time=f.time,
        camera=f.camera,
        camera_id=f.camera_id,
        bracket=f.bracket,
        neighbors={o: scene.train[j].camera for o, j in f.neighbors.items()},
        pixels=pixels.to(f.image),
        rgb=at(f.image),
        uniform=torch.ones(len(pixels), dtype=torch.bool, device=f.image.device)
        if uniform is None
        else uniform,
        moving=maybe(f.moving),
        outline=maybe(f.outline),
        disparity=maybe(f.disparity),
        disparity_confidence=maybe(f.disparity_confidence),
        flow={o: at(v) for o, v in f.flow.items()},
        flow_valid={o: at(v) for o, v in f.flow_valid.items()},
    )


def draw_pixels(
    scene: Scene, frame: int, num_uniform: int, num_moving: int, generator: torch.Generator
) -> PixelBatch:
    """`num_uniform` random pixels of training frame `frame`, and `num_moving` more from
    its moving mask (none where nothing moves).
    """
    f = scene.train[frame]
    h, w = f.image.shape[:2]
    flat = torch.randint(h * w, (num_uniform,), generator=generator).to(f.image.device)
    if num_moving and f.moving is not None and len(inside := f.moving.reshape(-1).nonzero()[:, 0]):
        extra = torch.randint(len(inside), (num_moving,), generator=generator).to(f.image.device)
        flat = torch.cat([flat, inside[extra]])
    uniform = torch.arange(len(flat), device=flat.device) < num_uniform
    return gather(scene, frame, torch.stack([flat % w, flat // w], -1), uniform)
