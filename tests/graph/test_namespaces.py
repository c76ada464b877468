"""Two simulators in one graph, in namespaces of their own."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from command import us_sim

from us_sim.recording.path import read_path, write_path
from us_sim.recording.reader import read_bag

RIGHT = 0.005
"""m, how far the probe of the right one is away from that of the left one."""


def test_two_simulators_in_one_graph_share_nothing(small_scene, short_path, tmp_path):
    path = read_path(short_path)
    moved = tmp_path / "path" / "moved.mcap"
    write_path(moved, replace(path, positions=path.positions + np.array([RIGHT, 0.0, 0.0])))
    started = {}
    for space, played in (("left", short_path), ("right", moved)):
        command = [sys.executable, "-m", "us_sim", "run", small_scene, "--path", played]
        command += ["--record", tmp_path / f"{space}.mcap", "--ros-args", "-r", f"__ns:=/{space}"]
        if space == "right":
            command += ["-r", "ultrasound/image:=scanner/image"]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        started[space] = subprocess.Popen([*map(str, command)], **pipes)
    said = {space: process.communicate(timeout=150)[0] for space, process in started.items()}
    for space, process in started.items():
        assert process.returncode == 0, said[space]
        bag = read_bag(tmp_path / f"{space}.mcap")
        topics = {topic.name: topic.message_count for topic in bag.topics}
        assert all(name.startswith(f"/{space}/") for name in topics), topics
        image = "scanner/image" if space == "right" else "ultrasound/image"
        assert topics[f"/{space}/{image}"] > 10
        poses = [bag.deserialize(each) for each in bag.read_messages([f"/{space}/probe/pose"])]
        assert {round(p.pose.position.x, 6) for p in poses} == {RIGHT if space == "right" else 0.0}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["-r", "__node:=one"], "__node:=one: would give all nodes one name"),
        (["-r", "__ns:=left"], "ROS cannot be used: "),
    ],
)
def test_ros_arguments_that_cannot_be_are_one_sentence(small_scene, arguments, sentence):
    result = us_sim("run", small_scene, "--ros-args", *arguments)
    assert result.returncode == 1
    assert sentence in result.stderr
    assert "Traceback" not in result.stderr
