"""The page of a benchmark: crops around moving pixels; names are escaped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from test_report import Balanced
from test_tables import ROWS

from hdr_nsff.bench.config import BenchConfig, BenchPlan
from hdr_nsff.bench.gallery import moving_box, write_page
from hdr_nsff.core.images import write_png


def test_a_crop_has_a_margin_and_stays_inside_the_picture(tmp_path: Path) -> None:
    mask = np.zeros((60, 120), bool)
    mask[20:40, 110:] = True
    write_png(tmp_path / "mask.png", mask)
    # 0.3 x 20 = 6 rows; 0.3 x 10 = 3, but at least 120 / 12 = 10 columns
    assert moving_box(tmp_path / "mask.png", (60, 120)) == (slice(14, 46), slice(100, 120))
    assert moving_box(tmp_path / "none.png", (60, 120)) == (slice(0, 60), slice(0, 120))


def test_the_page_of_runs_without_pictures_is_whole_and_escaped(tmp_path: Path) -> None:
    rows = [*ROWS, replace(ROWS[3], reason="<script>alert(1)</script>")]
    write_page(BenchPlan(BenchConfig(tmp_path, "a<b>", "x"), (), {}), rows)
    text = (tmp_path / "index.html").read_text()
    parser = Balanced()
    parser.feed(text)
    assert parser.open == [] and "<script>" not in text
    assert parser.headings == [
        "Quality",
        "Mean over 2 scenes: a, c",
        "Cost",
        "Without a result",
        "a",
        "b",
        "c",
        "The views of these means",
    ]
    assert text.count("No run of this scene has pictures yet.") == 3
