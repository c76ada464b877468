"""No code compares, splits or parses an English sentence: facts travel in fields and codes."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import us_sim

PARSING = {
    *("startswith", "endswith", "removeprefix", "removesuffix", "index", "find", "rfind"),
    *("partition", "rpartition", "split", "rsplit", "match", "search", "fullmatch", "sub"),
}
FOREIGN = ("Wrong parameter type", "model name")
"""Texts of others: rclpy's refusal, which has no code, and a line of /proc/cpuinfo."""


def sentences(node: ast.AST) -> Iterator[str]:
    """Literals of two words or more; separators and single words are none."""
    for each in ast.walk(node):
        text = each.value if isinstance(each, ast.Constant) else None
        if isinstance(text, str) and re.search(r"[A-Za-z]{2,} [a-z]{2,}", text):
            yield text


def parsed(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Sentences with which a text is compared or taken apart, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            literals = node.args if node.func.attr in PARSING else []
        elif isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
            literals = [node.left]
        else:
            continue
        yield from ((node.lineno, text) for each in literals for text in sentences(each))


@pytest.mark.slow
def test_no_code_takes_a_sentence_apart():
    root = Path(us_sim.__file__).parent
    found = {
        f"{file.relative_to(root)}:{line}: {text!r}"
        for file in root.rglob("*.py")
        for line, text in parsed(ast.parse(file.read_text(encoding="utf-8")))
        if text not in FOREIGN
    }
    assert not found


def test_sentences_are_found_where_they_are_parsed():
    code = "t.endswith('it is set back'); 'keep one' in t; t.split(', '); t == 'a b'; 'one' in t"
    assert {text for _, text in parsed(ast.parse(code))} == {"it is set back", "keep one"}
