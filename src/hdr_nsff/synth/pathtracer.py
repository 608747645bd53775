"""Mitsuba's only door: radiance by path tracing, and exact surfaces by one ray through
each pixel center (Mitsuba's own depth and position channels are averaged over the
pixel, and its depth runs along the ray).

Radiance is made in two parts, which gives a tenth of the plain path tracer's noise in
the same time: light that comes straight from a lamp, one lamp (or circuit of lamps) at
a time, as sharp as it is; and light that bounced, which is what full paths see beyond
that, divided by albedo, averaged over a few centimeters of each surface, and multiplied
by albedo again.

The LLVM variant is some four times faster than the scalar one; it needs LLVM 16 or
newer (Debian: `libllvm19`).
"""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.progress import say
from hdr_nsff.synth.scenes.base import STILL, Part, SynthScene

PASS = 64  # samples per pixel in one launch: bounds the memory
SKY = "sky"  # the lamp that is all around
BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
REACH = 9  # pixels the average reaches at most
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])  # OpenCV's camera axes to Mitsuba's


@dataclass(frozen=True)
class Surface:
    """What the ray through each pixel center hits."""

    points: np.ndarray  # (H, W, 3) world
    normals: np.ndarray  # (H, W, 3) world
    depth: np.ndarray  # (H, W) z-depth
    bodies: np.ndarray  # (H, W) 0 what stands still, k the scene's k-th body
    uv: np.ndarray  # (H, W, 2) texture coordinates


