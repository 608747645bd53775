"""Tone mappers with free numbers per image: the paper's gain and curve (eq. 9-11, 15),
and HDR-HexPlane's exposure through a fixed sigmoid.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hdr_nsff.radiometry.response import Response
from hdr_nsff.tonemap import curve
from hdr_nsff.tonemap.base import LN2, Recordings, ToneMapConfig, ToneMapper, drift_of
from hdr_nsff.tonemap.curve import GAMMA
from hdr_nsff.tonemap.kernel import bin_table
from hdr_nsff.tonemap.responses import ImageResponse

MAX_SIGMOID_RGB = 1 - 1 / 512  # white could be any radiance


class ImageGainToneMapper(ToneMapper):
    """A free gain per image; that of the reference image is 1 (the gauge)."""

    free: Tensor  # (frames, 1): 0 for the reference image, else 1

    def __init__(self, config: ToneMapConfig, recordings: Recordings, channels: int) -> None:
        """`channels`: 3 gains per image, or 1 for all of its channels."""
        super().__init__(config, recordings)
        count = len(recordings.brackets)
        self.image_gain = nn.Parameter(torch.zeros(count, channels))  # natural log
        free = torch.ones(count, 1)
        free[self.reference_frame] = 0
        self.register_buffer("free", free, persistent=False)

    def log_gain(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        """Without a frame, the mean of the bracket's training images."""
        gains = (self.image_gain * self.free).expand(-1, 3)
        return gains[self.images_of(bracket)].mean(0) if frame is None else gains[frame]

    @torch.no_grad()
    def set_exposures(self, ev: list[float]) -> None:
        """Start every image's gain from `ev` (B,) of its bracket and its own drift,
        relative to the reference image.
        """
        levels = torch.tensor([[ev[b]] for b in self.frame_brackets])
        gains = (levels + drift_of(self.recordings)) * LN2
        if self.image_gain.shape[1] == 1:
            gains = gains.mean(1, keepdim=True)
        self.image_gain.copy_(gains - gains[self.reference_frame])


class ImageToneMapper(ImageGainToneMapper):
    """The paper's: three gains and three free curves per image."""

    bins: Tensor

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings, channels=3)
        self.power = 1 / GAMMA if config.knots == "gamma" else 1.0
        self.register_buffer("bins", bin_table(self.knots), persistent=False)
        self.response = ImageResponse(len(recordings.brackets), self.knots)

    @property
    def neutral_frame(self) -> int:
        return self.reference_frame

    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        """Of several images, the mean of their curves."""
        values = self.response.values(self.reference_frame if images is None else images)
        return values.mean(0) if values.ndim == 3 else values

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
        images = self.images_of(bracket) if frame is None else frame
        with torch.no_grad():
            x = curve.invert(rgb, self.curve_values(camera_id, images), self.knots)
            return x * (-self.log_gain(bracket, camera_id, frame)).exp()

    def set_curve(self, x: Tensor, y: Tensor) -> None:
        """Start every image from a curve y (3, M) over x (M,) in [0, 1]."""
        self.response.set_values(curve.resample(x, y, self.knots))

    def start(self, response: Response) -> None:
        """As published unless `from_recordings`: gamma 2.2 and gains of 1."""
        if not self.config.from_recordings:
            return
        self.set_exposures(self.known_ev(response))
        if response.source == "static points":
            self.set_curve(torch.from_numpy(response.x), torch.from_numpy(response.y).mean(0))

    def regularizers(self) -> dict[str, Tensor]:
        curves = self.response.values(slice(None))  # (images, 3, K)
        return {"response_smoothness": curve.smoothness(curves) * (len(curves) * 3)}


class SigmoidToneMapper(ImageGainToneMapper):
    """HDR-HexPlane's: x / (1 + x) with one learned exposure per image."""

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings, channels=1)

    def respond(
        self,
        radiance: Tensor,
        gain: Tensor,
        camera_id: int,
        images: Tensor | int | None,
        leaky: bool,
    ) -> Tensor:
        exposure = radiance * gain
        return exposure / (1 + exposure)

    def inverse(
        self, rgb: Tensor, bracket: int, camera_id: int = 0, frame: int | None = None
    ) -> Tensor:
        with torch.no_grad():
            y = rgb.clamp(0, MAX_SIGMOID_RGB)
            return y / (1 - y) * (-self.log_gain(bracket, camera_id, frame)).exp()

    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        return (self.knots / (1 + self.knots)).expand(3, -1)

    def start(self, response: Response) -> None:
        self.set_exposures(self.known_ev(response))
