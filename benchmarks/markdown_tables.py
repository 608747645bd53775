"""Tables and numbers in Markdown, for `results.py`."""

from collections.abc import Sequence

Lines = list[str]


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Lines:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return [f"| {' | '.join(line)} |" for line in lines]


def pair(values: dict[str, float], full: str, moving: str) -> str:
    """Two scores of a run, "full / moving"; a dash for one that it has not."""
    return " / ".join(number(values.get(key), 1) for key in (full, moving))


def number(value: float | None, digits: int) -> str:
    """A number with these digits; a dash for None."""
    return "-" if value is None else f"{value:,.{digits}f}"
