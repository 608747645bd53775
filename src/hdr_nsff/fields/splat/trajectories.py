"""How moving Gaussians move: a few shared rigid motions over the training times; each
Gaussian follows its own mixture of them.

Basis b turns by R_b(t) about its center c_b and shifts by s_b(t): x(t) = sum_b w_b
(R_b(t) (x - c_b) + c_b + s_b(t)). Poses are kept at the training times (knots) and
interpolated by a cubic with continuous velocity, so any time between can be asked for.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.fields.knots import catmull_rom
from hdr_nsff.fields.splat.rasterize import products, rotation_matrices

WINDOW = 3  # knots on either side whose smoothness a step may change
THIRD_DIFFERENCE = torch.tensor([-1.0, 3.0, -3.0, 1.0])
HAMILTON = products("ww -xx -yy -zz", "wx xw yz -zy", "wy -xz yw zx", "wz xy -yx zw")


class Trajectories(nn.Module):
    """`num_bases` rigid motions over `num_knots` training times."""

    centers: Tensor
    turns_touched: Tensor
    shifts_touched: Tensor

    def __init__(self, num_bases: int, num_knots: int) -> None:
        super().__init__()
        self.num_bases, self.num_knots = num_bases, num_knots
        still = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(num_knots * num_bases, 1)
        self.turns = nn.Parameter(still)  # (T * B, 4) quaternions w x y z of any length
        self.shifts = nn.Parameter(
            torch.zeros(num_knots * num_bases, 4)
        )  # (T * B, 3) scene units, and one unused column
        self.register_buffer("centers", torch.zeros(num_bases, 3))  # scene units
        for name in ("turns_touched", "shifts_touched"):  # rows with a gradient
            self.register_buffer(
                name, torch.zeros(num_knots * num_bases, dtype=torch.uint8), persistent=False
            )

    def pose(self, knot: float) -> tuple[Tensor, Tensor]:
        """Unit quaternions (B, 4) and shifts (B, 3) at a knot."""
        q = catmull_rom(self.turns.view(self.num_knots, self.num_bases, 4), knot)
        s = catmull_rom(self.shifts.view(self.num_knots, self.num_bases, 4), knot)
        return nn.functional.normalize(q, dim=-1), s[:, :3]

    def move(self, points: Tensor, mixture: Tensor, pose: tuple[Tensor, Tensor]) -> Tensor:
        """Where canonical `points` (G, 3) are in the bases' `pose`, given each one's
        `mixture` (B, G) of them.
        """
        q, s = pose
        r = rotation_matrices(q)  # (B, 3, 3)
        offset = self.centers + s - (r @ self.centers[..., None])[..., 0]
        motions = (mixture.T @ torch.cat([r, offset[..., None]], 2).flatten(1)).unflatten(
            1, (3, 4)
        )  # each point's own
        return torch.baddbmm(motions[..., 3:], motions[..., :3], points[..., None])[..., 0]

    def turn(self, quaternions: Tensor, mixture: Tensor, pose: tuple[Tensor, Tensor]) -> Tensor:
        """Orientations (G, 4) of Gaussians with canonical `quaternions` (G, 4): the
        mixture's mean turn in that `pose`, then their own.
        """
        return quaternion_product(mixture.T @ pose[0], quaternions)

    def mark(self, knot: float, reach: int = WINDOW) -> None:
        """Say that a step touches the poses near `knot` only."""
        low, high = max(int(knot) - reach, 0), min(int(knot) + 1 + reach, self.num_knots)
        for touched in (self.turns_touched, self.shifts_touched):
            touched.view(self.num_knots, self.num_bases)[low:high] = 1

    def roughness(self, knot: float, unit: float) -> Tensor:
        """Mean square third difference of the poses near a knot (quaternions; shifts in
        `unit`): 0 for constant acceleration.
        """
        low, high = max(int(knot) - WINDOW, 0), min(int(knot) + 1 + WINDOW, self.num_knots)
        turns = nn.functional.normalize(self.turns.view(self.num_knots, -1, 4)[low:high], dim=-1)
        if high - low < 4:
            return turns.sum() * 0
        shifts = self.shifts.view(self.num_knots, -1, 4)[low:high] / unit
        poses = torch.cat([turns, shifts], -1)
        bent = poses.unfold(0, 4, 1) @ THIRD_DIFFERENCE.to(poses)
        return 8 * bent.square().mean()  # the sum over the 4 + 4 numbers of a pose


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a b of (..., 4) w x y z: first b turns, then a."""
    return (a[..., None] * b[..., None, :]).flatten(-2) @ HAMILTON.to(a)
