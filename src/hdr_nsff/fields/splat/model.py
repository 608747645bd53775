"""What a field of 4D Gaussians has learned, in one record, with the times of its clip.

`Splat` holds these numbers. The functions that make Gaussians of a time, pictures,
terms and learning rates of them take this record.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from hdr_nsff.fields.kernels.footprint import NEAREST
from hdr_nsff.fields.knots import knot_of, time_at
from hdr_nsff.fields.splat.gaussians import Gaussians
from hdr_nsff.fields.splat.local_gaussians import LocalGaussians
from hdr_nsff.fields.splat.trajectories import Trajectories


@dataclass(frozen=True)
class Model:
    """All kinds of Gaussians together, and what is behind them."""

    static: Gaussians
    moving: Gaussians
    local: LocalGaussians
    trajectories: Trajectories
    opacity_offsets: Tensor  # (K, M)
    mixture_logits: Tensor  # (B, M)
    neighbors: Tensor  # (M, N) int32
    background: Tensor  # (3,) log radiance (or log odds) where no Gaussian is
    times: Tensor  # (T,) float64 training times, in frames, on the host
    unit: float  # the scene's typical length, scene units
    far: float  # z-depth of the background, scene units

    @property
    def bounded(self) -> bool:
        """Whether radiance stays below 1."""
        return self.static.bounded

    @property
    def view_dependence(self) -> bool:
        """Whether colors change with the direction of view."""
        return bool(len(self.static.sh1) + len(self.moving.sh1))

    @property
    def nearest(self) -> float:
        """The z-depth, in scene units, of which nothing nearer is drawn."""
        return NEAREST * self.unit

    # Time

    @property
    def last_knot(self) -> int:
        """The knot of the last training time."""
        return len(self.times) - 1

    def knot(self, time: float) -> float:
        """Position of a time (in frames) on the list of training times."""
        return knot_of(self.times, time)

    def share(self, knot: float) -> float:
        """A knot as a share in [0, 1] of the clip."""
        return knot / max(self.last_knot, 1)

    def time(self, knot: float) -> float:
        """The time (in frames) at a knot within the clip."""
        return time_at(self.times, knot)

    def has_knot(self, knot: float) -> bool:
        """Whether a knot lies within the clip."""
        return 0 <= knot <= self.last_knot

    def nearest_knot(self, knot: float) -> float:
        """The knot within the clip that is nearest to a knot."""
        return min(max(knot, 0), self.last_knot)

    # Kernels

    def parameters(self) -> tuple[Tensor, ...]:
        """Everything that is learned but view dependence and the background, as CUDA
        kernels take it.
        """
        s, m, t, local = self.static, self.moving, self.trajectories, self.local
        of_static = s.means, s.quaternions, s.log_scales, s.opacity_logits, s.log_radiance
        of_moving = m.means, m.quaternions, m.log_scales, m.opacity_logits, m.log_radiance
        offsets = m.log_radiance_offsets, self.opacity_offsets[..., None], self.mixture_logits
        tables = [getattr(local, name) for name in local.table_names()]
        rows = t.rotations, t.translations
        return (*of_static, s.log_radiance_offsets, *of_moving, *offsets, *rows, *tables)
