"""Random Gaussians of a training moment, made by kernels and by plain torch."""

import math
from dataclasses import replace
from typing import Any

import torch
from test_splat import batch_of, scattered
from torch import Tensor

from hdr_nsff.fields.splat import training_view
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.rasterize import rotation_matrices
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.fields.splat.training_view import CloudMaker
from hdr_nsff.geometry.cameras import Camera

NAMES = ("means", "quaternions", "scales", "opacities", "features")
ROUNDING = 2e-5  # of the largest number: plain torch computes in float32
FRAMES = torch.tensor([0.0, 1, 2, 4, 5, 6, 7, 8, 9, 10])  # a frame is held out
SETTINGS: list[dict[str, Any]] = [
    {"local": 0},
    {"moving": 0, "local": 0},
    {"radiance": "sigmoid"},
    {"brightness_knots": 1, "color_knots": 1, "opacity_knots": 1},
    {"bases": 1},
]
# seed and settings of a field; knot, and offset of the neighbor (None: rigidity is due)
MOMENTS: list[tuple[int, dict[str, Any], float, int | None]] = [
    *(
        (0, {}, knot, offset)
        for knot, offset in ((4.0, 1), (4.3, -1), (0.0, 1), (9.0, 1), (9.0, -1))
    ),
    *((1, {}, knot, None) for knot in (0.0, 2.0, 3.7, 9.0)),
    *((2, settings, 4.2, offset) for settings in SETTINGS for offset in (1, None)),
]


def oblique(focal: tuple[float, float], turn: list[float], center: list[float]) -> Camera:
    """A camera of 40 x 30 pixels, none of whose numbers is that of another axis."""
    K = torch.tensor([[focal[0], 0, 18.0], [0, focal[1], 16.0], [0, 0, 1]])
    rotation = rotation_matrices(torch.tensor([turn]))[0]
    return Camera(K, torch.cat([rotation, torch.tensor(center)[:, None]], 1), 40, 30)


HERE = oblique((60.0, 50.0), [1.0, 0.05, -0.1, 0.2], [0.1, 0.05, -0.1])
THERE = oblique((64.0, 56.0), [1.0, -0.1, 0.05, 0.1], [0.2, -0.1, 0.05])


def random_field(seed: int = 0, **settings: Any) -> Splat:
    """Random Gaussians, some of them with dark, long or steep numbers."""
    given = scattered(seed)
    field = Splat(replace(given.config, **settings), FRAMES, 1.0, 6.0, 1200)
    shapes = {k: v.shape for k, v in field.state_dict().items() if k != "times"}
    same = {k: v for k, v in given.state_dict().items() if v.shape == shapes.get(k)}
    field.load_state_dict(same, strict=False)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        field.static.opacity_logits[::5] = -9.0
        field.moving.log_radiance[::7] = 17.0
        field.local.log_scales[::2, 3] = math.log(0.8)  # shorter than lives become
        field.mixture_logits.add_(torch.randn(field.mixture_logits.shape, generator=generator))
    field.find_neighbors()
    return field


def values_and_gradients(
    field: Splat, knot: float, offset: int | None, rigidity: bool, make_cloud: CloudMaker | None
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Gaussians and terms by name, and gradients and marks by parameters, made by
    kernels or by plain torch.
    """
    offsets = [] if offset is None else [offset]
    batch = replace(batch_of(0, offset or 1), camera=HERE, neighbors={offset or 1: THERE})
    view = training_view.TrainingView(batch, knot, field.alive(knot), offsets, rigidity)
    if make_cloud is None:
        made, _, terms = training_view.draw_by_torch(field.model(), view)
        values = {**dict(zip(NAMES, made, strict=True)), **terms}
    else:
        cloud = training_view.cloud_by_kernels(field.model(), view, make_cloud)
        values = {**{name: getattr(cloud, name) for name in NAMES}, **cloud.terms}
    generator = torch.Generator().manual_seed(3)
    loss = sum((torch.randn(v.shape, generator=generator) * v).sum() for v in values.values())
    field.zero_grad()
    loss.backward()
    found = {n: p.grad for n, p in field.named_parameters() if p.grad is not None}
    marks = {n: b.clone() for n, b in field.named_buffers() if n.endswith("touched")}
    for name, buffer in field.named_buffers():
        if name.endswith("touched"):
            buffer.zero_()
    features = values.pop("features")
    kinds = {
        "log radiance": features[:, :3].log(),
        "motion": features[:, 3],
        "flow": features[:, 4:],
    }
    return {k: v.detach() for k, v in (values | kinds).items()}, {**found, **marks}


def compare(make_cloud: CloudMaker, field: Splat, knot: float, offset: int | None) -> None:
    """The same by kernels and by plain torch; rigidity is due where flow is not."""
    rigidity = offset is None
    expected = values_and_gradients(field, knot, offset, rigidity, None)
    found = values_and_gradients(field, knot, offset, rigidity, make_cloud)
    for ours, theirs in zip(found, expected, strict=True):
        for name, b in theirs.items():
            a = ours.get(name, torch.zeros_like(b))
            largest = float(b.float().abs().max()) if b.numel() else 0.0
            if b.numel():
                off = float((a.float() - b.float()).abs().max())
                assert off <= ROUNDING * largest + 1e-7, f"{name}: off by {off:.3g} of {largest}"


def field_of_times(num_times: int) -> Splat:
    """A small field of a clip of so many frames."""
    config = SplatConfig(static=8, moving=6, local=0, bases=2)
    field = Splat(config, torch.arange(num_times), 1.0, 6.0, 1200)
    for p in field.parameters():
        p.data.add_(0.1)
    return field
