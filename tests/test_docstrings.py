"""The examples in the docstrings do what they say."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import us_sim

ROOT = Path(us_sim.__file__).parent
MODULES = sorted(
    ".".join(file.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
    for file in ROOT.rglob("*.py")
    if file.relative_to(ROOT).parts[0] != "nodes" and ">>> " in file.read_text(encoding="utf-8")
)
PAGE = Path(__file__).parents[1] / "docs" / "api.md"
PUBLIC = re.findall(r"^::: (\S+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    assert doctest.testmod(importlib.import_module(name), optionflags=flags).failed == 0


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_name_has_an_example_where_the_page_says(name):
    module, _, member = name.rpartition(".")
    found = getattr(importlib.import_module(module), member)
    assert found.__module__ == module
    assert ">>> " in inspect.getdoc(found)
    assert module in MODULES  # so that it is run


def test_the_script_of_the_page_runs(capsys):
    (script,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(script, {})
    assert re.search(r"-\d", capsys.readouterr().out)  # N: the tissue pushes the probe back
