"""What a run asks of its training cameras, answered by those of the prepared scene."""

from __future__ import annotations

from torch import Tensor, nn

from hdr_nsff.core.param_group import ParamGroup
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame, Scene


class GivenPoses(nn.Module):
    """Cameras that stay as they are; `PoseCorrections` learns to correct them."""

    def forward(self, batch: PixelBatch) -> PixelBatch:
        """The batch as its camera and its neighbors' cameras see it."""
        return batch

    def frame(self, scene: Scene, position: int) -> Frame:
        """The training frame at `position` with its camera."""
        return scene.train[position]

    def regularizers(self, frame: int) -> dict[str, Tensor]:
        """Terms for the objective, of the camera of a training frame."""
        return {}

    def param_groups(self, lr: float) -> list[ParamGroup]:
        """What is learned of the cameras."""
        return []

    def fix_gauge(self) -> None:
        """Take out of the cameras, after a step, what no picture determines."""

    def describe(self) -> str | None:
        """A sentence on what was learned of the cameras, if anything."""
        return None

    def correct(self, scene: Scene) -> Scene:
        """The scene with the cameras of the run, in its manifest as well."""
        return scene
