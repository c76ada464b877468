"""Nodes given what they cannot use: one sentence, status 1, no traceback."""

import gc
import importlib
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
from rclpy.signals import uninstall_signal_handlers


@pytest.fixture
def _own_end() -> Iterator[None]:
    """Undo the changes that a node makes to signals, and remove what is left of it from ROS."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    kept = [signal.getsignal(number) for number in numbers]
    yield
    uninstall_signal_handlers()
    for number, handler in zip(numbers, kept, strict=True):
        signal.signal(number, handler)
    gc.collect()


@pytest.mark.parametrize(
    ("node", "arguments", "words"),
    [
        (
            "slice_interpolator",
            ["-p", "scene:=liver_sweep", "-p", "volume:=BROKEN"],
            "broken.mha",
        ),
        ("tissue_deformer", ["-p", "lockstep:=5"], "lockstep"),
        (
            "slice_interpolator",
            ["-p", "threads:=0"],
            "threads out of range. Min: 1, Max: 256",
        ),
        ("path_player", ["-p", "path:=nowhere.mcap"], "nowhere.mcap"),
        ("path_player", ["-p", "rate:=1.0"], "parameter `path` is missing; name a bag to play"),
        ("session_recorder", ["-p", "file:=/proc/nowhere/x.mcap"], "/proc/nowhere"),
    ],
)
@pytest.mark.usefixtures("_own_end")
def test_a_node_refuses_in_one_sentence(node, arguments, words, tmp_path, capfd):
    volume = tmp_path / "broken.mha"
    volume.write_bytes(b"ObjectType = Image\nNDims = 3\n")
    arguments = [argument.replace("BROKEN", str(volume)) for argument in arguments]
    module = importlib.import_module(f"us_sim.nodes.{node}")
    assert module.main([node, "--ros-args", *arguments]) == 1
    assert_one_sentence(capfd.readouterr().err, words)


@pytest.mark.parametrize(
    ("node", "arguments", "words"),
    [
        ("probe_tracker", ["-r", "no remapping"], "no remapping"),
        ("tissue_deformer", ["-p", "compare_with:=magic"], "magic"),
    ],
)
def test_so_does_its_process(node, arguments, words):
    result = subprocess.run(
        [sys.executable, "-m", f"us_sim.nodes.{node}", "--ros-args", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 1, result.stderr
    assert_one_sentence(result.stderr, words)


@pytest.mark.parametrize("command", ["us_sim.nodes.probe_tracker", "us_sim run upper_arm"])
@pytest.mark.parametrize("keystore", [False, True])
def test_a_secured_domain_without_keys_is_said(command, keystore, tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
    if keystore:
        monkeypatch.setenv("ROS_SECURITY_KEYSTORE", str(tmp_path))
        for node in ("probe_tracker", "session_control"):
            (tmp_path / "enclaves" / "us_sim" / node).mkdir(parents=True)
    result = subprocess.run(
        [sys.executable, "-m", *command.split()],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 1
    assert_one_sentence(result.stderr.replace("us-sim", "us_sim"), "ROS_SECURITY_KEYSTORE")


def assert_one_sentence(stderr, words):
    """No traceback, and those words in the one sentence that there is."""
    said = [line for line in stderr.splitlines() if line.startswith("us_sim: ")]
    assert len(said) == 1, stderr
    assert words in said[0]
    assert "Traceback" not in stderr
