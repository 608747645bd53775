"""RAFT (Teed and Deng, ECCV 2020), the large variant, as torchvision has it: its only
door, and imported when one is asked for.
"""

from __future__ import annotations

from torch import Tensor, nn

from hdr_nsff.core.errors import InputError


class Raft(nn.Module):
    """Two images to the flow between them, both ways, behind the same interface as
    `GMFlow`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.network = torchvision_raft()

    def forward(self, images: Tensor) -> Tensor:
        """Flow (2B, 2, H, W) px of a pair batch of `images` (2B, 3, H, W) in [0, 1],
        sides a multiple of 32 and at least 128.
        """
        return self.predictions(images)[-1]

    def predictions(self, images: Tensor) -> list[Tensor]:
        """The flow after each of the recurrent updates, the last one being the answer."""
        assert images.shape[0] % 2 == 0 and not any(s % 32 or s < 128 for s in images.shape[2:]), (
            f"images {tuple(images.shape)}"
        )
        signed = 2 * images - 1  # what it was trained on
        return list(self.network(signed, signed.roll(len(images) // 2, 0)))

    def load_state_dict(self, state_dict, *args, **kwargs):
        """Load weights by the names of the published file."""
        return self.network.load_state_dict(state_dict, *args, **kwargs)

    def state_dict(self, *args, **kwargs):
        """Weights by the names of the published file."""
        return self.network.state_dict(*args, **kwargs)


def torchvision_raft() -> nn.Module:
    """An untrained `raft_large`; InputError where torchvision is missing or does not go
    with this torch.
    """
    try:
        from torchvision.models.optical_flow import raft_large
    except (
        ImportError,
        RuntimeError,
    ) as error:  # RuntimeError: one built for CUDA beside torch for the CPU
        raise InputError(
            f"--flow raft: torchvision cannot be imported ({' '.join(str(error).split())[:120]}); install the extra `raft` beside the torch it "
            "was built for, or use --flow gmflow or dis"
        ) from error
    network: nn.Module = raft_large(weights=None, progress=False)
    return network
