"""Tone mappers with one exposure per bracket and one response per camera: `shared`, our
default, whose curve is learned; `fixed`, gamma 2.2; `mlp`, HDR-NeRF's network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from hdr_nsff.fields.base import Render
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.radiometry.response import Response
from hdr_nsff.scene.batch import PixelBatch, Recorder, Sensor
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap import curve
from hdr_nsff.tonemap.base import LN2, Recordings, ToneMapConfig, ToneMapper, drift_of
from hdr_nsff.tonemap.curve import GAMMA
from hdr_nsff.tonemap.fused_tone import Held, Learned, Recording, fused_recording
from hdr_nsff.tonemap.kernel import bin_table
from hdr_nsff.tonemap.photograph_cuda import photograph
from hdr_nsff.tonemap.responses import NetworkResponse, SharedResponse
from hdr_nsff.tonemap.vignetting import MIN_TRANSMISSION, Vignetting
from hdr_nsff.tonemap.vignetting_start import start_vignetting


class BracketGain(nn.Module):
    """Log gain: exposure + white balance + the frame's drift and residual.

    The exposure is the bracket's, the white balance the camera's. Drift is that of auto
    exposure and white balance, as `prepare` estimated it; residuals are learned. See
    docs/method.md#eq-9 and #eq-10.

    Known exposures are buffers and stay exactly what they are; unknown ones are
    parameters.
    """

    known: Tensor  # (B,) EV, 0 where unknown
    unknown: Tensor  # (U,) brackets to learn
    drift: Tensor  # (frames, 3) natural log, of every training frame

    def __init__(self, recordings: Recordings, with_residuals: bool) -> None:
        super().__init__()
        ev, reference = recordings.ev, recordings.reference
        unknown = [i for i, e in enumerate(ev) if e is None and i != reference]
        known = torch.tensor([e or 0.0 for e in ev], dtype=torch.float32)
        self.register_buffer("known", known, persistent=False)
        self.register_buffer("unknown", torch.tensor(unknown, dtype=torch.int64), persistent=False)
        self.learned_ev = nn.Parameter(torch.zeros(len(unknown)), requires_grad=bool(unknown))
        self.register_buffer("drift", drift_of(recordings) * LN2, persistent=False)
        others = recordings.num_cameras - 1
        self.white_balance = nn.Parameter(  # natural log
            torch.zeros(others, 3), requires_grad=others > 0
        )
        self.residual: nn.Parameter | None = None  # (frames, 3) natural log
        if with_residuals and recordings.brackets:
            self.residual = nn.Parameter(torch.zeros(len(recordings.brackets), 3))

    def ev(self) -> Tensor:
        """EV of every bracket (B,), the reference exactly 0."""
        return self.known.index_copy(0, self.unknown, self.learned_ev)

    def log_white_balance(self, camera_id: int) -> Tensor:
        """Natural log (3,), camera 0 exactly 0."""
        return torch.cat([self.white_balance.new_zeros(1, 3), self.white_balance])[camera_id]

    def forward(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        """Natural log gain (3,)."""
        log_gain = self.ev()[bracket] * LN2 + self.log_white_balance(camera_id)
        if frame is not None:
            log_gain = log_gain + self.drift[frame]
        if frame is not None and self.residual is not None:
            # Their mean is 0: the residuals cannot carry scale.
            log_gain = log_gain + self.residual[frame] - self.residual.mean(0)
        return log_gain


class BracketedToneMapper(ToneMapper):
    """One exposure per bracket; the response is the camera's, whatever the image."""

    bins: Tensor

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings)
        self.power = 1 / GAMMA if config.knots == "gamma" else 1.0
        self.register_buffer("bins", bin_table(self.knots), persistent=False)
        self.bracket_gain = BracketGain(
            recordings, with_residuals=config.kind == "shared" and config.residual
        )

    def log_gain(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        return self.bracket_gain(bracket, camera_id, frame)

    def log_white_balance(self, camera_id: int) -> Tensor:
        return self.bracket_gain.log_white_balance(camera_id)

    def respond(
        self,
        radiance: Tensor,
        gain: Tensor,
        camera_id: int,
        images: Tensor | int | None,
        leaky: bool,
    ) -> Tensor:
        leak = self.config.leak if leaky else None
        values = self.curve_values(camera_id, images)
        return curve.record(radiance, gain, values, self.knots, self.bins, self.power, leak)

    def inverse(
        self, rgb: Tensor, bracket: int, camera_id: int = 0, frame: int | None = None
    ) -> Tensor:
        with torch.no_grad():
            x = curve.invert(rgb, self.curve_values(camera_id, frame), self.knots)
            return x * (-self.log_gain(bracket, camera_id, frame)).exp()

    @torch.no_grad()
    def exposures(self) -> Tensor:
        return self.bracket_gain.ev().clone()

    @torch.no_grad()
    def set_exposures(self, ev: list[float]) -> None:
        """Start the unknown exposures from `ev` (B,); known ones stay.

        `ev` is relative to the reference bracket.
        """
        unknown = self.bracket_gain.unknown.tolist()
        self.bracket_gain.learned_ev.copy_(torch.tensor([ev[i] for i in unknown]))


class FixedToneMapper(BracketedToneMapper):
    """Gamma 2.2; exposures alone are learned."""

    fixed_curve: Tensor  # (3, 256)

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings)
        values = (self.knots ** (1 / GAMMA)).expand(3, -1).contiguous()
        self.register_buffer("fixed_curve", values, persistent=False)

    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        return self.fixed_curve

    def start(self, response: Response) -> None:
        self.set_exposures(response.ev.tolist())


