"""The page's shader develops as `viewer/display.py` does in numpy: in headless
Chromium, from maps that are handed to the shader. Skipped where there is no Chromium.
"""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
from browser import Page, find_browser
from viewer_scenes import trained
from viewer_tab import TO_BASE64

from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer import display

if find_browser() is None:
    pytest.skip("no Chromium", allow_module_level=True)

HEIGHT, WIDTH = 24, 64
DEVELOP = f"""(text, width, height, look) => {{
  const {{ renderer }} = viewer, {{ gl }} = renderer;
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const maps = renderer.target("given", width, height);
  gl.bindTexture(gl.TEXTURE_2D, maps.texture);
  const place = [gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.HALF_FLOAT];
  gl.texSubImage2D(...place, new Uint16Array(bytes.buffer));
  const picture = renderer.target("developed", width, height, renderer.deepFormat());
  renderer.develop(maps, {{ ...viewer.state, ...look }}, picture);
  return ({TO_BASE64})(renderer.read(picture));
}}"""


def developed(viewer: Page, maps: np.ndarray, **look: object) -> np.ndarray:
    """What the shader makes (H, W, 3) of maps (H, W, 4) of half floats."""
    upward = np.ascontiguousarray(maps[::-1])
    text = json.dumps(base64.b64encode(upward.tobytes()).decode())
    call = f"({DEVELOP})({text}, {WIDTH}, {HEIGHT}, {json.dumps(look)})"
    values = np.frombuffer(base64.b64decode(viewer.run(call)), np.float32)
    return values.reshape(HEIGHT, WIDTH, 4)[..., :3]


def radiance() -> np.ndarray:
    """24 stops of light from left to right, in another color in every row, as maps."""
    stops = np.linspace(-12, 12, WIDTH)
    tint = np.random.default_rng(0).uniform(0.05, 1, (HEIGHT, 1, 3))
    light = 2.0 ** stops[None, :, None] * tint
    return np.concatenate([light, np.ones((HEIGHT, WIDTH, 1))], -1).astype(np.float16)


def exposed(maps: np.ndarray, toy: Scene, ev: float) -> np.ndarray:
    """Exposed light (H, W, 3) of these maps, gray neutral."""
    neutral = trained(toy)[1].neutral(0).numpy()
    return maps[..., :3].astype(np.float32) * neutral * np.float32(2.0**ev)


@pytest.mark.parametrize("curve", ["agx", "neutral", "reinhard", "clip"])
@pytest.mark.parametrize("ev", [-3, 0, 3])
def test_curves_are_those_of_numpy(viewer: Page, toy: Scene, curve: str, ev: int) -> None:
    maps = radiance()
    expected = display.develop(exposed(maps, toy, ev), curve)
    assert expected.min() < 0.05 and expected.max() > 0.95
    np.testing.assert_allclose(developed(viewer, maps, curve=curve, ev=ev), expected, atol=1e-4)


def test_false_color_has_the_bands_of_numpy(viewer: Page, toy: Scene) -> None:
    maps = radiance()
    expected = display.false_color(exposed(maps, toy, 0))
    assert len(np.unique(expected.reshape(-1, 3), axis=0)) == 9
    found = developed(viewer, maps, curve="clip", falseColor=True, ev=0)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_clipped_pixels_are_striped_as_by_numpy(viewer: Page, toy: Scene) -> None:
    maps = radiance()
    plain = display.develop(exposed(maps, toy, -2), "clip")
    expected = display.mark_clipping(plain)
    for color in (display.BURNT_OUT_COLOR, display.BLACK_COLOR):
        assert 0.05 < (expected == color).all(-1).mean() < 0.3
    found = developed(viewer, maps, curve="clip", clipping=True, ev=-2)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_motion_and_flow_have_the_colors_of_numpy(viewer: Page) -> None:
    draw = np.random.default_rng(1)
    maps = draw.uniform(-2, 2, (HEIGHT, WIDTH, 4)).astype(np.float16)
    found = developed(viewer, maps, show="motion")
    expected = display.motion_color(maps[..., 1].astype(np.float32))
    np.testing.assert_allclose(found, expected, atol=1e-4)
    found = developed(viewer, maps, show="flow")
    expected = display.flow_color(maps[..., :2].astype(np.float32))
    np.testing.assert_allclose(found, expected, atol=1e-4)
