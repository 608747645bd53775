"""Small corrections of the training cameras, learned with the field.

They are learned through the tone-mapped picture (`train --refine-poses`). A camera
rotates by an axis-angle in world axes, and its center shifts by a share of the scene's
typical depth; focal lengths are multiplied by a factor. Frames of one physical camera
that have the same pose share a correction, and frames that have the same K share a
factor.

*Preconditioning.* Rotating and shifting a camera change its picture in almost the same
way. Parameters are therefore preconditioned (after CamP, Park et al. 2023): one unit of
any parameter moves the camera's visible points by about one width of the picture, root
mean square.

*Gauge.* A similarity of all cameras changes no picture, for the field follows it. It is
taken out of the corrections after every step. To first order they then contain no
common rotation, shift or scale, and the world stays that of the prepared scene.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.training.given_poses import GivenPoses

# All of these are hand-chosen on rendered scenes.
# points along each side of the picture, of which a camera's visible motion is measured
POINTS = 12
DISPARITIES = 7  # of the points without a depth prior; shares no divisor with POINTS
# Share of their mean that is added to all eigenvalues of the visible motion. It limits
# the steps in directions that hardly move the picture.
DAMPING = 0.5
# log focal length per parameter: pixels lie about a third of the width from the middle
ZOOM = 3.0
# of Adam: a long memory of gradient sizes, so that steps shrink as the pictures fit
BETAS = (0.9, 0.9999)
START = 0.05  # share of the run after which cameras move: the first surfaces are rough
# rate of a factor relative to that of a pose: it belongs to many frames, and moves at
# every step
ZOOM_RATE = 0.1
# corrections that count as 1 in the regularizer
ROTATION_UNIT = torch.pi / 180  # radians
SHIFT_UNIT = 0.01  # typical depths
FOCAL_UNIT = 0.002  # share of the focal length
# in these units, scale of a Cauchy distribution: smaller corrections are held, larger
# ones are let go
CAUCHY_SCALE = 0.1

FOCAL = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 0]])  # entries of K that are focal lengths


class PoseCorrections(GivenPoses):
    """Corrections for the training cameras of a scene, which start at 0.

    InputError for a camera that stands still.
    """

    to_twists: Tensor  # (C, 6, 6): parameters to rotations (radians) and shifts
    to_parameters: Tensor  # (C, 6, 6): its inverse, on free directions
    gauge: Tensor  # (G, C * 6): twists of all cameras that are similarities

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        if scene.manifest.parallax == "none":
            raise InputError(
                f"{scene.folder}: the camera stands still, there are no poses to refine; "
                "train without --refine-poses"
            )
        self.unit = typical_depth(scene)
        self.links = [f.neighbors for f in scene.train]
        pose_keys = [pose_key(f) for f in scene.train]
        lens_keys = [lens_key(f) for f in scene.train]
        # keys to positions in `moves` and in `zooms`, and both positions of every frame
        self.cameras = {key: i for i, key in enumerate(dict.fromkeys(pose_keys))}
        self.lenses = {key: i for i, key in enumerate(dict.fromkeys(lens_keys))}
        self.frames = [
            (self.cameras[pose], self.lenses[lens])
            for pose, lens in zip(pose_keys, lens_keys, strict=True)
        ]
        self.moves = nn.Parameter(torch.zeros(len(self.cameras), 6))  # preconditioned
        self.zooms = nn.Parameter(torch.zeros(len(self.lenses)))

        views = [scene.train[pose_keys.index(key)] for key in self.cameras]
        rotates_only = scene.manifest.parallax == "rotation"
        free = torch.tensor([1.0, 1, 1, 0, 0, 0] if rotates_only else [1.0] * 6)
        motions = torch.stack([visible_motion(f, scene, self.unit) for f in views])
        inverse_root, root = roots(motions * free * free[:, None])
        centers = torch.stack([f.camera.c2w[:, 3] for f in views]) / self.unit
        gauge = similarities(centers, rotates_only)
        self.register_buffer("to_twists", free[:, None] * inverse_root, persistent=False)
        self.register_buffer("to_parameters", root * free, persistent=False)
        self.register_buffer("gauge", gauge, persistent=False)

    def twists(self) -> Tensor:
        """Rotations about the world axes (radians), shifts (typical depths): (C, 6)."""
        return torch.einsum("cij,cj->ci", self.to_twists, self.moves)

    def camera(self, camera: Camera, correction: int | None, lens: int) -> Camera:
        """`camera` with a correction of its pose (None: none) and of its focal lengths.

        Both are given by their position, and both are differentiable.
        """
        change = (ZOOM * self.zooms[lens]).expm1()
        camera = replace(camera, K=camera.K + change * camera.K * FOCAL.to(camera.K))
        if correction is None:
            return camera
        return move_camera(camera, self.twists()[correction], self.unit)

    def forward(self, batch: PixelBatch) -> PixelBatch:
        """The batch seen by its corrected camera, with corrected neighbors."""
        camera = self.camera(batch.camera, *self.frames[batch.frame])
        links = self.links[batch.frame]
        neighbors = {o: self.camera(c, *self.frames[links[o]]) for o, c in batch.neighbors.items()}
        return replace(batch, camera=camera, neighbors=neighbors)

    def frame(self, scene: Scene, position: int) -> Frame:
        """A training frame with its camera as corrected so far."""
        frame = scene.train[position]
        return frame.with_camera(self.camera(frame.camera, *self.frames[position]))

    def regularizers(self, frame: int) -> dict[str, Tensor]:
        """The penalty `pose` of the corrections of a training frame's camera.

        With c the correction of the pose, rotation (degrees) and shift (percents of the
        typical depth) together: log(1 + (c / 0.1)^2). Most errors are small and some
        are large under this prior, so good poses are held and wrong ones are not.

        For the focal length: the square, in fifths of a percent. Structure from motion
        knows it from all frames together, and a field follows a wrong one with wrong
        depths.
        """
        correction, lens = self.frames[frame]
        twist = self.twists()[correction]
        zoom = ZOOM * self.zooms[lens] / FOCAL_UNIT
        rotation = (twist[:3] / ROTATION_UNIT).square().sum()
        shift = (twist[3:] / SHIFT_UNIT).square().sum()
        return {"pose": ((rotation + shift) / CAUCHY_SCALE**2).log1p() + zoom.square()}

    def param_groups(self, lr: float) -> list[ParamGroup]:
        """Poses and focal lengths; `lr` in shares of the picture's width."""
        rates = [(self.moves, lr), (self.zooms, ZOOM_RATE * lr)]
        return [ParamGroup([p], rate, BETAS, eps=1e-15, start=START) for p, rate in rates]

    @torch.no_grad()
    def fix_gauge(self) -> None:
        """Take the common similarity out of the corrections."""
        twists = self.twists().reshape(-1)
        twists = (twists - self.gauge.T @ (self.gauge @ twists)).view_as(self.moves)
        self.moves.copy_(torch.einsum("cij,cj->ci", self.to_parameters, twists))

    @torch.no_grad()
    def describe(self) -> str:
        """A sentence on how large the corrections are."""
        rotations, shifts = self.twists().split(3, -1)
        rotation = rotations.square().sum(-1).mean().sqrt()
        shift = shifts.square().sum(-1).mean().sqrt()
        zoom = (ZOOM * self.zooms).expm1().square().mean().sqrt()
        return (
            f"cameras: turned by {rotation / ROTATION_UNIT:.2f} degrees, "
            f"shifted by {shift:.2%} of the depth, focal length by {zoom:.2%} (rms)"
        )

    @torch.no_grad()
    def correct(self, scene: Scene) -> Scene:
        """The scene with corrected cameras, in its manifest as well.

        A held-out frame shares the factor of its K. Its pose is corrected only if the
        very camera of a training frame filmed it: no training picture determines it
        otherwise.
        """

        def corrected(f: Frame) -> Frame:
            lens = self.lenses.get(lens_key(f))
            if lens is None:
                return f
            correction = self.cameras.get(pose_key(f))
            return f.with_camera(self.camera(f.camera, correction, lens))

        train = [corrected(f) for f in scene.train]
        test = [corrected(f) for f in scene.test]
        cameras = {
            f.index: {"K": f.camera.K.tolist(), "c2w": f.camera.c2w.tolist()} for f in train + test
        }
        entries = [e.model_copy(update=cameras.get(e.index, {})) for e in scene.manifest.frames]
        manifest = scene.manifest.model_copy(update={"frames": entries})
        return replace(scene, train=train, test=test, manifest=manifest)


