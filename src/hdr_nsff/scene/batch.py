"""A batch of pixels of one frame, with everything that the objective compares to them.

Pixels are drawn uniformly, and more from the moving mask.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch
from torch import Tensor

from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.scene import Frame, Scene


@dataclass(frozen=True)
class Sensor:
    """How a camera records one frame, in numbers, as CUDA kernels take them."""

    gain: Tensor  # (3,) of the frame
    curve: Tensor  # (3, K) response at the knots
    knots: Tensor  # (K,)
    leak: float | None  # of eq. 11; None clamps
    # coefficients (C, 3) of every camera's lens, and the squared tangents (C,) at their
    # corners; (0, 3) and (0,) where lenses pass all light
    vignetting: Tensor
    corners: Tensor
    camera_id: int
    least: float  # share of light that a lens passes at least

    @staticmethod
    def without_lens(gain: Tensor, curve: Tensor, knots: Tensor, leak: float | None) -> Sensor:
        """Gain, curve and ends alone."""
        nothing = knots[:0]
        return Sensor(gain, curve, knots, leak, nothing.expand(3, -1).T, nothing, 0, 0.0)

    def learned(self) -> tuple[Tensor, Tensor, Tensor]:
        """What gets gradients."""
        return self.gain, self.curve, self.vignetting

    def numbers(self) -> tuple[Tensor | float, ...]:
        """All, as the kernels take them one after another."""
        tensors = self.gain, self.curve, self.knots, self.vignetting, self.corners
        ends = int(self.leak is not None), float(self.leak or 0)
        given = (t.detach().contiguous() for t in tensors)
        return *given, *ends, self.camera_id, float(self.least)


@dataclass(frozen=True)
class Recorder:
    """One recording, for fields that need it before samples are composited."""

    rgb: Callable[[Tensor], Tensor]  # radiance (M, 3) to recorded rgb (M, 3)
    # positions in `scene.train` of the images recorded like this one: the image itself,
    # or those of its exposure
    images: tuple[int, ...]
    # what a lens passes of radiance (M, 3), in a camera, at pixels (M, 2); None: all
    shade: Callable[[Tensor, Camera, Tensor], Tensor] | None = None
    sensor: Sensor | None = None  # the same, for CUDA kernels in training


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
    whole: bool = False  # every pixel of the frame, row by row
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

    def all_uniform(self) -> bool:
        """Whether no pixel was added; of whole frames without asking the device."""
        return self.whole or bool(self.uniform.all())


def neighbor_in_turn(batch: PixelBatch) -> list[int]:
    """The offset of the one neighbor with known flow whose turn it is, if any."""
    offsets = [o for o in batch.neighbors if o in batch.flow]
    turn = batch.seed // 2 % max(len(offsets), 1)
    return offsets[turn : turn + 1]


def gather(scene: Scene, frame: int, pixels: Tensor, uniform: Tensor | None = None) -> PixelBatch:
    """The batch of integer `pixels` (N, 2; column, row) of training frame `frame`."""
    column, row = pixels[:, 0], pixels[:, 1]

    def select(image: Tensor) -> Tensor:
        return image[row, column]

    return batch_of(scene, frame, pixels + 0.5, select, uniform)


@lru_cache(maxsize=8)
def all_pixels(width: int, height: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Pixel centers (N, 2) row by row, and that all are drawn uniformly (N,).

    These are constants, not to be changed.
    """
    with torch.inference_mode(False):
        pose = torch.eye(4, device=device)[:3]
        camera = Camera(torch.eye(3, device=device), pose, width, height)
        uniform = torch.ones(width * height, dtype=torch.bool, device=device)
        return camera.pixel_grid(), uniform


def whole_frame(scene: Scene, frame: int) -> PixelBatch:
    """The batch of every pixel of training frame `frame`, row by row.

    It holds views of the frame's images, not copies.
    """

    def select(image: Tensor) -> Tensor:
        return image.flatten(0, 1)

    camera = scene.train[frame].camera
    pixels, all_uniform = all_pixels(camera.width, camera.height, camera.K.device)
    batch = batch_of(scene, frame, pixels, select, all_uniform)
    return replace(batch, whole=True)


def batch_of(
    scene: Scene,
    frame: int,
    pixels: Tensor,
    select: Callable[[Tensor], Tensor],
    uniform: Tensor | None = None,
) -> PixelBatch:
    """The batch of `pixels` (N, 2; centers at +0.5) of training frame `frame`.

    `select` returns the values (N, ...) of an image (H, W, ...) at these pixels.
    """
    f: Frame = scene.train[frame]
    if uniform is None:
        uniform = torch.ones(len(pixels), dtype=torch.bool, device=f.image.device)

    def select_if_known(image: Tensor | None) -> Tensor | None:
        return None if image is None else select(image)

    return PixelBatch(
        frame=frame,
        time=f.time,
        camera=f.camera,
        camera_id=f.camera_id,
        bracket=f.bracket,
        neighbors={o: scene.train[j].camera for o, j in f.neighbors.items()},
        pixels=pixels.to(f.image),
        rgb=select(f.image),
        uniform=uniform,
        moving=select_if_known(f.moving),
        outline=select_if_known(f.outline),
        disparity=select_if_known(f.disparity),
        disparity_confidence=select_if_known(f.disparity_confidence),
        flow={o: select(v) for o, v in f.flow.items()},
        flow_valid={o: select(v) for o, v in f.flow_valid.items()},
    )


def draw_pixels(
    scene: Scene, frame: int, num_uniform: int, num_moving: int, generator: torch.Generator
) -> PixelBatch:
    """`num_uniform` random pixels of training frame `frame`, and more from its mask.

    `num_moving` pixels are drawn from the moving mask, none where it is empty.
    """
    f = scene.train[frame]
    height, width = f.image.shape[:2]
    device = f.image.device
    drawn = torch.randint(height * width, (num_uniform,), generator=generator).to(device)
    if num_moving and f.moving is not None:
        inside = f.moving.reshape(-1).nonzero()[:, 0]
        if len(inside):
            chosen = torch.randint(len(inside), (num_moving,), generator=generator).to(device)
            drawn = torch.cat([drawn, inside[chosen]])
    uniform = torch.arange(len(drawn), device=device) < num_uniform
    return gather(scene, frame, torch.stack([drawn % width, drawn // width], -1), uniform)
