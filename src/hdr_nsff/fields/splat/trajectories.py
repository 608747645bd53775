"""How moving Gaussians move: a few shared rigid motions over the training times; each
Gaussian follows its own mixture of them (motion bases as in Shape of Motion, Wang et
al. 2024).

Basis b turns by R_b(t) about its center c_b and shifts by s_b(t): x(t) = sum_b w_b
(R_b(t) (x - c_b) + c_b + s_b(t)). Poses are kept at the training times (knots) and
interpolated by a cubic with continuous velocity, so any time between can be rendered.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from hdr_nsff.core.tensors import constant, table_on
from hdr_nsff.fields.knots import cubic
from hdr_nsff.fields.splat.rasterize import rotation_matrices, sum_products
from hdr_nsff.maths.differences import differences

# knots on either side whose poses a step may change: the reach of `roughness` and of
# the cubic
WINDOW = 3
ORDER = 3  # of the differences in `roughness`: constant acceleration costs nothing
POSE_NUMBERS = 8  # of a basis at a knot: a quaternion, and a shift with an unused column
# w, x, y, z of the Hamilton product of two quaternions
HAMILTON_PRODUCT = sum_products(
    "+ww -xx -yy -zz",
    "+wx +xw +yz -zy",
    "+wy -xz +yw +zx",
    "+wz +xy -yx +zw",
)

Pose = tuple[Tensor, Tensor]  # unit quaternions (B, 4) w x y z, shifts (B, 3) scene units


class Trajectories(nn.Module):
    """`num_bases` (B) rigid motions over the training `times` (T,), in frames."""

    centers: Tensor
    rotations_touched: Tensor
    translations_touched: Tensor

    def __init__(self, num_bases: int, times: Tensor) -> None:
        super().__init__()
        self.num_bases, self.num_knots = num_bases, len(times)
        self.times: list[float] = times.tolist()  # on the host
        self.differences = weights_of_differences(times)
        rows = self.num_knots * num_bases
        unturned = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(rows, 1)
        self.rotations = nn.Parameter(unturned)  # (T * B, 4) quaternions w x y z of any length
        # (T * B, 3) scene units, and a column that is not used: optimizer rows have
        # four
        self.translations = nn.Parameter(torch.zeros(rows, 4))
        self.register_buffer("centers", torch.zeros(num_bases, 3))  # scene units
        for name in ("rotations_touched", "translations_touched"):  # rows with a gradient
            marks = torch.zeros(rows, dtype=torch.uint8)
            self.register_buffer(name, marks, persistent=False)

    def pose(self, knot: float) -> Pose:
        """The bases' poses at a knot."""
        shape = self.num_knots, self.num_bases, 4
        turns = cubic(self.rotations.view(shape), self.times, knot)
        shifts = cubic(self.translations.view(shape), self.times, knot)
        return nn.functional.normalize(turns, dim=-1), shifts[:, :3]

    def motions(self, pose: Pose) -> Tensor:
        """Matrices (B, 3, 4) that move a canonical point as the bases in `pose` do."""
        quaternions, shifts = pose
        rotations = rotation_matrices(quaternions)  # (B, 3, 3)
        turned_centers = (rotations @ self.centers[..., None])[..., 0]
        offsets = self.centers + shifts - turned_centers
        return torch.cat([rotations, offsets[..., None]], 2)

    def pose_numbers(self, knot: float) -> Tensor:
        """The bases at a knot as kernels take them: (B, 16) of `motions`, row by row,
        and unit quaternions.
        """
        pose = self.pose(knot)
        return torch.cat([self.motions(pose).flatten(1), pose[0]], 1)

    def move(self, points: Tensor, mixture: Tensor, pose: Pose) -> Tensor:
        """Where canonical `points` (G, 3) are when the bases are in `pose`: (G, 3).

        `mixture` (B, G) are each point's weights of the bases.
        """
        motions = (mixture.T @ self.motions(pose).flatten(1)).unflatten(1, (3, 4))
        return torch.baddbmm(motions[..., 3:], motions[..., :3], points[..., None])[..., 0]

    def turn(self, quaternions: Tensor, mixture: Tensor, pose: Pose) -> Tensor:
        """Orientations (G, 4) of Gaussians with canonical `quaternions` (G, 4).

        Their own turn comes first, then the mixture's mean turn in `pose`.
        """
        return quaternion_product(mixture.T @ pose[0], quaternions)

    def mark(self, knot: float) -> None:
        """Mark the poses near `knot` as the only ones that this step may change."""
        first, last = self.window(knot)
        for touched in (self.rotations_touched, self.translations_touched):
            touched.view(self.num_knots, self.num_bases)[first:last] = 1

    def window(self, knot: float) -> tuple[int, int]:
        """First and last + 1 of the knots within `WINDOW` of a knot."""
        return max(int(knot) - WINDOW, 0), min(int(knot) + 1 + WINDOW, self.num_knots)

    def window_differences(self, knot: float) -> tuple[float, ...]:
        """The weights of the poses near a knot in their third differences, four for
        each difference.
        """
        first, last = self.window(knot)
        return tuple(w for row in self.differences[first : last - ORDER] for w in row)

    def roughness(self, knot: float, unit: float) -> Tensor:
        """Mean square third difference of the poses near a knot, 0 for smooth motion.

        Of quaternions, and of shifts in `unit` (scene units); the sum over the 4 + 4
        numbers of a pose. Constant acceleration costs nothing, also where frames are
        missing or held out.
        """
        first, last = self.window(knot)
        turns = self.rotations.view(self.num_knots, -1, 4)[first:last]
        turns = nn.functional.normalize(turns, dim=-1)
        if last - first <= ORDER:
            return turns.sum() * 0
        shifts = self.translations.view(self.num_knots, -1, 4)[first:last] / unit
        poses = torch.cat([turns, shifts], -1)
        weights = constant(self.window_differences(knot), poses.device, poses.dtype)
        runs = poses.unfold(0, ORDER + 1, 1)  # (rows, B, 8, 4)
        third_differences = (runs @ weights.view(-1, 1, ORDER + 1, 1))[..., 0]
        return POSE_NUMBERS * third_differences.square().mean()


def weights_of_differences(times: Tensor) -> list[list[float]]:
    """The weights of four knots in a row in their third difference: (T - 3, 4)."""
    known = np.ones(max(len(times) - 1, 0), bool)
    rows = differences(times.numpy().astype(float), known, ORDER)
    return [row[k : k + ORDER + 1].tolist() for k, row in enumerate(rows)]


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a b of (..., 4) w x y z: first b turns, then a."""
    outer = (a[..., None] * b[..., None, :]).flatten(-2)  # (..., 16)
    return outer @ table_on(HAMILTON_PRODUCT, a.device, a.dtype)
