"""The only module that imports Mitsuba: radiance by path tracing, and exact surfaces by
one ray through each pixel center. (Mitsuba's own depth and position channels are
averaged over the pixel, and its depth runs along the ray.)

Radiance is the sum of two parts, which has a tenth of the plain path tracer's noise in
the same time. Direct light comes straight from a lamp: one lamp, or circuit of lamps,
is traced at a time, and nothing is blurred. Bounced light is what full paths see beyond
that: divided by albedo, averaged over a few centimeters of each surface, and multiplied
by albedo again.

The LLVM variant is about four times faster than the scalar one; it needs LLVM 16 or
newer (Debian: `libllvm19`).
"""

from __future__ import annotations

import glob
import itertools
import os
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.geometry import pinhole
from hdr_nsff.synth.scenes.base import STATIC_BODY, Part, SynthScene

PASS_SPP = 64  # samples per pixel in one launch: bounds the memory
MAX_DEPTH = 8  # edges of a path (hand-chosen)
ROULETTE_DEPTH = 2  # from there on paths end at random
SKY = "sky"  # the lamp that is all around
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
BLUR_RADIUS_PX = 9  # the average of bounced light reaches no further (hand-chosen)
FACING_POWER = 16  # of the cosine between normals: how sharply edges cut the average
MIN_ALBEDO = 0.01  # that bounced light is divided by
MIN_LLVM = 16  # version
SKY_DISTANCE = 1e4  # meters, where points of the sky are taken to be
OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  # camera axes
LLVM_FOLDERS = (
    "/usr/lib",
    "/usr/lib/*",
    "/usr/lib64",
    "/usr/lib/llvm*/lib",
    "/usr/local/lib",
)


@dataclass(frozen=True)
class Surface:
    """The surface that the ray through each pixel center hits. Where it hits none it
    sees the sky: far away, static, and turned to the camera.
    """

    points: np.ndarray  # (H, W, 3) world
    normals: np.ndarray  # (H, W, 3) world
    depth: np.ndarray  # (H, W) z-depth, 0 of the sky
    bodies: np.ndarray  # (H, W) int: 0 static, k the scene's k-th body
    uv: np.ndarray  # (H, W, 2) texture coordinates


def start(variant: str) -> Any:
    """Mitsuba with `variant`. "auto" takes LLVM where a new enough one is found, and
    reports where it is not.
    """
    library = newest_llvm()
    if library is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", library)
    try:
        import mitsuba as mi
    except ImportError as error:
        raise InputError("mitsuba is not installed; run `pip install 'hdr-nsff[synth]'`") from error
    if variant == "auto":
        variant = "llvm_ad_rgb" if library is not None else "scalar_rgb"
        if library is None:
            say(
                "no LLVM 16 or newer found: rendering with scalar_rgb, about four times slower "
                "(Debian: apt install libllvm19)"
            )
    if variant not in mi.variants():
        raise InputError(
            f"--variant {variant!r:.40}: not one of Mitsuba's; use auto, scalar_rgb or llvm_ad_rgb"
        )
    if variant.startswith("llvm") and library is None:
        raise InputError(
            f"--variant {variant}: no LLVM 16 or newer found; install one (Debian: libllvm19) "
            "or use scalar_rgb"
        )
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def newest_llvm() -> str | None:
    """The newest LLVM shared library of version 16 or later, None where there is none.
    DRJIT_LIBLLVM_PATH takes precedence.
    """
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return given
    found: dict[int, str] = {}  # by version
    for folder in LLVM_FOLDERS:
        for name in glob.glob(f"{folder}/libLLVM*.so*"):
            match = re.search(r"libLLVM(?:-|\.so\.)(\d+)", name)
            if match is not None:
                found[int(match[1])] = name
    newest = max(found, default=0)
    return found[newest] if newest >= MIN_LLVM else None


