"""The layers hold, and nothing is imported in circles."""

from graphlib import TopologicalSorter

import architecture as structure
import pytest

pytestmark = pytest.mark.slow

DOMAIN_MAY_NOT = ("rclpy", "_msgs", "_interfaces")


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
    graph = {name: (structure.imports(name, types=True) & names) - {name} for name in names}
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
