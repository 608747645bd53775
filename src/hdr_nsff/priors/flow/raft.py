"""RAFT (Teed and Deng, ECCV 2020), the large variant of torchvision.

torchvision is imported here alone, and only when a RAFT is built.
"""

from __future__ import annotations

from torch import Tensor, nn

from hdr_nsff.core.errors import InputError

MULTIPLE, MIN_SIDE_PX = 32, 128  # sides of its images: multiples of the one, at least the other


class Raft(nn.Module):
    """A pair of images to the flow between them, both ways, like `GMFlow`."""

    def __init__(self) -> None:
        super().__init__()
        self.network = torchvision_raft()

    def forward(self, images: Tensor) -> Tensor:
        """Flow (2B, 2, H, W) px of a pair batch of `images` (2B, 3, H, W) in [0, 1].

        Their sides are multiples of 32 and at least 128.
        """
        return self.predictions(images)[-1]

    def predictions(self, images: Tensor) -> list[Tensor]:
        """Flow (2B, 2, H, W) px after each recurrent update; the last is the result."""
        sides = images.shape[2:]
        assert images.shape[0] % 2 == 0, f"images {tuple(images.shape)}: no pairs"
        assert not any(side % MULTIPLE or side < MIN_SIDE_PX for side in sides), (
            f"images {tuple(images.shape)}: sides"
        )
        signed = 2 * images - 1  # the range that it was trained on
        partners = signed.roll(len(images) // 2, 0)
        return list(self.network(signed, partners))

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load weights by the names of the published file."""
        return self.network.load_state_dict(state_dict, *args, **kwargs)

    def state_dict(self, *args, **kwargs):
        """Weights by the names of the published file."""
        return self.network.state_dict(*args, **kwargs)


def torchvision_raft() -> nn.Module:
    """An untrained `raft_large`.

    InputError where torchvision is missing or does not fit this torch.
    """
    try:
        from torchvision.models.optical_flow import raft_large
    except (ImportError, RuntimeError) as error:
        # RuntimeError: a torchvision for CUDA beside a torch for the CPU
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            f"raft: torchvision cannot be imported ({reason}); install the extra `raft` "
            "beside the torch it was built for, or choose another network, such as gmflow"
        ) from error
    network: nn.Module = raft_large(weights=None, progress=False)
    return network
