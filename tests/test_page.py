"""Pieces of pages: pictures are embedded and shrunk, every text is escaped."""

from __future__ import annotations

import base64

import cv2
import jinja2
import numpy as np
import pytest

from hdr_nsff.core.page import Table, environment, figure, number, plot, plural, svg


def render(macro: str, value: object) -> str:
    """A macro of the shared parts, applied to a value."""
    source = '{% import "core/templates/parts.html" as parts %}{{ parts.' + macro + "(it) }}"
    return environment().from_string(source).render(it=value)


def size_of(source: str) -> tuple[int, ...]:
    """Height and width of an embedded picture."""
    data = base64.b64decode(source.removeprefix("data:image/jpeg;base64,"))
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape[:2]


def test_pictures_are_shrunk_to_the_widest() -> None:
    assert size_of(figure(np.zeros((10, 20, 3)), "a").source) == (10, 20)
    assert size_of(figure(np.zeros((400, 800, 3)), "b", width=100).source) == (50, 100)


def test_texts_of_tables_and_captions_are_escaped() -> None:
    table = render("table", Table(("a", "<b>"), [("x & y", "1 < 2")]))
    assert '<th class="n">&lt;b&gt;</th>' in table
    assert '<td>x &amp; y</td><td class="n">1 &lt; 2</td>' in table
    picture = render("picture", figure(np.zeros((4, 4, 3)), '"><script>'))
    assert "<script>" not in picture and "&#34;&gt;&lt;script&gt;" in picture


def test_a_table_without_header_has_none_and_the_best_numbers_are_bold() -> None:
    table = render("table", Table(("", ""), [("x", "1"), ("y", "2")], bold=frozenset({(1, 1)})))
    assert "<th" not in table
    assert '<td class="n">1</td>' in table and '<td class="n"><b>2</b></td>' in table


def test_a_name_that_a_template_does_not_know_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError):
        environment().from_string("{{ titel }}").render(title="a")


def test_a_plot_is_markup_whose_texts_are_escaped() -> None:
    drawing, axes = plot(2, 2)
    axes.set(title="a < b")
    text = svg(drawing)
    assert text.startswith("<svg") and "a &lt; b" in text and "a < b" not in text


def test_numbers_and_counts_in_words() -> None:
    assert (number(1.005, 1), number(None), number(2.0, 0, " dB")) == ("1.0", "–", "2 dB")
    assert (plural(1, "scene"), plural(2, "scene")) == ("1 scene", "2 scenes")
