"""Names and commands of a benchmark's runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from hdr_nsff.bench.config import BenchConfig, arguments, safe_name
from hdr_nsff.core.errors import InputError


@pytest.mark.parametrize(
    "text", ["../../etc", "/abs", "a/b", "..", "a\0b", "-x", "é b", "x" * 300, ".hidden"]
)
def test_names_stay_inside_the_folder(text: str, tmp_path: Path) -> None:
    try:
        name = safe_name(text, "--scenes")
    except InputError:
        return
    place = (tmp_path / "runs" / name).resolve()
    assert place.parent == tmp_path / "runs" and len(name) <= 60 and name == place.name
    place.mkdir(parents=True)


def test_the_command_of_a_run_has_the_settings_that_are_no_defaults() -> None:
    methods = "x=tiny --rays 32"
    config = BenchConfig(Path("out"), "folder", methods, steps=7, jobs=3, lpips="w", views=2)
    assert arguments(config, "scene/x") == [
        "bench",
        "out",
        "--scenes=folder",
        "--methods=x=tiny --rays 32",
        "--steps=7",
        "--lpips=w",
        "--views=2",
        "--only",
        "scene/x",
    ]
