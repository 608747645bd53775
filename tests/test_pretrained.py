"""Weights that look like those of a network and are not."""

import pytest
from safetensors.torch import load_file, save_file
from tiny_networks import tiny_dinov2

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.pretrained import pretrained


def test_dinov2_with_registers_is_no_dinov2(tmp_path):
    """It has all weights of DINOv2 under the same names, and tokens beside them."""
    transformers = pytest.importorskip("transformers")
    size = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = transformers.Dinov2WithRegistersConfig(**size, image_size=56, patch_size=14)
    transformers.Dinov2WithRegistersModel(config).save_pretrained(tmp_path)
    with pytest.raises(InputError, match="weights of 'dinov2_with_registers'"):
        pretrained("Dinov2Model", str(tmp_path))


def test_a_weight_of_another_size_is_named(tmp_path):
    file = tiny_dinov2(tmp_path) / "model.safetensors"
    name = "encoder.layer.0.mlp.fc1.weight"
    state = load_file(file)
    save_file(state | {name: state[name][:8].clone()}, file, {"format": "pt"})
    with pytest.raises(InputError, match=f"the size of {name}"):
        pretrained("Dinov2Model", str(tmp_path))
