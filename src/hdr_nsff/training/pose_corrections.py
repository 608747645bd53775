"""Small corrections of the training cameras, learned with the field through the
tone-mapped picture (`train --refine-poses`).

A camera turns by an axis-angle in world axes and its center shifts by a share of the
scene's typical depth; focal lengths are multiplied by a factor. Frames of one physical
camera that have the same pose share its correction, frames that have the same K share
the factor.

*Steps.* Turning and shifting a camera move its picture in almost the same way, so what
is learned is preconditioned (after CamP, Park et al. 2023): a parameter moves the
camera's visible points by about as many widths of the picture, root mean square,
whichever it is.

*Gauge.* A similarity of all cameras changes no picture, for the field follows it. It is
taken out of the corrections after every step: to first order they hold no common turn,
shift or scale, and the world stays that of the prepared scene.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from hdr_nsff.core.errors import InputError
from hdr_nsff.fields.base import ParamGroup
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame, Scene

POINTS = 12  # along each side of the picture, where a camera's motion is judged
# of the mean eigenvalue: how much slower what hardly moves the picture is than it would
# be
DAMPING = 0.5
ZOOM = 3.0  # log focal length per parameter: pixels lie about a third of the width from the middle
BETAS = (
    0.9,
    0.9999,
)  # a long memory of how large gradients were: steps shrink as the pictures come to fit
START = 0.05  # share of the run after which cameras move: the first surfaces are rough
ZOOM_RATE = 0.1  # a factor is of many frames and moves at every step: slowly
DEGREE, SHIFT, LENGTHENING = (
    torch.pi / 180,
    0.01,
    0.002,
)  # turn, typical depths, share of the focal length: 1 in the regularizer
DOUBT = 0.1  # of those: a correction this small is held, a larger one is let go (Cauchy)
FOCAL = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0]])  # entries of K that are focal lengths


class PoseCorrections(nn.Module):
    """Corrections for the training cameras of a scene; all are 0 at first. InputError
    for a camera that stands still.
    """

    precondition: Tensor
    judge: Tensor
    gauge: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        if scene.manifest.parallax == "none":
            raise InputError(
                f"{scene.folder}: the camera stands still, there are no poses to refine; "
                "train without --refine-poses"
            )
        self.unit = typical_depth(scene)
        self.links = [f.neighbors for f in scene.train]
        keys = [pose_key(f) for f in scene.train]
        self.cameras = {key: i for i, key in enumerate(dict.fromkeys(keys))}  # which correction
        self.lenses = {
            key: i for i, key in enumerate(dict.fromkeys(lens_key(f) for f in scene.train))
        }  # which factor
        self.frames = [
            (self.cameras[key], self.lenses[lens_key(f)])
            for key, f in zip(keys, scene.train, strict=True)
        ]
        self.moves = nn.Parameter(torch.zeros(len(self.cameras), 6))  # preconditioned
        self.zooms = nn.Parameter(torch.zeros(len(self.lenses)))
        views = [scene.train[keys.index(key)] for key in self.cameras]
        turns_only = scene.manifest.parallax == "rotation"
        free = torch.tensor([1.0, 1, 1, 0, 0, 0] if turns_only else [1.0] * 6)
        metric = (
            torch.stack([visible_motion(f, scene, self.unit) for f in views]) * free * free[:, None]
        )
        precondition, judge = roots(metric)
        self.register_buffer(
            "precondition", free[:, None] * precondition, persistent=False
        )  # (C, 6, 6) parameters to twists
        self.register_buffer(
            "judge", judge * free, persistent=False
        )  # (C, 6, 6) twists to parameters
        centers = torch.stack([f.camera.c2w[:, 3] for f in views]) / self.unit
        self.register_buffer(
            "gauge", similarities(centers, turns_only), persistent=False
        )  # (G, C * 6)

    def twists(self) -> Tensor:
        """Rotations about the world axes (radians), shifts (typical depths): (C, 6)."""
        return torch.einsum("cij,cj->ci", self.precondition, self.moves)

    def camera(self, camera: Camera, correction: int | None, lens: int) -> Camera:
        """`camera` with a correction (None: its pose stays) and a factor of the focal
        lengths, differentiable in both.
        """
        longer = (ZOOM * self.zooms[lens]).expm1()
        camera = replace(camera, K=camera.K + longer * camera.K * FOCAL.to(camera.K))
        return camera if correction is None else moved(camera, self.twists()[correction], self.unit)

    def forward(self, batch: PixelBatch) -> PixelBatch:
        """The batch seen by its corrected camera, and its neighbors likewise."""
        there = self.links[batch.frame]
        neighbors = {o: self.camera(c, *self.frames[there[o]]) for o, c in batch.neighbors.items()}
        return replace(
            batch, camera=self.camera(batch.camera, *self.frames[batch.frame]), neighbors=neighbors
        )

    def regularizers(self, frame: int) -> dict[str, Tensor]:
        """What a correction of a training frame's camera costs. Turn (degrees) and
        shift (percents of the typical depth) together: log(1 + (c / 0.1)^2), the prior
        of errors most of which are small and some large, so good poses are held and
        wrong ones are not. Focal length: the square, in fifths of a percent (structure
        from motion knows it from all frames together, and a field follows a wrong one
        with wrong depths).
        """
        correction, lens = self.frames[frame]
        twist = self.twists()[correction]
        zoom = ZOOM * self.zooms[lens] / LENGTHENING
        size = (twist[:3] / DEGREE).square().sum() + (twist[3:] / SHIFT).square().sum()
        return {"pose": (size / DOUBT**2).log1p() + zoom.square()}

    def param_groups(self, lr: float) -> list[ParamGroup]:
        """Poses and focal lengths; `lr` in shares of the picture's width."""
        rates = [(self.moves, lr), (self.zooms, ZOOM_RATE * lr)]
        return [ParamGroup([p], rate, BETAS, eps=1e-15, start=START) for p, rate in rates]

    @torch.no_grad()
    def fix_gauge(self) -> None:
        """Take the common similarity out of the corrections."""
        twists = self.twists().reshape(-1)
        twists = (twists - self.gauge.T @ (self.gauge @ twists)).view_as(self.moves)
        self.moves.copy_(torch.einsum("cij,cj->ci", self.judge, twists))

    @torch.no_grad()
    def describe(self) -> str:
        """How far the cameras have come, in words."""
        turn, shift = (t.square().sum(-1).mean().sqrt() for t in self.twists().split(3, -1))
        zoom = (ZOOM * self.zooms).expm1().square().mean().sqrt()
        return (
            f"cameras: turned by {turn / DEGREE:.2f} degrees, shifted by {shift:.2%} of the depth, "
            f"focal length by {zoom:.2%} (rms)"
        )

    @torch.no_grad()
    def applied(self, scene: Scene) -> Scene:
        """The scene with corrected cameras, its manifest's included. A held-out frame
        keeps its pose, of which no training picture tells, unless it was filmed by the
        very camera of a training frame; it shares the factor of its K.
        """

        def corrected(f: Frame) -> Frame:
            if (lens := self.lenses.get(lens_key(f))) is None:
                return f
            return replace(f, camera=self.camera(f.camera, self.cameras.get(pose_key(f)), lens))

        train, test = [corrected(f) for f in scene.train], [corrected(f) for f in scene.test]
        known = {
            f.index: {"K": f.camera.K.tolist(), "c2w": f.camera.c2w.tolist()} for f in train + test
        }
        entries = [e.model_copy(update=known.get(e.index, {})) for e in scene.manifest.frames]
        return replace(
            scene,
            train=train,
            test=test,
            manifest=scene.manifest.model_copy(update={"frames": entries}),
        )


