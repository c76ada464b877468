"""The evaluation stands on top, without circles, and fills every place of its templates."""

import ast
import graphlib
from pathlib import Path

import pytest

import us_sim
from us_sim.evaluation.report import filled

PACKAGE = Path(us_sim.__file__).parent


def imported(file):
    """The modules of this package that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("us_sim"):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_nothing_below_imports_the_evaluation():
    below = [file for file in PACKAGE.rglob("*.py") if file.parts[-3:-1] != ("us_sim", "command")]
    guilty = {
        str(file.relative_to(PACKAGE))
        for file in below
        if PACKAGE / "evaluation" not in file.parents
        for module in imported(file)
        if module.startswith("us_sim.evaluation")
    }
    assert guilty == set()


def test_the_evaluation_imports_nothing_in_a_circle():
    files = {
        ".".join(("us_sim", *file.relative_to(PACKAGE).with_suffix("").parts)): file
        for file in (PACKAGE / "evaluation").rglob("*.py")
        if file.name != "__init__.py"
    }
    graph = {name: {m for m in imported(file) if m in files} for name, file in files.items()}
    list(graphlib.TopologicalSorter(graph).static_order())  # raises where there is a circle


def test_a_place_of_a_template_that_is_not_filled_is_an_error():
    assert filled("tissue", "locking", nodes="8,192", table="").startswith("## Locking\n\nError of")
    with pytest.raises(ValueError, match="table"):
        filled("tissue", "locking", nodes="8,192")
    with pytest.raises(ValueError, match="more"):
        filled("tissue", "locking", nodes="8,192", table="", more="")
