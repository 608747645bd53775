"""The tone mapper: linear HDR radiance to what the camera recorded, learned.

It computes `rgb = g(gain * radiance)` (eq. 9-10).

Gauge: recordings alone leave scale and power of the radiance free, so construction
fixes these. The gain of the reference bracket and the white balance of camera 0 are
exactly 1, per-frame residuals have mean 0, and every response has g(0) = 0, g(1) = 1.
Hence radiance 1 is where a channel saturates at the reference exposure: with one free
curve per channel the camera's own white balance is part of that unit, per channel, and
only known exposures fix the power (with learned ones E^p explains the same recordings;
the initial curve and the anchor decide). EV is log2 of exposure, relative to the
reference bracket; gains are natural logs inside.

`ToneMapper` is what everything else uses; one class per kind implements it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le, Lt
from torch import Tensor, nn

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.core.settings import Advanced, Weight
from hdr_nsff.fields.base import Render
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.radiometry.response import Response
from hdr_nsff.scene.batch import PixelBatch, Recorder
from hdr_nsff.scene.manifest import bracket_problem
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.curve import knot_positions

LN2 = math.log(2.0)


@dataclass(frozen=True)
class ToneMapLosses:
    """Weights of the tone mapper's own terms; 0 turns one off."""

    response_smoothness: Weight = 1e-3
    """Eq. 15: squared second differences of the curve; per_image: of all images' and
    channels' curves together, as printed.
    """
    unit_exposure: Weight = 0.5
    """mlp: distance of the network from mid gray at the unit exposure."""
    gain_residual: Weight = 1.0
    """shared: square of the frames' deviations from their bracket's gain."""
    response_anchor: Weight = 100.0
    """shared: distance from the curve and exposures held since `anchor_at`."""
    vignetting: Weight = 1e-3
    """shared: mean square of the coefficients of vignetting."""


@dataclass(frozen=True)
class ToneMapConfig:
    """How radiance becomes recorded rgb."""

    kind: Literal["shared", "per_image", "mlp", "fixed", "sigmoid", "none"] = "shared"
    """shared: one monotone curve per camera and one exposure per bracket; per_image:
    the paper's free gain and curve per image; mlp: HDR-NeRF's network for the curve;
    fixed: gamma 2.2; sigmoid: HDR-HexPlane's x / (1 + x), one exposure per image; none:
    radiance is taken for rgb (plain NSFF).
    """
    knots: Advanced[Literal["gamma", "even"]] = "gamma"
    """Where the curve's 256 points lie on [0, 1]: evenly in x^(1/2.2), which resolves
    the darks, or evenly in x (paper).
    """
    leak: Advanced[Annotated[float, Ge(0), Le(1)]] = 0.01
    """Slope parameter of eq. 11 beyond [0, 1]."""
    residual: Advanced[bool] = True
    """shared: let every training frame deviate a little from its bracket's gain
    (flicker, drifting white balance).
    """
    vignetting: Advanced[bool] = True
    """shared: learn the fall-off of light towards the corners, where the camera moves
    enough to determine it.
    """
    from_recordings: Advanced[bool] = True
    """per_image: start at the response that `prepare` estimated; else at gamma 2.2 and
    gains of 1, as published.
    """
    min_step: Advanced[Annotated[float, Ge(0), Lt(1)]] = 1e-3
    """shared: smallest step of the curve between two points as a share of the mean
    step; keeps it invertible.
    """
    loss: Advanced[ToneMapLosses] = field(default_factory=ToneMapLosses)


@dataclass(frozen=True)
class Recordings:
    """What a tone mapper knows of the frames it is trained on."""

    brackets: tuple[int, ...]  # of every training frame
    cameras: tuple[int, ...]  # physical camera of every training frame
    ev: tuple[float | None, ...]  # of every bracket, None where it is to be learned
    reference: int  # bracket
    num_cameras: int
    # stops by which every training frame differs from its bracket (auto exposure);
    # empty: none does
    drift: tuple[float, ...] = ()
    # stops (3,) by which its white balance differs from the clip's; empty: none does
    balance: tuple[tuple[float, ...], ...] = ()
    # of every camera, where vignetting can be learned (see `vignetting_corners`)
    corners: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        assert len(self.brackets) == len(self.cameras), (self.brackets, self.cameras)
        if problem := bracket_problem(self.brackets, self.ev, self.reference):
            raise InputError(f"scene.json: {problem}")


