"""Exposures that cannot be: verbs that read footage name them in one sentence, before
they write anything.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from bad_input import FRAMES, Capture, clip, prepared, recorded, refused

from hdr_nsff.core.video import write_video


@pytest.mark.parametrize("verb", ["run", "prepare"])
def test_exposures_that_cannot_be(verb: str, tmp_path: Path, capsys: Capture) -> None:
    footage, out = clip(tmp_path / "clip", recorded(24)), tmp_path / "out"
    assert "divides by zero" in refused(capsys, verb, footage, out, "--exposures", "1/1000,1/0")
    assert "is not a number" in refused(capsys, verb, footage, out, "--ev=0,dark")
    assert not out.exists()
    assert "2 exposures listed" in refused(capsys, verb, footage, out, "--ev=0,-1.5")


@pytest.mark.parametrize("value", ["1/0", "nan", "dark", ""])
def test_exposures_that_cannot_be_made(value: str, tmp_path: Path, capsys: Capture) -> None:
    assert "--ev" in refused(
        capsys, "reexpose", clip(tmp_path / "clip"), tmp_path / "out", f"--ev={value},0"
    )
    assert "--ev" in refused(capsys, "synth", "interior", tmp_path / "out", f"--ev={value},0")
    assert not (tmp_path / "out").exists()


def test_an_exposure_list_that_fits_no_cycle(tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip", recorded(24))
    for given, count in (("--ev=-2,0", 2), ("--exposures=1/1000,1/500,1/250,1/125", 4)):
        sentence = prepared(capsys, folder, given)
        assert f"{count} exposures listed" in sentence and "repeats every 3" in sentence


def test_an_exposure_list_longer_than_the_clip(tmp_path: Path, capsys: Capture) -> None:
    assert "5 exposures listed for 4 frames" in prepared(
        capsys, clip(tmp_path / "clip", recorded(4)), "--ev=0,1,2,3,4"
    )


@pytest.mark.parametrize(
    "exposures", ["1/1000,1/0", "1/60,,1/30", "1/60;1/30", "-1/60,1/30", "0,1/30"]
)
def test_impossible_exposures(exposures: str, tmp_path: Path, capsys: Capture) -> None:
    assert "--exposures" in prepared(capsys, clip(tmp_path / "clip"), f"--exposures={exposures}")


@pytest.mark.parametrize("verb", ["run", "prepare"])
def test_times_in_another_unit(verb: str, tmp_path: Path, capsys: Capture) -> None:
    folder, out = clip(tmp_path / "clip"), tmp_path / "out"
    given = "--exposures=2000000,500000"
    assert "2e+06 seconds is impossible" in refused(capsys, verb, folder, out, given)
    (folder / "exposures.csv").write_text("frame,exposure\n0,16666667\n1,4166667\n")
    sentence = refused(capsys, verb, folder, out)
    assert "line 2: an exposure of 1.667e+07 seconds" in sentence and "`exposure_ns`" in sentence
    assert not out.exists()


def test_a_csv_that_leaves_frames_out(tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip")
    (folder / "exposures.csv").write_text("file,ev\n000.png,-2\n")
    assert "no row for frame 001.png" in prepared(capsys, folder)


def test_only_a_verb_that_has_an_option_advises_it(tmp_path: Path, capsys: Capture) -> None:
    folder = clip(tmp_path / "clip")
    (folder / "exposures.csv").write_text("file,ev\n000.png,-2\n")
    sentence = refused(capsys, "check", folder, "--picture", tmp_path / "a.png")
    assert "no row for frame 001.png; add it, or rename the list" in sentence
    assert "no row for frame 001.png; add it, or give `--exposures" in prepared(capsys, folder)


LISTS = {
    "file,ev\n000.png,dark\n": "line 2: 'dark' is not a number",
    "file,ev\n000.png,-2\n": "no row for frame 001.png",
    "file,ev,timestamp_ns\n" + "".join(f"{t:03d}.png,0,x\n" for t in range(FRAMES)): "'x' is not",
}


@pytest.mark.parametrize("option", [(), ("--segment", 0.2)])
@pytest.mark.parametrize("text", LISTS)
def test_a_bad_list_is_found_before_frames_are_decoded(
    text: str,
    option: tuple[object, ...],
    tmp_path: Path,
    capsys: Capture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = clip(tmp_path / "clip")
    (folder / "exposures.csv").write_text(text)
    for module in ("prepare.prepare", "prepare.steps.footage"):
        monkeypatch.setattr(f"hdr_nsff.{module}.read_frames", None)
    assert LISTS[text] in refused(capsys, "prepare", folder, tmp_path / "out", *option)
    assert not (tmp_path / "out").exists()


def test_a_list_of_a_video_is_checked_up_to_its_end(tmp_path: Path, capsys: Capture) -> None:
    write_video(tmp_path / "clip.mp4", recorded(20))
    rows = [f"{t},0" for t in range(20) if t != 16]
    (tmp_path / "clip.csv").write_text("\n".join(["frame,ev", *rows]))
    out = tmp_path / "out"
    sentence = refused(capsys, "prepare", tmp_path / "clip.mp4", out)
    assert "no row for frame clip.mp4#16" in sentence and not out.exists()
