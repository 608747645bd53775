"""Dense features: XFeat with random weights, DINOv2 as a tiny network in a folder; the
published weights where they are found.
"""

import weakref

import cv2
import numpy as np
import pytest
import torch
from tiny_networks import tiny_dinov2

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.flow.correlation import cosines
from hdr_nsff.priors.flow.features import (
    BLOCKS,
    LINEAR,
    FeatureTuning,
    XFeat,
    dinov2_features,
    enlarge_and_pad,
    feature_source,
    load_xfeat,
    patch_tokens,
    run_per_frame,
    xfeat_features,
)


def random_state(seed: int = 0) -> dict[str, torch.Tensor]:
    """Weights of XFeat's shapes and names."""
    rng = torch.Generator().manual_seed(seed)
    state = {}
    for block, layers in BLOCKS.items():
        for i, (channels_in, channels_out, kernel, _) in enumerate(layers):
            name = f"{block}.{i}.layer"
            weight = torch.randn(channels_out, channels_in, kernel, kernel, generator=rng)
            state[f"{name}.0.weight"] = weight / (channels_in**0.5 * kernel)
            state[f"{name}.1.running_mean"] = 0.1 * torch.randn(channels_out, generator=rng)
            state[f"{name}.1.running_var"] = 0.5 + torch.rand(channels_out, generator=rng)
    for name, (channels_in, channels_out) in LINEAR.items():
        weight = torch.randn(channels_out, channels_in, 1, 1, generator=rng)
        state[f"{name}.weight"] = weight / channels_in**0.5
        state[f"{name}.bias"] = 0.1 * torch.randn(channels_out, generator=rng)
    return state


def noise(*shape: int) -> np.ndarray:
    """Random rgb."""
    return np.random.default_rng(0).random(shape).astype(np.float32)


@pytest.fixture(scope="module")
def dino(tmp_path_factory):
    """A folder with a tiny DINOv2."""
    return tiny_dinov2(tmp_path_factory.mktemp("dino"))


def test_a_folded_normalization_is_convolution_then_batch_norm():
    state = random_state()
    network, x = XFeat(state), torch.rand(1, 1, 8, 8)
    plain = torch.nn.functional.conv2d(x, state["block1.0.layer.0.weight"], padding=1)
    mean, variance = state["block1.0.layer.1.running_mean"], state["block1.0.layer.1.running_var"]
    expected = torch.nn.functional.batch_norm(plain, mean, variance)
    assert torch.allclose(network.convolve(x, "block1_0"), expected, atol=1e-5)


def test_xfeat_is_invariant_to_gain_and_offset():
    network, rgb = XFeat(random_state()), torch.from_numpy(noise(1, 3, 64, 64))
    with torch.no_grad():
        assert torch.allclose(network(rgb), network(0.25 * rgb + 0.1), atol=2e-2)
        assert not torch.allclose(network(rgb), network(rgb.flip(-1)), atol=2e-2)


def test_small_frames_are_doubled_so_cells_are_four_pixels():
    found = xfeat_features(XFeat(random_state()), noise(2, 48, 70, 3))
    assert found.stride == 4 and found.origin == 1
    assert found.maps.shape == (2, 64, 12, 20)  # 96 is 3 times 32, 140 becomes 160


def test_maps_of_earlier_frames_are_not_held_a_second_time():
    """A 640x360 clip has 33 MB of DINOv2's features a frame."""
    made: list[weakref.ref[torch.Tensor]] = []

    def network(rgb: torch.Tensor) -> torch.Tensor:
        assert sum(maps() is not None for maps in made) <= 1
        maps = rgb.mean(1, keepdim=True)
        made.append(weakref.ref(maps))
        return maps

    video = noise(5, 16, 16, 3)
    maps = run_per_frame(video, 1, 8, network, torch.device("cpu"))
    assert len(made) == 5 and np.allclose(maps[:, 0], video.mean(-1), atol=1e-6)


def test_features_move_with_the_frame():
    """A shift by 32 pixels is one by 8 cells of 4 pixels (32 doubled is 64, a whole
    number of the coarsest cells). What is left is from edges and the frames' different
    means.
    """
    wide = noise(1, 160, 320, 3)
    network = XFeat(random_state())
    a, b = (
        xfeat_features(network, x).maps[0, :, 16:24] for x in (wide[:, :, 32:288], wide[:, :, :256])
    )
    a, b = (torch.nn.functional.normalize(x, dim=0) for x in (a, b))
    assert (a[:, :, 24:32] - b[:, :, 32:40]).abs().max() < 0.01
    assert (a[:, :, 24:32] - b[:, :, 24:32]).abs().max() > 0.05


