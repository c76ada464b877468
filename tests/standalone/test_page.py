"""The node in `docs/standalone.md` runs as it stands there, and what the page counts is so."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy
from geometry_msgs.msg import PoseStamped

from us_sim.standalone.interfaces import message_names, packages

PAGE = (Path(__file__).parents[2] / "docs" / "standalone.md").read_text(encoding="utf-8")


def test_the_node_publishes_poses_until_it_is_interrupted(bench, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    file = tmp_path / "my_tracker.py"
    file.write_text(code)
    received: list[PoseStamped] = []
    listener = bench.node("listener")
    listener.create_subscription(PoseStamped, "/left/tracker/pose", received.append, 10)
    command = [sys.executable, str(file), "--ros-args", "-r", "tracker/pose:=/left/tracker/pose"]
    with subprocess.Popen(
        [*command, "-r", "__node:=left_tracker"],
        env=dict(os.environ),
        stderr=subprocess.PIPE,
        text=True,
    ) as node:
        try:
            assert bench.spin_until(lambda: len(received) >= 5, seconds=30)
            assert bench.spin_until(lambda: "left_tracker" in listener.get_node_names(), seconds=30)
            node.send_signal(signal.SIGINT)
            _, errors = node.communicate(timeout=10)
        finally:
            node.kill()
    assert (node.returncode, errors) == (0, "")
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in received[:5]]
    assert stamps == sorted(stamps)
    assert 0.03 < stamps[-1] - stamps[0] < 5
    assert received[0].pose.position.z == 0.01


@pytest.mark.skipif(rclpy.__name__ == "rclpy", reason="the real rclpy has other messages")
def test_the_page_counts_the_messages() -> None:
    counts = [len(message_names(package)) for package in packages()]
    assert f"({sum(counts)} in {sum(map(bool, counts))} packages)" in PAGE
