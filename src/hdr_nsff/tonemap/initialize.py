"""The start of a tone mapper: response and exposures from the recordings of a scene."""

from __future__ import annotations

import numpy as np
import torch

from hdr_nsff.radiometry.debevec import (
    MAX_MISFIT,
    ResponseFit,
    brightness_ev,
    debevec,
    linked,
)
from hdr_nsff.radiometry.static_samples import ResponseView, static_samples
from hdr_nsff.scene.scene import Frame, Scene
from hdr_nsff.tonemap.tonemapper import ToneMapper


def initialize(tonemapper: ToneMapper, scene: Scene, num: int = 4000, seed: int = 0) -> str:
    """Start the response and the unknown exposures of `tonemapper` from the recordings
    of `scene`; says in a sentence how.

    From static points where there are enough of them; otherwise gamma 2.2, and
    exposures from the frames' brightness.
    """
    kind, ev, reference = (
        tonemapper.config.kind,
        tonemapper.given_ev,
        scene.manifest.reference_bracket,
    )
    if kind == "per_image" and not tonemapper.config.from_recordings:
        return "gamma 2.2 and gains of 1, as published"
    if len({f.bracket for f in scene.train}) == 1:
        return "gamma 2.2: a single exposure tells nothing of the response"
    problem = "as configured"
    if kind in ("shared", "per_image", "mlp"):
        views = [
            view_of(f)
            for f in scene.train
            if f.disparity is not None and scene.manifest.depth_kind == "scene"
        ]
        samples = static_samples(views, len(ev), num, np.random.default_rng(seed))
        brackets = {f.bracket for f in scene.train}
        fit = debevec(samples, ev, reference) if linked(samples, brackets) else None
        if fit is not None and fit.misfit < MAX_MISFIT:
            tonemapper.set_curve(torch.from_numpy(fit.x), torch.from_numpy(fit.y))
            tonemapper.set_exposures(fit.ev.tolist())
            own = camera_curves(tonemapper, scene, fit, num, seed) if kind == "shared" else ""
            if tonemapper.num_cameras == 1:  # the white balance of others is found with the field
                # measured, not guessed: a field that is still coarse would only bend it
                tonemapper.anchor()
            how = (
                "taken to be the likeliest steps, for recordings leave a common factor open: give `--ev` if you know them"
                if fit.guessed
                else "estimated with it"
            )
            return f"from {len(samples.rgb)} static points (misfit {fit.misfit:.3f} stops){own}; {exposure_note(tonemapper, how)}"
        problem = (
            "too few static points seen in several exposures"
            if fit is None
            else f"static points differ by {fit.misfit:.2f} stops"
        )
    images = [f.image.cpu().numpy() for f in scene.train]
    tonemapper.set_exposures(
        brightness_ev(images, [f.bracket for f in scene.train], reference, len(ev))
    )
    curve = {"none": "none", "sigmoid": "x / (1 + x)"}.get(kind, "gamma 2.2")
    return f"{curve} ({problem}); {exposure_note(tonemapper, 'from the brightness of the frames')}"


def camera_curves(
    tonemapper: ToneMapper, scene: Scene, fit: ResponseFit, num: int, seed: int
) -> str:
    """Give every camera with enough points of its own its own curve, at the exposures
    of the common `fit`; says which.
    """
    cameras = sorted({f.camera_id for f in scene.train})
    own = []
    for camera in cameras if len(cameras) > 1 else []:
        views = [
            view_of(f) for f in scene.train if f.disparity is not None and f.camera_id == camera
        ]
        samples = static_samples(views, len(fit.ev), num, np.random.default_rng(seed))
        seen = {v.bracket for v in views}
        if len(seen) > 1 and linked(samples, seen):
            mine = debevec(samples, fit.ev.tolist(), scene.manifest.reference_bracket)
            if mine.misfit < MAX_MISFIT:
                tonemapper.set_curve(torch.from_numpy(mine.x), torch.from_numpy(mine.y), camera)
                own.append(camera)
    if len(cameras) == 1:
        return ""
    return (
        f", own curves for cameras {own}, one for the others"
        if own
        else ", one curve for all cameras"
    )


def exposure_note(tonemapper: ToneMapper, how: str) -> str:
    """EVs in words."""
    ev = ", ".join(f"{e:+.2f}" for e in tonemapper.exposures().tolist())
    unknown = [i for i, e in enumerate(tonemapper.given_ev) if e is None]
    return f"EV {ev} " + (f"(unknown ones {how})" if len(unknown) else "(as given)")


def view_of(frame: Frame) -> ResponseView:
    """A frame's recording, camera and maps in numpy."""

    def array(t: torch.Tensor | None) -> np.ndarray | None:
        return None if t is None else t.cpu().numpy()

    disparity = array(frame.disparity)
    assert disparity is not None, frame.index
    return ResponseView(
        image=frame.image.cpu().numpy(),
        bracket=frame.bracket,
        time=frame.time,
        K=frame.camera.K.cpu().double().numpy(),
        c2w=frame.camera.c2w.cpu().double().numpy(),
        disparity=disparity,
        confidence=array(frame.disparity_confidence),
        moving=array(frame.moving),
    )
