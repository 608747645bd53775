"""Networks of `prepare` on a pretend device that refuses to mix devices: they predict
what they predict on the CPU. Weights are tiny and random.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from pretend_device import pretend_device
from test_adapt import sliding
from test_features import random_state
from tiny_networks import (
    random_flow_network,
    random_lightglue,
    tiny_depth_anything,
    tiny_dinov2,
    tiny_sam2,
)

from hdr_nsff.core.errors import InputError
from hdr_nsff.prepare.prepare import prepare
from hdr_nsff.prepare.steps.neural import load_network
from hdr_nsff.prepare.work import PrepareConfig
from hdr_nsff.priors.depth.depth_anything import network_disparity
from hdr_nsff.priors.flow import networks
from hdr_nsff.priors.flow.adapt import Refiner
from hdr_nsff.priors.flow.features import FeatureName, FeatureTuning
from hdr_nsff.priors.flow.semantic import (
    SemanticConfig,
    SemanticFlow,
    SemanticTuning,
    semantic_flow,
)
from hdr_nsff.priors.masks.prompts import Prompt, PromptedObject
from hdr_nsff.priors.masks.sam2 import track_object
from hdr_nsff.priors.poses.lightglue import Matcher, match_images
from hdr_nsff.priors.pretrained import pretrained

CPU = torch.device("cpu")
SMALL = SemanticTuning(features=FeatureTuning(dino_longer_side_px=112))


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).random(shape).astype(np.float32)


@pytest.mark.parametrize("name", ["xfeat", "dinov2-small"])
def test_features_their_fit_and_the_search_run_on_the_device(
    name: FeatureName, tmp_path: Path
) -> None:
    weights = tmp_path / "xfeat.pt"
    if name == "xfeat":
        torch.save(random_state(), weights)
    else:
        weights = tiny_dinov2(tmp_path / "dino")
    video = sliding(4)
    clipped = np.zeros(video.shape[:3], bool)
    pairs = np.array([[0, 1], [1, 0], [2, 3]])

    def prior(device: torch.device) -> SemanticFlow:
        neighbors, equal = [(0, 1), (1, 2), (2, 3)], [(0, 2), (1, 3)]
        refiner: Refiner = "small" if name == "xfeat" else "published"
        config = SemanticConfig(name, steps=3, refiner=refiner)
        return semantic_flow(config, weights, neighbors, equal, SMALL, device=device)

    expected, _ = prior(CPU)(video, clipped, pairs)
    with pretend_device() as device:
        there = prior(device)
        found, _ = there(video, clipped, pairs)
    assert there.features is not None and there.features.maps.device == device
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize("name", ["gmflow", "raft"])
def test_a_flow_network_is_loaded_onto_the_device_and_runs_there(
    name: networks.Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = random_flow_network(name, tmp_path, monkeypatch)
    a, b = noise(2, 48, 64, 3)
    expected = networks.predict_both_directions(networks.load_network(name, weights), a, b)
    with pretend_device() as device:
        network = networks.load_network(name, weights, device)
        assert {p.device for p in network.parameters()} == {device}
        found = networks.predict_both_directions(network, a, b)
    np.testing.assert_allclose(found, expected, atol=1e-3)


@pytest.mark.parametrize("matcher", ["aliked", "disk"])
def test_learned_matches_are_those_of_the_cpu(
    matcher: Matcher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random_lightglue(matcher, tmp_path, monkeypatch)
    thresholds = pytest.importorskip("kornia.feature").LightGlue.pruning_keypoint_thresholds
    monkeypatch.setitem(thresholds, "pretend", thresholds["cpu"])
    images, everywhere = list(noise(2, 64, 96, 3)), [np.ones((64, 96))] * 2
    expected = match_images(images, everywhere, [(0, 1)], matcher)
    with pretend_device() as device:
        found = match_images(images, everywhere, [(0, 1)], matcher, device=device)
    np.testing.assert_allclose(found[0][0], expected[0][0], atol=1e-3)
    np.testing.assert_array_equal(found[1][0], expected[1][0])


def test_sam2_outlines_on_the_device(tmp_path: Path) -> None:
    network = pretrained("Sam2VideoModel", str(tiny_sam2(tmp_path)))
    video = noise(3, 60, 100, 3)
    prompt = Prompt(1, np.array([[40.0, 40.0]]), np.array([1]), np.array([20.0, 20, 60, 55]))
    prompted = PromptedObject(1, (prompt,))
    expected = track_object(network, video, prompted)
    with pretend_device() as device:
        found = track_object(network.to(device), video, prompted)
    assert (found == expected).mean() > 0.999


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_depth_anything_runs_on_the_device(kind: str, tmp_path: Path) -> None:
    network = pretrained(
        "DepthAnythingForDepthEstimation", str(tiny_depth_anything(tmp_path, kind))
    )
    video = noise(2, 60, 100, 3)
    expected, _ = network_disparity(network, video)
    with pretend_device() as device:
        found, _ = network_disparity(network.to(device), video)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


def test_prepare_obeys_the_device_of_its_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = str(tiny_depth_anything(tmp_path, "metric"))
    name = "DepthAnythingForDepthEstimation"
    with pretend_device() as device:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
        config = PrepareConfig(Path("clip"), Path("scene"), device="cpu")
        assert load_network(config, name, weights).device == CPU
        monkeypatch.setattr("hdr_nsff.prepare.steps.neural.pick_device", lambda name: device)
        assert load_network(config, name, weights).device == device


def test_an_unknown_device_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "clip").mkdir()
    with pytest.raises(InputError, match="--device tpu: no such device"):
        prepare(PrepareConfig(tmp_path / "clip", tmp_path / "scene", device="tpu"))
    assert not (tmp_path / "scene").exists()
