"""The written agent does its task over topics: images of the graph in, velocities of an arm out."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from bench import Bench
from geometry_msgs.msg import TwistStamped, WrenchStamped
from sensor_msgs.msg import Image

from us_sim.environment.agents import VisualServo
from us_sim.nodes.probe_robot import ProbeRobot
from us_sim.recording.decoding import pixels_from
from us_sim.slicing.settings import WALLS_TOUCH

SCENE = "name: live\nbased_on: upper_arm_learning\ntissue: {solver: fem}\n"
VEIN = 6
SPEED = 0.03  # m/s at an action of 1, as in an episode
LIMIT_S = 240.0


@pytest.fixture
def graph(tmp_path):
    """A running scene that waits for poses."""
    (tmp_path / "live.yaml").write_text(SCENE)
    with (tmp_path / "log").open("w") as log:
        command = [sys.executable, "-m", "us_sim", "run", str(tmp_path / "live.yaml")]
        process = subprocess.Popen(command, cwd=tmp_path, stdout=log, stderr=subprocess.STDOUT)
    yield tmp_path / "log"
    process.send_signal(signal.SIGINT)
    process.wait(timeout=30)


def test_the_vein_is_closed_and_let_go_by_images_over_topics(graph):
    agent, bench = VisualServo(), Bench()
    areas, forces = [], [0.0]  # truths, for the judge alone
    try:
        bench.make(ProbeRobot, rate=30.0, speed=SPEED, lift=0.004, aside=0.02, press=0.016)
        twists = bench.peer.create_publisher(TwistStamped, "robot/twist", 1)

        def see(image):
            message = TwistStamped()
            message.header.frame_id = "probe"
            action = SPEED * agent.act({"image": pixels_from(image)})
            message.twist.linear.x, message.twist.linear.z = map(float, action[[0, 2]])
            twists.publish(message)

        def measure(labels):
            areas.append(int((np.frombuffer(labels.data, np.uint8) == VEIN).sum()))

        bench.peer.create_subscription(Image, "ultrasound/image", see, 1)
        bench.peer.create_subscription(Image, "ultrasound/labels", measure, 1)
        bench.peer.create_subscription(
            WrenchStamped, "probe/wrench", lambda m: forces.append(-m.wrench.force.z), 1
        )
        end = time.monotonic() + LIMIT_S
        open_area = 0
        while not (agent.phase == "release" and forces[-1] < 1.0 and areas[-1] > 0.5 * open_area):
            assert time.monotonic() < end, (agent.phase, areas[-3:], forces[-1], graph.read_text())
            bench.executor.spin_once(timeout_sec=0.05)
            if agent.phase == "centre":
                open_area = areas[-1] if areas else 0
    finally:
        bench.close()
    assert open_area > 0
    assert min(areas) <= WALLS_TOUCH * open_area