def pose_key(f: Frame) -> tuple[Any, ...]:
    """Equal for frames of one physical camera with the same pose and K."""
    return (f.camera_id, *f.camera.c2w.flatten().tolist(), *lens_key(f))


def lens_key(f: Frame) -> tuple[float, ...]:
    """Equal for frames with the same K."""
    return tuple(f.camera.K.flatten().tolist())


def moved(camera: Camera, twist: Tensor, unit: float) -> Camera:
    """`camera` turned by `twist[:3]`, an axis-angle in radians and world axes, about
    its center, which shifts by `twist[3:]` * `unit`.
    """
    x, y, z = twist[:3].unbind()
    zero = torch.zeros_like(x)
    turn = torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3))
    return camera.moved(
        torch.cat([turn @ camera.c2w[:, :3], camera.c2w[:, 3:] + unit * twist[3:, None]], 1)
    )


def typical_depth(scene: Scene) -> float:
    """The median z-depth of the depth prior in scene units; without one, the middle of
    the range of disparities.
    """
    priors = [f.disparity[::4, ::4].flatten() for f in scene.train if f.disparity is not None]
    if priors and scene.manifest.depth_kind == "scene":
        return 1 / float(torch.cat(priors).median().clamp(1 / scene.far, 1 / scene.near))
    return 2 / (1 / scene.near + 1 / scene.far)


