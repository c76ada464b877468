"""`us_sim.standalone.install`: only where there is no ROS 2, and light."""

import subprocess
import sys
from pathlib import Path

import pytest
import rclpy

import us_sim.standalone

pytestmark = pytest.mark.skipif(
    rclpy.__name__ == "rclpy", reason="the real rclpy is here, so nothing is installed"
)

RCLPY = Path(us_sim.standalone.__file__).parent / "rclpy"
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
