"""Networks with random weights, most of them tiny, saved where they are looked for.

Their predictions are meaningless; tests check their inputs and what is done with them.
"""

import hashlib
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from hdr_nsff.priors.flow import networks
from hdr_nsff.priors.flow.gmflow import GMFlow
from hdr_nsff.priors.weights import KNOWN


def tiny_sam2(folder: Path) -> Path:
    """A Sam2VideoModel for 64 x 64 pixels."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = dict(
        model_type="sam2_hiera_det_model",
        hidden_size=8,
        embed_dim_per_stage=[8, 16, 32, 64],
        blocks_per_stage=[1, 1, 2, 1],
        num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[4, 4, 4, 2],
        global_attention_blocks=[3],
        image_size=[64, 64],
        window_positional_embedding_background_size=[2, 2],
    )
    vision = dict(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
        fpn_hidden_size=128,
    )
    config = transformers.Sam2VideoConfig(
        vision_config=vision,
        prompt_encoder_config=dict(hidden_size=128, image_size=64),
        mask_decoder_config=dict(
            hidden_size=128, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=32
        ),
        image_size=64,
        memory_attention_hidden_size=128,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=128,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128,
        memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32,
    )
    transformers.Sam2VideoModel(config).save_pretrained(folder)
    return folder


def tiny_depth_anything(folder: Path, kind: str) -> Path:
    """A DepthAnythingForDepthEstimation for 28 pixels on the shorter side.

    `kind` is "relative", or "metric" up to 20 m.
    """
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=28,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        apply_layernorm=True,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        patch_size=14,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[4, 8, 12, 16],
        fusion_hidden_size=8,
        head_hidden_size=4,
        depth_estimation_type=kind,
        max_depth=20,
    )
    network = transformers.DepthAnythingForDepthEstimation(config)
    with torch.no_grad():  # the initial weights predict nearly constant depth
        for weights in (*network.neck.parameters(), *network.head.parameters()):
            weights.normal_(0, 0.3)
    network.save_pretrained(folder)
    return folder


def tiny_dinov2(folder: Path) -> Path:
    """A Dinov2Model: 4 layers of 16 channels, patches of 14 pixels, 4 x 4 positions."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    config = transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=56,
        patch_size=14,
    )
    transformers.Dinov2Model(config).save_pretrained(folder)
    return folder


def random_lightglue(
    matcher: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> dict[str, torch.Tensor]:
    """Random weights of both networks of a matcher where the real ones would be, in
    `folder`, LightGlue's under its authors' first names. Returns those by kornia's.
    """
    kf = pytest.importorskip("kornia.feature")
    torch.manual_seed(0)
    extractor = kf.ALIKED("aliked-n16") if matcher == "aliked" else kf.DISK()
    state = extractor.state_dict()
    glue = kf.LightGlue(None, input_dim=128).state_dict()
    old = {
        re.sub(r"transformers\.(\d+)\.(self_attn|cross_attn)\.", r"\2.\1.", k): v
        for k, v in glue.items()
    }
    for name, content in (
        (matcher, state if matcher == "aliked" else {"extractor": state}),
        (f"{matcher}-lightglue", old),
    ):
        path = folder / name / str(KNOWN[name].file)
        path.parent.mkdir()
        torch.save(content, path)
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        monkeypatch.setitem(KNOWN, name, replace(KNOWN[name], sha256=sha256))
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(folder))
    return dict(glue)


class TinyRaft(nn.Module):
    """A stand-in for torchvision's RAFT: one layer that sees both images."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Conv2d(6, 2, 3, padding=1)

    def forward(self, first: Tensor, second: Tensor) -> list[Tensor]:
        return [self.layer(torch.cat([first, second], 1))]


def random_flow_network(
    name: networks.Network, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Random weights of a tiny flow network of float32, which `load_network` builds."""
    monkeypatch.setattr(networks, "GMFlow", lambda bf16: GMFlow(channels=16, blocks=2))
    monkeypatch.setattr("hdr_nsff.priors.flow.raft.torchvision_raft", TinyRaft)
    torch.manual_seed(0)
    path = folder / f"{name}.pth"
    torch.save(networks.build(name, torch.device("cpu")).state_dict(), path)
    return path
