"""Several processes under `torchrun` hold the same parameters, though each may measure
something else.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from presets import small

from hdr_nsff.core import distributed
from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import write_json
from hdr_nsff.training.run_folder import Run

SCRIPT = """
import json, os, sys
import torch
from hdr_nsff.fields.splat import relocate as relocation
from hdr_nsff.training import run_folder, train
from hdr_nsff.training.config import TrainConfig

train.CHECK_SAME_EVERY = 1
run_folder.write_preview = lambda *_: None
relocated = []
relocate = relocation.relocate

def disagree(gaussians, scores, companions, generator):
    if os.environ["RANK"] == "1":  # sees errors elsewhere
        scores = torch.rand(scores.shape)
    relocated.append(relocate(gaussians, scores, companions, generator))
    return relocated[-1]

relocation.relocate = disagree
if sys.argv[2] == "alone":
    train.distributed.Ranks.follow_first = lambda ranks, tensors: None
train.train(TrainConfig.from_json(json.loads(open(sys.argv[1]).read())))
assert sum(relocated) > 0, relocated
"""


def two_processes(folder: Path, scene: Path, how: str) -> subprocess.CompletedProcess[str]:
    """Train a tiny `splat` for 12 steps in two processes."""
    config = replace(small("splat", scene, folder / "run", 12), batches=2)
    config = replace(config, field=replace(config.field, relocate_every=4))
    write_json(folder / "given.json", config.to_json())
    (folder / "script.py").write_text(SCRIPT)
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.run(
        [sys.executable, *launcher, str(folder / "script.py"), str(folder / "given.json"), how],
        env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=240,
    )


@pytest.mark.parametrize("how", ["together", "alone"])
def test_the_first_process_decides_what_is_relocated(
    how: str, toy_folder: Path, tmp_path: Path
) -> None:
    result = two_processes(tmp_path, toy_folder, how)
    if how == "alone":  # nobody follows: the parameters differ, and that is noticed
        assert "2 processes have learned different parameters" in result.stderr
        return
    assert result.returncode == 0, result.stderr[-3000:]
    assert Run.open(tmp_path / "run").step == 12


def test_processes_take_a_cuda_device_each_unless_they_train_on_the_cpu(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joined: list[str] = []
    monkeypatch.setattr(dist, "init_process_group", joined.append)
    for name in ("barrier", "destroy_process_group"):
        monkeypatch.setattr(dist, name, lambda: None)
    monkeypatch.setattr(dist, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "set_device", lambda index: joined.append(f"cuda:{index}"))
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "1")
    with distributed.group("cpu") as ranks:
        assert (ranks.rank, ranks.world, joined) == (1, 2, ["gloo"])
    too_few = pytest.raises(InputError, match="1 CUDA devices are too few for process 2")
    with too_few, distributed.group("auto"):
        pass
    monkeypatch.setenv("LOCAL_RANK", "0")
    with distributed.group("cuda"):
        assert joined == ["gloo", "cuda:0", "cpu:gloo,cuda:nccl"]
