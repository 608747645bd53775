"""The tone mapper: linear HDR radiance in, what the camera recorded out (`rgb = g(gain
* radiance)`, eq. 9-10), learned.

Gauge: recordings alone leave scale and power of the radiance free, so these are fixed
by construction. The gain of the reference bracket and the white balance of camera 0 are
exactly 1, per-frame residuals have mean 0, and every response has g(0) = 0, g(1) = 1.
Hence radiance 1 is where a channel saturates at the reference exposure: with one free
curve per channel the camera's own white balance is part of that unit, per channel, and
only known exposures fix the power (with learned ones E^p explains the same recordings;
the initial curve and the anchor decide). EV is log2 of exposure, relative to the
reference bracket; gains are natural logs inside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from hdr_nsff.core.errors import InputError
from hdr_nsff.scene.batch import Recorder
from hdr_nsff.scene.manifest import bracket_problem
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.kernel import Respond, bin_table
from hdr_nsff.tonemap.responses import GAMMA, ImageResponse, NetworkResponse, SharedResponse

NUM_POINTS = 256
LN2 = math.log(2.0)


@dataclass(frozen=True)
class ToneMapConfig:
    """How radiance becomes recorded rgb."""

    kind: Literal["shared", "per_image", "mlp", "fixed", "sigmoid", "none"] = "shared"
    """shared: one monotone curve per camera and one exposure per bracket; per_image:
    the paper's free gain and curve per image; mlp: HDR-NeRF's network for the curve;
    fixed: gamma 2.2; both with one exposure per bracket; sigmoid: HDR-HexPlane's fixed
    x / (1 + x) with one exposure per image; none: radiance is taken for rgb (plain
    NSFF).
    """
    knots: Literal["gamma", "even"] = "gamma"
    """Where the curve's 256 points lie on [0, 1]: evenly in x^(1/2.2), which resolves
    the darks, or evenly in x (paper).
    """
    leak: float = 0.01
    """Slope parameter of eq. 11 beyond [0, 1]."""
    residual: bool = True
    """shared: let every training frame deviate a little from its bracket's gain
    (flicker, drifting white balance).
    """
    from_recordings: bool = True
    """per_image: start gains and curves where the others start; else at 1 and gamma
    2.2, as published.
    """
    min_step: float = 1e-3
    """shared: smallest step of the curve between two points as a share of the mean
    step; keeps it invertible.
    """


def knot_positions(spacing: Literal["gamma", "even"], num: int = NUM_POINTS) -> Tensor:
    """Knots (num,) on [0, 1], ends included: evenly in x^(1/2.2) or evenly in x."""
    u = torch.linspace(0, 1, num, dtype=torch.float64)
    return (u**GAMMA if spacing == "gamma" else u).float()


def piecewise_linear(x: Tensor, values: Tensor, knots: Tensor, power: float) -> Tensor:
    """g(x) (N, 3) by linear interpolation of `values` (3, K) at `knots` (K,), which lie
    evenly in x^power; x (N, 3) is clamped to [0, 1].

    Differentiable in x (zero outside [0, 1]) and in `values`. The bin comes in closed
    form; where rounding puts x just outside its bin, the line is extended, which
    differs by rounding only.
    """
    inside = x.clamp(0, 1)
    last = len(knots) - 2
    place = inside.detach() if power == 1 else inside.detach().pow(power)
    bins = (
        (place * (last + 1)).to(torch.int64).clamp_(0, last)
    )  # (N, 3); NaN has no bin and stays NaN
    share = (inside - knots[bins]) * (1 / (knots[1:] - knots[:-1]))[bins]
    columns = values.T
    left = columns.gather(0, bins)
    return left + (columns.gather(0, bins + 1) - left) * share


def leaky_ends(x: Tensor, y: Tensor, leak: float) -> Tensor:
    """Eq. 11 as printed: `leak * x` below 0, `-leak / sqrt(x) + leak + 1` above 1, `y`
    = g(x) between; continuous at both ends.
    """
    above = 1 + leak - leak * torch.rsqrt(x.clamp_min(1.0))
    return torch.where(x > 1, above, torch.where(x < 0, leak * x, y))


class BracketGain(nn.Module):
    """log gain = exposure of the bracket + white balance of the camera + residual of
    the frame (METHOD.md 1).

    Known exposures are buffers and stay exactly what they are; unknown ones are
    parameters.
    """

    def __init__(
        self, bracket_ev: Sequence[float | None], reference: int, num_cameras: int, num_frames: int
    ) -> None:
        super().__init__()
        unknown = [i for i, ev in enumerate(bracket_ev) if ev is None and i != reference]
        self.register_buffer(
            "known",
            torch.tensor([ev or 0.0 for ev in bracket_ev], dtype=torch.float32),
            persistent=False,
        )
        self.register_buffer("unknown", torch.tensor(unknown, dtype=torch.int64), persistent=False)
        self.learned_ev = nn.Parameter(torch.zeros(len(unknown)), requires_grad=bool(unknown))
        self.white_balance = nn.Parameter(
            torch.zeros(num_cameras - 1, 3), requires_grad=num_cameras > 1
        )  # natural log
        self.residual = (
            nn.Parameter(torch.zeros(num_frames, 3)) if num_frames else None
        )  # natural log

    known: Tensor
    unknown: Tensor

    def ev(self) -> Tensor:
        """EV of every bracket (B,), the reference exactly 0."""
        return self.known.index_copy(0, self.unknown, self.learned_ev)

    def log_white_balance(self, camera_id: int) -> Tensor:
        """Natural log (3,), camera 0 exactly 0."""
        return torch.cat([self.white_balance.new_zeros(1, 3), self.white_balance])[camera_id]

    def forward(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        """Natural log gain (3,)."""
        log_gain = self.ev()[bracket] * LN2 + self.log_white_balance(camera_id)
        if frame is not None and self.residual is not None:
            log_gain = (
                log_gain + self.residual[frame] - self.residual.mean(0)
            )  # mean 0: the residuals cannot carry scale
        return log_gain


class ToneMapper(nn.Module):
    """Radiance to recorded rgb and back. Frames are positions in `Scene.train`; a frame
    of None is any other view.
    """

    def __init__(
        self,
        config: ToneMapConfig,
        frame_brackets: Sequence[int],
        frame_cameras: Sequence[int],
        bracket_ev: Sequence[float | None],
        reference_bracket: int = 0,
        num_cameras: int | None = None,
    ) -> None:
        """`frame_brackets` and `frame_cameras` give each training frame's bracket and
        camera; `bracket_ev` the known EVs, None = to be learned.
        """
        super().__init__()
        assert len(frame_brackets) == len(frame_cameras), (len(frame_brackets), len(frame_cameras))
        if problem := bracket_problem(frame_brackets, bracket_ev, reference_bracket):
            raise InputError(f"scene.json: {problem}")
        self.config, self.given_ev = config, tuple(bracket_ev)
        self.frame_brackets, self.frame_cameras = tuple(frame_brackets), tuple(frame_cameras)
        self.num_cameras = num_cameras or max(frame_cameras, default=0) + 1
        self.reference_frame = (
            self.frame_brackets.index(reference_bracket)
            if reference_bracket in frame_brackets
            else 0
        )
        self.power = 1 / GAMMA if config.knots == "gamma" else 1.0
        knots = knot_positions(config.knots)
        self.register_buffer("knots", knots, persistent=False)
        self.register_buffer("bins", bin_table(knots), persistent=False)
        self.register_buffer(
            "fixed_curve", (knots ** (1 / GAMMA)).expand(3, -1).contiguous(), persistent=False
        )
        self.register_buffer("anchored", torch.zeros((), dtype=torch.bool))
        residuals = len(frame_brackets) if config.kind == "shared" and config.residual else 0
        free = torch.ones(len(frame_brackets), 1)
        free[self.reference_frame] = 0
        match config.kind:
            case "shared":
                self.response: SharedResponse | ImageResponse | NetworkResponse | None = (
                    SharedResponse(self.num_cameras, knots, config.min_step)
                )
                self.bracket_gain = BracketGain(
                    bracket_ev, reference_bracket, self.num_cameras, residuals
                )
                self.register_buffer("anchor_curve", torch.zeros(self.num_cameras, 3, NUM_POINTS))
                self.register_buffer("anchor_ev", torch.zeros(len(bracket_ev)))
                self.register_buffer("anchor_white_balance", torch.zeros(self.num_cameras - 1, 3))
            case "fixed" | "mlp":
                self.response = (
                    NetworkResponse(knots, self.fixed_curve) if config.kind == "mlp" else None
                )
                self.bracket_gain = BracketGain(
                    bracket_ev, reference_bracket, self.num_cameras, residuals
                )
            case "per_image":
                self.response = ImageResponse(len(frame_brackets), knots)
                self.image_gain = nn.Parameter(torch.zeros(len(frame_brackets), 3))  # natural log
                self.register_buffer("free", free, persistent=False)
            case "sigmoid":
                self.response = None
                self.image_gain = nn.Parameter(torch.zeros(len(frame_brackets), 1))  # natural log
                self.register_buffer("free", free, persistent=False)
            case "none":
                self.response = None
                self.register_buffer(
                    "told_ev", torch.tensor([ev or 0.0 for ev in bracket_ev], dtype=torch.float32)
                )

    knots: Tensor
    bins: Tensor
    fixed_curve: Tensor
    free: Tensor
    told_ev: Tensor
    anchored: Tensor
    anchor_curve: Tensor
    anchor_ev: Tensor
    anchor_white_balance: Tensor

    @staticmethod
    def for_scene(config: ToneMapConfig, scene: Scene) -> ToneMapper:
        """The tone mapper of a prepared scene, before `priors.response.initialize`."""
        frames = scene.train
        num_brackets = max(f.bracket for f in frames + scene.test) + 1
        ev = scene.manifest.bracket_ev or [None] * num_brackets
        num_cameras = max(f.camera_id for f in frames + scene.test) + 1
        reference = scene.manifest.reference_bracket
        return ToneMapper(
            config,
            [f.bracket for f in frames],
            [f.camera_id for f in frames],
            ev,
            reference,
            num_cameras,
        )

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
        radiance = radiance.float()
        if self.config.kind == "none":
            return radiance if leaky else radiance.clamp(0, 1)
        gain = self.log_gain(bracket, camera_id, frame).exp()
        return (
            self.record(radiance * gain)
            if self.has_formula
            else self.respond(radiance, gain, self.curve_values(bracket, camera_id, frame), leaky)
        )

    def recorder(
        self, bracket: int, camera_id: int, frame: int | None = None, leaky: bool = False
    ) -> Recorder:
        """One recording, for fields that record before they composite."""
        images = self.images_of(bracket).tolist() if frame is None else [frame]
        return Recorder(
            lambda radiance: self(radiance, bracket, camera_id, frame, leaky), tuple(images)
        )

    def recorder_at(self, ev: float, camera_id: int = 0) -> Recorder:
        """A picture developed at `ev`, the same; it looks like the training images of
        the nearest exposure.
        """
        nearest = int((self.exposures() - ev).abs().argmin())
        return Recorder(
            lambda radiance: self.develop(radiance, ev, camera_id),
            tuple(self.images_of(nearest).tolist()),
        )

    @property
    def has_formula(self) -> bool:
        """Whether the response is a formula of the exposure, never clipped, instead of
        a curve of points on [0, 1].
        """
        return self.config.kind in ("sigmoid", "mlp")

    def record(self, exposure: Tensor) -> Tensor:
        """What such a response records of exposures (N, 3) = gain * radiance:
        sigmoid(log x) = x / (1 + x), or the network.
        """
        return (
            self.response(exposure)
            if isinstance(self.response, NetworkResponse)
            else exposure / (1 + exposure)
        )

    def develop(self, radiance: Tensor, ev: float, camera_id: int = 0) -> Tensor:
        """The picture (..., 3) in [0, 1] that camera `camera_id` would record of
        `radiance` (..., 3) at `ev` relative to the reference bracket.

        per_image: through the reference image's gain and curve. none: radiance already
        is rgb, so `ev` changes nothing.
        """
        shape = radiance.shape
        radiance = radiance.reshape(-1, 3).float()
        with torch.no_grad():
            match self.config.kind:
                case "none":
                    return radiance.clamp(0, 1).reshape(shape)
                case "sigmoid":
                    return self.record(radiance * 2.0**ev).reshape(shape)
                case "mlp":
                    return self.record(
                        radiance * (self.bracket_gain.log_white_balance(camera_id) + ev * LN2).exp()
                    ).reshape(shape)
                case "per_image":
                    values = self.curve_values(0, camera_id, self.reference_frame)
                    return self.respond(
                        radiance, values.new_full((3,), 2.0**ev), values, leaky=False
                    ).reshape(shape)
                case _:
                    gain = (self.bracket_gain.log_white_balance(camera_id) + ev * LN2).exp()
                    return self.respond(
                        radiance, gain, self.curve_values(0, camera_id, None), leaky=False
                    ).reshape(shape)

    def respond(self, radiance: Tensor, gain: Tensor, values: Tensor, leaky: bool) -> Tensor:
        """g(gain * radiance) (N, 3) for radiance (N, 3), gain (3,) and a curve (3,
        256), with the ends of eq. 11 or clamped.
        """
        if all(
            t.device.type == "cpu" and t.dtype == torch.float32 for t in (radiance, gain, values)
        ):
            return Respond.apply(
                radiance, gain, values, self.knots, self.bins, self.config.leak if leaky else None
            )
        x = radiance * gain
        y = piecewise_linear(x, values, self.knots, self.power)
        return leaky_ends(x, y, self.config.leak) if leaky else y

    def inverse(
        self, rgb: Tensor, bracket: int, camera_id: int = 0, frame: int | None = None
    ) -> Tensor:
        """Radiance (N, 3) that would be recorded as `rgb` (N, 3); no gradients. Trust
        it only where `informative(rgb)`.
        """
        with torch.no_grad():
            if self.config.kind == "none":
                return rgb.clone()
            if self.config.kind == "sigmoid":
                y = rgb.clamp(0, 1 - 1 / 512)  # white could be anything
                return y / (1 - y) * (-self.log_gain(bracket, camera_id, frame)).exp()
            values = self.curve_values(bracket, camera_id, frame).cummax(-1).values.contiguous()
            y = rgb.clamp(0, 1).T.contiguous()  # (3, N)
            right = torch.searchsorted(values, y).clamp(1, NUM_POINTS - 1)
            y0, y1 = values.gather(1, right - 1), values.gather(1, right)
            x = torch.lerp(
                self.knots[right - 1], self.knots[right], (y - y0) / (y1 - y0).clamp_min(1e-12)
            )
            return x.T * (-self.log_gain(bracket, camera_id, frame)).exp()

    def neutral(self, camera_id: int = 0) -> Tensor:
        """Gains (3,), geometric mean 1, that make neutral what the camera records as
        mid gray at the reference exposure.

        Radiance is in the camera's own units, per channel (the gauge): for looking at,
        its white balance has to be put in.
        """
        bracket = self.frame_brackets[self.reference_frame]
        frame = self.reference_frame if self.config.kind == "per_image" else None
        gray = self.inverse(
            torch.full((1, 3), 0.5, device=self.knots.device), bracket, camera_id, frame
        )[0].clamp_min(1e-9)
        return gray.log().mean().exp() / gray

    def log_gain(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        """Natural log gain (3,), eq. 10. per_image and sigmoid without a frame borrow
        the mean of the bracket's training images.
        """
        if self.config.kind in ("per_image", "sigmoid"):
            gains = (self.image_gain * self.free).expand(-1, 3)
            return gains[self.images_of(bracket)].mean(0) if frame is None else gains[frame]
        return self.bracket_gain(bracket, camera_id, frame)

    def curve_values(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        """The response at the knots (3, 256). per_image without a frame borrows the
        mean of the bracket's training images.
        """
        match self.response:
            case SharedResponse():
                return self.response.values(camera_id)
            case ImageResponse():
                return (
                    self.response.values(self.images_of(bracket)).mean(0)
                    if frame is None
                    else self.response.values(frame)
                )
            case NetworkResponse():
                return self.response.values()
            case _:
                return (
                    self.knots / (1 + self.knots).expand(3, -1)
                    if self.config.kind == "sigmoid"
                    else self.fixed_curve
                )

    def images_of(self, bracket: int) -> Tensor:
        """Positions of the training images of a bracket; all of them where the bracket
        was never trained.
        """
        found = [i for i, b in enumerate(self.frame_brackets) if b == bracket] or list(
            range(len(self.frame_brackets))
        )
        return torch.tensor(found, device=self.knots.device)

    def gains(self) -> Tensor:
        """EV of the gain (log2) of every training frame and channel, (frames, 3), for
        reports.
        """
        with torch.no_grad():
            if self.config.kind == "none":
                return torch.zeros(len(self.frame_brackets), 3, device=self.knots.device)
            frames = zip(self.frame_brackets, self.frame_cameras, strict=True)
            return torch.stack([self.log_gain(b, c, i) / LN2 for i, (b, c) in enumerate(frames)])

    def exposures(self) -> Tensor:
        """EV of every bracket (B,) relative to the reference; per_image, sigmoid: mean
        over the bracket's images and channels; none: what the scene or its brightness
        says, which nothing here uses.
        """
        with torch.no_grad():
            if self.config.kind == "none":
                return self.told_ev.clone()
            if self.config.kind in ("shared", "fixed", "mlp"):
                return self.bracket_gain.ev().clone()
            num_brackets = max(self.frame_brackets, default=0) + 1
            gains = self.gains().mean(-1)
            return torch.stack([gains[self.images_of(b)].mean() for b in range(num_brackets)])

    def curve(self, camera_id: int = 0) -> tuple[Tensor, Tensor]:
        """The response: exposure x (256,) in [0, 1] and recorded y (3, 256). per_image:
        the reference image's; none: the identity.
        """
        with torch.no_grad():
            if self.config.kind == "none":
                return self.knots.clone(), self.knots.expand(3, -1).clone()
            frame = self.reference_frame if self.config.kind == "per_image" else None
            return self.knots.clone(), self.curve_values(0, camera_id, frame).clone()

    def set_curve(self, x: Tensor, y: Tensor, camera_id: int | None = None) -> None:
        """Start the response (of one camera, or of all) from a curve y (3, M) over x
        (M,) in [0, 1], resampled onto the knots and made monotone.
        """
        assert y.shape == (3, len(x)), (x.shape, y.shape)
        at = torch.searchsorted(x.contiguous(), self.knots.to(x)).clamp(1, len(x) - 1)
        share = ((self.knots.to(x) - x[at - 1]) / (x[at] - x[at - 1])).clamp(0, 1)
        values = torch.lerp(y[:, at - 1], y[:, at], share).cummax(-1).values
        match self.response:
            case SharedResponse():
                self.response.set_values(values, camera_id)
            case ImageResponse() | NetworkResponse():
                self.response.set_values(values)
            case _:
                raise AssertionError(f"a {self.config.kind} tone mapper has no curve to set")

    def set_exposures(self, ev: Sequence[float]) -> None:
        """Start the unknown exposures from `ev` (B,), relative to the reference
        bracket; known ones stay. per_image, sigmoid: the images' gains.
        """
        told = [e if known is None else known for e, known in zip(ev, self.given_ev, strict=True)]
        with torch.no_grad():
            if self.config.kind in ("per_image", "sigmoid"):
                self.image_gain.copy_(
                    torch.tensor([[told[b] * LN2] for b in self.frame_brackets]).expand_as(
                        self.image_gain
                    )
                )
            elif self.config.kind == "none":
                self.told_ev.copy_(torch.tensor(told))
            else:
                self.bracket_gain.learned_ev.copy_(
                    torch.tensor([ev[int(i)] for i in self.bracket_gain.unknown])
                )

    def set_white_balance(self, stops: Tensor) -> None:
        """Start the white balance of every camera from `stops` (C, 3), camera 0 being 0."""
        with torch.no_grad():
            self.bracket_gain.white_balance.copy_(stops[1:] * LN2)

    def smoothness(self) -> Tensor:
        """Eq. 15: sum of squared second differences of every curve over its own knots,
        averaged over curves and channels.

        On even knots this is the paper's term. On gamma knots it is curvature over
        x^(1/2.2): zero for gamma 2.2, and the darks are held as firmly as the lights
        (evenly in x, the first of 255 cells would hide 20 knots from it).
        """
        match self.response:
            case None:
                return self.knots.new_zeros(())
            case NetworkResponse():
                return self.response.values().diff(n=2, dim=-1).square().sum(-1).mean()
        return self.response.values(slice(None)).diff(n=2, dim=-1).square().sum(-1).mean()

    def regularizers(self) -> dict[str, Tensor]:
        """Terms for the objective: `response_smoothness` (eq. 15), and for shared
        `gain_residual` and `response_anchor` (0 until `anchor()`).

        `gain_residual` is the mean square of the frames' residuals and of the log white
        balances: of a camera that only ever saw one bracket, the recordings do not tell
        exposure from white balance.
        """
        terms = {} if self.response is None else {"response_smoothness": self.smoothness()}
        if isinstance(self.response, NetworkResponse):
            terms["unit_exposure"] = self.response.unit_point()
        if self.config.kind == "shared":
            gain = self.bracket_gain
            small = [
                t.square().mean()
                for t in (gain.residual, gain.white_balance)
                if t is not None and t.numel()
            ]
            terms["gain_residual"] = torch.stack(small).sum() if small else self.knots.new_zeros(())
            terms["response_anchor"] = (
                self.anchor_distance() if self.anchored else self.knots.new_zeros(())
            )
        return terms

    def anchor_distance(self) -> Tensor:
        """Mean square distance of curves, exposures (natural log) and white balances
        from where `anchor()` found them.
        """
        assert isinstance(self.response, SharedResponse)
        distance = (self.response.values(slice(None)) - self.anchor_curve).square().mean()
        distance = distance + ((self.bracket_gain.ev() - self.anchor_ev) * LN2).square().mean()
        if self.num_cameras > 1:
            distance = (
                distance
                + (self.bracket_gain.white_balance - self.anchor_white_balance).square().mean()
            )
        return distance

    def anchor(self) -> None:
        """Remember curve, exposures and white balances as converged: `response_anchor`
        pulls towards them from now on (saved with the state).
        """
        if not isinstance(self.response, SharedResponse):
            return
        with torch.no_grad():
            self.anchor_curve.copy_(self.response.values(slice(None)))
            self.anchor_ev.copy_(self.bracket_gain.ev())
            self.anchor_white_balance.copy_(self.bracket_gain.white_balance)
            self.anchored.fill_(True)

    def freeze(self, frozen: bool = True) -> None:
        """Stop (or resume) learning anything here. Not part of the saved state: a
        schedule calls it again after a restart.
        """
        for parameter in self.parameters():
            parameter.requires_grad_(not frozen and parameter.numel() > 0)

    def param_groups(self, lr: float) -> list[dict[str, Any]]:
        """Optimizer groups `response` and `gain`; empty ones are left out."""
        response = [] if self.response is None else list(self.response.parameters())
        own = {id(p) for p in response}
        gain = [p for p in self.parameters() if id(p) not in own and p.numel()]
        groups = [
            {"name": "response", "params": response, "lr": lr},
            {"name": "gain", "params": gain, "lr": lr},
        ]
        return [g for g in groups if g["params"]]


def informative(rgb: Tensor, low: float = 3 / 255, high: float = 250 / 255) -> Tensor:
    """True (N,) where recorded `rgb` (N, 3) tells its radiance: every channel away from
    black and from saturation.
    """
    return ((rgb >= low) & (rgb <= high)).all(-1)
