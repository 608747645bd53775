"""`finetune-flow` with a tiny network: it learns, goes on after a kill as if there had
been none, and keeps what it measures on apart.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_flow_sets import synth

from hdr_nsff.core.errors import InputError
from hdr_nsff.flow_training import finetune_flow as verb
from hdr_nsff.flow_training.finetune_flow import (
    FinetuneConfig,
    finetune_flow,
    mean_weights,
    rate_share,
    sequence_loss,
    split_pairs,
)
from hdr_nsff.flow_training.flow_sets import FlowPair, flow_pairs
from hdr_nsff.priors.flow import networks as flow_networks
from hdr_nsff.priors.flow.gmflow import GMFlow


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FinetuneConfig:
    """Five pairs, a tiny random network, four steps."""
    monkeypatch.setattr(flow_networks, "GMFlow", lambda bf16: GMFlow(8, 1))
    torch.manual_seed(0)
    torch.save(GMFlow(8, 1).state_dict(), tmp_path / "start.pkl")
    data = synth(tmp_path / "data", frames=6, size=(48, 64))
    return FinetuneConfig(
        tmp_path / "out",
        (data,),
        weights=tmp_path / "start.pkl",
        steps=4,
        batch=1,
        size="128x128",
        measure=1,
        checkpoint_steps=2,
    )


def test_weights_are_adapted_measured_and_loadable(config: FinetuneConfig):
    path = finetune_flow(config)
    note = json.loads(path.with_suffix(".json").read_text())
    assert note["network"] == "gmflow"
    assert note["steps"] == 4
    assert note["training_pairs"] == 3
    assert set(note["before"]) == set(note["after"]) == {"0", "2", "4"}
    assert note["before"] != note["after"]
    start, end = (
        torch.load(config.weights, weights_only=True),
        flow_networks.load_network(None, config.out).state_dict(),
    )
    assert set(start) == set(end)
    assert not torch.equal(start["backbone.conv1.weight"], end["backbone.conv1.weight"])


def trained(config: FinetuneConfig) -> dict[str, torch.Tensor]:
    """The weights after `train` on the first three pairs, in the folder of `config`."""
    verb.claim_folder(config)
    network = flow_networks.load_network("gmflow", config.weights)
    verb.train(network, flow_pairs(config.data[0])[:3], (128, 128), config)
    return network.state_dict()


def test_a_killed_run_ends_as_one_that_was_not(
    config: FinetuneConfig, monkeypatch: pytest.MonkeyPatch
):
    whole, draw = trained(config), verb.draw_example
    again = replace(config, out=config.out.with_name("again"))

    def killed(pairs, size, config, step, slot):
        if step == 3:  # the checkpoint of step 2 is there
            raise KeyboardInterrupt
        return draw(pairs, size, config, step, slot)

    monkeypatch.setattr(verb, "draw_example", killed)
    with pytest.raises(KeyboardInterrupt):
        trained(again)
    monkeypatch.setattr(verb, "draw_example", draw)
    ended = trained(again)
    assert all(torch.equal(whole[k], ended[k]) for k in whole)


def test_errors_count_where_flow_is_known_and_later_predictions_more():
    flow = torch.zeros(2, 2, 4, 4)
    known = torch.zeros(2, 4, 4, dtype=torch.bool)
    known[0, 0, 0] = True
    first, last = torch.full_like(flow, 7.0), torch.full_like(flow, 7.0)
    first[0, :, 0, 0], last[0, :, 0, 0] = 2.0, 1.0
    assert sequence_loss([first, last], flow, known).item() == pytest.approx(0.9 * 2 + 1)
    flow[0, :, 0, 0] = 1000.0  # faster than is trained on
    assert sequence_loss([first, last], flow, known).item() == 0


def test_a_few_steps_lower_the_loss(config: FinetuneConfig):
    """Shifted noise, the same example each time: a network that learns gets closer."""
    network = flow_networks.load_network("gmflow", config.weights).requires_grad_(True)
    images = torch.rand(2, 3, 32, 64, generator=torch.Generator().manual_seed(0))
    images[1] = images[0].roll(3, -1)
    flow, known = torch.zeros(2, 2, 32, 64), torch.ones(2, 32, 64, dtype=torch.bool)
    flow[0, 0], flow[1, 0] = 3, -3
    adam, losses = torch.optim.AdamW(network.parameters(), 1e-3), []
    for _ in range(12):
        loss = sequence_loss(network.predictions(images), flow, known)
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert losses[-1] < 0.8 * losses[0]


def test_the_result_is_half_way_between_start_and_end(config: FinetuneConfig):
    start = torch.load(str(config.weights), weights_only=True)
    half = load_file(finetune_flow(config))
    trained = load_file(config.out / "checkpoints/step_00000004.safetensors")
    name = "backbone.conv1.weight"
    assert torch.allclose(half[name], (start[name] + trained[f"network.{name}"]) / 2)
    assert (
        mean_weights({"a": torch.tensor([0.0])}, {"a": torch.tensor([1.0])}, 0.25)["a"] == 0.75
    ).all()


def pair(scene: str, k: int) -> FlowPair:
    return FlowPair(Path(f"{scene}{k}"), Path(f"{scene}{k + 1}"), Path("f"), None, scene)


def test_scenes_are_held_out_whole_and_one_scene_at_its_end():
    scenes = [pair(s, k) for s in "abcdefghij" for k in range(2)]
    training, held_out = split_pairs(scenes, 0.2)
    assert {p.scene for p in held_out} == {"i", "j"}
    assert not {p.scene for p in training} & {
        "i",
        "j",
    }
    training, held_out = split_pairs([pair("a", k) for k in range(10)], 0.2)
    assert [p.first.name for p in held_out] == ["a8", "a9"]
    assert training[-1].second.name == "a7"  # no frame in both
    with pytest.raises(InputError, match="too few"):
        split_pairs([pair("a", 0), pair("a", 1)], 0.5)


def test_the_rate_rises_and_falls():
    shares = [rate_share(p) for p in np.linspace(0, 1, 21)]
    assert shares[0] < 0.05
    assert max(shares) > 0.99
    assert shares[-1] == 0
    assert all(np.diff(shares[2:]) < 0)


def test_settings_and_folders_that_make_no_sense_are_refused(config: FinetuneConfig):
    for change, words in (
        ({"data": ()}, "--data"),
        ({"size": "100x128"}, "--size"),
        ({"size": "9" * 5000 + "x128"}, "--size"),
        ({"seed": -1}, "--seed"),
        ({"steps": 0}, "at least 1"),
        ({"held_out": 1.0}, "--held-out"),
        ({"data": (config.out.parent,)}, "no pairs"),
        ({"weights": config.out}, "no such weights"),
    ):
        with pytest.raises(InputError, match=words):
            finetune_flow(replace(config, **change))
    config.out.mkdir()
    (config.out / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match="other files"):
        finetune_flow(config)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"by_stops": {}}', '{"by_stops": {"0": 3}}'])
def test_damaged_measurements_are_repeated(
    text: str, config: FinetuneConfig, capsys: pytest.CaptureFixture[str]
):
    network, pairs, kept = (
        flow_networks.load_network("gmflow", config.weights),
        flow_pairs(config.data[0])[:1],
        config.out / "before.json",
    )
    before = verb.measure_or_read(network, pairs, kept)
    assert verb.measure_or_read(network, pairs, kept) == before
    assert "treated as missing" not in capsys.readouterr().err
    kept.write_text(text)
    assert verb.measure_or_read(network, pairs, kept) == before
    assert "treated as missing" in capsys.readouterr().err
    assert verb.measure_or_read(network, [], kept) == before  # from the file


def test_damaged_settings_are_one_sentence(config: FinetuneConfig):
    verb.claim_folder(config)
    for text in (b"{", b"\xff"):
        (config.out / "config.json").write_bytes(text)
        with pytest.raises(InputError, match="not readable JSON"):
            finetune_flow(config)


def test_another_run_in_the_folder_is_refused(config: FinetuneConfig):
    verb.claim_folder(config)
    verb.claim_folder(config)
    with pytest.raises(InputError, match="other settings"):
        verb.claim_folder(replace(config, seed=1))