def poses_for(scene: Scene, refine: bool) -> GivenPoses:
    """The cameras of a run: with corrections that start at 0 if `refine`."""
    return PoseCorrections(scene) if refine else GivenPoses()


def pose_key(f: Frame) -> tuple[Any, ...]:
    """Equal for frames of one physical camera with the same pose and K."""
    return (f.camera_id, *f.camera.c2w.flatten().tolist(), *lens_key(f))


def lens_key(f: Frame) -> tuple[float, ...]:
    """Equal for frames with the same K."""
    return tuple(f.camera.K.flatten().tolist())


def move_camera(camera: Camera, twist: Tensor, unit: float) -> Camera:
    """`camera` rotated about its center by `twist[:3]`, and shifted.

    The rotation is an axis-angle in radians and world axes; the shift is `twist[3:]` *
    `unit`.
    """
    x, y, z = twist[:3].unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    rotation = torch.linalg.matrix_exp(skew)
    center = camera.c2w[:, 3:] + unit * twist[3:, None]
    return camera.moved(torch.cat([rotation @ camera.c2w[:, :3], center], 1))


def typical_depth(scene: Scene) -> float:
    """The median z-depth of the depth prior, in scene units.

    Without such a prior, the depth in the middle of the range of disparities.
    """
    priors = [f.disparity[::4, ::4].flatten() for f in scene.train if f.disparity is not None]
    if priors and scene.manifest.depth_kind == "scene":
        return 1 / float(torch.cat(priors).median().clamp(1 / scene.far, 1 / scene.near))
    return 2 / (1 / scene.near + 1 / scene.far)


