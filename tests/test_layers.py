"""Layers: arrows point down only, nothing goes in circles, and a module is about one thing."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

import us_sim

ROOT = Path(us_sim.__file__).parent
FILES = {
    ".".join(file.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): file
    for file in ROOT.rglob("*.py")
}
DOMAIN = [
    "tissue",
    "skin",
    "slicing",
    "tracking",
    "viewer",
    "volume",
    "recording",
    "geometry",
    "settings",
    "scene",
    "errors",
    "progress",
    "share",
]
UPPER = ("nodes", "run", "demo", "command", "evaluation", "to_rerun")
MESSAGES = [
    "builtin_interfaces",
    "diagnostic_msgs",
    "geometry_msgs",
    "rcl_interfaces",
    "rosbag2_interfaces",
    "sensor_msgs",
    "shape_msgs",
    "std_msgs",
    "tf2_msgs",
    "visualization_msgs",
]


@functools.cache
def imported(name: str, *, lazily: bool = True) -> tuple[str, ...]:
    """What a module imports at run time: in functions too, or only while it is imported itself."""

    def within(nodes: list[ast.stmt]) -> Iterator[str]:
        for node in nodes:
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                package = FILES[name].relative_to(ROOT.parent).parts[: -node.level or None]
                origin = ".".join([*(package if node.level else ()), *filter(None, [node.module])])
                for alias in node.names:
                    inner = f"{origin}.{alias.name}"
                    yield inner if inner in FILES else origin
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not lazily:
                continue
            elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
                yield from within(node.orelse)
            else:
                for block in ("body", "orelse", "handlers", "finalbody"):
                    yield from within(getattr(node, block, []))

    return tuple(within(tree(name).body))


@functools.cache
def tree(name: str) -> ast.Module:
    return ast.parse(FILES[name].read_text(encoding="utf-8"))


def is_of(name: str, rooms: list[str] | tuple[str, ...]) -> bool:
    """Whether a module is in one of the rooms of the package, or is one."""
    return any(f"{name}.".startswith(f"us_sim.{room}.") for room in rooms)


def arrows(rooms: list[str] | tuple[str, ...], forbidden: list[str] | tuple[str, ...]) -> set[str]:
    """Imports from rooms of what they must not know: other rooms, or packages of others."""
    return {
        f"{name} -> {target}"
        for name in FILES
        if is_of(name, rooms)
        for target in imported(name)
        if is_of(target, forbidden) or target.partition(".")[0] in forbidden
    }


@pytest.mark.parametrize(
    ("rooms", "forbidden"),
    [
        (DOMAIN, ["rclpy", *MESSAGES, *UPPER, "standalone"]),
        (["nodes"], ["run", "demo", "command", "evaluation", "to_rerun"]),
        (["run"], ["evaluation", "command", "to_rerun"]),
        (["standalone"], [*DOMAIN, *UPPER, "cache"]),
        (["run", "demo", "command", "evaluation", "to_rerun"], ["standalone"]),
        (
            ["settings"],
            [room for room in DOMAIN if room not in ("settings", "errors")] + ["numpy", "scipy"],
        ),
    ],
)
def test_arrows_point_down_only(rooms, forbidden):
    assert not arrows(rooms, forbidden)


def test_only_what_provides_rclpy_knows_that_it_may_not_be_there():
    known = {arrow.partition(" ")[0] for arrow in arrows(["nodes", *DOMAIN], ["standalone"])}
    assert known == {"us_sim.nodes"}


def test_nothing_is_imported_in_circles():
    graph = {
        name: {t for t in imported(name, lazily=False) if t in FILES and t != name}
        for name in FILES
    }
    while leaves := {name for name, targets in graph.items() if not targets & graph.keys()}:
        graph = {name: targets for name, targets in graph.items() if name not in leaves}
    assert not graph


def test_a_module_is_no_longer_than_700_lines_and_few_are_at_the_top():
    lines = {name: len(file.read_text().splitlines()) for name, file in FILES.items()}
    assert {name for name, count in lines.items() if count > 700} == set()
    assert len(list(ROOT.glob("*.py"))) <= 7
