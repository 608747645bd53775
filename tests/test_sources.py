"""The sources that `--flow` names; bad names and needless weights are refused before
any work is done.
"""

from pathlib import Path

import numpy as np
import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_npy, write_text
from hdr_nsff.prepare.steps.flow import learning_pairs
from hdr_nsff.priors import weights
from hdr_nsff.priors.flow.dense import DenseFlowTuning, dense_flow
from hdr_nsff.priors.flow.semantic import SemanticConfig
from hdr_nsff.priors.flow.sources import (
    FlowTuning,
    check_flow,
    fallback_note,
    flow_source,
    flow_weights,
    resolve_source,
)
from hdr_nsff.priors.weights import find
from hdr_nsff.scene.manifest import FrameEntry

FRAMES = np.random.default_rng(0).random((3, 24, 32, 3)).astype(np.float32)
CLIPPED = np.zeros(FRAMES.shape[:3], bool)
PAIRS = np.array([[1, 2], [2, 1]])


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine without weights; the folder where they would be kept."""
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr(weights, "package_folder", lambda entry: None)
    return tmp_path / "weights"


def test_without_weights_the_default_is_dense_inverse_search_and_a_note_reports_it(bare: Path):
    assert resolve_source(None, "xfeat") == "dis"
    assert "hdr-nsff weights xfeat" in fallback_note(None, "xfeat")
    assert fallback_note("dis", "xfeat") == "" and flow_weights(None, None, SemanticConfig()) == []
    expected, _ = dense_flow(FRAMES, CLIPPED, PAIRS)
    for chosen in (None, "dis"):
        assert np.array_equal(flow_source(chosen)(FRAMES, CLIPPED, PAIRS)[0], expected)


def test_frames_of_no_pair_change_nothing():
    found, _ = flow_source("dis")(FRAMES, CLIPPED, PAIRS)
    assert np.array_equal(found, dense_flow(FRAMES[1:], CLIPPED[1:], PAIRS - 1)[0])


def test_with_the_weights_of_its_features_the_default_is_semantic(bare: Path):
    write_text(bare / "xfeat" / "xfeat.pt", "something else")
    assert resolve_source(None, "xfeat") == "semantic" and fallback_note(None, "xfeat") == ""
    assert resolve_source("dis", "xfeat") == "dis" and resolve_source(None, "dinov2-small") == "dis"
    with pytest.raises(InputError, match=r"xfeat.pt"):  # broken weights: no silent fallback
        flow_weights(None, None, SemanticConfig())


def test_the_weights_that_the_prepare_extra_brings_are_found():
    assert find("xfeat", download=False).name == "xfeat.pt"
    assert resolve_source(None, "xfeat") == "semantic"


def test_tuning_reaches_the_source():
    blurred = FlowTuning(dense=DenseFlowTuning(blur_px=3.0))
    found, _ = flow_source("dis", tuning=blurred)(FRAMES, CLIPPED, PAIRS)
    assert np.array_equal(found, dense_flow(FRAMES, CLIPPED, PAIRS, blurred.dense)[0])
    assert not np.array_equal(found, dense_flow(FRAMES, CLIPPED, PAIRS)[0])


def test_a_folder_gives_its_maps(tmp_path: Path):
    for i, j in PAIRS:
        write_npy(tmp_path / f"{i:05d}_{j:05d}.npy", np.full((24, 32, 2), i - j, np.float32))
    found, _ = flow_source(tmp_path)(FRAMES, CLIPPED, PAIRS)
    assert (found[0] == -1).all() and (found[1] == 1).all()


def test_a_name_that_is_neither_a_source_nor_a_folder_is_refused():
    with pytest.raises(InputError, match=r"--flow farneback: neither a folder .* use dis"):
        check_flow(Path("farneback"), None)


def test_weights_for_a_source_without_weights_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="takes no weights"):
        check_flow("dis", tmp_path)
    with pytest.raises(InputError, match="name the network"):
        check_flow(None, tmp_path)


def test_semantic_flow_takes_the_weights_of_its_features(tmp_path: Path):
    broken = tmp_path / "xfeat.pt"
    broken.write_bytes(b"nothing")
    for load in (check_flow, flow_source):
        with pytest.raises(InputError, match="no weights of XFeat"):
            load("semantic", broken)
    with pytest.raises(InputError, match="0 or more"):
        flow_source("semantic", broken, SemanticConfig(steps=-1))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (SemanticConfig(features="dinov2-small", layer=0), "1 or more"),
        (SemanticConfig(features="dinov2-small", stride=0), "1 or more"),
        (SemanticConfig(layer=3), "DINOv2 only"),
        (SemanticConfig(steps=-1), "0 or more"),
        (SemanticConfig(seed=-1), "0 or more"),
    ],
)
def test_settings_of_semantic_flow_are_checked_before_any_work(
    settings: SemanticConfig, words: str
):
    for chosen in (None, "semantic"):
        with pytest.raises(InputError, match=words):
            check_flow(chosen, None, settings)


def test_settings_of_semantic_flow_are_for_it_alone(tmp_path: Path):
    check_flow(None, None, SemanticConfig(steps=10))
    for chosen in ("dis", tmp_path):
        with pytest.raises(InputError, match="leave one of them out"):
            check_flow(chosen, None, SemanticConfig(steps=10))


def test_features_learn_from_training_frames_of_one_camera_at_a_time():
    """Two cameras of 5 and 2 frames, exposures 0, 1, 0, ..., frame 1 held out."""
    frames = [
        FrameEntry(
            index=k,
            image="",
            source="",
            time=float(k),
            bracket=k % 2,
            camera_id=int(k > 4),
            split="test" if k == 1 else "train",
        )
        for k in range(7)
    ]
    neighbors, equal = learning_pairs(frames)
    assert neighbors == [(0, 2), (2, 3), (3, 4), (5, 6)]
    assert equal == [(0, 2), (2, 4)]


def test_missing_weights_are_reported_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("hdr_nsff.priors.weights.package_folder", lambda weights: None)
    with pytest.raises(InputError, match=r"weights gmflow .* is not on this machine"):
        check_flow("gmflow", None)
    with pytest.raises(InputError, match=r"--flow-weights .*: no such file"):
        check_flow("gmflow", tmp_path / "nothing")
    with pytest.raises(InputError, match="raft-finetuned needs the weights"):
        check_flow("raft-finetuned", None)
    (tmp_path / "cut.safetensors").write_bytes(b"nothing")
    with pytest.raises(InputError, match="no readable weights"):
        check_flow("raft-finetuned", tmp_path / "cut.safetensors")
