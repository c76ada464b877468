"""The subset stands alone: it imports nothing of us_sim, in no circle, and works elsewhere."""

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
import rclpy

import us_sim.standalone

FOLDER = Path(us_sim.standalone.__file__).parent
PACKAGE = FOLDER.name
OTHERS = {"cyclonedds", "numpy", "rosbags", "yaml"}


def module_name(file: Path) -> str:
    """The dotted name below `us_sim`."""
    parts = [PACKAGE, *file.relative_to(FOLDER).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(file): file for file in sorted(FOLDER.rglob("*.py"))}


def imports(name: str) -> Iterator[str]:
    """Full names of what a module imports anywhere, in functions and for types too."""
    package = name if FILES[name].name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(FILES[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] if node.level else ""
            source = ".".join(filter(None, (above, node.module)))
            for alias in node.names:
                member = f"{source}.{alias.name}"
                yield member if member in FILES else source


@pytest.mark.parametrize("name", FILES)
def test_a_module_imports_its_own_kind_and_what_is_declared(name: str) -> None:
    for imported in imports(name):
        root = imported.partition(".")[0]
        known = imported in FILES or root in OTHERS or root in sys.stdlib_module_names
        assert known, f"{name} imports {imported}"


def test_there_is_no_circle() -> None:
    graph = {name: {other for other in imports(name) if other in FILES} - {name} for name in FILES}
    TopologicalSorter(graph).prepare()  # raises CycleError


NODE = """
import sys
import alone
assert alone.install()
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("probe")
heard = []
node.create_subscription(String, "text", heard.append, 10)
publisher = node.create_publisher(String, "text", 10)
node.create_timer(0.02, lambda: publisher.publish(String(data="vein")))
while not heard:
    rclpy.spin_once(node, timeout_sec=5.0)
node.destroy_node()
rclpy.shutdown()
print(heard[0].data, [name for name in sys.modules if name.startswith("us_sim")])
"""


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="the real rclpy is here")
def test_it_works_under_another_name_without_the_rest(tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "alone", ignore=shutil.ignore_patterns("__pycache__"))
    done = subprocess.run(
        [sys.executable, "-c", NODE],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.stdout, done.stderr) == ("vein []\n", "")


RCLPYS_OWN = {  # private names that rclpy's Node has too, and a node must not use
    "_allow_undeclared_parameters",
    "_clients",
    "_clock",
    "_context",
    "_default_callback_group",
    "_descriptors",
    "_guards",
    "_logger",
    "_on_set_parameters_callbacks",
    "_parameter_event_publisher",
    "_parameter_overrides",
    "_parameters",
    "_post_set_parameters_callbacks",
    "_pre_set_parameters_callbacks",
    "_publishers",
    "_services",
    "_subscriptions",
    "_time_source",
    "_timers",
}


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="the real rclpy is here")
def test_nodes_may_call_their_attributes_what_they_like(bench) -> None:
    node = bench.node()
    names = {*vars(node), *(name for name in dir(type(node)) if not hasattr(object, name))}
    private = {name for name in names if name.startswith("_") and not name.startswith("__")}
    assert {name for name in private if not name.startswith("_rcl_")} == RCLPYS_OWN
