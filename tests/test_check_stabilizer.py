"""What `check` says of electronic stabilization, on facts made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from test_check import good_facts

from hdr_nsff.check.findings import judge


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({"stabilized": True}, "warning", "was on"),
        ({"stabilized": False}, "good", "was off"),
        ({"shake": None}, "note", "not measured"),
        ({"shake": (1.0, 3.0)}, "good", "shakes"),
        ({"shake": (0.2, 3.0)}, "note", "stabilized"),
        ({"shake": (0.01, 0.05)}, "note", "hardly moves"),
        ({"shake": (1.0, 3.0), "motion": "tripod"}, "note", "hardly moves"),
    ],
)
def test_stabilization_is_judged_by_the_file_else_by_shake(
    changes: dict[str, Any], level: str, words: str
) -> None:
    good = good_facts()
    file, camera = (
        replace(part, **{k: v for k, v in changes.items() if hasattr(part, k)})
        for part in (good.file, good.camera)
    )
    found = judge(replace(good, file=file, camera=camera))
    (finding,) = [f for f in found if f.subject == "stabilizer"]
    assert finding.level == level and words in finding.text
    assert bool(finding.advice) == (level != "good")
