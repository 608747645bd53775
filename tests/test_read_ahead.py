"""Frames are read before the step that needs them."""

from dataclasses import replace
from pathlib import Path

import pytest
from presets import small, trainer

from hdr_nsff.core.errors import InputError
from hdr_nsff.scene.batch import PixelBatch
from hdr_nsff.scene.scene import Frame, Scene, StoredFrame
from hdr_nsff.training.read_ahead import ReadAhead


def test_every_step_has_its_frames_read_by_the_step_before(
    toy: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = trainer(small("splat", toy.folder, tmp_path / "run", 8), toy)
    used: list[int] = []
    ahead: list[int] = []
    draw = run.draw

    def drawn(slot: int) -> PixelBatch:
        batch = draw(slot)
        used.append(batch.frame)
        return batch

    monkeypatch.setattr(run, "draw", drawn)
    monkeypatch.setattr(run, "read_ahead", ahead.append)
    for _ in range(4):
        run.step()
        run.clock = replace(run.clock, step=run.clock.step + 1)
    batches = run.config.batches
    assert len(set(used)) > 1 and ahead[:-batches] == used[batches:]


def test_a_frame_that_cannot_be_read_is_an_error_where_it_is_used() -> None:
    loads: list[int] = []

    def load() -> Frame:
        loads.append(1)
        raise InputError("broken")

    frame = StoredFrame(load, index=0)
    read_ahead = ReadAhead([frame])
    read_ahead(0)
    read_ahead.pool.shutdown(wait=True)
    assert loads == [1]
    with pytest.raises(InputError, match="broken"):
        _ = frame.image
