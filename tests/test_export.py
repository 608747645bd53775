"""The verb `export`: a run folder in, PLY files out; settings that make no sense are
one sentence. Layouts have tests of their own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_export_gaussians import make_run, splat

from hdr_nsff import cli
from hdr_nsff.core.checkpoints import pack, save_checkpoint
from hdr_nsff.core.errors import InputError
from hdr_nsff.rendering import ply
from hdr_nsff.rendering.export import ExportConfig, export
from hdr_nsff.rendering.export_gaussians import ColorTransform
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training.run_folder import write_config


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({}, "--ply-sequence"),
        ({}, r"a\.ply: add --ply for Gaussians at one time"),
        ({"out": Path("a.xyz")}, r"a\.xyz: .*end it in \.html, \.hdr4d, \.usdc, \.usda, "),
        ({"out": Path("a.hdr4d"), "ply": True}, "the scene of a page; .* leave --ply,"),
        ({"ply": True, "ply_sequence": True}, "--ply-sequence"),
        ({"ply": True, "out": Path("a.obj")}, "ends in .ply"),
        ({"ply_sequence": True, "time": 1.0}, "every training time"),
        ({"ply_sequence": True, "out": Path("/")}, "/: .*name one below this"),
        ({"ply": True, "truth": Path("truth")}, "use it with --layout NAME"),
        ({"ply": True, "colors": ColorTransform(ev=1.0, linear=True)}, "not developed"),
        ({"ply": True, "colors": ColorTransform(ev=float("nan"))}, "in stops"),
        ({"layout": "nerfstudio", "time": 1.0}, "writes the recorded frames"),
    ],
)
def test_settings_that_make_no_sense_are_one_sentence(change: dict, word: str) -> None:
    config = replace(ExportConfig(Path("run"), Path("a.ply")), **change)
    with pytest.raises(InputError, match=word):
        export(config)


def test_the_verb_exports_from_a_run_folder(toy: Scene, toy_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run = make_run(toy, folder)
    write_config(folder, replace(run.config, scene=toy_folder, out=folder))
    tensors = pack({"field": splat(run), "tonemapper": run.tonemapper}, {})
    save_checkpoint(folder, 7, 1.0, tensors)
    one = ["export", str(folder), str(tmp_path / "one.ply"), "--ply", "--time", "1.5", "--linear"]
    cli.main(one)
    cli.main(["export", str(folder), str(tmp_path / "all"), "--ply-sequence", "--ev", "-1"])
    expected = splat(run).gaussians(1.5)
    np.testing.assert_array_equal(ply.read(tmp_path / "one.ply").means, expected.means)
    assert len(list((tmp_path / "all").glob("*.ply"))) == len(run.scene.train)
