"""The layers hold, nothing is imported in circles, and docs/architecture.md is of this code."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import architecture as structure
import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
DOMAIN_MAY_NOT = ("rclpy", "_msgs", "_interfaces")


def test_every_room_has_its_place_in_a_layer():
    assert set(structure.places()) == set(structure.rooms())


@pytest.mark.slow
def test_no_arrow_leads_to_a_layer_above():
    layer = {
        room: number
        for number, (_, rows) in enumerate(structure.LAYERS)
        for row in rows
        for room in row
    }
    assert not {(start, end) for start, end in structure.arrows() if layer[start] > layer[end]}


def test_rooms_are_not_in_circles():
    pairs = structure.arrows()
    assert not [room for room in structure.rooms() if room in structure.reached(room, pairs)]


def test_modules_are_not_in_circles():
    names = structure.FILES.keys()
    graph = {name: (structure.imports(name, lazy=False) & names) - {name} for name in names}
    TopologicalSorter(graph).prepare()  # raises CycleError


def test_the_domain_knows_nothing_of_ros():
    domain = {room for row in structure.LAYERS[-1][1] for room in row}
    for name in structure.FILES:
        if structure.room_of(name) in domain:
            roots = {imported.split(".")[0] for imported in structure.imports(name)}
            assert not [root for root in roots if root.endswith(DOMAIN_MAY_NOT)], name


def test_settings_import_no_other_room_and_no_numerical_library():
    assert not [end for start, end in structure.arrows() if start == "settings"]
    for name in structure.FILES:
        if structure.room_of(name) == "settings":
            roots = {imported.split(".")[0] for imported in structure.imports(name)}
            assert not roots & {"numpy", "scipy", "numba"}, name


def test_a_module_is_no_longer_than_700_lines_and_few_are_at_the_top():
    texts = {name: file.read_text(encoding="utf-8") for name, file in structure.FILES.items()}
    assert {name for name, text in texts.items() if len(text.splitlines()) > 700} == set()
    assert len(list(structure.PACKAGE.glob("*.py"))) <= 7


def test_the_page_has_each_rooms_own_sentence():
    told = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", PAGE, re.MULTILINE))
    said = {room: text.partition("\n")[0] for room, text in structure.rooms().items()}
    assert {room: told.get(room) for room in said} == said


@pytest.mark.slow
def test_every_class_on_the_page_is_where_it_says():
    links = re.findall(r"\[([A-Z]\w+)\]\(\.\./(us_sim/[\w/]+\.py)\)", PAGE)
    assert len(links) > 15
    for name, file in links:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {n.name for n in tree.body if isinstance(n, ast.ClassDef)}, (name, file)
