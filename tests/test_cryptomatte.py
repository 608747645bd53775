"""Cryptomatte: ids as in the specification, ranked coverages, names in the header."""

import json
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from hdr_nsff.core import cryptomatte
from hdr_nsff.core.exr import write_exr


@pytest.mark.parametrize(
    ("text", "value"),
    [("", 0), ("a", 0x3C2569B2), ("abc", 0xB3DD93FA), ("hello", 0x248BFA47)],
)
def test_hashes_are_those_of_murmur3(text: str, value: int) -> None:
    assert cryptomatte.hash_text(text) == value


def test_ids_are_those_of_the_specification() -> None:
    assert cryptomatte.object_id("hello") == pytest.approx(6.0705627102400005616e-17, rel=1e-6)
    assert cryptomatte.object_id("cube") == pytest.approx(-4.08461912519e15, rel=1e-6)
    assert cryptomatte.object_id("sphere") == pytest.approx(2.79018604383e15, rel=1e-6)


def test_every_id_is_an_ordinary_float() -> None:
    for i in range(5000):
        value = abs(cryptomatte.object_id(f"object {i}"))
        assert np.isfinite(value) and value > 1e-38


def test_a_reader_gets_the_mattes_back(tmp_path: Path) -> None:
    """Read as Nuke does: by the manifest, the sum of coverage of one id."""
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.ones(3), (4, 5)).astype(np.float32)
    objects = {"wall": shares[..., 0], "walker": shares[..., 1], "dög": shares[..., 2]}
    header = cryptomatte.header("CryptoObject", list(objects))
    channels = cryptomatte.channels("CryptoObject", objects)
    write_exr(tmp_path / "a.exr", channels, header, half=True)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        attributes, pixels = file.header(), file.channels()
        key = next(name for name in attributes if name.endswith("/manifest"))
        manifest = json.loads(attributes[key])
        assert attributes[key.replace("manifest", "name")] == "CryptoObject"
        pairs = [("R", "G"), ("B", "A")]
        for name, expected in objects.items():
            wanted = np.float32(struct.unpack(">f", bytes.fromhex(manifest[name]))[0])
            found = np.zeros((4, 5), np.float32)
            for layer in ("CryptoObject00", "CryptoObject01"):
                for identity, coverage in pairs:
                    here = pixels[f"{layer}.{identity}"].pixels == wanted
                    found += here * pixels[f"{layer}.{coverage}"].pixels
            assert np.array_equal(found, expected)


def test_the_object_of_most_coverage_comes_first() -> None:
    objects = {"a": np.array([[0.2]]), "b": np.array([[0.8]]), "c": np.array([[0.0]])}
    channels = cryptomatte.channels("X", objects)
    assert channels["X00.R"] == np.float32(cryptomatte.object_id("b"))
    assert channels["X00.G"] == np.float32(0.8) and channels["X00.A"] == np.float32(0.2)
    assert channels["X01.R"] == 0