class SharedToneMapper(BracketedToneMapper):
    """One monotone curve per camera and channel, anchored once it has converged."""

    anchor_curve: Tensor  # (C, 3, 256)
    anchor_ev: Tensor  # (B,)
    anchor_white_balance: Tensor  # (C - 1, 3)

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings)
        count = self.num_cameras
        self.response = SharedResponse(count, self.knots, config.min_step)
        self.register_buffer("anchor_curve", torch.zeros(count, 3, len(self.knots)))
        self.register_buffer("anchor_ev", torch.zeros(len(recordings.ev)))
        self.register_buffer("anchor_white_balance", torch.zeros(count - 1, 3))
        self.unread_terms: dict[str, Tensor] | None = None  # of the last recording
        self.vignetting: Vignetting | None = None
        if config.vignetting and recordings.corners:
            self.vignetting = Vignetting(recordings.corners)
            self.register_load_state_dict_pre_hook(without_vignetting)

    def start_vignetting(self, scene: Scene) -> None:
        if self.vignetting is not None:
            start_vignetting(self.vignetting, self, scene)

    def shade(
        self, radiance: Tensor, camera: Camera, camera_id: int, pixels: Tensor | None = None
    ) -> Tensor:
        if self.vignetting is None:
            return radiance
        if pixels is None:
            pixels = camera.pixel_grid()
        return self.vignetting.shade(radiance, camera, pixels, camera_id)

    def shading(self, camera_id: int) -> Callable[[Tensor, Camera, Tensor], Tensor] | None:
        if self.vignetting is None:
            return None
        return lambda radiance, camera, pixels: self.shade(radiance, camera, camera_id, pixels)

    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        return self.response.values(camera_id)

    def forward(
        self,
        radiance: Tensor,
        bracket: int,
        camera_id: int = 0,
        frame: int | None = None,
        leaky: bool = True,
    ) -> Tensor:
        if not kernels_on(self.knots.device):
            return super().forward(radiance, bracket, camera_id, frame, leaky)
        assert radiance.shape[-1] == 3, radiance.shape
        recording = self.recording(bracket, camera_id, frame)
        if torch.is_grad_enabled():
            self.unread_terms = recording.terms
        leak = self.config.leak if leaky else None
        given = self.knots, self.bins, self.power, leak
        return curve.record(radiance.float(), recording.gain, recording.curve, *given)

    def recorder(
        self, bracket: int, camera_id: int, frame: int | None = None, leaky: bool = False
    ) -> Recorder:
        """One recording; in training, kernels take it in numbers."""
        recorder = super().recorder(bracket, camera_id, frame, leaky)
        if not leaky or not kernels_on(self.knots.device):
            return recorder
        recording = self.recording(bracket, camera_id, frame)
        self.unread_terms = recording.terms
        given = recording.gain, recording.curve, self.knots, self.config.leak
        sensor = Sensor.without_lens(*given)
        if self.vignetting is not None:
            sensor = replace(
                sensor,
                vignetting=self.vignetting.coefficients,
                corners=self.vignetting.corners,
                camera_id=camera_id,
                least=MIN_TRANSMISSION,
            )
        return replace(recorder, sensor=sensor)

    def record_render(self, render: Render, batch: PixelBatch, leaky: bool) -> Tensor:
        sensor = None if batch.recorder is None else batch.recorder.sensor
        if not leaky or sensor is None or render.rgb is not None or batch.camera.K.requires_grad:
            return super().record_render(render, batch, leaky)
        late = None
        if render.late is not None and render.late_share is not None:
            late = render.late, render.late_share
        return photograph(render.radiance, sensor, batch.camera, batch.pixels, late)

    def recording(self, bracket: int, camera_id: int, frame: int | None) -> Recording:
        """What records a frame, by CUDA kernels."""
        return fused_recording(self.learned(), self.held(), bracket, camera_id, frame)

    def learned(self) -> Learned:
        """What is learned, for CUDA kernels."""
        gain, none = self.bracket_gain, self.knots.new_empty(0, 3)
        residual = none if gain.residual is None else gain.residual
        vignetting = none if self.vignetting is None else self.vignetting.coefficients
        return Learned(
            self.response.logits, gain.learned_ev, gain.white_balance, residual, vignetting
        )

    def held(self) -> Held:
        """What is given and held, for CUDA kernels."""
        gain = self.bracket_gain
        given = gain.known, gain.unknown, gain.drift
        anchors = self.anchor_curve, self.anchor_ev, self.anchor_white_balance
        return Held(*given, *anchors, self.is_anchored(), self.config.min_step)

    def set_curve(self, x: Tensor, y: Tensor, camera_id: int | None = None) -> None:
        """Start the response from a curve y (3, M) over x (M,) in [0, 1].

        The response is that of one camera, or of all without `camera_id`.
        """
        self.response.set_values(curve.resample(x, y, self.knots), camera_id)

    def start(self, response: Response) -> None:
        """Curves, exposures and white balance from what `prepare` estimated.

        What static points determined for a single camera is anchored at once: a field
        that is still coarse would only bend it.
        """
        self.set_exposures(response.ev.tolist())
        if response.source != "static points":
            return
        x, y = torch.from_numpy(response.x), torch.from_numpy(response.y)
        for camera in range(self.num_cameras):
            self.set_curve(x, y[camera], camera)
        with torch.no_grad():
            stops = torch.from_numpy(response.white_balance[1:])
            self.bracket_gain.white_balance.copy_(stops * LN2)
        if self.num_cameras == 1:  # of several, white balance is refined first
            self.anchor()

    def regularizers(self) -> dict[str, Tensor]:
        """Smoothness of the curve, `gain_residual` and `response_anchor`.

        `gain_residual` is the mean square of the frames' residuals and of the log white
        balances: for a camera that recorded one bracket only, exposure and white
        balance cannot be separated. `response_anchor` is 0 until `anchor()`.

        CUDA kernels make the terms with a recording: those of the last one are read,
        once.
        """
        if kernels_on(self.knots.device):
            terms, self.unread_terms = self.unread_terms, None
            return self.recording(0, 0, None).terms if terms is None else terms
        gain = self.bracket_gain
        small = [t for t in (gain.residual, gain.white_balance) if t is not None and t.numel()]
        residual = self.knots.new_zeros(())
        if small:
            residual = torch.stack([t.square().mean() for t in small]).sum()
        terms = {
            "response_smoothness": curve.smoothness(self.response.values(slice(None))),
            "gain_residual": residual,
            "response_anchor": self.anchor_distance(),
        }
        if self.vignetting is not None:
            terms["vignetting"] = self.vignetting.size()
        return terms

    def anchor_distance(self) -> Tensor:
        """Mean square distance from the values that `anchor()` held.

        These are curves, exposures (natural log) and white balances.
        """
        if not self.is_anchored():
            return self.knots.new_zeros(())
        distance = (self.response.values(slice(None)) - self.anchor_curve).square().mean()
        distance = distance + ((self.bracket_gain.ev() - self.anchor_ev) * LN2).square().mean()
        if self.num_cameras > 1:
            moved = self.bracket_gain.white_balance - self.anchor_white_balance
            distance = distance + moved.square().mean()
        return distance

    @torch.no_grad()
    def anchor(self) -> None:
        """Remember curve, exposures and white balances as converged: `response_anchor`
        pulls towards them from now on (saved with the state).
        """
        self.anchor_curve.copy_(self.response.values(slice(None)))
        self.anchor_ev.copy_(self.bracket_gain.ev())
        self.anchor_white_balance.copy_(self.bracket_gain.white_balance)
        self.anchored.fill_(True)
        self.known_anchored = True