def test_features_carry_no_gradient():
    assert not xfeat_features(XFeat(random_state()), noise(1, 32, 32, 3)).maps.requires_grad
    assert not list(XFeat(random_state()).parameters())


def test_other_weights_are_refused_in_a_sentence(tmp_path):
    torch.save({"something": torch.zeros(3)}, tmp_path / "xfeat.pt")
    with pytest.raises(InputError, match="no weights of XFeat"):
        load_xfeat(tmp_path / "xfeat.pt")


def test_dinov2_tokens_are_those_of_transformers_where_patches_do_not_overlap(dino):
    transformers = pytest.importorskip("transformers")
    network = transformers.Dinov2Model.from_pretrained(dino).eval()
    rgb = torch.from_numpy(noise(1, 3, 56, 56))
    mean = torch.tensor((0.485, 0.456, 0.406)).view(1, 3, 1, 1)
    std = torch.tensor((0.229, 0.224, 0.225)).view(1, 3, 1, 1)
    with torch.no_grad():
        expected = network((rgb - mean) / std, output_hidden_states=True).hidden_states[3][:, 1:]
        found = patch_tokens(network, 3, 14, rgb).flatten(2).mT
    assert torch.allclose(found, expected, atol=1e-5)


def test_a_smaller_stride_gives_more_dinov2_tokens(dino):
    """In 56 pixels, patches of 14 fit 4 side by side, and (56 - 14) / 7 + 1 = 7 times
    with a stride of 7. Frames are doubled, so tokens are 3.5 of their pixels apart, and
    the first one's center is at 3.5.
    """
    tuning = FeatureTuning(dino_longer_side_px=56)
    source = feature_source("dinov2-small", dino, layer=2, stride=7, tuning=tuning)
    found = source(noise(2, 28, 28, 3))
    assert found.maps.shape == (2, 16, 7, 7) and not found.maps.requires_grad
    assert found.stride == 3.5 and found.origin == 3.5


def test_the_layer_is_the_papers_share_of_the_depth(dino):
    """Of 4 layers, 15 / 24 are round(2.5) = 2."""
    network = feature_source("dinov2-small", dino).args[0]
    video, tuning = noise(1, 28, 28, 3), FeatureTuning(dino_longer_side_px=56)
    by_default = dinov2_features(network, video, tuning=tuning).maps
    assert torch.equal(by_default, dinov2_features(network, video, 2, 7, tuning).maps)
    assert not torch.equal(by_default, dinov2_features(network, video, 3, 7, tuning).maps)


@pytest.mark.parametrize(
    ("layer", "stride", "words"),
    [
        (9, None, "has 4 layers"),
        (0, None, "has 4 layers"),
        (None, 15, "14 pixels wide"),
        (None, 0, "14 pixels wide"),
    ],
)
def test_a_layer_or_stride_that_is_not_there_is_refused(dino, layer, stride, words):
    source = feature_source("dinov2-small", dino, layer, stride)
    with pytest.raises(InputError, match=words):
        source(noise(1, 28, 28, 3))


def test_texture_finer_than_the_pixels_of_a_shrunk_frame_is_averaged():
    """Stripes of 2.1 pixels, at 0.45 times the size of the frame."""
    stripes = 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(400) / 2.1)
    frame = np.broadcast_to(stripes[:, None], (40, 400, 3)).astype(np.float32)
    shrunk = enlarge_and_pad(frame, 0.45, 1)[..., 4:-4]
    assert shrunk.shape == (1, 3, 18, 172) and (shrunk - 0.5).abs().max() < 0.01


def test_xfeat_has_no_layer_to_choose():
    with pytest.raises(InputError, match="DINOv2"):
        feature_source("xfeat", layer=3)


def test_published_weights_match_across_four_ev():
    """The same texture, 16 times darker and clipped: most cells are still nearest to
    themselves.
    """
    try:
        source = feature_source("xfeat")
    except InputError as error:
        pytest.skip(str(error))
    picture = cv2.resize(noise(24, 32, 3), (256, 192), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    bright, dark = (2 * picture).clip(0, 1) ** (1 / 2.2), (picture / 8).clip(0, 1) ** (1 / 2.2)
    maps = source(np.stack([bright, np.rint(dark * 255) / 255]).astype(np.float32)).maps
    nearest = cosines(maps[0].flatten(1).T, maps[1]).argmax(1)
    assert (nearest == torch.arange(len(nearest))).float().mean() > 0.7