def visible_motion(f: Frame, scene: Scene, unit: float) -> Tensor:
    """How far a twist moves what the frame's camera sees: M (6, 6) so that twist^T M
    twist is the mean square motion of its points, in widths of the picture. Points lie
    at the depth prior, or, without one in scene units, all over the range of
    disparities.
    """
    camera = f.camera.resized(POINTS, POINTS)
    pixels = camera.pixel_grid()
    low, high = 1 / scene.far, 1 / scene.near
    disparity = torch.linspace(low, high, 7)[
        torch.arange(len(pixels)) % 7
    ]  # 7 and 12 share no divisor
    if f.disparity is not None and scene.manifest.depth_kind == "scene":
        column, row = (
            (pixels / POINTS * torch.tensor([f.camera.width, f.camera.height])).long().unbind(-1)
        )
        disparity = f.disparity[row, column].clamp(low, high)
    rays = camera.rays(pixels)
    points = rays.origins + rays.directions / disparity[:, None]
    jacobian = torch.func.jacfwd(lambda twist: moved(f.camera, twist, unit).project(points)[0])(
        torch.zeros(6)
    )  # (P, 2, 6)
    flat = (jacobian / f.camera.width).double().flatten(0, 1)
    return flat.T @ flat / len(pixels)


def roots(metric: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse square root and the square root (C, 6, 6) of damped metrics (C, 6,
    6).
    """
    values, vectors = torch.linalg.eigh(metric)
    values = values.clamp_min(0) + DAMPING * values.mean(-1, keepdim=True)

    def power(exponent: float) -> Tensor:
        return ((vectors * values[:, None] ** exponent) @ vectors.mT).float()

    return power(-0.5), power(0.5)


def similarities(centers: Tensor, turns_only: bool) -> Tensor:
    """An orthonormal basis (G, C * 6) of the twists that a similarity gives to cameras
    at `centers` (C, 3; typical depths): three turns about their mean, three shifts and
    a scale; of the turns alone where cameras only turn.
    """
    arms = (centers - centers.mean(0)).double()
    axes = torch.eye(3, dtype=torch.float64)
    count = len(arms)
    turns = [
        torch.cat([a.expand(count, 3), torch.linalg.cross(a.expand(count, 3), arms)], 1)
        for a in axes
    ]
    if turns_only:
        basis = torch.stack([torch.cat([t[:, :3], 0 * t[:, 3:]], 1) for t in turns])
    else:
        shifts = [torch.cat([torch.zeros(count, 3).double(), a.expand(count, 3)], 1) for a in axes]
        basis = torch.stack([*turns, *shifts, torch.cat([0 * arms, arms], 1)])
    _, size, rows = torch.linalg.svd(basis.flatten(1), full_matrices=False)
    return rows[size > 1e-6 * size[0]].float()