def without_vignetting(
    tonemapper: SharedToneMapper, state: dict[str, Tensor], prefix: str, *args: Any
) -> None:
    """Runs from before vignetting was learned have none."""
    assert tonemapper.vignetting is not None
    none = torch.zeros_like(tonemapper.vignetting.coefficients)
    state.setdefault(f"{prefix}vignetting.coefficients", none)


class NetworkToneMapper(BracketedToneMapper):
    """HDR-NeRF's response: a small network of the log exposure, one for all cameras."""

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings)
        gamma = (self.knots ** (1 / GAMMA)).expand(3, -1).contiguous()
        self.response = NetworkResponse(self.knots, gamma)

    def respond(
        self,
        radiance: Tensor,
        gain: Tensor,
        camera_id: int,
        images: Tensor | int | None,
        leaky: bool,
    ) -> Tensor:
        return self.response(radiance * gain)

    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        return self.response.values()

    def set_curve(self, x: Tensor, y: Tensor) -> None:
        """Start the network from a curve y (3, M) over x (M,) in [0, 1]."""
        self.response.set_values(curve.resample(x, y, self.knots))

    def start(self, response: Response) -> None:
        self.set_exposures(response.ev.tolist())
        if response.source == "static points":
            self.set_curve(torch.from_numpy(response.x), torch.from_numpy(response.y).mean(0))

    def regularizers(self) -> dict[str, Tensor]:
        return {
            "response_smoothness": curve.smoothness(self.response.values()),
            "unit_exposure": self.response.unit_point(),
        }
