"""Ctrl-C meets a node that runs by itself while it is still imported."""

import os
import signal
import subprocess
import sys


def test_ctrl_c_among_imports_is_silent():
    command = [sys.executable, "-X", "importtime", "-m", "us_sim.nodes.path_player"]
    node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=dict(os.environ))
    said = []
    for line in node.stderr:
        said.append(line)
        if "us_sim.standalone" in line:  # comes after it
            node.send_signal(signal.SIGINT)
            break
    said += node.communicate(timeout=60)[1].splitlines()
    assert node.returncode == 130
    assert [line for line in said if not line.startswith("import time:")] == []
