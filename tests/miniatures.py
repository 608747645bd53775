"""Miniature public data sets that tests write: a textured wall at z = 4 with one red
dot, seen by cameras along x that turn a little.

`see` is the only way to a picture, so a reader that gets a convention wrong finds the
dot elsewhere.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.images import write_png
from hdr_nsff.core.io import write_npy

W, H, FOCAL = 48, 32, 40.0
WALL = 4.0
DOT = np.array([0.25, -0.15, WALL])
EV = (-2.0, 0.0, 2.0)
K = np.array([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]])
ANGLE = 2 * np.arctan(W / 2 / FOCAL)  # camera_angle_x
TEXTURE = cv2.GaussianBlur(
    np.kron(np.random.default_rng(3).random((80, 80)), np.ones((4, 4))), (0, 0), 2
).astype(np.float32)


def pose(x: float) -> np.ndarray:
    """c2w (3, 4) OpenCV of a camera at (x, 0.1 x, 0), turned a little."""
    turn = Rotation.from_euler("yxz", [-6 * x, 3 * x, 2 * x], degrees=True).as_matrix()
    return np.concatenate([turn, [[x], [0.1 * x], [0.0]]], 1)


def opengl(c2w: np.ndarray) -> list[list[float]]:
    """4x4 with columns right, up, back."""
    right, down, forward, center = c2w.T
    return np.stack(
        [np.append(right, 0), np.append(-down, 0), np.append(-forward, 0), np.append(center, 1)], 1
    ).tolist()


def dot_pixel(c2w: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """The projection (2,) px of the dot, without the code under test."""
    x, y, z = c2w[:, :3].T @ (DOT - c2w[:, 3])
    return scale * np.array([W / 2 + FOCAL * x / z, H / 2 + FOCAL * y / z])


def radiance(c2w: np.ndarray, scale: int = 1) -> np.ndarray:
    """What a camera sees (H, W, 3), linear; the dot is 10 times as bright as the wall
    and red.
    """
    y, x = (np.mgrid[: H * scale, : W * scale] + 0.5) / scale
    rays = np.stack([(x - W / 2) / FOCAL, (y - H / 2) / FOCAL, np.ones_like(x)], -1) @ c2w[:, :3].T
    points = c2w[:, 3] + rays * ((WALL - c2w[2, 3]) / rays[..., 2:])
    wall = cv2.remap(
        TEXTURE, *((points[..., k].astype(np.float32) + 4) * 40 for k in (0, 1)), cv2.INTER_LINEAR
    )
    dot = np.linalg.norm(points - DOT, axis=-1) < 0.16
    return np.where(
        dot[..., None], [2.0, 0, 0], 0.4 * np.stack([wall, wall, 0.8 * wall], -1) ** 2 + 0.01
    ).astype(np.float32)


def see(c2w: np.ndarray, ev: float = 0.0, scale: int = 1) -> np.ndarray:
    """What a camera records (H, W, 3) at an exposure, in 8 bits."""
    return np.rint(np.clip(radiance(c2w, scale) * 2.0**ev, 0, 1) ** (1 / 2.2) * 255) / 255


def found_dot(rgb: np.ndarray) -> np.ndarray:
    """Where the dot is in a picture (2,): the middle of what is red."""
    y, x = np.nonzero(rgb[..., 0] - rgb[..., 1] > 0.3)
    return np.array([x.mean() + 0.5, y.mean() + 0.5])


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


# HDR-GoPro / NSFF

COUNT, CAMERAS = 9, 3


def gopro_pose(camera: int) -> np.ndarray:
    return pose(0.3 * camera)


def gopro(root: Path, scale: int = 1, held_out: bool = True) -> Path:
    """Nine times, three cameras that take turns; camera k records at EV[k]."""
    dense = root / "dense"
    rows = []
    for i in range(COUNT):
        c2w, ev = gopro_pose(i % CAMERAS), EV[i % CAMERAS]
        right, down, forward, center = c2w.T
        # of pictures twice as large
        matrix = np.stack([down, right, -forward, center, np.array([2 * H, 2 * W, 2 * FOCAL])], 1)
        rows.append(np.append(matrix.ravel(), [3.0, 5.0]))
        picture = see(c2w, ev, scale)
        write_png(dense / f"images_{W * scale}x{H * scale}/{i:05d}.png", picture)
        write_png(dense / f"images/{i:05d}.png", see(c2w, ev, 2))
        write_png(dense / f"motion_masks/{i:05d}.png", left(3))
        write_png(root / f"masks/{i:05d}.png", ~left(5))
        # its unit is 2 scene units
        write_npy(dense / f"depth-anything/{i:05d}.npy", np.full((H, W), 2.0, np.float32))
        for j, side in ((i + 1, "fwd"), (i - 1, "bwd")):
            if 0 <= j < COUNT:
                flow = np.full((H, W, 2), [j - i, 0.5], np.float32)
                (dense / "flow_i1").mkdir(exist_ok=True)
                np.savez(
                    dense / f"flow_i1/{i:05d}_{side}.npz",
                    flow=flow,
                    mask=left(30).astype(np.float32),
                )
        if held_out:
            gopro_held_out(dense, i)
    np.save(dense / "poses_bounds.npy", np.array(rows))
    return root


def left(columns: int) -> np.ndarray:
    """A mask (H, W) of the leftmost columns."""
    return np.arange(W)[None].repeat(H, 0) < columns


def gopro_held_out(dense: Path, t: int) -> None:
    """What every camera saw at time t and half a frame later."""
    for k in range(CAMERAS):
        write_png(dense / f"mv_images/{t:05d}/{k + 1:05d}.png", see(gopro_pose(k), EV[k]))
        write_png(dense / f"mv_masks/{t:05d}/{k + 1:05d}.png", left(4 + k))
        if t < COUNT - 1:
            write_png(dense / f"mv_images_time/{t:05d}/{k + 1:05d}.png", see(gopro_pose(k), EV[k]))


def colmap(dense: Path, points: np.ndarray, names: Sequence[str] = ()) -> None:
    """`sparse/` of the tree: every picture sees every point of `points` (P, 3).

    Picture i is `names[i]`, else 00000.png, 00001.png, ...
    """
    names = names or [f"{i:05d}.png" for i in range(COUNT)]
    folder = dense / "sparse"
    folder.mkdir()
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ3d", 1, 1, 0, W, H, FOCAL, W / 2, H / 2)
    )
    images = struct.pack("<Q", COUNT)
    for i in range(COUNT):
        c2w = gopro_pose(i % CAMERAS)
        q = np.roll(Rotation.from_matrix(c2w[:, :3].T).as_quat(), 1)
        local = (points - c2w[:, 3]) @ c2w[:, :3]
        xy = local[:, :2] / local[:, 2:] * FOCAL + [W / 2, H / 2]
        images += (
            struct.pack("<i7di", i + 1, *q, *(-c2w[:, :3].T @ c2w[:, 3]), 1)
            + names[i].encode()
            + b"\0"
        )
        images += struct.pack("<Q", len(points)) + b"".join(
            struct.pack("<ddq", *p, k + 1) for k, p in enumerate(xy)
        )
    (folder / "images.bin").write_bytes(images)
    cloud = struct.pack("<Q", len(points))
    for k, p in enumerate(points):
        track = [n for i in range(COUNT) for n in (i + 1, k)]
        cloud += struct.pack(f"<Q3d3BdQ{2 * COUNT}i", k + 1, *p, 1, 2, 3, 0.4, COUNT, *track)
    (folder / "points3D.bin").write_bytes(cloud)


# Blender


def blender_pose(t: float) -> np.ndarray:
    return pose(0.15 * t)


def blender(root: Path, kind: str = "hexplane", transparent: bool = True) -> Path:
    """Ten times: 4 and 8 are held out. `kind`: dnerf (times in [0, 1]), hexplane
    (stops), hdr4d (exposure times, EXR), nerf (still).
    """
    for split, times in (("train", [0, 1, 2, 3, 5, 6, 7, 9]), ("test", [4, 8])):
        frames = []
        for n, t in enumerate(times):
            c2w = blender_pose(t)
            ev = 0.0 if kind in ("dnerf", "nerf") else EV[t % 3]
            name = f"./{split}/{n:04d}"
            frame: dict[str, Any] = {"file_path": name, "transform_matrix": opengl(c2w)}
            if kind != "nerf":
                frame["time"] = t / 9 if kind == "dnerf" else t
            if kind in ("hexplane", "hdr4d"):
                frame["exposures"] = 2.0**ev if kind == "hdr4d" else ev
            if kind == "hdr4d":
                frame["exr_file_path"] = f"{name}.exr"
                write_exr(root / f"{name}.exr", {"RGB": radiance(c2w)}, half=False)
            if kind in ("hexplane", "hdr4d"):
                frame["file_path"] += ".png"
            write_rgba(root / f"{name}.png", see(c2w, ev), transparent)
            frames.append(frame)
        write_json(
            root / f"transforms_{split}.json",
            {"camera_angle_x": ANGLE, "near": 2.0, "far": 6.0, "frames": frames},
        )
    return root


def write_rgba(path: Path, rgb: np.ndarray, transparent: bool) -> None:
    """A PNG whose two lowest rows are a quarter opaque."""
    alpha = np.ones((*rgb.shape[:2], 1))
    alpha[-2:] = 0.25 if transparent else 1.0
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(
        str(path), np.rint(np.concatenate([rgb[..., ::-1], alpha], -1) * 255).astype(np.uint8)
    )


# HDR-NeRF


def hdr_nerf(root: Path) -> Path:
    """Six training and two test views, five exposures two stops apart."""
    for split, places in (("train", range(6)), ("test", (1.5, 3.5))):
        frames, exposures = [], {}
        for n, x in enumerate(places):
            c2w, name = pose(0.2 * x), f"./{split}/r_{n}"
            frames.append({"file_path": name, "transform_matrix": opengl(c2w)})
            for e in range(5):
                ev = 2.0 * (e - 2)
                exposures[f"{name}_{e}.png"] = 2.0**ev
                write_png(root / f"{name}_{e}.png", see(c2w, ev))
            if split == "test":
                write_exr(root / f"test_hdr/hdr_{n:03d}.exr", {"RGB": radiance(c2w)}, half=False)
        write_json(root / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})
        write_json(root / f"exposure_{split}.json", exposures)
    return root


def hdr_nerf_real(root: Path) -> Path:
    """Twelve poses, five exposures each, two stops apart."""
    rows = []
    for n in range(12):
        c2w = pose(0.1 * n)
        right, down, forward, center = c2w.T
        # of pictures twice as large
        matrix = np.stack([down, right, -forward, center, np.array([2 * H, 2 * W, 2 * FOCAL])], 1)
        for e in range(5):
            ev = 2.0 * (e - 2)
            rows.append([*matrix.ravel(), 3.0, 5.0, 2.0**ev])
            write_png(root / f"input_images/{n:03d}_{e}.png", see(c2w, ev))
    write_npy(root / "poses_bounds_exps.npy", np.array(rows))
    return root


# nerfstudio


def nerfstudio(root: Path, **changes: Any) -> Path:
    """Eight pictures in no order of the list, one of them held out, with depth in
    millimeters.
    """
    frames = []
    for n in (3, 0, 1, 2, 4, 5, 7, 6):
        c2w = pose(0.15 * n)
        write_png(root / f"images/frame_{n:05d}.png", see(c2w))
        write_npy(root / f"depth/{n}.npy", np.full((H, W), 1000 * WALL, np.float32))
        frames.append(
            {
                "file_path": f"images/frame_{n:05d}.png",
                "transform_matrix": opengl(c2w),
                "depth_file_path": f"depth/{n}.npy",
                "mask_path": f"masks/{n}.png",
            }
        )
    document = {
        "camera_model": "OPENCV",
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": W / 2,
        "cy": H / 2,
        "w": W,
        "h": H,
        "frames": frames,
        "test_filenames": ["images/frame_00004.png"],
    }
    write_json(root / "transforms.json", document | changes)
    return root