class ToneMapper(nn.Module, ABC):
    """Radiance to recorded rgb and back. Frames are positions in `Scene.train`; a frame
    of None is any other view.
    """

    knots: Tensor  # (256,)
    anchored: Tensor  # () bool

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__()
        self.config, self.recordings = config, recordings
        self.given_ev = recordings.ev
        self.frame_brackets, self.frame_cameras = recordings.brackets, recordings.cameras
        self.num_cameras = recordings.num_cameras
        self.reference_frame = 0
        if recordings.reference in recordings.brackets:
            self.reference_frame = recordings.brackets.index(recordings.reference)
        self.register_buffer("knots", knot_positions(config.knots), persistent=False)
        self.register_buffer("anchored", torch.zeros((), dtype=torch.bool))
        self.known_anchored: bool | None = None  # the buffer on the host, once it was read
        self.register_load_state_dict_post_hook(forget_anchored)

    def is_anchored(self) -> bool:
        """Whether `anchor` was called, without waiting for a GPU at every step."""
        if self.known_anchored is None:
            self.known_anchored = bool(self.anchored)
        return self.known_anchored

    # What a kind has to say

    @abstractmethod
    def log_gain(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        """Natural log gain (3,), eq. 10."""

    @abstractmethod
    def respond(
        self,
        radiance: Tensor,
        gain: Tensor,
        camera_id: int,
        images: Tensor | int | None,
        leaky: bool,
    ) -> Tensor:
        """g(gain * radiance) (N, 3) of radiance (N, 3) and gain (3,).

        g is the response of `camera_id`, or of `images` of the training frames.
        """

    @abstractmethod
    def inverse(
        self, rgb: Tensor, bracket: int, camera_id: int = 0, frame: int | None = None
    ) -> Tensor:
        """Radiance (N, 3) that would be recorded as `rgb` (N, 3), without gradients.

        Trust it only where `informative(rgb)`.
        """

    @abstractmethod
    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        """The response at the knots (3, 256)."""

    @abstractmethod
    def start(self, response: Response) -> None:
        """Start where `prepare` estimated the response."""

    # What everything else uses

    def start_vignetting(self, scene: Scene) -> None:
        """Start the fall-off towards the corners, after `start`, at what static points
        of a scene show; only the shared kind learns one.
        """

    def forward(
        self,
        radiance: Tensor,
        bracket: int,
        camera_id: int = 0,
        frame: int | None = None,
        leaky: bool = True,
    ) -> Tensor:
        """Recorded rgb (N, 3) of `radiance` (N, 3) >= 0 through the frame's gain and
        response (eq. 9-10).

        `leaky` (training): eq. 11 beyond [0, 1], so that saturated pixels keep a
        gradient; otherwise clamped to [0, 1].
        """
        assert radiance.shape[-1] == 3, radiance.shape
        gain = self.log_gain(bracket, camera_id, frame).exp()
        images = self.images_of(bracket) if frame is None else frame
        return self.respond(radiance.float(), gain, camera_id, images, leaky)

    def shade(
        self, radiance: Tensor, camera: Camera, camera_id: int, pixels: Tensor | None = None
    ) -> Tensor:
        """What of `radiance` (N, 3) the lens of a camera passes to `pixels` (N, 2), by
        default all of a picture: pass it on to `forward` or a recorder.
        """
        return radiance

    def record(self, radiance: Tensor, batch: PixelBatch, leaky: bool) -> Tensor:
        """What the camera of a `batch` records of `radiance` (N, 3) at its pixels."""
        shaded = self.shade(radiance, batch.camera, batch.camera_id, batch.pixels)
        return self(shaded, batch.bracket, batch.camera_id, batch.frame, leaky)

    def record_render(self, render: Render, batch: PixelBatch, leaky: bool) -> Tensor:
        """What the camera of a `batch` records (N, 3) of all that a field rendered."""
        if render.rgb is not None:
            return render.rgb
        rgb = self.record(render.radiance, batch, leaky)
        if render.late is None or render.late_share is None:
            return rgb
        return torch.lerp(rgb, render.late, render.late_share)

    def develop(self, radiance: Tensor, ev: float, camera_id: int = 0) -> Tensor:
        """The picture (..., 3) in [0, 1] that camera `camera_id` would record of
        `radiance` (..., 3) at `ev` relative to the reference bracket.
        """
        flat = radiance.reshape(-1, 3).float()
        with torch.no_grad():
            gain = (self.log_white_balance(camera_id) + ev * LN2).exp()
            rgb = self.respond(flat, gain, camera_id, self.reference_frame, leaky=False)
        return rgb.reshape(radiance.shape)

    def log_white_balance(self, camera_id: int) -> Tensor:
        """Natural log (3,), camera 0 exactly 0."""
        return torch.zeros(3, device=self.knots.device)

    def recorder(
        self, bracket: int, camera_id: int, frame: int | None = None, leaky: bool = False
    ) -> Recorder:
        """One recording, for fields that record before they composite."""
        images = self.images_of(bracket).tolist() if frame is None else [frame]
        return Recorder(
            lambda radiance: self(radiance, bracket, camera_id, frame, leaky),
            tuple(images),
            self.shading(camera_id),
        )

    def drifted_recorder(self, bracket: int, camera_id: int, drift: Tensor) -> Recorder:
        """The same of a view that is no training frame, whose exposure and white
        balance differ from those of its bracket by `drift` (3,) stops.
        """
        images = self.images_of(bracket)

        def record(radiance: Tensor) -> Tensor:
            gain = self.log_gain(bracket, camera_id, None)
            gain = (gain + drift.to(gain) * LN2).exp()
            return self.respond(radiance.float(), gain, camera_id, images, leaky=False)

        return Recorder(record, tuple(images.tolist()), self.shading(camera_id))

    def recorder_at(self, ev: float, camera_id: int = 0, lens: bool = False) -> Recorder:
        """The same of a picture developed at `ev`; it looks like the training images of
        the nearest exposure. With `lens` it is as dark towards the corners as these.
        """
        nearest = int((self.exposures() - ev).abs().argmin())
        images = tuple(self.images_of(nearest).tolist())
        shade = self.shading(camera_id) if lens else None
        return Recorder(lambda radiance: self.develop(radiance, ev, camera_id), images, shade)

    def shading(self, camera_id: int) -> Callable[[Tensor, Camera, Tensor], Tensor] | None:
        """`shade` of a camera, for recorders; None where its lens passes all light."""
        return None

    def neutral(self, camera_id: int = 0) -> Tensor:
        """Gains (3,), geometric mean 1, that make mid gray neutral.

        Mid gray is what the camera records as such at the reference exposure.

        Radiance is in the camera's own units, per channel (the gauge): for looking at,
        its white balance has to be put in.
        """
        bracket = self.frame_brackets[self.reference_frame]
        mid_gray = torch.full((1, 3), 0.5, device=self.knots.device)
        radiance = self.inverse(mid_gray, bracket, camera_id, self.neutral_frame)[0]
        radiance = radiance.clamp_min(1e-9)
        return radiance.log().mean().exp() / radiance

    @property
    def neutral_frame(self) -> int | None:
        """The frame whose response `neutral` is taken from, None for the camera's."""
        return None

    def images_of(self, bracket: int) -> Tensor:
        """Positions of the training images of a bracket; all of them where the bracket
        was never trained.
        """
        found = [i for i, b in enumerate(self.frame_brackets) if b == bracket]
        if not found:
            found = list(range(len(self.frame_brackets)))
        return torch.tensor(found, device=self.knots.device)

    @torch.no_grad()
    def gains(self) -> Tensor:
        """EV of the gain (log2) of every training frame and channel, (frames, 3), for
        reports.
        """
        frames = zip(self.frame_brackets, self.frame_cameras, strict=True)
        return torch.stack([self.log_gain(b, c, i) / LN2 for i, (b, c) in enumerate(frames)])

    @torch.no_grad()
    def exposures(self) -> Tensor:
        """EV of every bracket (B,) relative to the reference."""
        gains = self.gains().mean(-1)
        brackets = range(max(self.frame_brackets, default=0) + 1)
        return torch.stack([gains[self.images_of(b)].mean() for b in brackets])

    @torch.no_grad()
    def curve(self, camera_id: int = 0) -> tuple[Tensor, Tensor]:
        """The response: exposure x (256,) in [0, 1] and recorded y (3, 256)."""
        values = self.curve_values(camera_id, self.reference_frame)
        return self.knots.clone(), values.clone()

    def regularizers(self) -> dict[str, Tensor]:
        """Terms for the objective, by their name in `ToneMapLosses`."""
        return {}

    def anchor(self) -> None:
        """From now on, hold what has converged (only the shared kind does)."""

    def known_ev(self, response: Response) -> list[float]:
        """EV of every bracket: as given, else as estimated."""
        pairs = zip(response.ev.tolist(), self.given_ev, strict=True)
        return [estimate if known is None else known for estimate, known in pairs]

    def param_groups(self, lr: float) -> list[ParamGroup]:
        """Everything that is learned here, at one rate."""
        params = [p for p in self.parameters() if p.numel()]
        return [ParamGroup(params, lr)] if params else []


def drift_of(recordings: Recordings) -> Tensor:
    """Stops (frames, 3) by which every training frame differs from its bracket."""
    count = len(recordings.brackets)
    exposure = torch.tensor(recordings.drift or [0.0] * count, dtype=torch.float32)
    balance = torch.tensor(recordings.balance or [[0.0] * 3] * count, dtype=torch.float32)
    return exposure[:, None] + balance.view(count, 3)


def informative(rgb: Tensor, low: float = 3 / 255, high: float = 250 / 255) -> Tensor:
    """True (N,) where recorded `rgb` (N, 3) determines its radiance: every channel away
    from black and from saturation.
    """
    return ((rgb >= low) & (rgb <= high)).all(-1)


def forget_anchored(tonemapper: ToneMapper, keys: object) -> None:
    """Another state was loaded: read again whether it is anchored."""
    tonemapper.known_anchored = None
