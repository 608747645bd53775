"""The report is one file that needs no other, shows what there is, and names what is
missing.
"""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from estimates import tone_mapper
from fakes import fake_run
from test_scores import truth_of, with_flow
from torch import Tensor

from hdr_nsff.core.errors import InputError
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.evaluation.report import ReportConfig, find_viewer, report, write_report
from hdr_nsff.evaluation.report.pictures import recorded_frame, side_by_side
from hdr_nsff.evaluation.report.plots import moving_average
from hdr_nsff.geometry.paths import PathView
from hdr_nsff.rendering.output import Output
from hdr_nsff.rendering.shot_views import plan_shot
from hdr_nsff.rendering.shots import describe_view
from hdr_nsff.rendering.standard_set import render_all
from hdr_nsff.training.run_folder import Run

VOID = {"meta", "img", "link", "br", "path", "use", "rect", "line", "circle"}


class Balanced(HTMLParser):
    """Fails where a tag is closed that is not open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.headings: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def read(path: Path) -> tuple[str, list[str]]:
    """The page's text and its headings. Every tag is closed, and nothing outside the
    file is loaded.
    """
    text = path.read_text()
    parser = Balanced()
    parser.feed(text)
    assert parser.open == []
    for source in re.findall(r'(?:src|href)="([^"]*)"', text):
        assert source.startswith(("data:", "#")), source[:60]
    return text, parser.headings


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    """A run that was rendered, evaluated and logged."""
    folder = tmp_path_factory.mktemp("run")
    run = fake_run(folder)
    render_all(run, folder / "render")
    evaluate_run(run, None)
    lines = []
    for step in range(1, 60):
        losses = {"photometric": 1 / step, "flow_magnitude": 0.1}
        line = {"step": step, "seconds": 0.1 * step, "psnr": 20 + step / 10}
        lines.append(line | {"rays_per_second": 1234.0, "losses": losses})
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run, folder


def test_the_report_of_a_finished_run_has_every_section(
    finished: tuple[Run, Path],
) -> None:
    run, folder = finished
    text, headings = read(write_report(run, folder / "report.html", folder / "render"))
    assert headings == [
        "Results",
        "Videos",
        "Side by side",
        "Held-out views",
        "Quality",
        "Response curves and gains",
        "Radiance",
        "Training",
        "Timings",
        "What was estimated, what was given",
        "Settings",
    ]
    assert 'class="missing"' not in text and text.count("<video") == 4
    # Three frames: recorded, HDR, three exposures, depth, motion; three held-out views.
    assert text.count("<img") == 3 * 7 + 3
    for words in ("training views (not held out)", "flow magnitude", "1,234 rays per second"):
        assert words in text, words


def test_the_report_counts_the_steps_of_the_run_and_not_of_its_log(
    finished: tuple[Run, Path], tmp_path: Path
) -> None:
    later = replace(finished[0], step=64)  # the log ends at 59
    text, _ = read(write_report(later, tmp_path / "report.html", tmp_path))
    assert "; step 64;" in text and "64 steps, 1,234 rays" in text and "59 steps" not in text


def test_numbers_of_an_earlier_step_are_named_so(
    finished: tuple[Run, Path], tmp_path: Path
) -> None:
    run, folder = finished
    words = f"these numbers are of step {run.step}, the run is at step 64"
    text, _ = read(write_report(run, folder / "report.html", folder / "render"))
    assert words not in text
    text, _ = read(write_report(replace(run, step=64), tmp_path / "report.html", tmp_path))
    assert words in text


def test_the_report_shows_what_was_given_and_estimated_with_names_escaped(
    finished: tuple[Run, Path],
) -> None:
    run, folder = finished
    text, _ = read(write_report(run, folder / "report.html", folder / "render"))
    for words in ("EV -4, -2, 0 from --ev", "6 of 6 frames registered", "12.5 s"):
        assert words in text, words
    assert "made up &lt;clip&gt;" in text and "<clip>" not in text


def test_depth_motion_stability_and_exposure_steps_are_shown_where_the_truth_has_them(
    tmp_path: Path,
) -> None:
    run = with_flow(fake_run(tmp_path / "run"))
    manifest = run.scene.manifest.model_copy(update={"protocol": "novel-view-time"})
    run = replace(run, scene=replace(run.scene, manifest=manifest))
    evaluate_run(run, truth_of(tmp_path / "truth", run))
    text, _ = read(write_report(run, tmp_path / "report.html", tmp_path / "render"))
    for words in (
        "depth, AbsRel",
        "scene flow, end-point error",
        "PU21 PSNR moving",
        "HDR-TAE",
        "largest error of a step between exposures",
        "scene flow by 3.0000",
        "1000 cd/m²",
        "protocol novel-view-time",
    ):
        assert words in text, words
    pairs = "<td>pairs of training frames, along the clip&#39;s own flow</td>"
    assert f'{pairs}<td class="n">5</td>' in text


def test_missing_parts_are_named_with_the_command_that_makes_them(tmp_path: Path) -> None:
    text, _ = read(write_report(fake_run(tmp_path), tmp_path / "report.html", tmp_path / "render"))
    # results, videos, side by side, held-out, quality, radiance, training
    assert text.count('class="missing"') == 7
    for words in ("hdr-nsff evaluate RUN", "hdr-nsff render RUN", "as filmed, in hdr"):
        assert words in text, words


def test_refused_bullet_time_is_explained(tmp_path: Path) -> None:
    run = fake_run(tmp_path, parallax="none")
    render_all(run, tmp_path / "render")
    text, _ = read(write_report(run, tmp_path / "report.html", tmp_path / "render"))
    assert "no bullet time from this clip, its camera stood still" in text


@pytest.mark.parametrize("kind", ["none", "fixed", "per_image", "mlp", "sigmoid"])
def test_every_tone_mapper_can_be_reported(tmp_path: Path, kind) -> None:
    tonemapper = tone_mapper([0, 1, 2, 0, 1, 2], [0] * 6, [-4.0, None, 0.0], 2, kind=kind)
    run = replace(fake_run(tmp_path), tonemapper=tonemapper)
    text, _ = read(write_report(run, tmp_path / "report.html", tmp_path / "render"))
    assert "response of camera 0" in text


def test_long_videos_are_linked_by_relative_path(
    finished: tuple[Run, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, folder = finished
    monkeypatch.setattr("hdr_nsff.evaluation.report.pictures.MAX_EMBEDDED_BYTES", 10)
    text = write_report(run, folder / "report.html", folder / "render").read_text()
    assert 'href="render/bullet.mp4"' in text and "<video" not in text


def test_the_page_of_the_viewer_is_linked_where_it_is(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run")
    assert find_viewer(run, tmp_path) is None
    run.folder.mkdir(exist_ok=True)
    (run.folder / "scene.html").touch()
    assert find_viewer(run, tmp_path) == "run/scene.html"
    (tmp_path / "scene.html").touch()
    assert find_viewer(run, tmp_path) == "scene.html"
    assert find_viewer(run, tmp_path / "elsewhere") is None


def test_a_moving_average_keeps_length_and_constants() -> None:
    assert np.allclose(moving_average([3.0] * 200), 3.0)
    assert moving_average(list(range(7))).tolist() == list(range(7))
    # Five of 200 values at a time, the first one repeated at the border.
    assert np.allclose(moving_average([0.0, 5.0, 10.0] + [10.0] * 197)[:3], [3.0, 5.0, 7.0])


def test_the_verb_writes_beside_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder: fake_run(Path(folder))))
    assert report(ReportConfig(tmp_path)) == tmp_path / "report.html"
    assert (tmp_path / "report.html").stat().st_size > 10_000


def test_the_verb_finds_the_videos_of_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder: fake_run(Path(folder))))
    (tmp_path / "run").mkdir()
    (tmp_path / "render").mkdir()
    (tmp_path / "render/training.mp4").write_bytes(b"a video")
    text, _ = read(report(ReportConfig(tmp_path / "run")))
    assert "data:video/mp4" in text


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="not Linux")
def test_a_report_is_not_written_over_devices_or_below_proc(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder: fake_run(Path(folder))))
    for out in ("/dev/null", "/proc/self/mem", "/proc/nowhere/report.html"):
        with pytest.raises(InputError, match=f"^{out.removesuffix('/report.html')}: "):
            report(ReportConfig(tmp_path, out=Path(out)))


def test_learned_exposures_are_called_learned(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    manifest = run.scene.manifest.model_copy(
        update={"exposure_given": False, "bracket_ev": [None, None, 0.0]}
    )
    run = replace(run, scene=replace(run.scene, manifest=manifest))
    text, _ = read(write_report(run, tmp_path / "r.html", tmp_path / "render"))
    assert "learned" in text and "none given" in text


def test_pictures_of_other_views_are_left_out(finished: tuple[Run, Path], tmp_path: Path) -> None:
    run, folder = finished
    renders = tmp_path / "render"
    shutil.copytree(folder / "render", renders)
    assert side_by_side(run, renders) is not None
    note = json.loads((renders / "training/sequence.json").read_text())
    note["views"] += note["views"][:2]  # as if `render --path training` had made more
    (renders / "training/sequence.json").write_text(json.dumps(note))
    assert side_by_side(run, renders) is None


def test_the_recorded_frame_is_of_the_camera_of_the_view(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    beside = [
        replace(f, index=f.index + 6, camera_id=1, camera=f.camera.moved(shifted(f.camera.c2w)))
        for f in run.scene.train
    ]
    rig = replace(run, scene=replace(run.scene, train=run.scene.train + beside))
    views = [describe_view(rig, v, Output()) for v in plan_shot(rig, "training").views]
    assert [recorded_frame(rig, view).index for view in views] == [v.frame for v in views]
    assert sorted(view.frame or 0 for view in views) == list(range(12))
    between = describe_view(rig, PathView(run.scene.train[0].camera, 2.2), Output())
    assert between.frame is None and recorded_frame(rig, between).time == 2


def shifted(c2w: Tensor) -> Tensor:
    """A pose (3, 4) a little to the right."""
    return c2w + torch.eye(3, 4).roll(3, 1) * 0.3
