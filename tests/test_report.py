"""The report is one file that needs no other, shows what there is, and names what is
missing.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from fakes import fake_run
from test_scores import truth_of, with_flow

from estimates import tone_mapper
from hdr_nsff.core.page import figure, table
from hdr_nsff.evaluation.evaluate import evaluate_run
from hdr_nsff.evaluation.report import ReportConfig, report, smoothed, write_report
from hdr_nsff.rendering.render import render_all
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
    """The page's text and its headings; every tag is closed, and nothing outside the
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
    lines = [
        {"step": s, "seconds": 0.1 * s, "psnr": 20 + s / 10, "rays_per_second": 1234.0, "losses": {"photometric": 1 / s, "flow_magnitude": 0.1}}
        for s in range(1, 60)
    ]  # fmt: skip
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return run, folder


def test_a_finished_run_has_every_section_and_nothing_is_missing(
    finished: tuple[Run, Path],
) -> None:
    run, folder = finished
    text, headings = read(write_report(run, folder / "report.html", folder / "render"))
    assert headings == [
        "Results", "Videos", "Side by side", "Held-out views", "Quality", "Response curves and gains", "Radiance", "Training",
        "Timings", "What was estimated, what was given", "Settings",
    ]  # fmt: skip
    assert 'class="missing"' not in text and text.count("<video") == 4
    assert (
        text.count("<img") == 3 * 7 + 3
    )  # three frames: recorded, HDR, three exposures, depth, motion; three held-out pictures
    assert (
        "training views (not held out)" in text
        and "flow magnitude" in text
        and "1,234 rays per second" in text
    )


def test_what_was_given_and_estimated_is_told_and_names_are_escaped(
    finished: tuple[Run, Path],
) -> None:
    run, folder = finished
    text, _ = read(write_report(run, folder / "report.html", folder / "render"))
    assert (
        "EV -4, -2, 0 from --ev" in text and "6 of 6 frames registered" in text and "12.5 s" in text
    )
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
    ):
        assert words in text, words
    assert (
        "scene flow by 3.0000" in text
        and "1000 cd/m²" in text
        and "protocol novel-view-time" in text
    )
    assert (
        "<td>pairs of training frames, along the clip&#x27;s own flow</td><td class=n>5</td>"
        in text
    )


def test_missing_parts_are_named_with_the_command_that_makes_them(tmp_path: Path) -> None:
    text, _ = read(write_report(fake_run(tmp_path), tmp_path / "report.html", tmp_path / "render"))
    assert (
        text.count('class="missing"') == 7
    )  # results, videos, side by side, held-out, quality, radiance, training
    assert (
        "hdr-nsff evaluate RUN" in text
        and "hdr-nsff render RUN" in text
        and "as filmed, in hdr" in text
    )


def test_refused_bullet_time_is_explained(tmp_path: Path) -> None:
    run = fake_run(tmp_path, parallax="none")
    render_all(run, tmp_path / "render")
    text, _ = read(write_report(run, tmp_path / "report.html", tmp_path / "render"))
    assert "no bullet time from this clip, its camera stood still" in text


@pytest.mark.parametrize("kind", ["none", "fixed", "per_image", "mlp", "sigmoid"])
def test_every_tone_mapper_can_be_reported(tmp_path: Path, kind) -> None:
    run = replace(
        fake_run(tmp_path),
        tonemapper=tone_mapper([0, 1, 2, 0, 1, 2], [0] * 6, [-4.0, None, 0.0], 2, kind=kind),
    )
    text, _ = read(write_report(run, tmp_path / "report.html", tmp_path / "render"))
    assert "response of camera 0" in text


def test_long_videos_are_linked_by_relative_path(
    finished: tuple[Run, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, folder = finished
    monkeypatch.setattr("hdr_nsff.evaluation.report.EMBED", 10)
    text = write_report(run, folder / "report.html", folder / "render").read_text()
    assert 'href="render/bullet.mp4"' in text and "<video" not in text


def test_pictures_are_shrunk_to_the_widest_and_tables_escaped() -> None:
    small, large = (
        figure(np.zeros((10, 20, 3)), "a"),
        figure(np.random.default_rng(0).random((400, 800, 3)), "b", widest=100),
    )
    assert len(small) < 2000 and len(large) < 20000
    assert "<td class=n>1 &lt; 2</td>" in table(("a", "b"), [("x", "1 < 2")])


def test_smoothing_keeps_length_and_constants() -> None:
    assert np.allclose(smoothed([3.0] * 200), 3.0) and len(smoothed(list(range(7)))) == 7


def test_the_verb_writes_beside_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder: fake_run(Path(folder))))
    assert (
        report(ReportConfig(tmp_path)) == tmp_path / "report.html"
        and (tmp_path / "report.html").stat().st_size > 10_000
    )


def test_learned_exposures_are_called_learned(tmp_path: Path) -> None:
    run = fake_run(tmp_path)
    manifest = run.scene.manifest.model_copy(
        update={"exposure_given": False, "bracket_ev": [None, None, 0.0]}
    )
    text, _ = read(
        write_report(
            replace(run, scene=replace(run.scene, manifest=manifest)),
            tmp_path / "r.html",
            tmp_path / "render",
        )
    )
    assert "learned" in text and "none given" in text
