"""Installing the subset: only where there is no ROS 2, light, and alone."""

import doctest
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy

import us_sim.standalone
from us_sim.standalone.libddsc import DdsError

pytestmark = pytest.mark.skipif(
    rclpy.__name__ == "rclpy", reason="the real rclpy is here, so nothing is installed"
)

FOLDER = Path(us_sim.standalone.__file__).parent
RCLPY = FOLDER / "rclpy"
MODULES = sorted(
    ".".join(file.relative_to(RCLPY).with_suffix("").parts)
    for file in RCLPY.rglob("*.py")
    if file.name != "__init__.py"
)


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_module_has_one_identity_under_both_names() -> None:
    code = "import importlib, sys, us_sim.standalone as s\nassert s.install() and s.install()\n"
    for module in MODULES:
        code += (
            f"assert importlib.import_module('rclpy.{module}') is "
            f"importlib.import_module('us_sim.standalone.rclpy.{module}')\n"
        )
    code += "import rclpy\nfrom rclpy.node import Node\nassert rclpy.node.Node is Node\n"
    code += (
        "from geometry_msgs.msg import PoseStamped\nfrom rcl_interfaces.srv import GetParameters\n"
    )
    code += "try:\n    import rclpy.nothing\nexcept ModuleNotFoundError:\n    print('none')\n"
    assert run(code) == "none\n"


def test_installing_does_not_load_the_middleware() -> None:
    code = (
        "import sys, us_sim.standalone as s; s.install()\n"
        "print([m for m in sys.modules if 'ddsc' in m or m.startswith('cyclonedds')])"
    )
    assert run(code) == "[]\n"


def test_a_real_rclpy_is_left_alone(tmp_path) -> None:
    (tmp_path / "rclpy.py").write_text("real = True\n")
    code = (
        f"import sys; sys.path.append({str(tmp_path)!r})\n"
        "import us_sim.standalone as s; print(s.install())\n"
        "import rclpy; print(rclpy.real)"
    )
    assert run(code) == "False\nTrue\n"


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


# Private names that rclpy's Node has too, and a node must not use.
RCLPYS_OWN = """
    _allow_undeclared_parameters _clients _clock _context _default_callback_group
    _descriptors _guards _logger _on_set_parameters_callbacks _parameter_event_publisher
    _parameter_overrides _parameters _post_set_parameters_callbacks
    _pre_set_parameters_callbacks _publishers _services _subscriptions _time_source
    _timers
"""


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="the real rclpy is here")
def test_nodes_may_call_their_attributes_what_they_like(bench) -> None:
    node = bench.node()
    names = {*vars(node), *(name for name in dir(type(node)) if not hasattr(object, name))}
    private = {name for name in names if name.startswith("_") and not name.startswith("__")}
    assert {name for name in private if not name.startswith("_rcl_")} == {*RCLPYS_OWN.split()}


@pytest.mark.parametrize(
    "name", [file.stem for file in sorted(FOLDER.glob("*.py")) if ">>> " in file.read_text()]
)
def test_examples(name: str) -> None:
    try:
        module = importlib.import_module(f"us_sim.standalone.{name}".removesuffix(".__init__"))
    except DdsError as error:  # zenoh takes its place there
        pytest.skip(str(error))
    assert doctest.testmod(module).failed == 0