class Tracer:
    """Renders a scene at any time. There is one Mitsuba scene with every lamp and one
    per circuit; between pictures only movers are updated.
    """

    def __init__(self, scene: SynthScene, seed: int, variant: str = "auto"):
        self.mi = start(variant)
        self.content = scene
        self.parts = {part.name: part for part in scene.build(seed)}
        self.scene = self.build(lamp=None)

    @cached_property
    def lamps(self) -> list[Any]:
        """A Mitsuba scene for every circuit, with only its lamps switched on."""
        circuits = [circuit(part) for part in self.parts.values() if part.emits]
        if self.content.sky is not None:
            circuits.append(SKY)
        return [self.build(name) for name in dict.fromkeys(circuits)]

    def build(self, lamp: str | None) -> Any:
        """Mitsuba's scene at time 0 with every lamp, or only the circuit `lamp`,
        switched on. Scenes share no objects, with which Mitsuba crashes.
        """
        shapes = {}
        for part in self.parts.values():
            lit = lamp is None or lamp == circuit(part)
            shapes[part.name] = self.shape(part, lit)
        if self.content.sky is not None and lamp in (None, SKY):
            shapes[SKY] = self.surroundings(self.content.sky())
        return self.mi.load_dict({"type": "scene", **shapes})

    def surroundings(self, radiance: np.ndarray) -> dict[str, Any]:
        """Light from all around as a Mitsuba emitter; its zenith is up, -y of the
        world.
        """
        bitmap = self.mi.Bitmap(np.ascontiguousarray(radiance, np.float32))
        return {
            "type": "envmap",
            "bitmap": bitmap,
            "to_world": self.mi.ScalarTransform4f().rotate([0, 0, 1], 180),
        }

    def shape(self, part: Part, lit: bool) -> Any:
        """A part as a Mitsuba shape in its body's coordinates; `lit` False switches a
        lamp off.
        """
        mi = self.mi
        material = {key: mi.load_dict(value) for key, value in self.material(part, lit).items()}
        if part.radius is not None:
            place = mi.ScalarTransform4f().translate(part.vertices[0].tolist())
            sphere = {"type": "sphere", "radius": part.radius, "to_world": place, "id": part.name}
            return mi.load_dict({**sphere, **material})
        properties = mi.Properties()
        for key, value in material.items():
            properties[key] = value
        mesh = mi.Mesh(
            part.name,
            len(part.vertices),
            len(part.faces),
            has_vertex_texcoords=True,
            props=properties,
        )
        values = mi.traverse(mesh)
        values["vertex_positions"] = np.ravel(part.vertices).astype(np.float32)
        values["faces"] = np.ravel(part.faces).astype(np.uint32)
        values["vertex_texcoords"] = np.ravel(part.uv).astype(np.float32)
        values.update()
        return mesh

    def material(self, part: Part, lit: bool) -> dict[str, Any]:
        """How a part reflects or emits light, for Mitsuba. A single color is not made a
        bitmap: lamps of one color are sampled by solid angle.
        """
        texture: dict[str, Any] = {"type": "rgb", "value": np.ravel(part.texture).tolist()}
        if part.texture.size > 3:
            bitmap = self.mi.Bitmap(np.ascontiguousarray(part.texture, np.float32))
            texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
        if not part.emits:
            diffuse = {"type": "diffuse", "reflectance": texture}
            return {"bsdf": {"type": "twosided", "bsdf": diffuse}}
        if not lit:
            return {"bsdf": BLACK}
        return {"bsdf": BLACK, "emitter": {"type": "area", "radiance": texture}}

    def scene_at(self, scene: Any, t: float) -> Any:
        """`scene` with its movers moved to where they are at time `t` in frames."""
        values = self.mi.traverse(scene)
        for part in self.parts.values():
            if part.body == STATIC_BODY:
                continue
            vertices = self.content.vertices(part, t)
            if part.radius is None:
                values[f"{part.name}.vertex_positions"] = np.ravel(vertices).astype(np.float32)
            else:
                place = self.mi.Transform4f().translate(vertices[0].tolist())
                values[f"{part.name}.to_world"] = place.scale(part.radius)
        values.update()
        return scene

    def sensor(
        self, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int], rows: tuple[int, int]
    ) -> Any:
        """Mitsuba's camera that sees the `rows`; a pixel is averaged over its own
        square.
        """
        width, height = size
        field_of_view = 2 * np.arctan(width / 2 / K[0, 0])
        pose = np.vstack([c2w, [0, 0, 0, 1]]) @ OPENCV_TO_MITSUBA
        film = {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "crop_offset_y": rows[0],
            "crop_width": width,
            "crop_height": rows[1] - rows[0],
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        }
        camera = {
            "type": "perspective",
            "fov": float(np.degrees(field_of_view)),
            "fov_axis": "x",
            "near_clip": 0.01,
            "far_clip": 100.0,
            "to_world": self.mi.ScalarTransform4f(pose),
            "film": film,
            "sampler": {"type": "multijitter"},
        }
        return self.mi.load_dict(camera)

    def radiance(
        self,
        t: float,
        K: np.ndarray,
        c2w: np.ndarray,
        size: tuple[int, int],
        spp: int,
        seed: int,
        rows: tuple[int, int] | None = None,
    ) -> np.ndarray:
        """Linear radiance (H, W, 3) >= 0 at time `t`, from `spp` samples per pixel and
        lamp for direct light and as many paths; of `rows` alone, from the first to
        before the last, (rows, W, 3).
        """
        first, last = (0, size[1]) if rows is None else rows
        seen = max(0, first - BLUR_RADIUS_PX), min(size[1], last + BLUR_RADIUS_PX)
        sensor = self.sensor(K, c2w, size, seen)
        scene = self.scene_at(self.scene, t)
        straight = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
        full = {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH}
        guide = {"type": "aov", "aovs": "albedo:albedo"}
        direct = sum(
            self.average(self.scene_at(lamp, t), sensor, straight, spp, seed) for lamp in self.lamps
        )
        paths = self.average(scene, sensor, full, spp, seed)[..., :3]
        albedo = np.maximum(self.average(scene, sensor, guide, spp, seed)[..., -3:], MIN_ALBEDO)
        surface = self.surface(t, K, c2w, size, seen)
        bounced = albedo * smooth((paths - direct) / albedo, surface, self.content.blur)
        picture = (direct + np.maximum(bounced, 0)).astype(np.float32)
        return picture[first - seen[0] : last - seen[0]]

    def average(
        self, scene: Any, sensor: Any, integrator: dict[str, Any], spp: int, seed: int
    ) -> np.ndarray:
        """The picture (H, W, C) of an integrator, in passes of bounded memory."""
        passes = max(1, round(spp / PASS_SPP))
        kind = self.mi.load_dict(integrator)
        images = []
        for k in range(passes):
            own_seed = (seed * 4096 + k) % 2**32  # Mitsuba takes 32 bits
            image = self.mi.render(
                scene, sensor=sensor, integrator=kind, spp=min(spp, PASS_SPP), seed=own_seed
            )
            images.append(np.array(image, np.float64))
        return np.sum(images, 0) / passes

    def surface(
        self,
        t: float,
        K: np.ndarray,
        c2w: np.ndarray,
        size: tuple[int, int],
        rows: tuple[int, int] | None = None,
    ) -> Surface:
        """The first surface along the ray through every pixel center, in `rows`."""
        width, height = size
        first, last = (0, height) if rows is None else rows
        origin = c2w[:, 3]
        pixels = pinhole.pixel_centers(height, width)[first:last].reshape(-1, 2)
        height = last - first
        directions = pinhole.world_rays(pixels, K, c2w)
        depth, normals, uv, names = self.trace(self.scene_at(self.scene, t), origin, directions)
        sky = ~np.isfinite(depth)
        points = origin + np.where(sky, SKY_DISTANCE, depth)[:, None] * directions
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        normals, uv = np.where(sky[:, None], -unit, normals), np.where(sky[:, None], 0, uv)
        depth = np.where(sky, 0, depth)
        index = {name: self.content.index(part.body) for name, part in self.parts.items()}
        index[""] = self.content.index(STATIC_BODY)  # the sky
        bodies = np.array([index[name] for name in names])
        return Surface(
            points.reshape(height, width, 3),
            normals.reshape(height, width, 3),
            depth.reshape(height, width),
            bodies.reshape(height, width),
            uv.reshape(height, width, 2),
        )

    def trace(
        self, scene: Any, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
        """For rays from one point: distances (S,) in units of each direction's length
        (infinite where nothing is hit), normals (S, 3), texture coordinates (S, 2),
        names of the parts hit.
        """
        import drjit as dr

        mi = self.mi
        if mi.variant().startswith("scalar"):
            return self.trace_one_by_one(scene, origin, directions)
        columns = [np.ascontiguousarray(column, np.float32) for column in directions.T]
        x, y, z = (float(coordinate) for coordinate in origin)
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, z), mi.Vector3f(*columns)))
        # Shapes are identified by the numbers of their pointers: asking every shape for
        # its rays would take longer than rendering a picture.
        names = {}
        for shape in scene.shapes():
            number = np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0]
            names[int(number)] = shape.id()
        numbers = np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
        return (
            np.array(hit.t, np.float64),
            np.array(hit.n, np.float64).T,
            np.array(hit.uv, np.float64).T,
            [names.get(int(number), "") for number in numbers],
        )

    def trace_one_by_one(
        self, scene: Any, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
        """The same in a scalar variant of Mitsuba, ray by ray."""
        mi = self.mi
        rays = (mi.Ray3f(mi.Point3f(origin), mi.Vector3f(d)) for d in directions)
        hits = [scene.ray_intersect(ray) for ray in rays]
        distances = np.array([hit.t for hit in hits])
        normals = np.array([np.ravel(hit.n) for hit in hits])
        uv = np.array([np.ravel(hit.uv) for hit in hits])
        names = [hit.shape.id() if hit.is_valid() else "" for hit in hits]
        return distances, normals, uv, names


def circuit(part: Part) -> str:
    """The name of the lamps that are traced with a lamp: its circuit, or itself."""
    return part.circuit or part.name


def smooth(light: np.ndarray, surface: Surface, blur: float) -> np.ndarray:
    """Light (H, W, 3) averaged over nearby points of the same surface: a Gaussian of
    `blur` meters, cut where the normal turns.
    """
    height, width = light.shape[:2]
    light = light.astype(np.float32)
    points = surface.points.astype(np.float32)
    normals = surface.normals.astype(np.float32)
    total = np.zeros_like(light)
    weights = np.zeros((height, width, 1), np.float32)
    offsets = range(-BLUR_RADIUS_PX, BLUR_RADIUS_PX + 1)
    for dy, dx in itertools.product(offsets, offsets):
        here = np.s_[max(0, -dy) : height - max(0, dy), max(0, -dx) : width - max(0, dx)]
        there = np.s_[max(0, dy) : height + min(0, dy), max(0, dx) : width + min(0, dx)]
        squared_distance = ((points[here] - points[there]) ** 2).sum(-1, keepdims=True)
        nearness = np.exp(-squared_distance / (2 * blur**2))
        facing = np.clip((normals[here] * normals[there]).sum(-1, keepdims=True), 0, 1)
        same_body = (surface.bodies[here] == surface.bodies[there])[..., None]
        weight = nearness * facing**FACING_POWER * same_body
        total[here] += weight * light[there]
        weights[here] += weight
    return total / weights
