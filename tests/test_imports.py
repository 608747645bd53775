"""Rules about imports, read from the source: one order (that of the tree in
docs/architecture.md), verbs apart, the truth out of training's sight, each heavy
library imported by one file.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "hdr_nsff"
VERBS = {
    "check.check",
    "prepare.prepare",
    "synth.synth",
    "synth.reexpose",
    "training.train",
    "rendering.render",
    "rendering.export",
    "evaluation.evaluate",
    "evaluation.report",
    "flow_training.finetune_flow",
    "prepare.weights",
    "doctor",
    "view",
}
# who reads it, for `evaluate` and for `export --truth`, and the last three, which write
# it
TRUTH = {
    "evaluation.targets",
    "evaluation.scores.geometry",
    "evaluation.scores.camera",
    "evaluation.evaluate",
    "footage.layouts.held_out",
    "synth.synth",
    "synth.reexpose",
    "footage.datasets.held_out",
}
HEAVY = {
    "torchvision",
    "pycolmap",
    "mitsuba",
    "drjit",
    "rawpy",
    "flip_evaluator",
    "gsplat",
    "transformers",
    "huggingface_hub",
    "kornia",
    "pxr",
    "PyOpenColorIO",
}


def module_of(path: Path) -> str:
    """`fields.base` for fields/base.py, `fields` for fields/__init__.py."""
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def documented_order() -> list[str]:
    """The modules as the tree of docs/architecture.md lists them, top floor first."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    listing = page.partition("\nsrc/hdr_nsff/\n")[2].partition("```")[0]
    folders: list[str] = []
    order = []
    for line in listing.splitlines():
        name = line.split()[0]
        folders = folders[: (len(line) - len(line.lstrip())) // 2 - 1]
        if name.endswith("/"):
            folders.append(name)
        else:
            order.append(module_of(Path(*folders, name)))
    return order


def imports(tree: ast.AST) -> set[str]:
    """Every dotted name imported anywhere in a file, for type checkers too."""
    if isinstance(tree, ast.Import):
        return {a.name for a in tree.names}
    if isinstance(tree, ast.ImportFrom):
        assert tree.level == 0, f"line {tree.lineno}: write the import out, from hdr_nsff"
        return {f"{tree.module}.{a.name}" for a in tree.names}
    return {name for child in ast.iter_child_nodes(tree) for name in imports(child)}


SOURCES = {
    module_of(p.relative_to(PACKAGE)): ast.parse(p.read_text(encoding="utf-8"))
    for p in PACKAGE.rglob("*.py")
}
ORDER = documented_order()


def own_imports(module: str) -> set[str]:
    """The modules of this package that a module imports."""
    inner = [
        n.removeprefix("hdr_nsff").removeprefix(".")
        for n in imports(SOURCES[module])
        if n.split(".")[0] == "hdr_nsff"
    ]
    return {
        next((m for m in (name, name.rpartition(".")[0]) if m in SOURCES), "__init__")
        for name in inner
    }


def test_every_file_has_one_line_in_the_tree():
    bare = {
        m for m, tree in SOURCES.items() if all(isinstance(node, ast.Expr) for node in tree.body)
    }  # a docstring at most
    assert sorted(ORDER) == sorted(set(ORDER))
    assert set(ORDER) - bare == set(SOURCES) - bare


@pytest.mark.parametrize("module", sorted(SOURCES))
def test_imports_point_down_the_tree(module: str):
    below = set(ORDER[ORDER.index(module) + 1 :]) if module in ORDER else set()
    assert own_imports(module) <= below


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_verbs_never_import_each_other(verb: str):
    assert not own_imports(verb) & VERBS


def test_the_truth_is_read_for_evaluate_and_export_alone():
    assert {m for m in SOURCES if "scene.truth" in own_imports(m)} == TRUTH


def reached(module: str, without: frozenset[str] = frozenset()) -> set[str]:
    """Every module of this package that a module imports, by itself or through others,
    but for ways through those `without`.
    """
    found: set[str] = set()
    waiting = [module]
    while waiting:
        for name in own_imports(waiting.pop()) - found - without:
            found.add(name)
            waiting.append(name)
    return found


def knows_the_truth(modules: set[str]) -> set[str]:
    """Which of these can open a truth folder, or what data sets keep back."""
    return {
        m for m in modules if m in TRUTH | {"scene.truth"} or m.startswith("evaluation.scores.")
    }


LEARNERS = [
    "training.train",
    "prepare.steps.footage",
    "prepare.steps.poses",
    "prepare.steps.movers",
    "prepare.engine",
    "footage.datasets",
    "scene.scene",
    "scene.batch",
    "training.config",
    "training.run_folder",
    "rendering.render",
]


@pytest.mark.parametrize("module", LEARNERS)
def test_preparation_and_training_cannot_import_held_out_truth(module: str):
    assert not knows_the_truth(reached(module))
    assert (
        knows_the_truth(reached("evaluation.evaluate")) >= {"scene.truth", "evaluation.targets"}
        and len(SOURCES) > 50
    )  # the search finds what is there


def test_prepare_reaches_the_truth_through_its_writer_alone():
    assert knows_the_truth(reached("prepare.prepare")) == {
        "footage.datasets.held_out",
        "scene.truth",
    }
    assert not knows_the_truth(
        reached("prepare.prepare", without=frozenset({"footage.datasets.held_out"}))
    )


def test_export_reaches_the_truth_through_what_it_writes_it_with():
    door = "footage.layouts.held_out"
    assert knows_the_truth(reached("rendering.export")) == {door, "scene.truth"}
    assert {m for m in SOURCES if door in own_imports(m)} == {"rendering.export"}
    assert not knows_the_truth(reached("rendering.export", without=frozenset({door})))


def test_only_prepare_writes_what_data_sets_keep_back():
    for module, user in (
        ("footage.datasets.held_out", "prepare.prepare"),
        ("footage.datasets.held_out_views", "footage.datasets.held_out"),
    ):
        assert {m for m in SOURCES if module in own_imports(m)} == {user}


@pytest.mark.parametrize("library", sorted(HEAVY))
def test_a_heavy_library_has_one_door_inside_a_function(library: str):
    users = [
        m for m, tree in SOURCES.items() if library in {n.split(".")[0] for n in imports(tree)}
    ]
    assert len(users) == 1, f"{library} is imported by {users}"
    top = [
        n
        for node in SOURCES[users[0]].body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for n in imports(node)
    ]
    assert not any(n.startswith(library) for n in top), (
        f"{users[0]} imports {library} before anyone needs it"
    )
