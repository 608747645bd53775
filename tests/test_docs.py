"""The documentation against the tree: anchors, links, files, functions, verbs and flags
that it names exist.
"""

import ast
import json
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import asdict
from functools import cache
from io import StringIO
from pathlib import Path

import pytest

from hdr_nsff import cli
from hdr_nsff.core.settings import to_plain
from hdr_nsff.scene.manifest import FrameEntry, LensEntry, Manifest, StepRecord
from hdr_nsff.scene.movers import Mover
from hdr_nsff.scene.response import ResponseFile
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.weighted_terms import merge_weights

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "hdr_nsff"
PAGES = sorted((ROOT / "docs").glob("*.md"))
DOCUMENTS = [ROOT / "README.md", *PAGES]
SOURCES = sorted(p for p in PACKAGE.rglob("*") if p.suffix in {".py", ".html"})
EQUATIONS = {f"eq-{n}" for n in range(1, 18)}  # of the paper
SUBJECTS = {
    "budget",
    "debevec",
    "exposure-cycle",
    "gauge",
    "gaussians",
    "response",
    "rigid-groups",
    "rotation-only",
}

HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
ANCHOR = re.compile(r'<a id="([^"]+)"></a>')
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)")
CITATION = re.compile(r"docs/([a-z]+\.md)(#[\w-]+)?")
FILE = re.compile(r"`(?:[^`]* )?((?:[\w.-]+/)*[\w-]+\.py)(?::([A-Za-z_][\w.]*))?[^`]*`")
CODE = re.compile(r"```.*?```", re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
FLAG = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
COMMAND = re.compile(r"hdr-nsff +([a-z][a-z-]*)([^\n#&|;)]*)")
SETTING = re.compile(r"--set ([\w.]+)=([\w.]+)")
# of pip, torchrun, Chromium and other programs that the documentation calls
FOREIGN_FLAGS = {"--no-deps", "--local-dir", "--version", "--help"}
FOREIGN_FLAGS |= {"--nproc-per-node", "--no-python", "--array"}
FOREIGN_FLAGS |= {"--use-angle", "--enable-unsafe-swiftshader"}

by_name = pytest.mark.parametrize("page", DOCUMENTS, ids=lambda p: p.name)


@cache
def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@cache
def prose_of(page: Path) -> str:
    """A page without its code blocks."""
    return CODE.sub("", text_of(page))


def slug(heading: str) -> str:
    """The anchor that GitHub and MyST give a heading."""
    kept = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return kept.replace(" ", "-")


@cache
def anchors_of(page: Path) -> tuple[str, ...]:
    """Explicit anchors of a page, and those of its headings."""
    headings = [slug(heading) for heading in HEADING.findall(prose_of(page))]
    return (*ANCHOR.findall(text_of(page)), *headings)


@by_name
def test_every_anchor_is_unique(page: Path) -> None:
    repeated = [name for name, count in Counter(anchors_of(page)).items() if count > 1]
    assert not repeated


def test_every_equation_and_subject_of_the_method_has_an_anchor() -> None:
    assert set(anchors_of(ROOT / "docs" / "method.md")) >= EQUATIONS | SUBJECTS


@by_name
def test_every_link_leads_to_a_page_and_an_anchor(page: Path) -> None:
    for target in LINK.findall(prose_of(page)):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        place = page.parent / name if name else page
        assert place.exists(), target
        if anchor:
            assert anchor in anchors_of(place), target


def test_every_cited_page_and_anchor_exists() -> None:
    broken = []
    for source in [*SOURCES, *PAGES]:
        for name, anchor in CITATION.findall(text_of(source)):
            page = ROOT / "docs" / name
            exists = page.is_file() and (not anchor or anchor[1:] in anchors_of(page))
            if not exists:
                broken.append(f"{source.name}: docs/{name}{anchor}")
    assert not broken


def weights_of(preset: str) -> dict[str, float]:
    """The weights of a preset's terms that are not 0."""
    config = PRESETS[preset]
    own = [asdict(config.field.loss), asdict(config.tonemap.loss)]  # type: ignore[union-attr]
    merged = merge_weights(config.loss, *own, {"pose": config.pose_prior})
    return {name: weight for name, weight in merged.items() if weight}


@pytest.mark.parametrize("preset", ["paper", "grid", "splat"])
def test_the_method_names_every_term_of_a_preset(preset: str) -> None:
    named = INLINE.findall(text_of(ROOT / "docs" / "method.md"))
    assert set(weights_of(preset)) <= set(named)


@pytest.mark.parametrize(("preset", "column"), [("paper", 3), ("grid", 4), ("splat", 5)])
def test_the_table_of_the_method_has_the_weights_of_a_preset(preset: str, column: int) -> None:
    table = text_of(ROOT / "docs" / "method.md").partition("## Where the presets stand")[2]
    weights = weights_of(preset)
    for row in re.findall(r"^\| `\w+` \|.*$", table, re.MULTILINE):
        cells = [cell.strip() for cell in row.split("|")]
        name = cells[1].strip("`")
        number = re.match(r"\**([\d.]+)(?: / (\d))?", cells[column])
        weight = float(number[1]) / float(number[2] or 1) if number else None
        assert weight == weights.get(name), row


@pytest.mark.parametrize(
    ("file", "models"),
    [
        ("scene.json", (Manifest, LensEntry, FrameEntry, StepRecord)),
        ("response.json", (ResponseFile,)),
        ("movers.npz", (Mover,)),
    ],
)
def test_the_formats_have_the_keys_of_a_scene_and_no_others(file: str, models: tuple) -> None:
    section = text_of(ROOT / "docs" / "formats.md").partition(f"### `{file}`\n")[2]
    rows = re.findall(r"^\|([^|]*)\|", section.partition("\n###")[0], re.MULTILINE)
    named = {name for row in rows for name in INLINE.findall(row)}
    keys = {key for model in models for key in model.__annotations__} - {"model_config"}
    assert named == keys


@pytest.mark.parametrize(("heading", "model"), [("`truth.json`", Truth), ("a view", TruthView)])
def test_the_formats_have_the_keys_of_a_truth_and_no_others(heading: str, model: type) -> None:
    table = text_of(ROOT / "docs" / "formats.md").partition(f"| key of {heading} |")[2]
    rows = re.findall(r"^\|([^|]*)\|", table.partition("\n\n")[0], re.MULTILINE)
    named = {name for row in rows for name in INLINE.findall(row)}
    assert named == set(model.__annotations__)


def test_the_readme_has_the_measured_errors_of_auto_exposure() -> None:
    measured = json.loads(text_of(ROOT / "benchmarks/results/auto_exposure.json"))["results"]
    for lossless, where in ((True, "EV (median) on lossless frames"), (False, "EV on video")):
        errors = [clip["median_error"] for clip in measured if clip["lossless"] is lossless]
        assert f"{min(errors):.2f} to {max(errors):.2f} {where}" in text_of(ROOT / "README.md")


# Files and functions


def places_of(name: str) -> list[Path]:
    """The files that a path in the documentation can mean."""
    roots = [ROOT, PACKAGE, ROOT / "src", ROOT / "docs"]
    found = [root / name for root in roots if (root / name).is_file()]
    if not found and "/" not in name:
        folders = (PACKAGE, ROOT / "tests", ROOT / "benchmarks")
        found = [path for folder in folders for path in folder.rglob(name)]
    return found


@cache
def definitions(path: Path) -> set[str]:
    """Functions, classes, methods (`Class.method`) and constants of a file."""
    return set(names_in(ast.parse(text_of(path)), ""))


def names_in(tree: ast.Module | ast.ClassDef, prefix: str) -> Iterator[str]:
    for node in tree.body:
        match node:
            case ast.FunctionDef():
                yield prefix + node.name
            case ast.ClassDef():
                yield prefix + node.name
                yield from names_in(node, f"{prefix}{node.name}.")
            case ast.Assign() | ast.AnnAssign():
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                yield from (prefix + t.id for t in targets if isinstance(t, ast.Name))


@by_name
def test_every_file_and_function_named_exists(page: Path) -> None:
    for name, function in FILE.findall(prose_of(page)):
        places = places_of(name)
        assert places, name
        if function:
            assert any(function in definitions(path) for path in places), f"{name}:{function}"


# Verbs and flags


@pytest.fixture(scope="module")
def flags() -> dict[str, set[str]]:
    """The flags of every verb as its help lists them."""
    return {verb: set().union(*map(flags_in, calls_of(verb))) for verb in cli.VERBS}


def calls_of(verb: str) -> list[list[str]]:
    if verb != "train":
        return [[verb, "--help"]]
    presets = ("splat", "grid", "paper", "hdr-hexplane")
    return [[verb, "--help"], *([verb, preset, "--help"] for preset in presets)]


def flags_in(arguments: list[str]) -> set[str]:
    """The flags that a help page lists."""
    page = StringIO()
    with redirect_stdout(page), pytest.raises(SystemExit):
        cli.main(arguments)
    return set(FLAG.findall(page.getvalue()))


def commands_of(page: Path) -> list[tuple[str, str]]:
    """Verbs and the rest of their line, in code blocks and in inline code."""
    joined = re.sub(r'"[^"\n]*"', "", text_of(page).replace("\\\n", " "))  # quoted: of others
    code = [*CODE.findall(joined), *INLINE.findall(CODE.sub("", joined))]
    return [found for piece in code for found in COMMAND.findall(piece)]


@by_name
def test_every_command_names_a_verb_and_its_flags(page: Path, flags: dict[str, set[str]]) -> None:
    for verb, rest in commands_of(page):
        assert verb in cli.VERBS, f"hdr-nsff {verb}"
        for flag in FLAG.findall(rest):
            assert flag in flags[verb] | FOREIGN_FLAGS, f"hdr-nsff {verb} {flag}"


@by_name
def test_every_flag_belongs_to_a_verb_or_a_benchmark(
    page: Path, flags: dict[str, set[str]]
) -> None:
    scripts = "\n".join(text_of(p) for p in (ROOT / "benchmarks").glob("*.py"))
    known = set().union(FOREIGN_FLAGS, FLAG.findall(scripts), *flags.values())
    named = {flag for code in INLINE.findall(prose_of(page)) for flag in FLAG.findall(code)}
    unknown = sorted(named - known)
    assert not unknown, " ".join(unknown)


@by_name
def test_every_setting_given_by_set_exists(page: Path) -> None:
    configs = [json.loads(json.dumps(to_plain(config))) for config in PRESETS.values()]
    for key, _ in SETTING.findall(text_of(page)):
        assert key == "NAME" or any(has_key(config, key.split(".")) for config in configs), key


def has_key(data: object, path: list[str]) -> bool:
    """Whether nested plain data have an entry at a path of keys."""
    for name in path:
        if not isinstance(data, dict) or name not in data:
            return False
        data = data[name]
    return True
