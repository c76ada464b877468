"""The layers hold, and docs/architecture.md says what the code says."""

import ast
import functools
import importlib.util
import re
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
DOMAIN_MAY_NOT = ("rclpy", "_msgs", "rcl_interfaces")


def drawing():
    """docs/architecture.py, which reads the rooms and arrows from the code."""
    spec = importlib.util.spec_from_file_location("drawing", ROOT / "docs" / "architecture.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def picture():
    module = drawing()
    module.arrows = functools.cache(module.arrows)  # reads every file
    return module


def test_every_room_has_its_place(picture):
    assert set(picture.places()) == set(picture.rooms())


def test_the_picture_shows_the_arrows_that_there_are(picture):
    with Image.open(picture.PICTURE) as image:
        assert image.text["Description"] == picture.described(), (
            "docs/architecture.png is not of this code: draw it anew with "
            "`python docs/architecture.py`"
        )


def test_no_arrow_leads_to_a_layer_above(picture):
    layer = {
        room: number
        for number, (_, rows) in enumerate(picture.LAYERS)
        for row in rows
        for room in row
    }
    up = {
        (start, end)
        for start, end in picture.arrows()
        if picture.BESIDE not in (start, end) and layer[start] > layer[end]
    }
    assert not up


def test_no_arrows_lead_in_a_circle(picture):
    pairs = picture.arrows()
    assert not [room for room in picture.rooms() if room in picture.reached(room, pairs)]


def test_standalone_stands_beside(picture):
    pairs = picture.arrows()
    assert [start for start, end in pairs if end == picture.BESIDE] == ["nodes"]
    assert not [end for start, end in pairs if start == picture.BESIDE]


def test_the_domain_knows_nothing_of_ros(picture):
    domain = [room for row in picture.LAYERS[-1][1] for room in row if room]
    for room in domain:
        for file in (picture.PACKAGE / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                modules += [n.name for n in node.names] if isinstance(node, ast.Import) else []
                for module in modules:
                    assert not module.split(".")[0].endswith(DOMAIN_MAY_NOT), (file, module)


def test_the_page_has_each_rooms_own_sentence(picture):
    told = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", PAGE, re.MULTILINE))
    said = {room: text.partition("\n")[0] for room, text in picture.rooms().items()}
    assert {room: told.get(room) for room in said} == said


def test_every_class_on_the_page_is_where_it_says():
    links = re.findall(r"\[([A-Z]\w+)\]\(\.\./(us_sim/[\w/]+\.py)\)", PAGE)
    assert len(links) > 15
    for name, file in links:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {n.name for n in tree.body if isinstance(n, ast.ClassDef)}, (name, file)
