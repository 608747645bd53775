"""A browser's tab with the viewer's page: how it is opened, and what is read back."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from browser import Page

from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.page_file import PageSettings, make_page
from hdr_nsff.viewer.scene_file import SceneFile, to_bytes

SIZE = (160, 90)
TO_BASE64 = """a => {
  const bytes = new Uint8Array(a.buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192)
    text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}"""


def open_page(tab: Page, path: Path, scene: SceneFile, width: int = 500, height: int = 300) -> None:
    path.write_text(make_page(scene.title, to_bytes(scene), PageSettings()))
    tab.goto(path.as_uri(), width, height)


def view_of(scene: Scene, frame: int, time: float) -> dict[str, Any]:
    """A view for `readLinear`."""
    camera = scene.train[frame].camera.resized(*SIZE)
    pose = {"c2w": camera.c2w.tolist(), "K": camera.K.tolist()}
    return {"time": time, **pose, "width": SIZE[0], "height": SIZE[1]}


def read_linear(tab: Page, view: dict[str, Any]) -> torch.Tensor:
    """The page's exposed linear radiance and opacity (H, W, 4)."""
    text = tab.run(f"viewer.readLinear({json.dumps(view)}).then({TO_BASE64})")
    values = np.frombuffer(base64.b64decode(text), np.float32)
    return torch.from_numpy(values.copy()).view(view["height"], view["width"], 4)


def state(tab: Page, name: str) -> Any:
    return tab.run(f"viewer.state.{name}")


def png_text(bits: int) -> str:
    """An expression: the base64 text of the picture's PNG."""
    return (
        f"viewer.png({bits}).then(blob => blob.arrayBuffer())"
        f".then(data => new Uint8Array(data)).then({TO_BASE64})"
    )


def read_png(data: bytes, bits: int = 16) -> np.ndarray:
    """RGB (H, W, 3) in [0, 1] of a PNG without filters, by its own rules."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    place, body, header = 8, b"", b""
    while place < len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        chunk = data[place + 8 : place + 8 + length]
        (crc,) = struct.unpack(">I", data[place + 8 + length : place + 12 + length])
        assert crc == zlib.crc32(kind + chunk)
        body += chunk if kind == b"IDAT" else b""
        header = chunk if kind == b"IHDR" else header
        place += 12 + length
    width, height, *depth_and_color = struct.unpack(">IIBB", header[:10])
    assert depth_and_color == [bits, 2]
    rows = np.frombuffer(zlib.decompress(body), np.uint8).reshape(height, -1)
    assert not rows[:, 0].any()  # no filter
    samples = rows[:, 1:].copy().view(">u2" if bits == 16 else "u1")
    return samples.reshape(height, width, 3) / (2**bits - 1)
