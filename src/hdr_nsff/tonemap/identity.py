"""No tone mapper: radiance is taken for recorded rgb, as plain NSFF does."""

from __future__ import annotations

import torch
from torch import Tensor

from hdr_nsff.radiometry.response import Response
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, ToneMapper


class IdentityToneMapper(ToneMapper):
    """rgb = radiance; exposures change nothing, and are kept for reports alone."""

    reported_ev: Tensor  # (B,)

    def __init__(self, config: ToneMapConfig, recordings: Recordings) -> None:
        super().__init__(config, recordings)
        ev = torch.tensor([e or 0.0 for e in recordings.ev], dtype=torch.float32)
        self.register_buffer("reported_ev", ev)

    def log_gain(self, bracket: int, camera_id: int, frame: int | None) -> Tensor:
        return torch.zeros(3, device=self.knots.device)

    def respond(
        self,
        radiance: Tensor,
        gain: Tensor,
        camera_id: int,
        images: Tensor | int | None,
        leaky: bool,
    ) -> Tensor:
        return radiance if leaky else radiance.clamp(0, 1)

    def inverse(
        self, rgb: Tensor, bracket: int, camera_id: int = 0, frame: int | None = None
    ) -> Tensor:
        return rgb.detach().clone()

    def curve_values(self, camera_id: int, images: Tensor | int | None) -> Tensor:
        return self.knots.expand(3, -1)

    def exposures(self) -> Tensor:
        return self.reported_ev.clone()

    def start(self, response: Response) -> None:
        with torch.no_grad():
            self.reported_ev.copy_(torch.tensor(self.known_ev(response)))
