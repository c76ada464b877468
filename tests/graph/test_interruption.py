"""Ctrl-C at any moment: every process ends by itself, and the recording can be read."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command import us_sim

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag

IMAGES = "/ultrasound/image"


def processes_in(folder: Path) -> list[int]:
    """Processes whose working directory that is."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if (process / "cwd").samefile(folder):
                found.append(int(process.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/cwd").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("images", [0, 20])
def test_ctrl_c(played_scene, tmp_path, images):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "us_sim", "demo", str(played_scene), "--out", str(out)]
    command += ["--param", "path_player.loop=true"]
    recording = out / "session.mcap"
    demo = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 100
        while message_count(recording, IMAGES) < images:
            assert demo.poll() is None, demo.stderr.read().decode()
            assert time.monotonic() < deadline
            time.sleep(0.02)  # what runs needs this core
        demo.send_signal(signal.SIGINT)
        demo.wait(10)
        deadline = time.monotonic() + 2
        while processes_in(tmp_path):  # what forked the nodes ends by itself
            assert time.monotonic() < deadline
    finally:
        demo.kill()
    assert demo.returncode == 130
    assert b"Traceback" not in demo.stderr.read()
    assert message_count(recording, IMAGES) >= images
    assert not recording.exists() or not read_bag(recording).fault  # no node was killed


@pytest.mark.parametrize("seconds", [0.7, 1.2, 1.7, 2.2, 2.7])
def test_ctrl_c_of_a_terminal_while_nodes_are_started(tmp_path, seconds):
    command = [sys.executable, "-m", "us_sim", "run", "upper_arm"]
    run = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, start_new_session=True)
    time.sleep(seconds)
    os.killpg(run.pid, signal.SIGINT)
    said = run.communicate(timeout=10)[1]
    assert (run.returncode, b"Traceback" in said) == (130, False), said.decode()


def test_more_than_one_ctrl_c_does_not_break_off_the_end(tmp_path):
    recording = tmp_path / "session.mcap"
    command = [sys.executable, "-m", "us_sim.nodes.session_recorder", "--ros-args"]
    command += ["-p", f"file:={recording}"]
    node = subprocess.Popen(command, stderr=subprocess.PIPE)
    try:
        deadline = time.monotonic() + 30
        while message_count(recording, "/diagnostics") < 1:
            assert node.poll() is None, node.stderr.read().decode()
            assert time.monotonic() < deadline
            time.sleep(0.02)  # what runs needs this core
        while node.poll() is None:
            assert time.monotonic() < deadline
            node.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                node.wait(0.003)
    finally:
        node.kill()
    assert node.returncode == 0
    assert b"Traceback" not in node.stderr.read()
    assert (tmp_path / "metadata.yaml").is_file()


def message_count(recording: Path, topic: str) -> int:
    """Messages of a topic in the recording so far; -1 while it has no header yet."""
    try:
        bag = read_bag(recording)
    except BagError:
        return -1
    return {topic.name: topic.message_count for topic in bag.topics}.get(topic, 0)


def test_a_run_ends_after_its_duration_with_its_summary(played_scene, tmp_path):
    recording = tmp_path / "session.mcap"
    result = us_sim("run", played_scene, "--record", recording, "--duration", 2)
    assert (result.returncode, result.stdout) == (0, f"recorded to {recording}\n"), result.stderr
    assert "Traceback" not in result.stderr
    assert read_bag(recording).find_topic("/diagnostics").message_count > 0