def start(variant: str) -> Any:
    """Mitsuba with `variant`; "auto" takes LLVM where a new enough one is found and
    says so where it is not.
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
                "no LLVM 16 or newer found: rendering with scalar_rgb, about four times slower (Debian: apt install libllvm19)"
            )
    if variant not in mi.variants():
        raise InputError(
            f"--variant {variant!r}: not one of Mitsuba's; use auto, scalar_rgb or llvm_ad_rgb"
        )
    if variant.startswith("llvm") and library is None:
        raise InputError(
            f"--variant {variant}: no LLVM 16 or newer found; install one (Debian: libllvm19) or use scalar_rgb"
        )
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def newest_llvm() -> str | None:
    """The newest LLVM shared library of version 16 or later, None where there is none;
    DRJIT_LIBLLVM_PATH wins.
    """
    if given := os.environ.get("DRJIT_LIBLLVM_PATH"):
        return given
    found: dict[int, str] = {}
    for folder in ("/usr/lib", "/usr/lib/*", "/usr/lib64", "/usr/lib/llvm*/lib", "/usr/local/lib"):
        for name in glob.glob(f"{folder}/libLLVM*.so*"):
            if match := re.search(r"libLLVM(?:-|\.so\.)(\d+)", name):
                found[int(match[1])] = name
    versions = [v for v in found if v >= 16]
    return found[max(versions)] if versions else None


class Tracer:
    """Renders a scene at any time. One Mitsuba scene with every lamp and one per
    circuit; between pictures only movers move.
    """

    def __init__(self, scene: SynthScene, seed: int, variant: str = "auto"):
        self.mi = start(variant)
        self.content = scene
        self.parts = {part.name: part for part in scene.build(seed)}
        self.scene = self.build(lamp=None)

    @cached_property
    def lamps(self) -> list[Any]:
        """A scene for every circuit."""
        circuits = [circuit(part) for part in self.parts.values() if part.emits] + [SKY] * (
            self.content.sky is not None
        )
        return [self.build(name) for name in dict.fromkeys(circuits)]

    def build(self, lamp: str | None) -> Any:
        """Mitsuba's scene at time 0 with every lamp, or only the circuit `lamp`,
        switched on. Scenes share no objects: Mitsuba crashes.
        """
        shapes = {
            p.name: self.shape(p, lit=lamp in (None, circuit(p))) for p in self.parts.values()
        }
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
            return mi.load_dict(
                {
                    "type": "sphere",
                    "radius": part.radius,
                    "to_world": place,
                    "id": part.name,
                    **material,
                }
            )
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
        """How a part reflects or shines, for Mitsuba. One color is no bitmap: lamps of
        one color are sampled by solid angle.
        """
        texture: dict[str, Any] = {"type": "rgb", "value": np.ravel(part.texture).tolist()}
        if part.texture.size > 3:
            bitmap = self.mi.Bitmap(np.ascontiguousarray(part.texture, np.float32))
            texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}
        if not part.emits:
            return {
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}
            }
        return (
            {"bsdf": BLACK, "emitter": {"type": "area", "radiance": texture}}
            if lit
            else {"bsdf": BLACK}
        )

    def at(self, scene: Any, t: float) -> Any:
        """`scene` with its movers where they are at time `t` in frames."""
        values = self.mi.traverse(scene)
        for part in self.parts.values():
            if part.body == STILL:
                continue
            vertices = self.content.vertices(part, t)
            if part.radius is not None:
                values[f"{part.name}.to_world"] = (
                    self.mi.Transform4f().translate(vertices[0].tolist()).scale(part.radius)
                )
            else:
                values[f"{part.name}.vertex_positions"] = np.ravel(vertices).astype(np.float32)
        values.update()
        return scene

    def sensor(self, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int]) -> Any:
        """Mitsuba's camera; a pixel is averaged over its own square."""
        width, height = size
        return self.mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(width / 2 / K[0, 0]))),
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 100.0,
                "to_world": self.mi.ScalarTransform4f(np.vstack([c2w, [0, 0, 0, 1]]) @ FLIP),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
                "sampler": {"type": "multijitter"},
            }
        )

    def radiance(
        self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int], spp: int, seed: int
    ) -> np.ndarray:
        """Linear radiance (H, W, 3) >= 0 at time `t`, from `spp` samples per pixel and
        lamp for direct light and as many paths.
        """
        sensor, scene = self.sensor(K, c2w, size), self.at(self.scene, t)
        straight = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
        direct = sum(
            self.average(self.at(lamp, t), sensor, straight, spp, seed) for lamp in self.lamps
        )
        paths = self.average(
            scene, sensor, {"type": "path", "max_depth": 8, "rr_depth": 2}, spp, seed
        )[..., :3]
        guide = {"type": "aov", "aovs": "albedo:albedo"}
        albedo = np.maximum(self.average(scene, sensor, guide, spp, seed)[..., -3:], 0.01)
        bounced = albedo * smooth(
            (paths - direct) / albedo, self.surface(t, K, c2w, size), self.content.blur
        )
        return (direct + np.maximum(bounced, 0)).astype(np.float32)

    def average(
        self, scene: Any, sensor: Any, integrator: dict[str, Any], spp: int, seed: int
    ) -> np.ndarray:
        """What an integrator sees, (H, W, C), in passes of bounded memory."""
        passes = max(1, round(spp / PASS))
        kind = self.mi.load_dict(integrator)
        images = (
            self.mi.render(
                scene, sensor=sensor, integrator=kind, spp=min(spp, PASS), seed=seed * 4096 + k
            )
            for k in range(passes)
        )
        return np.sum([np.array(image, np.float64) for image in images], 0) / passes

    def surface(self, t: float, K: np.ndarray, c2w: np.ndarray, size: tuple[int, int]) -> Surface:
        """The first surface along the ray through every pixel center."""
        width, height = size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        local = np.stack(
            [(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1
        ).reshape(-1, 3)
        depth, normals, uv, names = self.trace(
            self.at(self.scene, t), c2w[:, 3], local @ c2w[:, :3].T
        )
        assert np.isfinite(depth).all(), "the geometry of a scene fills every picture of it"
        points = c2w[:, 3] + depth[:, None] * (local @ c2w[:, :3].T)
        index = {name: self.content.index(part.body) for name, part in self.parts.items()}
        bodies = np.array([index[name] for name in names]).reshape(height, width)
        points, normals, depth, uv = (
            a.reshape(height, width, *a.shape[1:]) for a in (points, normals, depth, uv)
        )
        return Surface(points, normals, depth, bodies, uv)

    def trace(
        self, scene: Any, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
        """For rays from one point: distances (S,) in units of each direction's length,
        normals (S, 3), texture coordinates (S, 2), names of the parts hit.
        """
        import drjit as dr

        mi = self.mi
        if mi.variant().startswith("scalar"):
            hits = [
                scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(d)))
                for d in directions
            ]
            normals, uv = (np.array([np.ravel(getattr(h, a)) for h in hits]) for a in ("n", "uv"))
            return np.array([h.t for h in hits]), normals, uv, [h.shape.id() for h in hits]
        columns = [np.ascontiguousarray(c, np.float32) for c in directions.T]
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*map(float, origin)), mi.Vector3f(*columns)))
        # one number per shape: asking of each shape where it was hit would take longer
        # than a picture
        number = {
            int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s)))[0]): s.id()
            for s in scene.shapes()
        }
        names = [
            number.get(int(k), "") for k in np.array(dr.reinterpret_array(mi.UInt32, hit.shape))
        ]
        return (
            np.array(hit.t, np.float64),
            np.array(hit.n, np.float64).T,
            np.array(hit.uv, np.float64).T,
            names,
        )


def circuit(part: Part) -> str:
    """What switches a lamp on: its circuit, or itself."""
    return part.circuit or part.name


def smooth(light: np.ndarray, surface: Surface, blur: float) -> np.ndarray:
    """Light (H, W, 3) averaged over what is near on the same surface: a Gaussian of
    `blur` meters, cut where the normal turns.
    """
    height, width = light.shape[:2]
    light, points, normals = (
        a.astype(np.float32) for a in (light, surface.points, surface.normals)
    )
    total, weights = np.zeros_like(light), np.zeros((height, width, 1), np.float32)
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            here = np.s_[max(0, -dy) : height - max(0, dy), max(0, -dx) : width - max(0, dx)]
            there = np.s_[max(0, dy) : height + min(0, dy), max(0, dx) : width + min(0, dx)]
            distance = ((points[here] - points[there]) ** 2).sum(-1, keepdims=True)
            facing = np.clip((normals[here] * normals[there]).sum(-1, keepdims=True), 0, 1)
            weight = (
                np.exp(-distance / (2 * blur**2))
                * facing**16
                * (surface.bodies[here] == surface.bodies[there])[..., None]
            )
            total[here] += weight * light[there]
            weights[here] += weight
    return total / weights
