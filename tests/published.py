"""A random field of the preset `paper` in float64, and its networks in plain loops."""

import math
from dataclasses import dataclass, replace

import torch
from presets import random_field
from torch import Tensor, nn

from hdr_nsff.fields.nsff.branches import MlpBranches, Trunk
from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.fields.nsff.scene_flow import SceneFlowPass
from hdr_nsff.fields.nsff.two_branches import BranchPass
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, draw_pixels
from hdr_nsff.scene.scene import Scene

RAYS = 5
TIME = 2  # of the batch
SIDES = ((0, 1), (1, -1))  # columns of scene flow, and the neighbors that they lead to


@dataclass
class Case:
    """A random field of the preset `paper` in float64, a batch and its pass."""

    field: NSFF
    batch: PixelBatch
    base: BranchPass
    scene_flow: SceneFlowPass
    terms: dict[str, Tensor]

    @property
    def knot(self) -> int:
        return round(self.base.knot)

    @property
    def num_samples(self) -> int:
        return self.base.samples.depths.shape[1]

    @property
    def branches(self) -> MlpBranches:
        assert isinstance(self.field.branches, MlpBranches)
        return self.field.branches

    def flow(self, i: int, k: int, side: int) -> list[float]:
        """Scene flow in cube units of sample k of ray i; side 0 forward, 1 backward."""
        return self.scene_flow.flow[i * self.num_samples + k, side].tolist()


def paper_case(scene: Scene, frame: int = TIME, chain: int = 1) -> Case:
    """Rays of a training frame, with a chain forward (1) or backward (-1)."""
    field = paper_field(scene)
    batch = draw_pixels(scene, frame, RAYS, 0, torch.Generator().manual_seed(1))
    batch = replace(in_float64(batch), chain=chain)
    base = field.query(batch, motion=True)
    scene_flow = SceneFlowPass(field, field.to_flow, batch, base)
    return Case(field, batch, base, scene_flow, field(batch)[1])


def paper_field(scene: Scene, preset: str = "paper") -> NSFF:
    """The field of `paper`, or of a preset like it, without noise of its density."""
    field = random_field(preset, scene)
    assert isinstance(field, NSFF)
    field.config = replace(field.config, density_noise=0.0)
    return field.double()


def in_float64(batch: PixelBatch) -> PixelBatch:
    """The batch with pixels, recorded values and cameras in float64."""

    def double(c: Camera) -> Camera:
        return replace(c, K=c.K.double(), c2w=c.c2w.double())

    return replace(
        batch,
        pixels=batch.pixels.double(),
        rgb=batch.rgb.double(),
        camera=double(batch.camera),
        neighbors={offset: double(c) for offset, c in batch.neighbors.items()},
    )


def decode(case: Case, coords: list[float]) -> Tensor:
    """A point of the cube in scene units."""
    return case.field.space.decode(torch.tensor([coords], dtype=torch.float64))[0]


def samples_of(case: Case) -> list[tuple[int, int, list[float]]]:
    """Every sample: its ray, its place along it, its cube coordinates."""
    coords = case.base.samples.coords
    places = [(i, k) for i in range(RAYS) for k in range(case.num_samples)]
    return [(i, k, coords[i, k].tolist()) for i, k in places]


def raw_at(case: Case, coords: list[float], knot: float, ray: int) -> list[float]:
    """What the dynamic network answers at one point of the cube."""
    where = torch.tensor([coords], dtype=torch.float64)
    direction = case.base.samples.directions[ray : ray + 1]
    raw, motion = case.field.branches.dynamic(where, knot, direction, True)
    assert motion is not None
    return [*raw[0].tolist(), *motion[0].tolist()]


def flow_of(raw: list[float], side: int) -> list[float]:
    """tanh in NDC of [-1, 1], in units of the cube."""
    start = 4 + 4 * side
    return [0.5 * math.tanh(x) for x in raw[start : start + 3]]


def disocclusion_of(raw: list[float], side: int) -> float:
    return sigmoid(raw[7 + 4 * side])


def add(a: list[float], b: list[float]) -> list[float]:
    return [x + y for x, y in zip(a, b, strict=True)]


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


# The published networks


def answer(trunk: Trunk, position: list[float], view: list[float]) -> list[float]:
    """Raw radiance (3), density and what follows it."""
    h = last_hidden(trunk, position)
    seen = affine(trunk.feature, h) + encoded(view, trunk.config.direction_octaves)
    return affine(trunk.radiance, relu(affine(trunk.view, seen))) + affine(trunk.extra, h)


def last_hidden(trunk: Trunk, position: list[float]) -> list[float]:
    """The last hidden layer at a position in [-1, 1]."""
    start = encoded(position, trunk.config.octaves)
    h = start
    for i, layer in enumerate(trunk.hidden):
        h = relu(affine(layer, start + h if i == trunk.config.skip_after else h))
    return h


def encoded(values: list[float], octaves: int) -> list[float]:
    """The values, then sine and cosine of every octave (NeRF, eq. 4)."""
    result = list(values)
    for octave in range(octaves):
        result += [math.sin(2**octave * x) for x in values]
        result += [math.cos(2**octave * x) for x in values]
    return result


def affine(layer: nn.Module, inputs: list[float]) -> list[float]:
    assert isinstance(layer, nn.Linear)
    rows, bias = layer.weight.tolist(), layer.bias.tolist()
    return [
        sum(w * x for w, x in zip(r, inputs, strict=True)) + b
        for r, b in zip(rows, bias, strict=True)
    ]


def relu(values: list[float]) -> list[float]:
    return [max(x, 0.0) for x in values]