def visible_motion(f: Frame, scene: Scene, unit: float) -> Tensor:
    """How far a twist moves what the frame's camera sees, as a matrix M (6, 6).

    twist^T M twist is the mean square motion of its points, in widths of the picture.
    Points lie at the depth prior. Without one in scene units, they lie all over the
    range of disparities.
    """
    camera = f.camera.resized(POINTS, POINTS)
    pixels = camera.pixel_grid()
    lowest = 1 / scene.far
    highest = 1 / scene.near
    if f.disparity is not None and scene.manifest.depth_kind == "scene":
        size = torch.tensor([f.camera.width, f.camera.height])
        column, row = (pixels / POINTS * size).long().unbind(-1)
        disparity = f.disparity[row, column].clamp(lowest, highest)
    else:
        levels = torch.linspace(lowest, highest, DISPARITIES)
        disparity = levels[torch.arange(len(pixels)) % DISPARITIES]
    rays = camera.rays(pixels)
    points = rays.origins + rays.directions / disparity[:, None]

    def project(twist: Tensor) -> Tensor:
        return move_camera(f.camera, twist, unit).project(points)[0]

    jacobian = torch.func.jacfwd(project)(torch.zeros(6))  # (P, 2, 6)
    in_widths = (jacobian / f.camera.width).double().flatten(0, 1)  # (P * 2, 6)
    return in_widths.T @ in_widths / len(pixels)


def roots(metric: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse square root and square root (C, 6, 6) of damped metrics (C, 6, 6)."""
    values, vectors = torch.linalg.eigh(metric)
    values = values.clamp_min(0) + DAMPING * values.mean(-1, keepdim=True)

    def power(exponent: float) -> Tensor:
        return ((vectors * values[:, None] ** exponent) @ vectors.mT).float()

    return power(-0.5), power(0.5)


def similarities(centers: Tensor, rotations_only: bool) -> Tensor:
    """An orthonormal basis (G, C * 6) of the twists that a similarity gives to cameras.

    The cameras are at `centers` (C, 3) in typical depths. A similarity is three
    rotations about their mean, three shifts and a scale, or the rotations alone if
    `rotations_only`.
    """
    arms = (centers - centers.mean(0)).double()
    zeros = torch.zeros_like(arms)
    axes = [axis.expand_as(arms) for axis in torch.eye(3, dtype=torch.float64)]
    if rotations_only:
        twists = [torch.cat([axis, zeros], 1) for axis in axes]
    else:
        rotations = [torch.cat([axis, torch.linalg.cross(axis, arms)], 1) for axis in axes]
        shifts = [torch.cat([zeros, axis], 1) for axis in axes]
        scale = torch.cat([zeros, arms], 1)
        twists = [*rotations, *shifts, scale]
    basis = torch.stack(twists).flatten(1)
    _, size, rows = torch.linalg.svd(basis, full_matrices=False)
    return rows[size > 1e-6 * size[0]].float()
