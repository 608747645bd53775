"""How close to each other static Gaussians start: closer where there is detail.

Gaussians at a distance h leave an error of about h times the local contrast of the
picture. Of a given number of them, the sum of squared errors is then least where their
density is proportional to the contrast. Other errors (wrong depth, noise) limit what
density gains, so that it levels off. Where a surface is seen in several frames, these
vote by the trust in their pixels: one that clips shows no detail.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.fields.point_cloud import PointCloud

# root mean square of an image, in [0, 1], without its low frequencies, at which the
# density is half of the greatest (hand-chosen: 5 levels of 255)
HALF_DENSITY_DETAIL = 0.02
MIN_DENSITY = 1 / 64  # relative to the greatest, which nothing reaches
BLUR_PX = 3  # width of the box that separates low frequencies, applied twice
WINDOW_PX = 7  # width of the window in which detail is measured
VOTE_PX = 8.0  # side of the cells in which points vote on one density
SIZES_PER_OCTAVE = 2  # how finely cell sizes differ


def detail_density(image: Tensor) -> Tensor:
    """Relative density (H * W,) in [0, 1) for the detail of `image` (H, W, 3)."""
    planes = image.permute(2, 0, 1)[None]
    high = planes - box_mean(box_mean(planes, BLUR_PX), BLUR_PX)
    energy = box_mean(high.square().mean(1, keepdim=True), WINDOW_PX)
    detail = energy.sqrt().flatten()
    return detail / (detail + HALF_DENSITY_DETAIL)


def box_mean(planes: Tensor, width: int) -> Tensor:
    """Means of `planes` (1, C, H, W) in windows of odd `width` in pixels."""
    margin = width // 2
    padded = nn.functional.pad(planes, (margin, margin, margin, margin), mode="replicate")
    return nn.functional.avg_pool2d(padded, width, 1)


def cell_sizes(points: PointCloud, coords: Tensor, density: Tensor, width: int) -> Tensor:
    """The size (P,) of every point's cell, in integer steps from 0, the smallest.

    A step is 1 / `SIZES_PER_OCTAVE` of an octave. `density` (P,) is what each point's
    frame asks for. Points vote within cells of `coords` (P, 3), of which the longest
    side is the picture's `width` in pixels.
    """
    if not len(points):
        return torch.zeros(0, dtype=torch.long)
    inside = coords - coords.amin(0)
    inside = inside / inside.max().clamp_min(1e-30)
    x, y, z = (inside * (width / VOTE_PX)).long().unbind(-1)
    side = int(width / VOTE_PX) + 1
    _, cell = torch.unique((x * side + y) * side + z, return_inverse=True)
    weights = torch.stack([points.trust, points.trust * density], 1).double()
    sums = torch.zeros(int(cell.max()) + 1, 2, dtype=torch.float64).index_add_(0, cell, weights)
    voted = (sums[:, 1] / sums[:, 0])[cell]
    # a cell's side goes with the root of the area that one Gaussian has to itself
    octaves = -0.5 * voted.clamp(MIN_DENSITY, 1).log2()
    return (SIZES_PER_OCTAVE * octaves).round().long()


def scale_by_size(coords: Tensor, size: Tensor) -> Tensor:
    """`coords` (P, 3) minus their least, in units of each point's cell `size` (P,)."""
    return (coords - coords.amin(0)) * torch.exp2(-size / SIZES_PER_OCTAVE)[:, None]
