"""A scene folder in closed form, with a moving camera and three exposures.

A textured card moves at z = 2.5 before a textured wall at z = 4.
"""

from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core.images import read_image, write_png
from hdr_nsff.core.io import write_npy
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest
from hdr_nsff.synth.oracle import write_estimates

EV = [2.0, 0.0, -2.0]
WALL, CARD = 4.0, 2.5


def camera_center(t: float) -> np.ndarray:
    return np.array([0.4 * np.sin(0.5 * t), 0.1 * np.cos(0.7 * t), 0.0])


def card_offset(t: float) -> np.ndarray:
    return np.array([-0.6 + 0.1 * t, 0.2 * np.sin(0.6 * t)])


def textures(seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [
        cv2.GaussianBlur(np.kron(rng.random((40, 60, 3)), np.ones((4, 4, 1))), (0, 0), 1.5).astype(
            np.float32
        )
        for _ in range(2)
    ]


class ToyScene:
    """Renders radiance, mask and depth in closed form and writes the scene folder."""

    def __init__(self, width: int = 60, height: int = 34, frames: int = 6) -> None:
        self.width, self.height, self.frames = width, height, frames
        self.f = 0.92 * width
        self.textures = textures()
        y, x = np.mgrid[:height, :width] + 0.5
        self.dx, self.dy = (x - width / 2) / self.f, (y - height / 2) / self.f
        self.K = np.array([[self.f, 0, width / 2], [0, self.f, height / 2], [0, 0, 1]])

    def see(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radiance (H, W, 3), moving mask (H, W) and z-depth (H, W) at time t."""
        center = camera_center(t)

        def plane(
            z: float, offset: np.ndarray, texture: np.ndarray, size: float
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            px, py = center[0] + self.dx * z - offset[0], center[1] + self.dy * z - offset[1]
            u, v = (
                (px / size + 0.5) * texture.shape[1],
                (py / size * texture.shape[1] / texture.shape[0] + 0.5) * texture.shape[0],
            )
            return (
                cv2.remap(
                    texture,
                    u.astype(np.float32),
                    v.astype(np.float32),
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_WRAP,
                ),
                px,
                py,
            )

        wall, _, _ = plane(WALL, np.zeros(2), self.textures[0], 6.0)
        card, px, py = plane(CARD, card_offset(t), self.textures[1], 2.0)
        mask = (abs(px) < 0.35) & (abs(py) < 0.3)
        return (
            np.where(mask[..., None], card * 1.5 + 0.05, wall**2 * 1.2 + 0.02),
            mask,
            np.where(mask, CARD, WALL),
        )

    def flow(self, t: int, o: int) -> np.ndarray:
        """Exact optical flow (H, W, 2) from frame t to frame t + o."""
        _, mask, z = self.see(t)
        here, there = camera_center(t), camera_center(t + o)
        move = card_offset(t + o) - card_offset(t)
        x = self.dx * z + here[0] + mask * move[0] - there[0]
        y = self.dy * z + here[1] + mask * move[1] - there[1]
        return np.stack([x / z - self.dx, y / z - self.dy], -1) * self.f

    def write(self, folder: Path) -> Path:
        """The scene folder."""
        m = Manifest(
            source="toy",
            width=self.width,
            height=self.height,
            cycle=3,
            reference_bracket=1,
            bracket_ev=list(EV),
            exposure_given=True,
            near=1.8,
            far=5.0,
        )
        for t in range(self.frames):
            radiance, mask, z = self.see(t)
            name = f"{t:05d}"
            write_png(
                folder / f"images/{name}.png",
                np.clip(radiance * 2.0 ** EV[t % 3], 0, 1) ** (1 / 2.2),
            )
            write_png(folder / f"masks/{name}.png", mask)
            write_npy(folder / f"disparity/{name}.npy", (1 / z).astype(np.float16))
            entry = FrameEntry(
                index=t,
                image=f"images/{name}.png",
                source="toy",
                time=t,
                bracket=t % 3,
                ev=EV[t % 3],
                K=self.K.tolist(),
                c2w=np.c_[np.eye(3), camera_center(t)].tolist(),
                mask=f"masks/{name}.png",
                disparity=f"disparity/{name}.npy",
            )
            for o in (-1, 1):
                if 0 <= t + o < self.frames:
                    pair = f"raw_flow/{name}_{t + o:05d}"
                    write_npy(folder / f"{pair}.npy", self.flow(t, o).astype(np.float16))
                    write_png(
                        folder / f"{pair}_valid.png", np.ones((self.height, self.width), bool)
                    )
                    entry.flow[t + o] = FlowFiles(flow=f"{pair}.npy", valid=f"{pair}_valid.png")
            m.frames.append(entry)
        m.response, m.movers = "response.json", "movers.npz"
        video = np.stack([read_image(folder / f.image) for f in m.frames])
        write_estimates(folder, m, video)
        m.save(folder)
        return folder
